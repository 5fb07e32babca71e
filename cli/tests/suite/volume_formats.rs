//! Tests every reader with files of other libraries (see fixtures/make_volumes.py) and with broken files.
//! `independent_readers` compares size, spacing and voxels of every file in fixtures/; these tests cover what
//! its table does not state.

use crate::support::{fixture, report, words};
use entire_io::volume::{Reading, Volume, VolumeData};
use std::path::Path;

#[test]
fn slopes_names_and_descriptions_are_used() {
    assert_eq!(Volume::open(fixture("scaled.nii")).unwrap().name(), "scaled");
    let unknown = reported("nii-pixdim-nan.nii");
    assert_eq!(unknown.notes().len(), 1, "{:?}", unknown.notes());
    assert!(unknown.notes()[0].contains("pixdim[3] is NaN"), "{:?}", unknown.notes());
    for name in ["raw_5x7x11_int16_big.raw", "scivis.json", "scivis_5x7x11_uint8.raw"] {
        assert_eq!(Volume::open(fixture(name)).unwrap().name(), "Made up", "{name}");
    }
}

#[test]
fn raw_voxels_without_a_description_go_by_their_name() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("skull_5x7x11_uint8.raw");
    std::fs::copy(fixture("scivis_5x7x11_uint8.raw"), &path).unwrap();
    let volume = Volume::open(&path).unwrap();
    assert_eq!((volume.name(), volume.spacing(), volume.dims()), ("skull", [1.0; 3], [5, 7, 11]));
    std::fs::rename(&path, folder.path().join("skull.raw")).unwrap();
    told(Volume::open(folder.path().join("skull.raw")), &["skull.json", "\"size\""]);
}

#[test]
fn a_description_finds_the_voxels_of_its_size_and_type() {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("a.json");
    std::fs::write(&json, r#"{"size": [2, 2, 2], "type": "uint8"}"#).unwrap();
    // In the order of their names, these files come before the right one.
    for (name, bytes) in [("a_2x2x20_uint8.raw", 80), ("a_2x2x2_int16.raw", 12), ("a_2x2x2_float32.raw", 32)]
    {
        std::fs::write(folder.path().join(name), vec![1; bytes]).unwrap();
    }
    told(Volume::open(&json), &["no voxels beside the description"]);
    std::fs::write(folder.path().join("a_2x2x2_uint8.raw"), [7; 8]).unwrap();
    assert_eq!(Volume::open(&json).unwrap().data(), &VolumeData::U8(vec![7; 8]));
}

#[test]
fn formats_are_found_by_their_first_bytes_where_the_ending_says_nothing() {
    let folder = tempfile::tempdir().unwrap();
    for name in words(
        "pynrrd_raw_uint8_little.nrrd itk_local_uint8_little.mha nibabel_one_int16_big.nii \
         nibabel_two_int16_big.nii nibabel_gz_int16_little.nii.gz vtk_raw_float64_big.vti",
    ) {
        let path = folder.path().join("noending");
        std::fs::copy(fixture(name), &path).unwrap();
        let named = Volume::open(fixture(name)).unwrap();
        assert_eq!(Volume::open(&path).unwrap().data(), named.data(), "{name}");
    }
    let path = folder.path().join("noending");
    std::fs::write(&path, b"hello").unwrap();
    told(Volume::open(&path), &["accepted are .nrrd, .nhdr, .mhd"]);
}

/// Checks that a volume is refused, and that the message has every one of `parts`.
#[track_caller]
fn told(opened: anyhow::Result<Volume>, parts: &[&str]) {
    let message = format!("{:#}", opened.unwrap_err());
    for part in parts {
        assert!(message.contains(part), "{message:?} should contain {part:?}");
    }
}

/// Opens bytes under a file name; returns the error's message.
fn refused(name: &str, bytes: &[u8]) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    let message = format!("{:#}", Volume::open(&path).expect_err(name));
    assert!(message.contains(name), "{message:?} should name the file");
    assert!(!message.contains('\n'), "{message:?}");
    message
}

