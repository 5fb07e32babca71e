//! Round trips, and every kind of invalid model file.

use super::read::MAX_INPUT_GROUPS;
use super::*;
use crate::ErrorKind;
use crate::nn::{DenseParts, Dtype, Normalization, PredNet, PredNetParts, Target};
use alloc::format;
use alloc::string::{String, ToString};
use alloc::vec;
use alloc::vec::Vec;

fn layer(inputs: usize, outputs: usize, dtype: Dtype) -> DenseParts {
    // Multiples of 1/8 below 4 are exact in F32, F16 and BF16.
    let number = |i: usize| (i % 13) as f32 * 0.125 - 0.75;
    DenseParts {
        inputs,
        outputs,
        weight: (0..inputs * outputs).map(number).collect(),
        bias: (0..outputs).map(number).collect(),
        dtype,
    }
}

fn prednet(dtype: Dtype) -> PredNetParts {
    PredNetParts {
        layers: vec![layer(6, 5, dtype), layer(5, 3, dtype), layer(3, 1, dtype)],
        input: Some(Normalization { mean: vec![0.5; 6], std: vec![2.0; 6] }),
        output: Some(Normalization { mean: vec![-3.0], std: vec![0.25] }),
        target: Target::LogSeconds,
    }
}

fn groups() -> Vec<InputGroup> {
    let group = |name: &str, size| InputGroup { name: name.to_string(), size };
    vec![group("camera", 3), group("resolution", 2), group("step_size", 1)]
}

fn file() -> ModelFile {
    let mut file = ModelFile::default();
    file.set_prednet(&prednet(Dtype::F32), &groups()).unwrap();
    file
}

fn with_volumenet() -> ModelFile {
    let mut file = encoder_file(8, &[(2, 3, 2, 1), (3, 2, 2, 0)], 4);
    file.set_prednet(&prednet(Dtype::F32), &groups()).unwrap();
    file.set_tensor("volumenet.encoder.0.conv.bias", Dtype::F32, &[2], &[0.5; 2]).unwrap();
    file
}

fn fails(file: &ModelFile, kind: ErrorKind, says: &[&str]) {
    let error = file.to_model().unwrap_err();
    assert_eq!(error.kind(), kind, "{error}");
    for text in says {
        assert!(error.to_string().contains(text), "{error:?} does not say {text:?}");
    }
    assert_eq!(file.to_bytes().unwrap_err(), error, "such a file must not be written");
}

#[test]
fn what_is_written_is_read_back() {
    for dtype in [Dtype::F32, Dtype::F16, Dtype::Bf16] {
        let mut file = ModelFile::default();
        file.set_prednet(&prednet(dtype), &groups()).unwrap();
        file.metadata.insert(Key::Device.into(), "a device".into());
        file.metadata.insert("notes".into(), "kept".into());
        let model = Model::from_bytes(&file.to_bytes().unwrap()).unwrap();
        assert_eq!(model.prednet, Some(prednet(dtype)));
        assert_eq!(model.inputs, groups());
        assert_eq!(model.metadata[Key::Device.name()], "a device");
        assert_eq!(model.metadata["notes"], "kept");
        assert!(model.volumenet.is_none());
        assert_eq!(PredNet::new(model.prednet.as_ref().unwrap()).unwrap().inputs(), 6);
    }
}

#[test]
fn bytes_need_no_alignment_and_have_one_order() {
    let bytes = with_volumenet().to_bytes().unwrap();
    let expected = Model::from_bytes(&bytes).unwrap();
    for shift in 1..8 {
        let mut moved = vec![0; shift];
        moved.extend_from_slice(&bytes);
        assert_eq!(Model::from_bytes(&moved[shift..]).unwrap(), expected);
    }
    assert_eq!(ModelFile::from_bytes(&bytes).unwrap().to_bytes().unwrap(), bytes);
}

#[test]
fn unknown_tensors_and_metadata_survive_fine_tuning() {
    let mut file = with_volumenet();
    file.set_tensor("volumenet.decoder.0.weight", Dtype::F16, &[3], &[1.0, 2.0, 3.0]).unwrap();
    file.set_tensor("prednet.note", Dtype::F32, &[], &[1.0]).unwrap();
    let before = ModelFile::from_bytes(&file.to_bytes().unwrap()).unwrap();
    let mut tuned = before.clone();
    tuned.set_prednet(&prednet(Dtype::F16), &groups()).unwrap();
    for name in before.tensors.keys().filter(|n| !n.starts_with("prednet.")) {
        assert!(tuned.tensors.contains_key(name), "{name} was lost");
    }
    assert_eq!(tuned.metadata, before.metadata);
    assert_eq!(tuned.to_model().unwrap().volumenet, before.to_model().unwrap().volumenet);
}

