//! Checks that a program without libc, with a fixed arena as memory, loads a model and predicts with the same
//! bits as this build with the standard library, on every level (instruction set).

use entire_core::model::{Model, ModelFile};

/// Returns the PredNet of one golden model and the VolumeNet of another in one file. Together they use panels
/// of each width, and numbers of inputs and channels that are no multiples of a vector length.
fn model() -> Vec<u8> {
    let golden = |name: &str| {
        let path = format!("{}/golden/{name}.safetensors", env!("CARGO_MANIFEST_DIR"));
        std::fs::read(&path).unwrap_or_else(|e| panic!("{path}: {e}"))
    };
    let mut file = ModelFile::from_bytes(&golden("volume16_kernels")).unwrap();
    let predictor = Model::from_bytes(&golden("panels_f16")).unwrap();
    file.set_prednet(predictor.prednet.as_ref().unwrap(), &predictor.inputs).unwrap();
    file.metadata.extend(predictor.metadata);
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