fn opened(name: &str, bytes: impl AsRef<[u8]>) -> Volume {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    Volume::open(&path).unwrap_or_else(|error| panic!("{error:#}"))
}

fn check(name: &str, bytes: &[u8], expected: &str) {
    let message = refused(name, bytes);
    assert!(message.contains(expected), "{name}: {message:?} should contain {expected:?}");
}

#[test]
fn missing_files_and_folders_are_refused() {
    let message = format!("{:#}", Volume::open("no/such.nrrd").unwrap_err());
    assert_eq!(message, "no/such.nrrd: no such file; check the path");
    told(Volume::open(fixture("")), &["is a folder"]);
}

/// Opens a file that must be refused and returns the message. The file is opened in a separate thread, so
/// that the test fails if a reader waits for ever.
#[cfg(unix)]
fn refused_at_once(path: &Path) -> String {
    let (send, receive) = std::sync::mpsc::channel();
    let owned = path.to_owned();
    std::thread::spawn(move || {
        send.send(Volume::open(&owned).map(|_| ()).map_err(|error| format!("{error:#}")))
    });
    let answer = receive.recv_timeout(std::time::Duration::from_secs(60));
    answer.unwrap_or_else(|_| panic!("{} is read for ever", path.display())).expect_err("not a volume")
}

#[cfg(unix)]
#[test]
fn what_is_no_regular_file_is_refused_and_never_waited_for() {
    let folder = tempfile::tempdir().unwrap();
    let fifo = folder.path().join("pipe");
    assert!(std::process::Command::new("mkfifo").arg(&fifo).status().unwrap().success());
    let socket = folder.path().join("socket");
    let _listener = std::os::unix::net::UnixListener::bind(&socket).unwrap();
    for (path, kind) in
        [(fifo.as_path(), "a FIFO"), (&socket, "a socket"), (Path::new("/dev/zero"), "a device")]
    {
        // The file is opened under its own name, under the ending of every format, and as the voxels that a
        // header names.
        for ending in ["", ".nrrd", ".mha", ".vti", ".nii.gz", ".json", ".raw"] {
            let link = folder.path().join(format!("link{ending}"));
            std::os::unix::fs::symlink(path, &link).unwrap();
            let message = refused_at_once(&link);
            assert!(message.contains(kind) && message.contains("save its content to a file"), "{message}");
            std::fs::remove_file(&link).unwrap();
        }
        let voxels = folder.path().join("voxels");
        std::os::unix::fs::symlink(path, &voxels).unwrap();
        let header = folder.path().join("a.mhd");
        let text = "NDims = 3\nDimSize = 2 2 2\nElementType = MET_CHAR\nElementDataFile = voxels\n";
        std::fs::write(&header, text).unwrap();
        let message = refused_at_once(&header);
        assert!(message.contains(kind) && message.contains("a.mhd"), "{message}");
        let header = folder.path().join("a.nhdr");
        let text = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 2 2 2\nencoding: raw\ndata file: voxels\n\n";
        std::fs::write(&header, text).unwrap();
        let message = refused_at_once(&header);
        assert!(message.contains(kind) && message.contains("a.nhdr"), "{message}");
        let header = folder.path().join("a.json");
        let text = r#"{"size": [2, 2, 2], "type": "uint8", "file": "voxels"}"#;
        std::fs::write(&header, text).unwrap();
        assert!(refused_at_once(&header).contains("no voxels beside the description"));
        std::fs::remove_file(&voxels).unwrap();
    }
}