#[test]
fn unknown_tensors_make_no_network() {
    let with = |mut file: ModelFile, name: &str| {
        file.set_tensor(name, Dtype::F32, &[1], &[1.0]).unwrap();
        file.to_model().unwrap()
    };
    for name in ["volumenet.encoder.note", "volumenet.encoder.0.note", "volumenet.fc.note"] {
        assert!(with(file(), name).volumenet.is_none(), "{name}");
    }
    for name in ["prednet.note", "prednet.input.note", "prednet.output.note"] {
        assert!(with(encoder_file(4, &[(2, 1, 1, 0)], 1), name).prednet.is_none(), "{name}");
    }
}

/// Largest difference of a folded weight or bias, due to rounding in single precision.
const FOLD_TOLERANCE: f32 = 1e-5;

#[test]
fn volumenet_shapes_are_followed_and_batch_normalization_is_folded() {
    let model = with_volumenet().to_model().unwrap();
    let net = model.volumenet.as_ref().unwrap();
    assert_eq!((net.input, net.features(), net.blocks.len()), (8, 4, 2));
    assert_eq!((net.blocks[0].output_edge, net.blocks[1].output_edge), (4, 2));
    // The factor is gamma / sqrt(var + eps) with gamma = 1 and var = 0.002; without eps, it would be 0.25 %
    // larger.
    let scale = 1.0 / (0.002f32 + 1e-5).sqrt();
    for (found, expected) in [
        (net.blocks[0].weight[0], 0.01 * scale),
        (net.blocks[0].bias[0], (0.5 - 0.3) * scale + 0.2),
        // This block's convolution has no bias.
        (net.blocks[1].bias[0], (0.0 - 0.3) * scale + 0.2),
    ] {
        assert!((found - expected).abs() <= FOLD_TOLERANCE, "{found} {expected}");
    }
}

#[test]
fn damaged_containers_are_refused() {
    let bytes = file().to_bytes().unwrap();
    for cut in 0..bytes.len() {
        let error = Model::from_bytes(&bytes[..cut]).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::InvalidModel, "cut to {cut} bytes: {error}");
    }
    let mut longer = bytes.clone();
    longer.push(0);
    assert_eq!(Model::from_bytes(&longer).unwrap_err().kind(), ErrorKind::InvalidModel);
    let with_header = |header: &str, data: usize| {
        let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
        bytes.extend_from_slice(header.as_bytes());
        bytes.resize(bytes.len() + data, 0);
        Model::from_bytes(&bytes).unwrap_err()
    };
    for header in [
        "",
        "[]",
        "{",
        "{\"a\":1}",
        // These sizes overflow when the header's length is added to them, or when they are multiplied.
        r#"{"a":{"dtype":"U8","shape":[18446744073709551615],"data_offsets":[0,18446744073709551615]}}"#,
        r#"{"a":{"dtype":"F32","shape":[4294967296,4294967296],"data_offsets":[0,0]}}"#,
        r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[8,0]}}"#,
        r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[4,12]}}"#,
        r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}}"#,
        r#"{"a":{"dtype":"F99","shape":[2],"data_offsets":[0,8]}}"#,
        r#"{"__metadata__":{"entire.format":1}}"#,
    ] {
        assert_eq!(with_header(header, 4).kind(), ErrorKind::InvalidModel, "{header}");
    }
    let tensor = r#""a":{"dtype":"U8","shape":[4],"data_offsets":[0,4]}"#;
    for (header, name) in [
        (r#"{"__metadata__":{"entire.format":"2","x":"","entire.format":"1"}}"#.into(), "entire.format"),
        (format!("{{{tensor},{tensor}}}"), "a"),
    ] {
        let error = with_header(&header, 4).to_string();
        assert!(error.contains(&format!("{name:?} twice")), "{error}");
    }
    let mut lying = bytes;
    lying[..8].copy_from_slice(&u64::MAX.to_le_bytes());
    assert!(Model::from_bytes(&lying).unwrap_err().to_string().contains("18446744073709551615"));
}

