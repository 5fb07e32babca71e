//! Runs the built command and makes its input files.
#![allow(dead_code, reason = "each test file uses its own part")]

use entire_core::model::Model;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

pub(crate) fn entire(folder: &Path, arguments: &[&str]) -> Output {
    entire_in(folder, &[], arguments)
}

pub(crate) fn entire_in(folder: &Path, environment: &[(&str, &str)], arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_entire"));
    command.args(arguments).envs(environment.iter().copied()).current_dir(folder).output().unwrap()
}

pub(crate) fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

pub(crate) fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

/// Returns the words of a command line without quotes.
pub(crate) fn words(line: &str) -> Vec<&str> {
    line.split_whitespace().collect()
}

/// Returns the standard output of a run that must succeed.
pub(crate) fn succeeds(folder: &Path, arguments: &[&str]) -> String {
    let output = entire(folder, arguments);
    assert_eq!(output.status.code(), Some(0), "{arguments:?}: {}", stderr(&output));
    stdout(&output)
}

/// Returns the output of a run that must succeed although the reader of its standard output closes it.
pub(crate) fn unread(folder: &Path, line: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_entire"));
    command.args(words(line)).env("XDG_DATA_HOME", folder).current_dir(folder);
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{line}: {}", stderr(&output));
    output
}

/// Checks that a run ends with status 1, prints nothing on standard output, and prints one line on standard
/// error that contains every one of `parts`.
pub(crate) fn refuses(folder: &Path, arguments: &[&str], parts: &[&str]) {
    refuses_in(folder, &[], arguments, parts);
}

/// Checks the same as [`refuses`], with additional environment variables.
pub(crate) fn refuses_in(folder: &Path, environment: &[(&str, &str)], arguments: &[&str], parts: &[&str]) {
    let output = entire_in(folder, environment, arguments);
    let told = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{arguments:?}: {told}");
    let errors: Vec<&str> = told.lines().filter(|line| !line.starts_with("note: ")).collect();
    assert_eq!(errors.len(), 1, "{arguments:?} should say one line: {told:?}");
    assert!(errors[0].starts_with("entire: "), "{told}");
    assert!(!told.contains("panicked") && !told.contains("internal error"), "{told}");
    assert!(output.stdout.is_empty(), "{arguments:?}: {}", stdout(&output));
    for part in parts {
        assert!(errors[0].contains(part), "{arguments:?}: {told:?} should contain {part:?}");
    }
}

/// Checks that a run ends with this status, and that its messages contain every one of `parts`.
#[track_caller]
pub(crate) fn fails(folder: &Path, line: &str, code: i32, parts: &[&str]) {
    let output = entire(folder, &words(line));
    let told = stderr(&output);
    assert_eq!(output.status.code(), Some(code), "{line}: {told}");
    assert!(!told.contains("panicked"), "{line}: {told}");
    parts.iter().for_each(|part| assert!(told.contains(part), "{line}: {part}: {told}"));
}

/// Output of `entire probe` on a device, as JSON if `json` is true. While other programs run, the times of
/// short frames may be too noisy, which the command reports. Longer frames are tried then.
pub(crate) fn probed(folder: &Path, device: &str, json: bool) -> String {
    let mut said = String::new();
    for milliseconds in ["10", "40", "160", "640"] {
        let format = if json { "--json" } else { "" };
        let line = format!("probe --device {device} --frame-ms {milliseconds} --repeats 3 {format}");
        let output = entire(folder, &words(&line));
        if output.status.success() {
            return stdout(&output);
        }
        said = stderr(&output);
        assert!(said.contains("the clock is too noisy"), "{said}");
    }
    panic!("{said}");
}

pub(crate) type Tensor<'a> = (&'a str, Vec<usize>, Vec<f32>);

