//! The clock whose seconds a model predicts. Model, timing table and steered renderer must use the same
//! clock: seconds of two clocks can differ by a large factor.

use crate::dataset::{Clock, TimedFrame};
use crate::options::{described, is_software};
use anyhow::{Result, bail, ensure};
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use entire_core::model::{Key, Model, ModelFile};
use entire_vk_raycaster::Renderer;

/// Choice of a clock by an option; `None` for `auto`. If the option's help text states a clock for `auto`,
/// this clock is meant; otherwise the device's timestamps if all frames have them, else wall time.
pub type ClockChoice = Option<Clock>;

/// Returns the clock that a model states: under [`Key::Clock`], else in its provenance. `None` if it states
/// no clock.
pub fn of(model: &Model) -> Option<Clock> {
    let of_provenance = || {
        let provenance: serde_json::Value =
            serde_json::from_str(model.metadata.get(Key::Provenance.name())?).ok()?;
        Some(provenance.get("clock")?.as_str()?.to_owned())
    };
    let name = model.metadata.get(Key::Clock.name()).cloned().or_else(of_provenance)?;
    name.parse().ok()
}

/// Writes the clock into a model file.
pub fn set(file: &mut ModelFile, clock: Clock) {
    file.metadata.insert(Key::Clock.into(), clock.name().into());
}

/// Value of `--clock` that leaves the choice to the command.
const AUTO: &str = "auto";

/// Returns the names of the clocks, with their descriptions.
fn named_clocks() -> Vec<PossibleValue> {
    let texts = ["Device timestamps", "Wall time on the host", "Process CPU time, all threads"];
    described([Clock::Device, Clock::Wall, Clock::Cpu].map(Clock::name), texts)
}

/// Returns the parser of an option for the clocks that a model can state: all but `auto`, which depends on
/// the device.
pub fn fixed_parser() -> impl TypedValueParser<Value = Clock> {
    PossibleValuesParser::new(named_clocks()).try_map(|name| name.parse::<Clock>())
}

/// Returns the parser of `--clock`.
pub fn clock_parser() -> impl TypedValueParser<Value = ClockChoice> {
    let auto = PossibleValue::new(AUTO).help(
        "Device timestamps if all frames have them, wall time if none has (mixed frames are refused), unless \
         another rule for `auto` is stated above",
    );
    PossibleValuesParser::new([auto].into_iter().chain(named_clocks()))
        .try_map(|name| if name == AUTO { Ok(None) } else { name.parse::<Clock>().map(Some) })
}

/// Returns the chosen clock; for `auto`, device time if every repeat of the frames has it, wall time if no
/// repeat has it.
///
/// # Errors
/// When only some repeats have device timestamps: their times are not comparable.
pub fn concrete<'a>(asked: ClockChoice, frames: impl IntoIterator<Item = &'a TimedFrame>) -> Result<Clock> {
    if let Some(clock) = asked {
        return Ok(clock);
    }
    let (mut all, mut with) = (0usize, 0usize);
    for repeat in frames.into_iter().flat_map(|f| &f.repeats) {
        all += 1;
        with += usize::from(repeat.device.is_some());
    }
    ensure!(
        with == 0 || with == all,
        "{with} of {all} repeats have device timestamps, the others have none; choose another clock: --clock \
         wall, or --clock cpu if all repeats have CPU time"
    );
    Ok(if with > 0 { Clock::Device } else { Clock::Wall })
}

/// Returns the chosen clock; for `auto`, device timestamps on a GPU that has them, else wall time.
pub fn waited_for(asked: ClockChoice, renderer: &dyn Renderer) -> Clock {
    let timestamps = renderer.limits().is_some_and(|l| l.timestamps.is_some());
    let auto = if timestamps && !is_software(renderer) { Clock::Device } else { Clock::Wall };
    asked.unwrap_or(auto)
}