#[test]
fn headers_name_data_files_relative_to_themselves() {
    let folder = tempfile::tempdir().unwrap();
    let voxels = folder.path().join("v.raw");
    std::fs::write(&voxels, [7u8; 8]).unwrap();
    std::fs::create_dir(folder.path().join("headers")).unwrap();
    let nrrd = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 2 2 2\nencoding: raw\ndata file: ";
    let list = format!("{nrrd}LIST 3\n");
    let mhd = "NDims = 3\nDimSize = 2 2 2\nElementType = MET_UCHAR\nElementDataFile = ";
    let json = "{\"size\": [2, 2, 2], \"type\": \"uint8\", \"file\": \"";
    let absolute = "by an absolute path; put the file beside the header";
    for (name, start, end, expected) in [
        ("a.nhdr", nrrd, "\n\n", absolute),
        ("list.nhdr", list.as_str(), "\n", absolute),
        ("a.mhd", mhd, "\n", absolute),
        ("a.json", json, "\"}", "relative to the description"),
    ] {
        let header = folder.path().join("headers").join(name);
        std::fs::write(&header, format!("{start}{}{end}", voxels.display())).unwrap();
        told(Volume::open(&header), &[name, "v.raw", expected]);
        std::fs::write(&header, format!("{start}../v.raw{end}")).unwrap();
        assert_eq!(Volume::open(&header).unwrap().data(), &VolumeData::U8(vec![7; 8]), "{name}");
    }
}

#[test]
fn truncated_files_say_what_is_missing() {
    for name in words(
        "pynrrd_raw_float64_big.nrrd itk_local_float32_little.mha itk_zlib_int16_little.mha \
         itk_text_int16_little.mha nibabel_one_int16_big.nii nibabel_gz_int16_little.nii.gz \
         vtk_ascii_int16_little.vti vtk_binary_int16_little.vti vtk_binary-zlib_int16_little.vti \
         vtk_raw_float64_big.vti vtk_raw-zlib-wide_int16_little.vti vtk_base64-zlib_int16_little.vti \
         pynrrd_gzip_int16_little.nrrd",
    ) {
        let whole = std::fs::read(fixture(name)).unwrap();
        // The file is cut within the voxels or within the header; reading must fail without a panic.
        for keep in [whole.len() * 3 / 5, whole.len() / 2, 100, 10, 0] {
            let message = refused(name, &whole[..keep]);
            assert!(message.len() > name.len() + 20, "{name} cut to {keep}: {message}");
        }
    }
}