/// Returns the bytes of a safetensors file. Metadata and tensors are not checked, so the file may be invalid.
pub(crate) fn safetensors(metadata: &[(&str, &str)], tensors: &[Tensor<'_>]) -> Vec<u8> {
    let mut header = serde_json::Map::new();
    let pairs: serde_json::Map<String, serde_json::Value> =
        metadata.iter().map(|(k, v)| ((*k).to_owned(), (*v).into())).collect();
    header.insert("__metadata__".into(), pairs.into());
    let mut data = Vec::new();
    for (name, shape, values) in tensors {
        let start = data.len();
        values.iter().for_each(|v| data.extend_from_slice(&v.to_le_bytes()));
        header.insert(
            (*name).to_owned(),
            serde_json::json!({ "dtype": "F32", "shape": shape, "data_offsets": [start, data.len()] }),
        );
    }
    let header = serde_json::Value::Object(header).to_string();
    let mut file = (header.len() as u64).to_le_bytes().to_vec();
    file.extend_from_slice(header.as_bytes());
    file.extend_from_slice(&data);
    file
}

pub(crate) const PREDNET_METADATA: [(&str, &str); 3] = [
    ("entire.format", "1"),
    ("entire.inputs", r#"[{"name":"camera","size":3},{"name":"resolution","size":2}]"#),
    ("entire.target", "seconds"),
];

/// Tensors of a PredNet of 5 inputs (camera, resolution) and 4 hidden units.
pub(crate) fn prednet() -> Vec<Tensor<'static>> {
    let weight = |n: usize, seed: f32| (0..n).map(|i| ((i as f32 + seed) * 0.7).sin() * 0.5).collect();
    vec![
        ("prednet.0.weight", vec![4, 5], weight(20, 1.0)),
        ("prednet.0.bias", vec![4], weight(4, 2.0)),
        ("prednet.1.weight", vec![1, 4], weight(4, 3.0)),
        ("prednet.1.bias", vec![1], vec![0.25]),
        ("prednet.input.mean", vec![5], vec![0.0, 0.0, 2.5, 512.0, 512.0]),
        ("prednet.input.std", vec![5], vec![60.0, 90.0, 1.0, 300.0, 300.0]),
    ]
}

pub(crate) const VOLUMENET_METADATA: [(&str, &str); 2] =
    [("entire.format", "1"), ("entire.volumenet", r#"{"input":4,"blocks":[{"stride":2,"padding":0}]}"#)];

/// Tensors of a VolumeNet with an input of 4³ voxels, one block of two channels (kernel 2, stride 2), and two
/// features.
pub(crate) fn volumenet() -> Vec<Tensor<'static>> {
    let weight = |n: usize, seed: f32| (0..n).map(|i| ((i as f32 + seed) * 0.9).cos() * 0.3).collect();
    vec![
        ("volumenet.encoder.0.conv.weight", vec![2, 1, 2, 2, 2], weight(16, 0.0)),
        ("volumenet.encoder.0.conv.bias", vec![2], vec![0.1, -0.2]),
        ("volumenet.encoder.0.bn.weight", vec![2], vec![1.0, 1.5]),
        ("volumenet.encoder.0.bn.bias", vec![2], vec![0.0, 0.1]),
        ("volumenet.encoder.0.bn.running_mean", vec![2], vec![0.05, -0.05]),
        ("volumenet.encoder.0.bn.running_var", vec![2], vec![0.5, 2.0]),
        ("volumenet.fc.weight", vec![2, 16], weight(32, 5.0)),
        ("volumenet.fc.bias", vec![2], vec![0.0, 1.0]),
    ]
}

fn nrrd(kind: &str, [x, y, z]: [usize; 3], voxels: impl Iterator<Item = u8>) -> Vec<u8> {
    let sizes = format!("sizes: {x} {y} {z}\nendian: little\nencoding: raw");
    format!("NRRD0004\ntype: {kind}\ndimension: 3\n{sizes}\n\n").bytes().chain(voxels).collect()
}

pub(crate) fn float_nrrd(dims: [usize; 3], values: impl Iterator<Item = f32>) -> Vec<u8> {
    nrrd("float", dims, values.flat_map(f32::to_le_bytes))
}

pub(crate) fn byte_nrrd(dims: [usize; 3], values: impl Iterator<Item = u8>) -> Vec<u8> {
    nrrd("uint8", dims, values)
}

/// A folder with the files that most tests use; it is removed after the test.
pub(crate) fn workshop() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let put = |name: &str, bytes: &[u8]| std::fs::write(folder.path().join(name), bytes).unwrap();
    put("pred.safetensors", &safetensors(&PREDNET_METADATA, &prednet()));
    put("volume.safetensors", &safetensors(&VOLUMENET_METADATA, &volumenet()));
    // A soft ball in a box that is longer along z.
    let ball = (0..12 * 10 * 16).map(|i| {
        let (x, y, z) = (i % 12, i / 12 % 10, i / 120);
        let d = ((x as f32 - 5.5) / 6.0).powi(2)
            + ((y as f32 - 4.5) / 5.0).powi(2)
            + ((z as f32 - 7.5) / 8.0).powi(2);
        (1.0 - d).max(0.0)
    });
    put("ball.nrrd", &float_nrrd([12, 10, 16], ball));
    let mut rows = String::new();
    for i in 0..7 {
        writeln!(rows, "{},{},2.5,{},512", i * 10, i * -25, 128 * (i + 1)).unwrap();
    }
    put("rows.csv", rows.as_bytes());
    folder
}

pub(crate) fn model_of(path: &Path) -> Model {
    Model::from_bytes(&std::fs::read(path).unwrap()).unwrap()
}

pub(crate) fn json(path: &Path) -> serde_json::Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// Returns the files with this ending in a folder of the project, in order.
pub(crate) fn files_in(folder: &str, ending: &str) -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(folder);
    let mut out: Vec<PathBuf> = std::fs::read_dir(folder)
        .unwrap()
        .map(|e| e.unwrap().path())
        .filter(|p| p.to_string_lossy().ends_with(ending))
        .collect();
    out.sort();
    out
}

pub(crate) fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/volumes").join(name)
}

/// A file that is modeled on a public bug report of another program that reads volumes.
pub(crate) fn report(name: &str) -> PathBuf {
    fixture("").with_file_name("reports").join(name)
}

/// Returns width, height and RGB pixels of a PNG picture.
pub(crate) fn picture(path: &Path) -> (u32, u32, Vec<u8>) {
    let file = std::io::BufReader::new(std::fs::File::open(path).unwrap());
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let mut rgb = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut rgb).unwrap();
    assert_eq!((info.color_type, info.bit_depth), (png::ColorType::Rgb, png::BitDepth::Eight));
    (info.width, info.height, rgb)
}

/// Returns the arguments of `render` for a volume with the CPU version, followed by further arguments. The
/// picture is out.png unless they name another one.
pub(crate) fn render<'a>(
    volume: &'a str,
    camera: &'a str,
    tf: &'a str,
    size: &'a str,
    more: &[&'a str],
) -> Vec<&'a str> {
    let mut arguments =
        vec!["render", volume, "--camera", camera, "--tf", tf, "--size", size, "--device", "cpu"];
    if !more.contains(&"--out") {
        arguments.extend(["--out", "out.png"]);
    }
    arguments.extend_from_slice(more);
    arguments
}
