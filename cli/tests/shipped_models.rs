//! The encoders in `models/` give what PyTorch gives for the same files.

use entire_cli::volume::Volume;
use entire_core::model::Model;
use entire_core::nn::{Executor, VOLUMENET_TOLERANCE, VolumeNet};
use std::path::Path;

/// Features by `examples/volumenet/encode.py --double`.
const GOLDEN: [(&str, &str, [f64; 2]); 6] = [
    ("volumenet-64f2", "castro_blast/m05/t0012.nrrd", [-0.890949843, 2.90556979]),
    ("volumenet-64f2", "maestroex_bubbles/m03/t0015.nrrd", [2.42874764, -7.57150944]),
    ("volumenet-64f2", "mr_banana.nrrd", [2.6435271, -7.84255203]),
    ("volumenet-128f2", "castro_blast/m05/t0012.nrrd", [8.2085767, 2.47007466]),
    ("volumenet-128f2", "maestroex_bubbles/m03/t0015.nrrd", [-25.7473061, -8.24082264]),
    ("volumenet-128f2", "mr_banana.nrrd", [-27.0670349, -8.75770166]),
];

#[test]
fn shipped_encoders_agree_with_pytorch_in_double_precision() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    for (model, volume, expected) in GOLDEN {
        let bytes = std::fs::read(root.join("models").join(format!("{model}.safetensors"))).unwrap();
        let model_file = Model::from_bytes(&bytes).unwrap();
        let net = VolumeNet::new(model_file.volumenet().unwrap()).unwrap();
        let volume_file = Volume::open(root.join("data").join(volume)).unwrap();
        let mut features = [0.0f32; 2];
        net.encode(&volume_file.view(), &mut net.scratch(), Executor::serial(), &mut features).unwrap();
        let norm = expected.iter().map(|e| e * e).sum::<f64>().sqrt();
        for (found, expected) in features.iter().zip(expected) {
            let error = (f64::from(*found) - expected).abs() / norm;
            assert!(error <= VOLUMENET_TOLERANCE, "{model} on {volume}: {features:?}, error {error:e}");
        }
    }
}

#[test]
fn every_shipped_model_has_a_card_and_provenance() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().join("models");
    let mut models = 0;
    for entry in std::fs::read_dir(&folder).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|e| e == "safetensors") {
            let model = Model::from_bytes(&std::fs::read(&path).unwrap()).unwrap();
            let provenance: serde_json::Value = serde_json::from_str(model.provenance().unwrap()).unwrap();
            assert!(provenance.is_object(), "{}", path.display());
            let card = std::fs::read_to_string(path.with_extension("md")).unwrap();
            for heading in ["## Use", "## Data", "## Training", "## Limits"] {
                assert!(card.contains(heading), "{}: {heading}", path.display());
            }
            models += 1;
        }
    }
    assert!(models >= 2);
}