#[test]
fn lying_headers_do_not_allocate() {
    let mha = |sizes: &str, more: &str| {
        format!(
            "ObjectType = Image\nNDims = 3\n{more}DimSize = {sizes}\nElementType = \
             MET_SHORT\nElementDataFile = LOCAL\n"
        )
    };
    let (hundred, packed) = ("x".repeat(100), "CompressedData = True\n");
    let inside = "HeaderSize is 50, but the header alone has 109 bytes";
    for (sizes, more, data, expected) in [
        ("10000 10000 10000", "", &hundred[..], "need 2000000000000 bytes, but the file has 100"),
        ("10000 10000 10000", packed, &hundred, "can hold 103200 at most"),
        ("4294967296 4294967296 4294967296", "", &hundred, "more than can be addressed"),
        ("5 0 5", "", "", "size along y is 0"),
        ("5 5 5", "ElementSpacing = 1 nan 1\n", "", "need 250 bytes"),
        ("5 5 2", "ElementSpacing = 1 nan 1\n", &hundred, "finite and positive"),
        ("5 5 2", "ElementNumberOfChannels = 3\n", &hundred, "Channels is 3"),
        ("5 5", "", "", "DimSize has 2 entries"),
        ("5 5 2", "HeaderSize = 1000\n", "", "bytes, but only 0 are left"),
        ("5 5 2", "HeaderSize = 50\n", "", inside),
    ] {
        check("a.mha", (mha(sizes, more) + data).as_bytes(), expected);
    }
    check("a.mha", b"ObjectType = Scene\n", "ObjectType is \"Scene\"");
    check("a.mha", b"ObjectType = Image\n", "without ElementDataFile");
    check("a.mha", b"ElementDataFile = a%03d.raw 1 5\n", "no pattern of file names");
    check(
        "a.mha",
        b"NDims = 3\nDimSize = 2 2 4\nElementType = MET_CHAR\nElementDataFile = a%03d.raw 1 5 1\n",
        "over 4 files of 2 axes each, but 5 are named",
    );
    check(
        "a.mhd",
        b"NDims = 3\nDimSize = 2 2 2\nElementType = MET_CHAR\nElementDataFile = gone.raw\n",
        "gone.raw",
    );

    let mut nii = std::fs::read(fixture("nibabel_one_int16_little.nii")).unwrap();
    let mut patched = |at: usize, bytes: &[u8], expected: &str| {
        let before = nii.clone();
        nii[at..at + bytes.len()].copy_from_slice(bytes);
        check("a.nii", &nii, expected);
        nii = before;
    };
    patched(42, &[0x10, 0x27, 0x10, 0x27, 0x10, 0x27], "need 2000000000000 bytes, but the file has 770");
    patched(42, &[0, 0], "size along x is 0");
    patched(42, &[0xff, 0xff], "dim[1] is -1");
    patched(40, &[4, 0, 5, 0, 7, 0, 1, 0, 11, 0], "axis 3 holds 11");
    patched(40, &[9, 0], "dim[0] is 9");
    patched(40, &[2, 0], "the data has 2 axes");
    patched(70, &[128, 0], "several color components");
    patched(70, &[99, 0], "datatype 99");
    patched(108, &1e12f32.to_le_bytes(), "only");
    patched(108, &3f32.to_le_bytes(), "cannot begin before byte 348");
    patched(344, b"ni1\0", "second file");
    patched(344, b"\0\0\0\0", "Analyze");
    patched(0, &[9, 9, 9, 9], "348 or 540");

    let vti = std::fs::read_to_string(fixture("vtk_binary-zlib_int16_little.vti")).unwrap();
    for (from, to, expected) in [
        ("2 6 -3 3 0 10", "0 9999 0 9999 0 9999", "need 2000000000000"),
        ("2 6 -3 3 0 10", "0 9223372036854775807 0 9 0 9", "more than can be addressed"),
        ("2 6 -3 3 0 10", "-9223372036854775808 9223372036854775807 0 9 0 9", "holds no voxel"),
        ("2 6 -3 3 0 10", "2 1 -3 3 0 10", "holds no voxel"),
        ("2 6 -3 3 0 10", "2 0 -3 3 0 10", "holds no voxel"),
        ("0.5 1.25 3", "0.5 nan 3", "finite and positive"),
        ("Scalars=\"density\"", "Scalars=\"gone\"", "\"gone\" is not in the file"),
        ("Scalars=\"density\"", "Scalars=\"velocity\"", "has 3 components"),
        ("vtkZLibDataCompressor", "vtkLZMADataCompressor", "after its SetCompressorTypeToZLib()"),
        ("vtkZLibDataCompressor", "vtkLZ4DataCompressor", "\"density\": compressed block 0 of 4 is damaged"),
        ("ImageData", "PolyData", "only ImageData is accepted"),
        ("LittleEndian", "BigEndian", "array \"density\": the header states"),
        ("Int16", "String", "type \"String\", which is not read"),
        ("</DataArray>", "</DataArrau>", "not well-formed"),
    ] {
        assert!(vti.contains(from), "{from}");
        check("a.vti", vti.replace(from, to).as_bytes(), expected);
    }
    check("a.vti", b"<html></html>", "not a VTK XML file");

    check("a.json", b"{", "not JSON");
    check("a.json", b"[]", "not a JSON object");
    check("a.json", b"{}", "no \"size\"");
    check("a.json", b"{\"size\": [2, 2, 2], \"type\": \"uint8\"}", "looked for a.raw");
    check("a.json", b"{\"size\": [2, 2, -2], \"type\": \"uint8\"}", "accepted is an array of numbers");
    check("a.json", b"{\"size\": [2, 2, 2], \"type\": \"rgb\"}", "type \"rgb\" is not read");
    check("a.json", b"{\"size\": [2, 2, 2], \"type\": \"uint8\", \"spacing\": [1]}", "1 entries");
    check("a_9999x9999x9999_uint8.raw", b"123", "need 999700029999 bytes, but the file has 3");
    check("a_1x1x2_uint8.raw", b"1234", "need 2 bytes, but the data has 4");
}

