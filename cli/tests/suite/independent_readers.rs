//! Compares every file of fixtures/volumes and fixtures/reports, as it is read, with the values of
//! independent readers in fixtures/right-values.csv. `lab/scripts/readers/differential.py --write` makes this
//! table with pynrrd, SimpleITK, nibabel and VTK.

use entire_io::volume::{Fill, Reading, Volume, VolumeData};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

fn fixtures() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures")
}

/// Paths from the folder of fixtures, with `/` on every system.
fn files(folder: &str, found: &mut BTreeSet<String>) {
    for entry in std::fs::read_dir(fixtures().join(folder)).unwrap() {
        let name = format!("{folder}/{}", entry.unwrap().file_name().to_str().unwrap());
        if fixtures().join(&name).is_dir() {
            files(&name, found);
        } else {
            found.insert(name);
        }
    }
}

#[derive(Clone, Debug, serde::Deserialize)]
struct Row {
    file: String,
    readers: String,
    dims: String,
    #[serde(rename = "type")]
    kind: String,
    spacing: String,
    min: Option<f32>,
    max: Option<f32>,
    crc32: String,
    refusal: String,
}

fn table() -> BTreeMap<String, Row> {
    let mut rows = BTreeMap::new();
    let mut csv = csv::Reader::from_path(fixtures().join("right-values.csv")).unwrap();
    assert_eq!(
        csv.headers().unwrap().iter().collect::<Vec<_>>(),
        ["file", "readers", "dims", "type", "spacing", "min", "max", "crc32", "refusal"]
    );
    for row in csv.deserialize() {
        let row: Row = row.unwrap();
        let name = row.file.clone();
        assert!(rows.insert(row.file.clone(), row).is_none(), "{name} has two rows");
    }
    rows
}

/// The type in memory, and the voxels' bytes, little-endian, with every NaN in one form.
fn stored(data: &VolumeData) -> (&'static str, Vec<u8>) {
    let plain = |v: &f32| if v.is_nan() { f32::from_bits(0x7fc0_0000) } else { *v };
    match data {
        VolumeData::U8(v) => ("uint8", v.clone()),
        VolumeData::U16(v) => ("uint16", v.iter().flat_map(|v| v.to_le_bytes()).collect()),
        VolumeData::I16(v) => ("int16", v.iter().flat_map(|v| v.to_le_bytes()).collect()),
        VolumeData::F32(v) => ("float32", v.iter().flat_map(|v| plain(v).to_le_bytes()).collect()),
    }
}

/// Files in which default reading finds fill values and replaces them.
const FILES_WITH_FILL: [&str; 5] = [
    "reports/fill-1e20.nrrd",
    "reports/fill-ct.nrrd",
    "reports/fill-minus-9999.nrrd",
    "reports/fill-minus-flt-max.nrrd",
    "reports/fill-netcdf.nrrd",
];

/// Returns the difference between a file as it is read and its row; `None` if they agree. Also compares the
/// voxels of default reading, which replaces fill values in [`FILES_WITH_FILL`] alone.
fn difference(name: &str, row: &Row) -> Option<String> {
    let stored_values = Reading { fill: Fill::None, ..Reading::default() };
    let volume = match Volume::open_as(fixtures().join(name), &stored_values, None) {
        Ok(volume) => volume,
        Err(error) => {
            let message = format!("{error:#}").replace('\\', "/");
            let told = !row.refusal.is_empty() && message.contains(&row.refusal);
            return (!told).then(|| format!("refused: {message}; the table has {row:?}"));
        }
    };
    if !row.refusal.is_empty() {
        return Some(format!("read, the table has {:?}", row.refusal));
    }
    let (kind, bytes) = stored(volume.data());
    let mut range: Option<(f32, f32)> = None;
    for value in volume.data().scalars().iter().filter(|v| v.is_finite()) {
        let (low, high) = range.unwrap_or((value, value));
        range = Some((low.min(value), high.max(value)));
    }
    let spacing: Vec<f32> = row.spacing.split(' ').map(|s| s.parse().unwrap()).collect();
    let same = volume.dims().map(|n| n.to_string()).join(" ") == row.dims
        && kind == row.kind
        && volume.spacing() == spacing[..]
        && range == row.min.zip(row.max)
        && format!("{:08x}", crc32fast::hash(&bytes)) == row.crc32;
    if !same {
        let (dims, spacing, crc32) = (volume.dims(), volume.spacing(), crc32fast::hash(&bytes));
        return Some(format!("{dims:?} {kind} {spacing:?} {range:?} {crc32:08x}; the table has {row:?}"));
    }
    match Volume::open(fixtures().join(name)) {
        Ok(usual) => {
            let like_stored = stored(usual.data()) == (kind, bytes)
                && (usual.dims(), usual.spacing()) == (volume.dims(), volume.spacing());
            (like_stored == FILES_WITH_FILL.contains(&name)).then(|| {
                format!("default reading: like the stored values: {like_stored}; {:?}", usual.notes())
            })
        }
        Err(error) => Some(format!("default reading refuses it: {error:#}")),
    }
}

#[test]
fn every_fixture_is_read_as_independent_readers_read_it() {
    let table = table();
    let mut found = BTreeSet::new();
    for folder in ["volumes", "reports"] {
        files(folder, &mut found);
    }
    let without: Vec<_> = found.iter().filter(|name| !table.contains_key(*name)).collect();
    assert!(without.is_empty(), "no row in right-values.csv for {without:?}: differential.py --write");
    let gone: Vec<_> = table.keys().filter(|name| !found.contains(*name)).collect();
    assert!(gone.is_empty(), "right-values.csv has rows without a file: {gone:?}");
    let wrong: Vec<String> = table
        .iter()
        .filter_map(|(name, row)| difference(name, row).map(|told| format!("{name}: {told}")))
        .collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    // At least 180 rows must have values of independent readers, not refusals or values of the command's own
    // readers.
    let own = |row: &Row| ["none", "ours"].contains(&row.readers.as_str());
    let independent = table.values().filter(|row| !own(row) && row.refusal.is_empty()).count();
    assert!(independent >= 180, "{independent} files have values of independent readers");
}

#[test]
fn a_value_that_differs_is_found() {
    let table = table();
    let name = "reports/nii-slope-negative.nii";
    let right = &table[name];
    assert_eq!(difference(name, right), None);
    let wrong = |change: &dyn Fn(&mut Row)| {
        let mut row = right.clone();
        change(&mut row);
        difference(name, &row)
    };
    let changes: [&dyn Fn(&mut Row); 6] = [
        &|row| row.dims = "10 12 8".to_owned(),
        &|row| row.kind = "int16".to_owned(),
        &|row| row.spacing = "1 1.5001 2".to_owned(),
        &|row| row.min = None,
        &|row| row.crc32 = "00000000".to_owned(),
        &|row| row.refusal = "gone".to_owned(),
    ];
    for (at, change) in changes.into_iter().enumerate() {
        assert!(wrong(change).is_some(), "change {at}");
    }
    let refused = "reports/behind-second.mha";
    assert_eq!(difference(refused, &table[refused]), None);
    let other = Row { refusal: "another reason".to_owned(), ..table[refused].clone() };
    assert!(difference(refused, &other).is_some());
}