/// Returns the clock whose seconds a new model learns: `asked` if given, else the clock of `base` (name and
/// clock of the model that training starts from), else CPU time. If `asked` is not given and some frames have
/// no time by the chosen clock, the clock that `auto` means for the frames is returned instead, and a note is
/// printed.
///
/// # Errors
/// Those of [`concrete`].
pub fn for_training<'a>(
    asked: Option<ClockChoice>,
    base: Option<(&str, Clock)>,
    frames: impl IntoIterator<Item = &'a TimedFrame> + Clone,
) -> Result<Clock> {
    let clock = match asked {
        Some(asked) => concrete(asked, frames)?,
        None => {
            let wanted = base.map_or(Clock::Cpu, |b| b.1);
            if frames.clone().into_iter().all(|f| f.seconds(wanted).is_some()) {
                wanted
            } else {
                let found = concrete(None, frames)?;
                crate::files::note(&format!(
                    "some frames have no {} time, so the model predicts {} seconds; to choose another \
                     clock, use --clock",
                    wanted.name(),
                    found.name()
                ));
                found
            }
        }
    };
    if let Some(text) = base.and_then(|(name, theirs)| started_from(name, Some(theirs), clock)) {
        crate::files::note(&text);
    }
    Ok(clock)
}

/// Returns a note that the new model has another clock than `theirs`, the clock of the model `name` from
/// which its training starts; `None` if `theirs` is the same clock or `None`.
pub fn started_from(name: &str, theirs: Option<Clock>, clock: Clock) -> Option<String> {
    let theirs = theirs.filter(|c| *c != clock)?;
    Some(format!(
        "{name} predicts {} seconds; the new model predicts {} seconds and learns the factor between the two \
         clocks from the frames",
        theirs.name(),
        clock.name()
    ))
}

/// Returns a note that names the models that state no clock; their predictions count as seconds of `clock`.
/// `None` if every model states a clock.
pub fn unstated<'a>(clock: Clock, models: impl IntoIterator<Item = (&'a str, &'a Model)>) -> Option<String> {
    let names: Vec<&str> = models.into_iter().filter(|m| of(m.1).is_none()).map(|m| m.0).collect();
    (!names.is_empty()).then(|| {
        format!(
            "no clock is stated by {}; their predictions are taken as {} seconds",
            names.join(", "),
            clock.name()
        )
    })
}

