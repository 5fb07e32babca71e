//! A whole comparison: random scenes at several steps, a target, and a path under every controller.

use super::calibrate::{measure, response};
use super::contenders::{ControllerKind, contender};
use super::model::{SteeringModel, Steers};
use super::play::{Contender, Course, Playback, Shown, Task, play};
use super::report::ResponseCurve;
use super::rivals::StepResponse;
use crate::calibrate::place::{machine_model, of_another_kind, shading_of};
use crate::shipped::shipped_model;
use anyhow::{Context, Result};
use entire_core::model::{Model, ModelFile};
use entire_core::scene::{Shading, VolumeView};
use entire_io::clock::ClockChoice;
use entire_io::dataset::Clock;
use entire_io::metrics::median;
use entire_io::options::DrawSettings;
use entire_io::path::FlightPath;
use entire_io::progress::progress_bar;
use entire_io::scenes::SceneDistribution;
use entire_steer::features::VolumeSummary;
use entire_vk_raycaster::Renderer;
use std::path::Path;

#[derive(Clone, Debug)]
pub(crate) struct Race<'a> {
    pub(crate) volume: &'a VolumeView<'a>,
    /// The file of `volume`.
    pub(crate) file: &'a Path,
    /// Volumes of a series after the first one. Random scenes are of the first volume only.
    pub(crate) series: &'a [VolumeView<'a>],
    pub(crate) course: Course<'a>,
    pub(crate) seed_name: &'a str,
    pub(crate) seed: u64,
    pub(crate) draw: DrawSettings,
    /// Number of random scenes, and of their renderings at each step.
    pub(crate) scenes: (usize, usize),
    pub(crate) controllers: &'a [ControllerKind],
    /// Target, seconds; `None` for [`TARGET_SHARE`] of the median time of the random scenes.
    pub(crate) target: Option<f64>,
    pub(crate) model: &'a SteeringModel,
    /// The predictor's error, if it is known, for controllers that correct the predictor.
    pub(crate) log_sd: Option<f32>,
}

/// Returns name and model of the predictor: the given model, else the machine's, else the shipped one. The
/// flag is true unless the model is the shipped one.
pub(crate) fn chosen_model(
    given: Option<(String, Model)>,
    machine: Option<(String, ModelFile)>,
    shading: Shading,
) -> Result<(String, Model, bool)> {
    if let Some((title, model)) = given {
        return Ok((title, model, true));
    }
    let known = machine.is_some();
    let (title, file) = machine.map_or_else(|| shipped_model(shading), Ok)?;
    Ok((title, file.to_model()?, known))
}

/// Returns the [chosen](chosen_model) model, and its error for controllers, if it is known. Sessions scale
/// the shipped model to this machine frame by frame.
pub(crate) fn steering_model(
    given: Option<(String, Model)>,
    machine: Option<(String, ModelFile)>,
    shading: Shading,
    volume: &VolumeView<'_>,
) -> Result<(SteeringModel, Option<f32>)> {
    if let Some((name, model)) = &given
        && let Some(fitted) = shading_of(model).filter(|fitted| *fitted != shading)
    {
        entire_io::files::note(&format!(
            "{name} was fitted to frames with --shade {fitted}; this path is drawn with --shade {shading}"
        ));
    }
    let (title, model, known) = chosen_model(given, machine, shading)?;
    let corrected = if known { "" } else { ", corrected by the measured time of every frame" };
    let model = SteeringModel::new(title + corrected, model, volume)?;
    let log_sd = model.predictor()?.log_sd().filter(|_| known);
    Ok((model, log_sd))
}

/// Returns the machine's model for a shading mode, with its name, and the clock of frame times, which for
/// `auto` is the clock that this model states. The model is ignored, with a note, if it states no
/// clock or another clock than the requested one. It is also ignored if it was calibrated on a GPU and a
/// renderer in software draws, or the reverse.
pub(crate) fn machine_model_for(
    shading: Shading,
    asked: ClockChoice,
    renderer: &dyn Renderer,
) -> Result<(Option<(String, ModelFile)>, ClockChoice)> {
    let Some((path, file, stated)) = machine_model(shading)? else { return Ok((None, asked)) };
    if let Some(why) = of_another_kind(&path, &file, renderer.backend(), &renderer.device()) {
        entire_io::files::note(&format!(
            "{why}; `entire calibrate --shade {shading}` with the same --device makes a model of this \
             device, which replaces the present model unless --out names another file"
        ));
        return Ok((None, asked));
    }
    let Some(clock) = stated.filter(|c| asked.clock().is_none_or(|a| a == *c)) else {
        entire_io::files::note(&format!("{} {}", path.display(), ignored(shading, stated, asked)));
        return Ok((None, asked));
    };
    Ok((Some((format!("{}, of this machine", path.display()), file)), clock.into()))
}

/// Returns the reason why the machine's model is ignored, and the remedy.
fn ignored(shading: Shading, stated: Option<Clock>, asked: ClockChoice) -> String {
    let asked = asked.clock().map(Clock::name);
    let remedy = asked.map_or(String::new(), |name| format!(" --clock {name}"));
    match (stated, asked) {
        (Some(stated), Some(asked)) => format!(
            "is ignored: it predicts {} time, but frames are timed by the clock {asked} (`entire calibrate \
             --shade {shading}{remedy}` makes a model of that clock)",
            stated.name()
        ),
        _ => format!(
            "is ignored: it states no clock (`entire calibrate --shade {shading}{remedy}` makes a model that \
             states its clock)"
        ),
    }
}