/// Opens a small file that is modeled on a public bug report of another program that reads volumes.
fn reported(name: &str) -> Volume {
    Volume::open(report(name)).unwrap_or_else(|error| panic!("{error:#}"))
}

#[test]
fn the_active_scalars_are_read_and_arrays_of_vtk_itself_never() {
    assert_eq!(reported("vti-ghost-cells-of-vtk.vti").view().range(), (-999.0, 4000.0));
    for name in words(
        "vti-cells-with-point-ghosts.vti vti-points-ghost-first.vti vti-points-mask-first.vti \
         vti-cells-ghost-first.vti vti-cell-scalars-point-vectors.vti vti-string-first.vti",
    ) {
        let volume = reported(name);
        assert_eq!((volume.view().range(), volume.notes().len()), ((-999.0, 4000.0), 0), "{name}");
    }
}

/// Returns a VTI file of 1 x 1 x 2 cells with the given arrays of points and cells.
fn vti_of(points: &str, cells: &str) -> String {
    format!(
        "<VTKFile type=\"ImageData\"><ImageData WholeExtent=\"0 1 0 1 0 2\"><Piece><PointData {points}\
         </PointData><CellData {cells}</CellData></Piece></ImageData></VTKFile>"
    )
}

#[test]
fn arrays_are_read_by_name_and_chosen_in_the_order_of_the_file() {
    let array =
        |name: &str, values: &str| format!("<DataArray type=\"UInt8\" Name=\"{name}\">{values}</DataArray>");
    let open_array = |path: &Path, array: &str| {
        Volume::open_as(path, &Reading { array: Some(array.to_owned()), ..Reading::default() }, None)
    };
    let points = |name: &str| array(name, "0 1 2 3 4 5 6 7 8 9 10 11");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.vti");
    let cells = |volume: &Volume| volume.dims() == [1, 1, 2];
    let write = |text: String| std::fs::write(&path, text).unwrap();

    write(vti_of(&format!(">{}{}", points("a"), points("vtkGhostType")), &format!(">{}", array("c", "5 6"))));
    let first = Volume::open(&path).unwrap();
    assert!(!cells(&first));
    assert!(first.notes()[0].contains("\"a\" is read, the first of \"a\", \"c\""), "{:?}", first.notes());
    assert_eq!(open_array(&path, "c").unwrap().data(), &VolumeData::U8(vec![5, 6]));
    assert!(!cells(&open_array(&path, "vtkGhostType").unwrap()));
    let message = format!("{:#}", open_array(&path, "b").unwrap_err());
    assert!(
        message.contains("\"b\" is not in the file; the file has \"a\", \"vtkGhostType\", \"c\""),
        "{message}"
    );

    // The active scalars of the cells are read if the points have none.
    write(vti_of(&format!(">{}", points("a")), &format!("Scalars=\"c\">{}", array("c", "5 6"))));
    assert!(cells(&Volume::open(&path).unwrap()));
    let vectors = "Scalars=\"v\"><DataArray type=\"UInt8\" Name=\"v\" NumberOfComponents=\"3\"></DataArray>";
    write(vti_of(vectors, &format!("Scalars=\"c\">{}", array("c", "5 6"))));
    assert!(cells(&Volume::open(&path).unwrap()));
    // An image with two axes has one layer of cells.
    let flat = vti_of(">", &format!(">{}", array("c", "1 2 3 4")));
    write(flat.replace("0 1 0 1 0 2", "0 2 0 2 0 0"));
    assert_eq!(Volume::open(&path).unwrap().dims(), [2, 2, 1]);
    // An array whose name begins like VTK's own is read if it is active; an array of ids is not read by
    // default.
    write(vti_of(&format!("Scalars=\"vtkDensity\">{}{}", points("a"), points("vtkDensity")), ">"));
    assert!(!Volume::open(&path).unwrap().notes().iter().any(|n| n.contains("is read")));
    write(vti_of(&format!("GlobalIds=\"i\">{}", points("i")), &format!(">{}", array("c", "5 6"))));
    assert!(cells(&Volume::open(&path).unwrap()));
    write(vti_of(&format!("Scalars=\"vtkGhostType\">{}", points("vtkGhostType")), ">"));
    told(Volume::open(&path), &["VTK's own (\"vtkGhostType\")"]);

    told(open_array(&fixture("scaled.nii"), "a"), &["holds one volume without a name"]);
}

