//! Fill values, and bytes that use a small part of their range.

use crate::support::{byte_nrrd, entire, float_nrrd, picture, render, report, stderr, succeeds, words};
use entire_io::volume::{Fill, Range, Reading, Volume, VolumeData};
use std::io::Read;
use std::path::Path;

fn open(path: &Path, fill: Fill) -> Volume {
    Volume::open_as(path, &Reading { fill, ..Reading::default() }, None).unwrap()
}

fn ends(values: impl Iterator<Item = f32>) -> (f32, f32) {
    values.fold((f32::MAX, f32::MIN), |(lo, hi), v| (lo.min(v), hi.max(v)))
}

/// In each file, 1920 of 7680 voxels have a fill value. The range must be that of the other voxels, as pynrrd
/// reads them.
#[test]
fn fill_values_do_not_decide_the_range() {
    let fields = ["minus-9999", "netcdf", "minus-flt-max", "1e20"];
    let values = [-9999.0, 9.969_21e36, f32::MIN, 1e20];
    for (name, fill) in fields.into_iter().zip(values) {
        let path = report(&format!("fill-{name}.nrrd"));
        let volume = open(&path, Fill::Found);
        assert_eq!(volume.view().range(), (0.000_101_613_06, 1.0), "{name}");
        let note = &volume.notes()[0];
        assert!(
            note.contains("1920 of 7680 voxels (25.0 %)") && note.contains("--fill none"),
            "{name}: {note}"
        );
        // Filled voxels are replaced, so that no interpolated sample lies beyond the range.
        assert_eq!(ends(volume.data().scalars().iter()), (0.000_101_613_06, 1.0), "{name}");
        let kept = open(&path, Fill::None);
        let range = kept.view().range();
        assert_eq!(range, (fill.min(0.000_101_613_06), fill.max(1.0)), "{name}");
        assert!(kept.notes().is_empty(), "{:?}", kept.notes());
        let named = open(&path, Fill::Values(vec![fill]));
        assert_eq!((named.data(), named.notes().len()), (volume.data(), 0), "{name}");
    }
    let ct = open(&report("fill-ct.nrrd"), Fill::Found);
    assert_eq!((ct.view().range(), ct.notes().len()), ((-999.0, 4000.0), 1));
    let none = open(&report("fill-none.nrrd"), Fill::Found);
    assert_eq!((none.view().range(), none.notes().len()), ((0.000_010_420_832, 1.0), 0));
    let nan = open(&report("fill-nan.nrrd"), Fill::Found);
    assert_eq!(nan.view().range(), (0.000_101_613_06, 1.0));
    assert!(nan.notes()[0].contains("1920 of 7680 voxels are NaN or infinite"), "{:?}", nan.notes());
}

/// The voxels that replace fill values are not taken for fill values themselves, whatever their number. Only
/// bytes get the note on a narrow range.
#[test]
fn hidden_fill_values_are_not_looked_for_again() {
    let folder = tempfile::tempdir().unwrap();
    let value = |i: usize| match i {
        0 => 0.0,
        i if i.is_multiple_of(4) => -9999.0,
        i => 0.5 + (i % 1999) as f32 / 4000.0,
    };
    let path = folder.path().join("v.nrrd");
    std::fs::write(&path, float_nrrd([16, 16, 16], (0..4096).map(value))).unwrap();
    let volume = open(&path, Fill::Found);
    assert_eq!((volume.view().range().0, volume.notes().len()), (0.0, 1), "{:?}", volume.notes());
    let kept = open(&path, Fill::None);
    assert_eq!((kept.view().range().0, kept.notes().len()), (-9999.0, 0), "{:?}", kept.notes());
}

