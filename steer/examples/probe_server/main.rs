//! Server for the probe's benchmark, which times two builds of the crate alternately. Reads lines `NAME`, and
//! answers each with a line `@@{"seconds": […]}`, one number per scene or call.
//!
//! [`calls`] uses only functions common to several versions of the crate; [`scene`] and the functions below
//! depend on this version.

mod calls;
mod scene;

use calls::{Volumes, report, time};
use entire_core::VolumeView;
use entire_core::kernels::Executor;
use entire_steer::features::{SummarySeries, VolumeSummary};
use std::hint::black_box;

/// Returns the seconds in which a series is updated by a time step with the same voxels. If `what` is `same`,
/// all voxels are compared; if it is `box`, only a given box of 64³ voxels is scanned.
fn time_step(view: &VolumeView<'_>, what: &str) -> Option<f64> {
    let planes = view.shape().dims[2];
    let mut series = SummarySeries::new(view).expect("a series");
    series.update(view, None, Executor::Serial).expect("the first time step");
    let changed = match what {
        "same" => None,
        "box" => Some([200..264, 200..264, planes / 2..planes / 2 + 64]),
        _ => return None,
    };
    Some(time(|| {
        black_box(series.update(black_box(view), changed, Executor::Serial).expect("a time step"));
    }))
}

fn main() {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("two threads");
    let mut volumes = Volumes::default();
    calls::serve(&mut volumes, &mut |volumes: &mut Volumes, name: &str| {
        if let Some((kind, what)) = name.strip_prefix("step/").and_then(|rest| rest.split_once('/')) {
            let view = volumes.large(kind)?;
            report(vec![time_step(&view, what)?]);
            return Some(());
        }
        let view = volumes.large(name.strip_prefix("summary2/")?)?;
        report(vec![time(|| {
            let executor = Executor::Rayon(&pool);
            black_box(VolumeSummary::new_on(&view, executor).expect("a summary"));
        })]);
        Some(())
    });
}