#[test]
fn pieces_of_vtk_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.vti");
    let piece = |extent: &str, values: &str| {
        format!(
            "<Piece Extent=\"{extent}\"><PointData><DataArray type=\"Int8\" Name=\"d\">{values}</DataArray>\
             </PointData></Piece>"
        )
    };
    let read = |pieces: &[String]| {
        let text = format!(
            "<VTKFile type=\"ImageData\"><ImageData WholeExtent=\"5 7 0 1 -1 -1\">{}</ImageData></VTKFile>",
            pieces.concat()
        );
        std::fs::write(&path, text).unwrap();
        Volume::open(&path).map_err(|error| format!("{error:#}"))
    };
    let (left, right) = (piece("5 6 0 1 -1 -1", "0 1 3 4"), piece("6 7 0 1 -1 -1", "1 2 4 5"));
    for pieces in [[left.clone(), right.clone()], [right.clone(), left.clone()]] {
        let volume = read(&pieces).unwrap();
        assert_eq!((volume.dims(), volume.data()), ([3, 2, 1], &VolumeData::I16((0..6).collect())));
    }
    // A single piece must cover the whole extent and must not exceed it.
    let alone = [left.clone()];
    assert!(read(&alone).unwrap_err().contains("hold 4 of the 6 voxels of WholeExtent"));
    let larger = [piece("4 7 0 1 -1 -1", "9 0 1 2 9 3 4 5")];
    assert!(read(&larger).unwrap_err().contains("lies outside of WholeExtent"));
    for (pieces, expected) in [
        ([left.clone(), left.clone()], "no piece of the file holds 2 of the 6 voxels"),
        ([left.clone(), piece("7 7 0 0 -1 -1", "2")], "hold 5 of the 6 voxels"),
        ([left.clone(), piece("7 8 0 1 -1 -1", "1 2 4 5")], "lies outside of WholeExtent"),
        ([left.clone(), piece("4 7 0 1 -1 -1", "1 2 4 5")], "lies outside of WholeExtent"),
        ([left.clone(), right.replace("\"d\"", "\"e\"")], "\"d\" is not in every piece"),
        ([left, right.replace("Int8", "Int16")], "has another type or number of components in another piece"),
    ] {
        let message = read(&pieces).unwrap_err();
        assert!(message.contains(expected), "{message:?} should contain {expected:?}");
    }
}

#[test]
fn byte_order_marks_are_no_part_of_the_text() {
    let folder = report("bom");
    entire_farm::job::Job::open(&folder.join("job.toml")).unwrap();
    entire_io::path::PathFile::open(&folder.join("path.json")).unwrap().resolve().unwrap();
    // The same files, with names whose ending does not determine the format.
    let other = tempfile::tempdir().unwrap();
    for name in ["a0.mhd", "a.nhdr", "../vti-bom-Appended.vti"] {
        std::fs::copy(folder.join("v.raw"), other.path().join("v.raw")).unwrap();
        std::fs::copy(folder.join(name), other.path().join("noending")).unwrap();
        let volume = Volume::open(other.path().join("noending")).unwrap();
        assert_eq!(volume.data(), reported("bom/a.nhdr").data(), "{name}");
    }
}