#[derive(Clone, Debug)]
pub(crate) struct Prepared {
    pub(crate) summary: VolumeSummary,
    /// G: relative frame time over ray step.
    pub(crate) response: StepResponse,
    /// G with the samples that it was fitted to.
    pub(crate) curve: ResponseCurve,
    pub(crate) predictor: Steers,
    /// Target, seconds.
    pub(crate) target: f64,
    /// Median seconds of the random scenes at the reference step.
    pub(crate) full_quality: f64,
    /// Origin of the target; empty if the target was given.
    pub(crate) target_reason: String,
    pub(crate) fixed_step: f32,
}

/// Default target as a share of the median time of the random scenes at the reference step. At this target,
/// most scenes must be drawn at steps coarser than the reference step, and few at the coarsest step.
pub(crate) const TARGET_SHARE: f64 = 0.5;

/// Returns the distribution of random scenes: as in collections, but with one to three lobes, so that some
/// scenes show a nearly empty volume.
pub fn calibration_scenes() -> SceneDistribution {
    SceneDistribution { lobes: (1, 3), ..SceneDistribution::default() }
}

/// Renders random scenes of the volume at several steps and derives from them G, the predictor's errors, the
/// default target and the fixed step. The predictor is not fitted to these scenes.
///
/// Returns `None` when `stop` returned true.
pub(crate) fn prepare(
    race: &Race<'_>,
    renderer: &mut dyn Renderer,
    stop: &dyn Fn() -> bool,
) -> Result<Option<Prepared>> {
    let summary = VolumeSummary::new(race.volume)?;
    if stop() {
        return Ok(None);
    }
    let bar = progress_bar("measure");
    let samples = measure(
        race.volume,
        &summary,
        &race.draw,
        &calibration_scenes(),
        (race.seed, race.seed_name),
        race.scenes,
        renderer,
        stop,
        &bar,
    );
    bar.finish_and_clear();
    let Some(samples) = samples? else { return Ok(None) };
    let response = response(&samples)?;
    let predictor = Steers {
        title: race.model.title().to_owned(),
        on_this_volume: race
            .model
            .quality(&samples)
            .context("the model cannot predict frames of the volume")?,
        calibrated_on_this_volume: race.model.calibrated_on(race.file)?,
    };
    let at_reference = samples.iter().filter(|s| s.setting.step == 1.0).map(|s| s.seconds);
    let full_quality = median(&mut at_reference.collect::<Vec<_>>()).context("no scene was timed")?;
    let (target, target_reason) = match race.target {
        Some(target) => (target, String::new()),
        None => {
            let target = TARGET_SHARE * full_quality;
            // Over a millisecond, the target is rounded to a tenth of a millisecond.
            let target = if target > 1e-3 { (target * 1e4).round() / 1e4 } else { target };
            let share = 100.0 * TARGET_SHARE;
            (target, format!("{share:.0} % of the median random scene's time at the reference step"))
        }
    };
    let fixed_step = race.course.limits.clamp(response.step_ratio((target / full_quality) as f32));
    let curve = ResponseCurve::new(&samples, &response);
    Ok(Some(Prepared {
        summary,
        response,
        curve,
        predictor,
        target,
        full_quality,
        target_reason,
        fixed_step,
    }))
}

/// Plays the path.
///
/// Returns `None` when `stop` returned true.
pub(crate) fn run(
    race: &Race<'_>,
    prepared: &Prepared,
    path: &FlightPath,
    keep: &[usize],
    renderer: &mut dyn Renderer,
    stop: &dyn Fn() -> bool,
) -> Result<Option<Playback>> {
    let mut contenders: Vec<Contender> = race
        .controllers
        .iter()
        .map(|kind| {
            let predictor = race.model.predictor()?;
            Ok(contender(*kind, prepared.fixed_step, predictor, &prepared.response, race.log_sd))
        })
        .collect::<Result<_>>()?;
    let volume_features = race.model.volume_features().map(<[f32]>::to_vec);
    let mut shown = vec![Shown { view: race.volume, summary: prepared.summary.clone(), volume_features }];
    for view in race.series {
        if stop() {
            return Ok(None);
        }
        let (summary, volume_features) = (VolumeSummary::new(view)?, race.model.encode(view)?);
        shown.push(Shown { view, summary, volume_features });
    }
    let task = Task { volumes: &shown, path, target: prepared.target, course: race.course, keep };
    let bar = progress_bar("play");
    let playback = play(&task, &race.draw, renderer, &mut contenders, stop, &bar);
    bar.finish_and_clear();
    playback
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_model_that_is_ignored_can_be_made_again_by_the_command_in_the_note() {
        let said = ignored(Shading::None, Some(Clock::Cpu), ClockChoice::Wall);
        assert!(said.contains("predicts cpu time") && said.contains("--shade none --clock wall`"), "{said}");
        for (asked, command) in [
            (ClockChoice::Auto, "`entire calibrate --shade local`"),
            (ClockChoice::Wall, "`entire calibrate --shade local --clock wall`"),
        ] {
            let said = ignored(Shading::Local, None, asked);
            assert!(said.contains("states no clock") && said.contains(command), "{said}");
        }
    }
}
