//! What the probe bars time, behind a line protocol so that two builds of the crate can be timed in turns: a
//! line
//! `NAME` in, a line `@@{"seconds": […]}` out, one number for each scene or call.
//!
//! The calls of [`calls`] need only what older versions of the crate have too; [`scene`] and those below are of
//! this one.

mod calls;
mod scene;

use calls::{Types, Volumes, report, time};
use entire_core::features::{SummaryBuilder, SummaryOptions, VolumeSummary};
use entire_core::nn::Executor;
use entire_core::{Result, VolumeView};
use std::hint::black_box;

/// A summary on the executor's threads.
fn summary(view: &VolumeView<'_>, executor: Executor<'_>) -> Result<VolumeSummary> {
    let mut builder = SummaryBuilder::new(view, view.shape().dims[2], SummaryOptions::default())?;
    builder.add(view, executor)?;
    builder.finish()
}

fn main() {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("two threads");
    let mut volumes = Volumes::default();
    calls::serve(&mut volumes, &mut |volumes: &mut Volumes, name: &str| {
        let kind = Types::parse(name.strip_prefix("summary2/")?)?;
        let view = volumes.large(kind);
        report(vec![time(|| {
            let executor = Executor::Rayon(&pool);
            black_box(summary(&view, executor).expect("a summary"));
        })]);
        Some(())
    });
}