#[test]
fn a_flipped_byte_never_panics() {
    let bytes = with_volumenet().to_bytes().unwrap();
    for i in 0..bytes.len() {
        for flip in [0x01, 0x20, 0x80, 0xff] {
            let mut changed = bytes.clone();
            changed[i] ^= flip;
            let _ = Model::from_bytes(&changed);
        }
    }
}

#[test]
fn metadata_is_checked() {
    let remove = |key: Key| {
        let mut f = file();
        f.metadata.remove(key.name());
        f
    };
    let set = |key: Key, value: &str| {
        let mut f = with_volumenet();
        f.metadata.insert(key.into(), value.into());
        f
    };
    let invalid = ErrorKind::InvalidModel;
    for key in [Key::Format, Key::Inputs, Key::Target] {
        fails(&remove(key), invalid, &[key.name()]);
    }
    fails(&set(Key::Format, "2"), invalid, &["\"2\"", "\"1\""]);
    fails(&set(Key::Target, "ms"), invalid, &["\"ms\"", "log_seconds"]);
    for (inputs, says) in [
        ("camera", &[Key::Inputs.name(), "JSON"][..]),
        (r#"[{"name":"camera","size":4},{"name":"x","size":2}]"#, &["camera", "4", "3"]),
        (r#"[{"name":"x","size":3},{"name":"x","size":3}]"#, &["twice"]),
        (r#"[{"name":"x","size":5}]"#, &["5", "6"]),
        (r#"[{"name":"x","size":6},{"name":"y","size":0}]"#, &["\"y\""]),
        (r#"[{"name":"x","size":18446744073709551615},{"name":"y","size":7}]"#, &["adds up"]),
        (r#"[{"name":"transfer_function","size":4},{"name":"x","size":2}]"#, &["lobe"]),
        (r#"[{"name":"volume_features","size":5},{"name":"x","size":1}]"#, &["volume_features", "5", "4"]),
    ] {
        fails(&set(Key::Inputs, inputs), invalid, says);
    }
    let scene = r#"[{"name":"scene_features","size":6}]"#;
    fails(&set(Key::Inputs, scene), invalid, &[Key::SceneFeatures.name()]);
    for (names, says) in
        [("[\"a\"]", "1 features"), ("[\"a\",\"b\",\"c\",\"d\",\"e\",\"a\"]", "twice"), ("{}", "JSON")]
    {
        let mut f = set(Key::Inputs, scene);
        f.metadata.insert(Key::SceneFeatures.into(), names.into());
        fails(&f, invalid, &[says]);
    }
    let mut f = set(Key::Inputs, scene);
    f.metadata.insert(Key::SceneFeatures.into(), r#"["a","b","c","d","e","f"]"#.into());
    assert_eq!(f.to_model().unwrap().scene_features, ["a", "b", "c", "d", "e", "f"].map(String::from));
    let one = r#"{"input":8,"blocks":[{"stride":2,"padding":1}]}"#;
    fails(&set(Key::VolumeNet, one), invalid, &["1 blocks", "2"]);
    fails(&set(Key::VolumeNet, &one.replace('8', "0")), invalid, &["input is 0"]);
    fails(&set(Key::VolumeNet, &one.replace('8', "100000")), invalid, &["100000", "512"]);
    fails(&set(Key::VolumeNet, "8"), invalid, &["form"]);
    let two = |a: &str, b: &str| format!(r#"{{"input":8,"blocks":[{a},{b}]}}"#);
    let (good, zero, padded) =
        (r#"{"stride":2,"padding":1}"#, r#"{"stride":0,"padding":1}"#, r#"{"stride":2,"padding":3}"#);
    fails(&set(Key::VolumeNet, &two(zero, good)), invalid, &["stride 0"]);
    fails(&set(Key::VolumeNet, &two(padded, good)), invalid, &["padding 3"]);
}

/// Returns a file with an encoder. A block is (outputs, kernel, stride, padding); the dense layer has
/// `features` outputs.
fn encoder_file(input: usize, blocks: &[(usize, usize, usize, usize)], features: usize) -> ModelFile {
    let mut file = ModelFile::default();
    let mut set = |name: &str, shape: &[usize], value: f32| {
        file.set_tensor(name, Dtype::F32, shape, &vec![value; shape.iter().product()]).unwrap();
    };
    let (mut edge, mut channels, mut layout) = (input, 1, Vec::new());
    for (i, &(outputs, kernel, stride, padding)) in blocks.iter().enumerate() {
        let name = format!("volumenet.encoder.{i}");
        set(&format!("{name}.conv.weight"), &[outputs, channels, kernel, kernel, kernel], 0.01);
        for (part, value) in [("weight", 1.0), ("bias", 0.2), ("running_mean", 0.3), ("running_var", 0.002)] {
            set(&format!("{name}.bn.{part}"), &[outputs], value);
        }
        layout.push(format!(r#"{{"stride":{stride},"padding":{padding}}}"#));
        (edge, channels) = ((edge + 2 * padding - kernel) / stride + 1, outputs);
    }
    set("volumenet.fc.weight", &[features, channels * edge * edge * edge], 0.1);
    set("volumenet.fc.bias", &[features], 0.0);
    file.metadata
        .insert(Key::VolumeNet.into(), format!(r#"{{"input":{input},"blocks":[{}]}}"#, layout.join(",")));
    file
}

#[test]
fn a_stride_beyond_the_padded_input_is_refused() {
    // A 32-bit machine tests only the strides that fit `usize`.
    let strides = [6, 1 << 31, 1 << 40, (1 << 59) + 7, 1 << 60, (1 << 60) + 7, 1 << 62, u64::MAX];
    for stride in strides.into_iter().filter_map(|s| usize::try_from(s).ok()) {
        let says = format!("stride {stride}");
        fails(&encoder_file(3, &[(1, 3, stride, 1)], 1), ErrorKind::InvalidModel, &[&says, "1 to 5"]);
    }
    let widest = encoder_file(3, &[(1, 3, 5, 1)], 1).to_model().unwrap();
    assert_eq!(widest.volumenet.as_ref().unwrap().blocks[0].output_edge, 1);
}

#[test]
fn an_encoder_whose_memory_leaves_the_bound_is_refused_whatever_the_files_size() {
    let says = ["bytes", "2147483648", "smaller"];
    for blocks in [
        // The second layer gives 64 × 512³ values: 34 GB.
        &[(1, 1, 1, 0), (64, 1, 1, 0), (1, 1, 512, 0)][..],
        &[(1, 1, 1, 0), (4096, 1, 1, 0), (1, 1, 512, 0)],
        // The second kernel spans 512 planes of the first layer, each of 4096 channels.
        &[(4096, 1, 1, 0), (1, 1, 512, 0)],
        // The kernel spans 80 prepared planes, each of 512 rows of 440 phases.
        &[(1, 80, 440, 0)],
    ] {
        let file = encoder_file(512, blocks, 1);
        fails(&file, ErrorKind::InvalidModel, &says);
    }
    // Rows and channels are padded to whole vectors. With one row and one channel, this padding enlarges the
    // dense layer's weights most.
    fails(&encoder_file(1, &[(1, 1, 1, 0)], 1 << 22), ErrorKind::InvalidModel, &says);
    assert!(encoder_file(512, &[(1, 1, 1, 0), (1, 1, 512, 0)], 1).to_model().is_ok());
}

#[test]
fn the_number_of_groups_and_their_check_are_bounded() {
    let groups = |n: usize| {
        let all: Vec<String> = (0..n).map(|i| format!(r#"{{"name":"g{i}","size":1}}"#)).collect();
        format!("[{}]", all.join(","))
    };
    let mut file = ModelFile::default();
    let mut net = prednet(Dtype::F32);
    net.layers[0] = layer(MAX_INPUT_GROUPS, 5, Dtype::F32);
    net.input = None;
    file.set_prednet(&net, &[InputGroup { name: "x".to_string(), size: MAX_INPUT_GROUPS }]).unwrap();
    file.metadata.insert(Key::Inputs.into(), groups(MAX_INPUT_GROUPS));
    assert_eq!(file.to_model().unwrap().inputs.len(), MAX_INPUT_GROUPS);
    for n in [MAX_INPUT_GROUPS + 1, 100_000] {
        file.metadata.insert(Key::Inputs.into(), groups(n));
        fails(&file, ErrorKind::InvalidModel, &[&format!("{n} groups"), "1024"]);
    }
}

#[test]
fn tensors_are_checked() {
    let invalid = ErrorKind::InvalidTensor;
    for name in with_volumenet().tensors.into_keys() {
        // The bias of a convolution is optional.
        let mut f = with_volumenet();
        f.tensors.remove(&name);
        if name == "volumenet.encoder.0.conv.bias" {
            assert!(f.to_model().is_ok());
        } else if name == "volumenet.encoder.1.conv.weight" {
            fails(&f, invalid, &[&name, "missing", "[channels, 2, k, k, k]"]);
        } else if name == "prednet.2.weight" {
            fails(&f, invalid, &["prednet.2.weight", "missing", "[1, 3]"]);
        } else {
            fails(&f, invalid, &[&name, "missing"]);
        }
        let mut f = with_volumenet();
        f.set_tensor(&name, Dtype::F32, &[7, 7, 7], &[0.5; 343]).unwrap();
        fails(&f, invalid, &["[7, 7, 7]"]);
    }
    let set = |name: &str, shape: &[usize], value: f32| {
        let mut f = with_volumenet();
        f.set_tensor(name, Dtype::F32, shape, &vec![value; shape.iter().product()]).unwrap();
        f
    };
    for (name, shape, value, says) in [
        ("prednet.1.weight", &[3, 4][..], 1.0, &["prednet.1.weight", "[3, 4]", "[out, 5]"][..]),
        ("prednet.2.weight", &[2, 3], 1.0, &["prednet.2.weight", "[2, 3]", "[1, 3]"]),
        ("prednet.0.weight", &[0, 6], 1.0, &["prednet.0.weight", "[0, 6]"]),
        ("prednet.7.weight", &[3, 3], 1.0, &["prednet.3.weight", "missing"]),
        ("prednet.input.std", &[6], 0.0, &["prednet.input.std[0]", "0"]),
        ("prednet.output.std", &[1], -1.0, &["prednet.output.std[0]", "-1"]),
        ("volumenet.encoder.1.conv.weight", &[3, 2, 5, 5, 5], 1.0, &["kernel 5", "4"]),
        ("volumenet.encoder.0.bn.running_var", &[2], -0.5, &["running_var[0]", "-0.5"]),
        ("volumenet.fc.weight", &[4, 23], 1.0, &["volumenet.fc.weight", "[4, 23]", "[out, 24]"]),
    ] {
        fails(&set(name, shape, value), invalid, says);
    }
    let mut f = set("volumenet.encoder.0.bn.weight", &[2], 1e38);
    f.set_tensor("volumenet.encoder.0.bn.running_var", Dtype::F32, &[2], &[0.0, 0.0]).unwrap();
    fails(&f, invalid, &["encoder.0", "overflows"]);
    let gap = "volumenet.encoder.1.conv.weight";
    let mut f = encoder_file(4, &[(2, 1, 1, 0); 3], 1);
    f.tensors.remove(gap);
    fails(&f, invalid, &[gap, "missing", "[channels, 2, k, k, k]"]);
    let mut f = ModelFile::default();
    fails(&f, ErrorKind::InvalidModel, &["neither"]);
    f.set_tensor("prednet.input.mean", Dtype::F32, &[1], &[1.0]).unwrap();
    fails(&f, invalid, &["prednet.0.weight", "missing", "[out, in]"]);
}

#[test]
fn nan_and_infinity_are_refused_by_name_and_index() {
    let bytes = file().to_bytes().unwrap();
    let quarter = 0.125f32.to_le_bytes();
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let at = bytes.windows(4).rposition(|w| w == quarter).unwrap();
        let mut changed = bytes.clone();
        changed[at..at + 4].copy_from_slice(&bad.to_le_bytes());
        let error = Model::from_bytes(&changed).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::InvalidTensor);
        assert!(error.to_string().contains("prednet.") && error.to_string().contains('['), "{error}");
        let mut f = file();
        assert!(f.set_tensor("x", Dtype::F32, &[1], &[bad]).unwrap_err().to_string().contains("x[0]"));
    }
    // 1e6 is finite in F32, but infinite in F16.
    assert!(file().set_tensor("x", Dtype::F16, &[1], &[1e6]).unwrap_err().to_string().contains("F16"));
    assert!(file().set_tensor("x", Dtype::F32, &[2], &[1.0]).unwrap_err().to_string().contains("[2]"));
}

#[test]
fn other_number_formats_are_refused() {
    let header = concat!(
        r#"{"__metadata__":{"entire.format":"1","entire.target":"seconds","entire.inputs":"[]"},"#,
        r#""prednet.0.weight":{"dtype":"F64","shape":[1,1],"data_offsets":[0,8]},"#,
        r#""prednet.0.bias":{"dtype":"F32","shape":[1],"data_offsets":[8,12]}}"#
    );
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend_from_slice(header.as_bytes());
    bytes.resize(bytes.len() + 12, 0);
    let error = Model::from_bytes(&bytes).unwrap_err();
    assert!(error.to_string().contains("prednet.0.weight") && error.to_string().contains("F64"), "{error}");
}
