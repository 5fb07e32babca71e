//! Invariants of the volumes and models that the readers return.

use crate::records::accepted;
use crate::volume::Volume;
use entire_core::kernels::Executor;
use entire_core::model::Model;
use entire_core::nn::{PredNet, VolumeNet};
use entire_core::scene::{Scalars, VolumeView, normalize};

/// Checks that an accepted volume has all its voxels and finite geometry, and that an error has a message.
pub fn check_volume<E: std::fmt::Display>(read: Result<Volume, E>) {
    let Some(volume) = accepted(read) else { return };
    let view = volume.view();
    assert_eq!(view.shape().voxels, volume.data().len() as u64);
    assert!(view.shape().half_extent.is_finite() && view.shape().reference_step > 0.0);
    let [x, y, z] = view.shape().dims;
    assert!((0.0..=1.0).contains(&normalize(view.range(), view.value(x - 1, y - 1, z - 1))));
}

/// Checks that the networks of an accepted model can be built and run, and that an error has a message.
pub fn check_model<E: std::fmt::Display>(read: Result<Model, E>) {
    let Some(model) = accepted(read) else { return };
    if let Some(parts) = model.prednet.as_ref() {
        let net = PredNet::new(parts).expect("a checked model can be built");
        let mut scratch = net.scratch(1).expect("memory for one row");
        let _ = net.predict(&vec![0.5; net.inputs()], &mut scratch);
    }
    if let Some(parts) = model.volumenet.as_ref().filter(|parts| parts.input <= 16) {
        let net = VolumeNet::new(parts).expect("a checked model can be built");
        let voxels = [0, 100, 255, 7, 9, 11, 13, 200];
        let view = VolumeView::new(Scalars::U8(&voxels), [2, 2, 2]).expect("eight voxels");
        let mut features = vec![0.0; net.feature_len()];
        net.encode(&view, &mut net.scratch(), Executor::Serial, &mut features)
            .expect("any volume can be encoded");
    }
}
