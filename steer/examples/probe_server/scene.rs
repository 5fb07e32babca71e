//! Construction of the timed objects, for this version of the crate.

use entire_core::scene::{Camera, Frame, Scalars, Shading, VolumeOptions, VolumeView};
use entire_steer::control::Session;
use entire_steer::features::VolumeSummary;

pub(crate) fn volume(scalars: Scalars<'_>, dims: [usize; 3], range: (f32, f32)) -> VolumeView<'_> {
    VolumeView::with(scalars, dims, VolumeOptions { range: Some(range), ..VolumeOptions::default() })
        .expect("a volume")
}

/// A volume's summary, made on one thread.
pub(crate) fn summary(volume: &VolumeView<'_>) -> VolumeSummary {
    VolumeSummary::new(volume).expect("a summary")
}

pub(crate) fn frame(camera: Camera, shading: Shading) -> Frame {
    Frame { shading, ..Frame::new(camera, 1024, 768).expect("a frame") }
}

/// A session with `side` probe rays along each side.
pub(crate) fn session(side: usize) -> Session {
    Session::default().with_probe(side, None).expect("a side")
}