/// A volume with a fill value is drawn like a volume with the low end in place of this value, whether the
/// value is a minimum or a maximum.
#[test]
fn fill_values_are_drawn_as_the_low_end() {
    let folder = tempfile::tempdir().unwrap();
    let value = |i: usize, fill: f32| if i.is_multiple_of(5) { fill } else { 0.1 + (i % 97) as f32 / 100.0 };
    let mut pictures = Vec::new();
    for (name, fill) in [("low", 0.1), ("minus", -9999.0), ("plus", 1e20)] {
        let file = format!("{name}.nrrd");
        let bytes = float_nrrd([16, 16, 16], (0..4096).map(|i| value(i, fill)));
        std::fs::write(folder.path().join(&file), bytes).unwrap();
        let output = entire(folder.path(), &render(&file, "10,20,2.5", "0.9,0.05,0.7", "32x32", &[]));
        assert!(output.status.success(), "{}", stderr(&output));
        assert_eq!(stderr(&output).contains("taken as a fill value"), name != "low", "{}", stderr(&output));
        pictures.push(picture(&folder.path().join("out.png")));
    }
    assert!(pictures[0].2.iter().any(|&v| v > 0), "the picture is black");
    assert!(pictures[0] == pictures[1] && pictures[0] == pictures[2], "fill values show");
}

/// Bytes of 3 to 17 are black where 0 to 255 maps to [0, 1], and a note says so; with their own range they
/// are visible.
#[test]
fn bytes_of_a_narrow_range_are_said_and_can_be_spanned() {
    let folder = tempfile::tempdir().unwrap();
    let bytes: Vec<u8> = (0..4096u32).map(|i| 3 + (i % 15) as u8).collect();
    std::fs::write(folder.path().join("dim.nrrd"), byte_nrrd([16; 3], bytes.iter().copied())).unwrap();
    let drawn = |more: &[&str]| {
        let arguments = render("dim.nrrd", "10,20,2.5", "0.8,0.02,0.7", "32x32", more);
        let output = entire(folder.path(), &arguments);
        assert!(output.status.success(), "{}", stderr(&output));
        let lit = picture(&folder.path().join("out.png")).2.iter().any(|&v| v > 0);
        (lit, stderr(&output))
    };
    let (lit, said) = drawn(&[]);
    assert!(!lit && said.contains("its bytes hold 3 to 17") && said.contains("--range data"), "{lit} {said}");
    let (lit, said) = drawn(&["--range", "data"]);
    assert!(lit && !said.contains("note"), "{lit} {said}");
    assert_eq!(drawn(&["--range", "3,17"]), (true, String::new()));
    let reading = Reading { range: Range::Data, ..Reading::default() };
    let volume = Volume::open_as(folder.path().join("dim.nrrd"), &reading, None).unwrap();
    assert_eq!((volume.view().range(), volume.data()), ((3.0, 17.0), &VolumeData::U8(bytes)));
    // If all bytes are equal, no note recommends `--range data`.
    let same = byte_nrrd([16; 3], std::iter::repeat_n(204, 4096));
    std::fs::write(folder.path().join("dim.nrrd"), same).unwrap();
    assert_eq!(drawn(&[]), (true, String::new()));
}

/// Checks that a table stores the options by which its volumes were read: `entire features` reads the volumes
/// with these options.
#[test]
fn tables_keep_how_volumes_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let value = |i: usize| if i.is_multiple_of(5) { -9999.0 } else { 0.1 + (i % 97) as f32 / 100.0 };
    let bytes = float_nrrd([16, 16, 16], (0..4096).map(value));
    std::fs::write(folder.path().join("v.nrrd"), bytes).unwrap();
    let collect = |out: &str, more: &str| {
        let common = "collect v.nrrd --device cpu --frames 2 --repeats 1 --max-size 32";
        entire(folder.path(), &words(&format!("{common} --out {out} {more}")))
    };
    for (out, more) in [("found.csv", ""), ("kept.csv", "--fill none"), ("low.csv", "--fill -9999")] {
        let output = collect(out, more);
        assert!(output.status.success(), "{}", stderr(&output));
        succeeds(folder.path(), &["features", "--data", out, "--quiet"]);
    }
    let features = |name: &str| {
        let packed = std::fs::File::open(folder.path().join(format!("{name}.features.csv.gz"))).unwrap();
        let mut text = String::new();
        flate2::read::GzDecoder::new(packed).read_to_string(&mut text).unwrap();
        // The first line names the table.
        text.split_once('\n').unwrap().1.to_owned()
    };
    assert_eq!(features("found"), features("low"));
    assert_ne!(features("found"), features("kept"));
    let output = collect("kept.csv", "--resume");
    let text = stderr(&output);
    assert!(!output.status.success() && text.contains("reading was"), "{text}");
}