#[test]
fn voxels_stand_before_the_end_where_the_byte_skip_is_negative() {
    // These voxels are not compressed. A skip of -6 needs 8 bytes after the header, and there are 7.
    let header = |skip: i64| {
        format!(
            "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 1 1 3\nencoding: raw\nbyte skip: {skip}\n\n1234567"
        )
    };
    for (skip, right) in [(-1, b"567"), (-3, b"345"), (-5, b"123")] {
        let volume = opened("a.nrrd", header(skip));
        assert_eq!(volume.data(), &VolumeData::U8(right.to_vec()));
        assert!(!volume.notes().iter().any(|n| n.contains("bytes after")), "{:?}", volume.notes());
    }
    check("a.nrrd", header(-6).as_bytes(), "3 bytes of voxels and 5 bytes after them, but 7 bytes");
    check("a.nrrd", header(i64::MIN).as_bytes(), "but 7 bytes follow");
}

#[test]
fn spacings_count_where_directions_say_nothing() {
    for (name, unknown) in
        [("none-without-kinds", 0), ("none-and-spacings", 0), ("nan-vectors", 0), ("unit-of-time", 1)]
    {
        let volume = reported(&format!("directions-{name}.nrrd"));
        assert_eq!(volume.notes().len(), unknown, "{name}: {:?}", volume.notes());
    }
    let header = |fields: &str| {
        format!("NRRD0004\ntype: uint8\ndimension: 3\nsizes: 1 1 3\nencoding: raw\n{fields}\n\n123")
    };
    for (fields, spacing) in [
        ("space directions: none none none\nspacings: 2 2 5", [2.0, 2.0, 5.0]),
        ("space directions: (nan,nan,nan) (nan,nan,nan) (nan,nan,nan)\nspacings: 2 2 5", [2.0, 2.0, 5.0]),
        ("space directions: (0,0,3) (4,0,0) (0,3,4)\nspacings: nan nan nan", [3.0, 4.0, 5.0]),
        ("spacings: nan 2 NaN", [1.0, 2.0, 1.0]),
    ] {
        assert_eq!(opened("a.nrrd", header(fields)).spacing(), spacing, "{fields}");
    }
    let vectors = header("space directions: (1,0,0) (0,1,0) none");
    check("a.nrrd", vectors.as_bytes(), "axis 2 holds 3 components or time steps");
}

#[test]
fn damaged_streams_of_bzip2_are_refused() {
    let packed = std::fs::read(report("enc-bz2.nrrd")).unwrap();
    check("a.nrrd", &packed[..packed.len() / 2], "cut short");
    let mut broken = packed;
    let at = broken.len() - 400;
    broken[at] ^= 0x55;
    check("a.nrrd", &broken, "damaged");
}

#[test]
fn voxels_in_several_files_are_read_in_their_order() {
    for name in ["list.nhdr", "pattern.nhdr", "slabs.nhdr", "list.mhd", "pattern.mhd"] {
        assert_eq!(reported(&format!("several/{name}")).notes().len(), 0, "{name}");
    }
    // Two bytes before the voxels of each file are skipped, and a file that is too short is refused.
    let other = tempfile::tempdir().unwrap();
    for (name, bytes) in [("a2.raw", "xx12"), ("a1.raw", "xx34"), ("a0.raw", "xx56")] {
        std::fs::write(other.path().join(name), bytes).unwrap();
    }
    let header = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 2 1 3\nencoding: raw\nbyte skip: 2\n";
    let path = other.path().join("a.nhdr");
    for files in ["data file: a%d.raw 2 0 -1\n", "data file: LIST\na2.raw\na1.raw\na0.raw\n"] {
        std::fs::write(&path, format!("{header}{files}")).unwrap();
        assert_eq!(Volume::open(&path).unwrap().data(), &VolumeData::U8(b"123456".to_vec()), "{files}");
    }
    std::fs::write(other.path().join("a1.raw"), "xx3").unwrap();
    told(Volume::open(&path), &["a1.raw", "need 2 bytes, but the file has 1"]);
    let text = "NDims = 3\nDimSize = 2 1 3\nElementType = MET_UCHAR\nHeaderSize = 2\nElementDataFile = LIST 2D\n\
                a2.raw\na0.raw\na2.raw\n";
    let path = other.path().join("a.mhd");
    std::fs::write(&path, text).unwrap();
    assert_eq!(Volume::open(&path).unwrap().data(), &VolumeData::U8(b"125612".to_vec()));
}