/// Returns the clock of an evaluation or of a comparison of controllers: the clock that the models state, or
/// `asked` if no model states a clock. All stated clocks must be equal and agree with `asked`.
///
/// # Errors
/// When models and the requested clock disagree; the error names the remedy.
pub fn agreed<'a>(
    asked: ClockChoice,
    models: impl IntoIterator<Item = (&'a str, &'a Model)>,
) -> Result<ClockChoice> {
    let mut found: Option<(&str, Clock)> = None;
    for (name, model) in models {
        let Some(clock) = of(model) else { continue };
        if let Some(other) = asked.filter(|c| *c != clock) {
            bail!(
                "{name} predicts {} seconds, but --clock asks for {}; leave --clock out, or make a model for \
                 the requested clock: `entire calibrate --clock {}` fits it to measurements of this machine \
                 or, with --data TABLE.csv, to a table",
                clock.name(),
                other.name(),
                other.name()
            );
        }
        if let Some((other, theirs)) = found {
            ensure!(
                theirs == clock,
                "{other} predicts {} seconds and {name} {} seconds; name models of one clock only",
                theirs.name(),
                clock.name()
            );
        }
        found = Some((name, clock));
    }
    Ok(found.map(|f| f.1).or(asked))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::Timing;
    use entire_steer::predict::AnalyticModel;

    fn model(clock: Option<Clock>, provenance: Option<&str>) -> Model {
        let mut file = AnalyticModel::default().to_model_file().unwrap();
        if let Some(clock) = clock {
            set(&mut file, clock);
        }
        if let Some(text) = provenance {
            file.metadata.insert(Key::Provenance.into(), text.into());
        }
        file.to_model().unwrap()
    }

    fn frame(repeats: &[Timing]) -> TimedFrame {
        TimedFrame { repeats: repeats.to_vec(), ..TimedFrame::of_no_volume("v", "") }
    }

    #[test]
    fn a_model_says_its_clock_in_a_key_of_its_own_or_in_its_provenance() {
        assert_eq!(of(&model(None, None)), None);
        assert_eq!(of(&model(Some(Clock::Wall), None)), Some(Clock::Wall));
        assert_eq!(of(&model(None, Some(r#"{"clock":"cpu"}"#))), Some(Clock::Cpu));
        assert_eq!(of(&model(Some(Clock::Device), Some(r#"{"clock":"cpu"}"#))), Some(Clock::Device));
        assert_eq!(of(&model(None, Some(r#"{"clock":"auto"}"#))), None);
        assert_eq!(of(&model(None, Some("not JSON"))), None);
    }

    #[test]
    fn models_and_commands_that_disagree_are_refused_with_a_remedy() {
        let (cpu, wall, none) =
            (model(Some(Clock::Cpu), None), model(Some(Clock::Wall), None), model(None, None));
        assert_eq!(agreed(None, [("a", &cpu), ("c", &none)]).unwrap(), Some(Clock::Cpu));
        assert_eq!(agreed(Some(Clock::Wall), [("b", &wall)]).unwrap(), Some(Clock::Wall));
        assert_eq!(agreed(Some(Clock::Wall), [("c", &none)]).unwrap(), Some(Clock::Wall));
        let text = agreed(Some(Clock::Wall), [("a", &cpu)]).unwrap_err().to_string();
        assert!(text.contains("a predicts cpu seconds") && text.contains("--clock wall"), "{text}");
        let text = agreed(None, [("a", &cpu), ("b", &wall)]).unwrap_err().to_string();
        assert!(text.contains("a predicts cpu seconds and b wall seconds"), "{text}");
    }

    #[test]
    fn what_states_no_clock_or_another_one_is_said() {
        let (cpu, none) = (model(Some(Clock::Cpu), None), model(None, None));
        let text = unstated(Clock::Wall, [("a", &cpu), ("b", &none), ("c", &none)]).unwrap();
        assert!(text.contains("by b, c;") && text.contains("wall seconds"), "{text}");
        assert_eq!(unstated(Clock::Wall, [("a", &cpu)]), None);
        let text = started_from("a", of(&cpu), Clock::Wall).unwrap();
        assert!(text.contains("a predicts cpu seconds") && text.contains("predicts wall seconds"), "{text}");
        assert_eq!(started_from("a", of(&cpu), Clock::Cpu), None);
        assert_eq!(started_from("b", of(&none), Clock::Cpu), None);
    }

    #[test]
    fn a_clock_that_a_model_can_state_is_not_auto() {
        #[derive(clap::Parser)]
        struct Line {
            #[arg(long, value_parser = fixed_parser(), default_value = "cpu")]
            clock: Clock,
        }
        let read = |arguments: &[&str]| {
            <Line as clap::Parser>::try_parse_from([&["line"], arguments].concat()).map(|l| l.clock)
        };
        assert_eq!(read(&[]).unwrap(), Clock::Cpu);
        for clock in [Clock::Cpu, Clock::Wall, Clock::Device] {
            assert_eq!(read(&["--clock", clock.name()]).unwrap(), clock);
        }
        for refused in ["auto", "CPU", "sundial"] {
            let text = read(&["--clock", refused]).unwrap_err().to_string();
            assert!(text.contains(refused) && text.contains("device, wall, cpu"), "{text}");
        }
    }

    #[test]
    fn auto_becomes_the_clock_that_all_frames_have() {
        let wall = Timing { wall: Some(0.1), ..Timing::default() };
        let both = Timing { device: Some(0.1), cpu: Some(0.2), ..wall };
        assert_eq!(concrete(None, [&frame(&[wall])]).unwrap(), Clock::Wall);
        assert_eq!(concrete(None, [&frame(&[both])]).unwrap(), Clock::Device);
        assert_eq!(concrete(Some(Clock::Cpu), [&frame(&[both])]).unwrap(), Clock::Cpu);
        let mixed = concrete(None, [&frame(&[both]), &frame(&[wall])]).unwrap_err().to_string();
        assert!(mixed.contains("1 of 2 repeats have device timestamps"), "{mixed}");
        // The default is CPU time, and a fine-tuned model keeps its clock. If some frames have no time by the
        // default clock, a clock that all frames have is used instead.
        let frames = [frame(&[both])];
        assert_eq!(for_training(None, None, &frames).unwrap(), Clock::Cpu);
        assert_eq!(for_training(None, Some(("m", Clock::Device)), &frames).unwrap(), Clock::Device);
        assert_eq!(
            for_training(Some(Some(Clock::Wall)), Some(("m", Clock::Device)), &frames).unwrap(),
            Clock::Wall
        );
        assert_eq!(for_training(None, None, &[frame(&[wall])]).unwrap(), Clock::Wall);
    }
}
