//! What the probe bars time, behind a line protocol so that two builds of the crate can be timed in turns: a
//! line
//! `NAME` in, a line `@@{"seconds": […]}` out, one number for each scene or call.
//!
//! The calls of [`calls`] need only what older versions of the crate have too; [`scene`] and those below are of
//! this one.

mod calls;
mod scene;

use calls::{Types, Volumes, report, time};
use entire_core::nn::Executor;
use entire_core::{Result, VolumeView};
use entire_steer::features::{SummaryBuilder, SummaryOptions, SummarySeries, VolumeSummary};
use std::hint::black_box;

/// A summary on the executor's threads.
fn summary(view: &VolumeView<'_>, executor: Executor<'_>) -> Result<VolumeSummary> {
    let mut builder = SummaryBuilder::new(view, view.shape().dims[2], SummaryOptions::default())?;
    builder.add(view, executor)?;
    builder.finish()
}

/// A time step of a series: `same`, of which nothing changed but that must be found out; `box`, of which a
/// box of 64³ voxels changed, which is said.
fn time_step(view: &VolumeView<'_>, what: &str) -> Option<f64> {
    let planes = view.shape().dims[2];
    let mut series = SummarySeries::new(view, planes, SummaryOptions::default()).expect("a series");
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
            let view = volumes.large(Types::parse(kind)?);
            report(vec![time_step(&view, what)?]);
            return Some(());
        }
        let kind = Types::parse(name.strip_prefix("summary2/")?)?;
        let view = volumes.large(kind);
        report(vec![time(|| {
            let executor = Executor::Rayon(&pool);
            black_box(summary(&view, executor).expect("a summary"));
        })]);
        Some(())
    });
}
