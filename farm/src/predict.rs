//! Base seconds of tasks before any measurement: from a model file, a list, the analytic model, or the
//! quotient pixels / step.

use super::job::{Job, Renderer, draw_settings, frame};
use super::record::parse_id;
use anyhow::{Context, Result, ensure};
use entire_core::kernels::Executor;
use entire_core::model::Model;
use entire_core::nn::VolumeNet;
use entire_core::scene::{Shading, Skipping};
use entire_io::dataset::Clock;
use entire_io::files::{note, open_model};
use entire_io::progress::progress_bar;
use entire_io::volume::open_volume;
use entire_steer::features::{Changes, FrameFeatures, PROBE_SIDE, Setting, TransferSummary, VolumeSummary};
use entire_steer::predict::{AnalyticModel, Inputs, Predictor, load};
use rayon::prelude::*;
use std::path::Path;

/// Assumed time per pixel at a step of one reference step, before any measurement, in nanoseconds.
const NANOSECONDS: f64 = 1000.0;

/// Source of base seconds, for display.
pub fn source(job: &Job) -> String {
    match (&job.predict.model, &job.predict.list) {
        (Some(model), _) => {
            let clock = open_model(model).ok().and_then(|m| entire_io::clock::of(&m));
            let seconds = clock.map_or(String::new(), |c| format!(" ({} seconds)", c.name()));
            format!("the model {}{seconds}", model.display())
        }
        (_, Some(list)) => format!("the list {}", list.display()),
        _ if looks(job) => "the analytic model, its scale fitted to the first tasks".into(),
        _ => "pixels divided by step, scaled to the measured times of the first tasks".into(),
    }
}

fn looks(job: &Job) -> bool {
    job.predict.analytic.unwrap_or(matches!(job.renderer, Renderer::Entire { .. }))
}

/// Returns ln of the base seconds of every task.
///
/// # Errors
/// When a model, list or volume cannot be read, or an input of a model is missing.
pub fn base(job: &Job) -> Result<Vec<f32>> {
    if let Some(list) = &job.predict.list {
        return of_list(job, list);
    }
    if job.predict.model.is_some() || looks(job) {
        return of_views(job);
    }
    // Size and step are the innermost dimensions of the task number, so the values repeat.
    let one = job.sizes.len() * job.steps.len();
    let round: Vec<f32> = (0..one)
        .map(|task| {
            let at = job.place(task);
            let [width, height] = job.sizes[at.size].map(f64::from);
            (1e-9 * NANOSECONDS * width * height / f64::from(job.steps[at.step])).ln() as f32
        })
        .collect();
    Ok(round.iter().copied().cycle().take(job.len()).collect())
}

fn of_list(job: &Job, list: &Path) -> Result<Vec<f32>> {
    let tasks = super::list::read_tasks(list)?;
    let numbers = job.numbers();
    let mut out = vec![f32::NAN; job.len()];
    for t in &tasks {
        // A list may contain tasks of other jobs.
        if let Some(&i) = parse_id(&t.task).and_then(|id| numbers.get(&id)) {
            let seconds = t.predicted_s.or(t.measured_s).unwrap_or(0.0);
            out[i as usize] = seconds.max(1e-9).ln() as f32;
        }
    }
    let missing = out.iter().filter(|v| v.is_nan()).count();
    ensure!(
        missing == 0,
        "{}: {missing} of the job's {} tasks are not in the list; `entire farm JOB --save-tasks FILE` writes \
         a list with all ids",
        list.display(),
        job.len()
    );
    Ok(out)
}

/// Prints a note if a model predicts seconds of another clock than wall time, which tasks are measured by.
fn note_clock(path: &Path, model: &Model) {
    if let Some(clock) = entire_io::clock::of(model).filter(|c| *c != Clock::Wall) {
        note(&format!(
            "{} predicts {} seconds, but tasks are measured by wall time: expected times are off by a factor \
             until tasks have been measured",
            path.display(),
            clock.name()
        ));
    }
}

/// Returns ln of the base seconds of every task, predicted from volumes, transfer functions and views.
fn of_views(job: &Job) -> Result<Vec<f32>> {
    let draw = match &job.renderer {
        own @ Renderer::Entire { .. } => draw_settings(own)?.0,
        _ => (Shading::None, Skipping::None, 0.99),
    };
    let model = job.predict.model.as_ref().map(|p| open_model(p)).transpose()?;
    if let (Some(path), Some(model)) = (&job.predict.model, &model) {
        note_clock(path, model);
    }
    let make = || -> Result<Box<dyn Predictor + Send>> {
        Ok(match &model {
            Some(model) => load(model)?,
            None => Box::new(AnalyticModel::default()),
        })
    };
    let side =
        if model.is_some() { make()?.probe_side() } else { job.predict.probe_side.unwrap_or(PROBE_SIDE) };
    let encoder = model.as_ref().and_then(|m| m.volumenet.as_ref()).map(VolumeNet::new).transpose()?;
    let bar = progress_bar("predicting tasks");
    bar.set_length(job.volumes.len() as u64);
    let mut out = Vec::with_capacity(job.len());
    for (index, file) in job.volumes.iter().enumerate() {
        let volume = open_volume(&file.path, &file.reading)?;
        let view = volume.view();
        let summary = VolumeSummary::new(&view).with_context(|| format!("{}", file.path.display()))?;
        let code = match &encoder {
            Some(net) => {
                let mut code = vec![0.0; net.feature_len()];
                net.encode(&view, &mut net.scratch(), Executor::Serial, &mut code)?;
                Some(code)
            }
            None => None,
        };
        let mut transfers = Vec::new();
        for named in &job.transfers {
            let transfer = TransferSummary::new(&summary, &named.transfer.function().to_table()?)?;
            transfers.push((transfer, named.transfer.lobes()));
        }
        let seconds: Vec<f32> = job
            .tasks_of(index)
            .into_par_iter()
            .map_init(
                || (make(), transfers.clone()),
                |(predictor, transfers), task| -> Result<f32> {
                    let predictor = predictor.as_mut().map_err(|e| anyhow::anyhow!("{e:#}"))?;
                    let at = job.place(task);
                    let pose = job.cameras[at.camera];
                    let frame = frame(pose, job.fov_y_deg, job.sizes[at.size], job.steps[at.step], draw)?;
                    let (transfer, lobes) = &mut transfers[at.transfer];
                    let features = FrameFeatures::of(&summary, transfer, &frame, side)?;
                    let predicted = predictor.predict(&Inputs {
                        features: &features,
                        setting: Setting::from(&frame),
                        changes: Changes::default(),
                        camera: pose,
                        volume_features: code.as_deref(),
                        lobes: lobes.as_deref(),
                    })?;
                    Ok(predicted.seconds.max(1e-9).ln())
                },
            )
            .collect::<Result<_>>()?;
        out.extend(seconds);
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(out)
}
