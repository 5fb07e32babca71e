//! Checks that a program without libc, with a fixed arena as memory, loads a model and predicts with the same
//! bits as this build with the standard library, on every level (instruction set).

use entire_core::model::{GroupKind, InputGroup, Key, ModelFile};
use entire_core::nn::{DenseParts, Dtype, Normalization, PredNetParts, Target};
use entire_tests::mutants::Random;

/// Returns a small model with a PredNet and a VolumeNet; most widths are no multiple of a vector length.
fn model() -> Vec<u8> {
    let mut random = Random::new(0x2545_f491_4f6c_dd1d);
    let mut next = || random.uniform();
    let widths = [19, 70, 33, 1];
    let layers = widths
        .windows(2)
        .map(|w| DenseParts {
            inputs: w[0],
            outputs: w[1],
            weight: (0..w[0] * w[1]).map(|_| next() / (w[0] as f32).sqrt()).collect(),
            bias: (0..w[1]).map(|_| 0.1 * next()).collect(),
            dtype: Dtype::F32,
        })
        .collect();
    let prednet = PredNetParts {
        layers,
        input: Some(Normalization { mean: vec![0.1; 19], std: vec![0.7; 19] }),
        output: Some(Normalization { mean: vec![-4.0], std: vec![0.5] }),
        target: Target::LogSeconds,
    };
    let group = |kind: GroupKind, size| InputGroup { name: kind.to_string(), size };
    let groups = [
        group(GroupKind::VolumeFeatures, 4),
        group(GroupKind::Camera, 3),
        group(GroupKind::Resolution, 2),
        group(GroupKind::TransferFunction, 9),
        group(GroupKind::StepSize, 1),
    ];
    let mut file = ModelFile::default();
    file.set_prednet(&prednet, &groups).unwrap();
    let blocks = [(1usize, 10usize, 3usize), (10, 18, 3), (18, 24, 3)];
    let two = r#"{"stride":2,"padding":1}"#;
    let layout = format!(r#"{{"input":16,"blocks":[{two},{two},{{"stride":1,"padding":0}}]}}"#);
    file.metadata.insert(Key::VolumeNet.into(), layout);
    for (i, (inputs, outputs, k)) in blocks.into_iter().enumerate() {
        let mut tensor = |name: &str, shape: &[usize], scale: f32, offset: f32| {
            let values: Vec<f32> = (0..shape.iter().product()).map(|_| scale * next() + offset).collect();
            file.set_tensor(&format!("volumenet.encoder.{i}.{name}"), Dtype::F32, shape, &values).unwrap();
        };
        tensor("conv.weight", &[outputs, inputs, k, k, k], 1.0 / (inputs as f32 * 27.0).sqrt(), 0.0);
        tensor("conv.bias", &[outputs], 0.1, 0.0);
        tensor("bn.weight", &[outputs], 0.1, 1.0);
        tensor("bn.bias", &[outputs], 0.1, 0.0);
        tensor("bn.running_mean", &[outputs], 0.1, 0.0);
        tensor("bn.running_var", &[outputs], 0.2, 1.0);
    }
    let flat = 24 * 2 * 2 * 2;
    let weight: Vec<f32> = (0..4 * flat).map(|_| 0.1 * next()).collect();
    file.set_tensor("volumenet.fc.weight", Dtype::F32, &[4, flat], &weight).unwrap();
    file.set_tensor("volumenet.fc.bias", Dtype::F32, &[4], &[0.1, -0.2, 0.3, 0.0]).unwrap();
    file.to_bytes().unwrap()
}

#[test]
#[cfg_attr(
    not(all(target_os = "linux", target_arch = "x86_64")),
    ignore = "the freestanding program is written for x86-64 Linux"
)]
fn the_freestanding_program_gives_the_bits_of_the_hosted_build() {
    let folder = std::path::Path::new(env!("CARGO_TARGET_TMPDIR"));
    let path = folder.join("freestanding-model.safetensors");
    let bytes = model();
    std::fs::write(&path, &bytes).unwrap();
    let target = folder.join("freestanding");
    let built = std::process::Command::new(env!("CARGO"))
        .args(["build", "--quiet", "--package", "entire-freestanding", "--profile", "freestanding"])
        .arg("--target-dir")
        .arg(&target)
        .current_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/freestanding"))
        .env("ENTIRE_FREESTANDING_MODEL", &path)
        // Flags of the outer build, such as instrumentation, need libraries that this program lacks.
        .env_remove("RUSTFLAGS")
        .env_remove("CARGO_ENCODED_RUSTFLAGS")
        .output()
        .unwrap();
    assert!(built.status.success(), "{}", String::from_utf8_lossy(&built.stderr));
    let program = target.join("freestanding/entire-freestanding");
    let output = std::process::Command::new(&program).output().unwrap();
    assert!(output.status.success(), "{:?} {}", output.status, String::from_utf8_lossy(&output.stderr));
    let mut expected = String::new();
    entire_freestanding::report(&bytes, &mut expected).unwrap();
    assert!(expected.lines().count() >= 11, "{expected}");
    let found = String::from_utf8(output.stdout).unwrap();
    for (found, expected) in found.lines().zip(expected.lines()) {
        assert_eq!(found, expected);
    }
    assert_eq!(found, expected);
    // A program that names no dynamic loader uses no shared library.
    let elf = std::fs::read(&program).unwrap();
    let headers = u64::from_le_bytes(elf[32..40].try_into().unwrap()) as usize;
    let size = usize::from(u16::from_le_bytes(elf[54..56].try_into().unwrap()));
    let count = usize::from(u16::from_le_bytes(elf[56..58].try_into().unwrap()));
    for i in 0..count {
        let kind = u32::from_le_bytes(elf[headers + i * size..][..4].try_into().unwrap());
        assert_ne!(kind, 3, "the program names an interpreter");
    }
}

#[test]
fn a_bad_model_is_reported_not_loaded() {
    let mut text = String::new();
    let error = entire_freestanding::report(&[1, 2, 3], &mut text).unwrap_err();
    assert!(!error.is_empty() && text.is_empty(), "{error} {text}");
}