#[test]
fn bytes_behind_the_voxels_follow_one_rule_in_all_formats() {
    for name in ["behind-newline.nrrd", "behind-newline.mha", "behind-pad.nrrd", "behind-pad.mha"] {
        let volume = reported(name);
        let behind = if name.contains("pad") { "64 bytes after" } else { "1 bytes after" };
        assert!(volume.notes()[0].contains(behind), "{name}: {:?}", volume.notes());
    }
    let gz = entire_io::files::gzip;
    let raw = b"123456".to_vec();
    let nii = |behind: usize| {
        let whole = std::fs::read(fixture("nibabel_one_int16_big.nii")).unwrap();
        [whole, vec![7; behind]].concat()
    };
    for (name, right, behind) in [
        ("a_1x2x3_uint8.raw", [&raw[..], b"\n"].concat(), [&raw[..], &raw].concat()),
        (
            "a_1x2x3_uint8.raw.gz",
            gz(&[&raw[..], b"\n"].concat()).unwrap(),
            gz(&[&raw[..], &raw].concat()).unwrap(),
        ),
        ("a.nii", nii(1), nii(770)),
        ("a.nii.gz", gz(&nii(769)).unwrap(), gz(&nii(2000)).unwrap()),
    ] {
        let volume = opened(name, right);
        assert!(volume.notes()[0].contains("bytes after the"), "{name}: {:?}", volume.notes());
        check(name, &behind, "check sizes and type in the header");
    }
}

/// Programs that write blocks of a fixed size fill the last one with zeros.
#[test]
fn bytes_after_the_last_gzip_member_are_ignored() {
    let right = Volume::open(fixture("nibabel_one_int16_big.nii")).unwrap();
    let whole = std::fs::read(right.source()).unwrap();
    let (head, tail) = whole.split_at(400);
    let gz = |part: &[u8]| entire_io::files::gzip(part).unwrap();
    for (name, bytes) in [
        ("zeros.nii.gz", [gz(&whole), vec![0; 512]].concat()),
        ("members.nii.gz", [gz(head), gz(tail), vec![0; 3]].concat()),
        ("text.nii.gz", [gz(&whole), b"end".to_vec()].concat()),
    ] {
        assert_eq!(opened(name, bytes).data(), right.data(), "{name}");
    }
    refused("cut.nii.gz", &gz(&whole)[..300]);
}

#[test]
fn names_in_capitals_are_known() {
    let raw = b"123456";
    let gz = entire_io::files::gzip(raw).unwrap();
    for (name, bytes) in [
        ("a_1x2x3_uint8.RAW", &raw[..]),
        ("b_1X2X3_UINT8.Raw", raw),
        ("c_1x2x3_uint8.raw.GZ", &gz),
        ("d_1x2x3_uint8.RAW.GZ", &gz),
    ] {
        let volume = opened(name, bytes);
        assert_eq!((volume.dims(), volume.data()), ([1, 2, 3], &VolumeData::U8(raw.to_vec())), "{name}");
    }
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("E.JSON"), "{\"size\": [1, 2, 3], \"type\": \"uint8\"}").unwrap();
    std::fs::write(folder.path().join("E.RAW"), raw).unwrap();
    for name in ["E.JSON", "E.RAW"] {
        assert_eq!(Volume::open(folder.path().join(name)).unwrap().dims(), [1, 2, 3], "{name}");
    }
}
