//! Study of a device within a given time: pictures compared with those of the CPU version, the device's
//! rates, timing tables in all shading modes, models of the machine, a path with switches, and a report.
//! Every step is stored when it is finished, so that an interrupted run can be continued.

pub(crate) mod pictures;
pub(crate) mod report;
pub(crate) mod steps;

use anyhow::{Context, Result};
use entire_io::files::{read_text, write_json};
use serde::{Deserialize, Serialize};
use std::path::Path;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum State {
    Done,
    /// Ended at its time limit; its partial result is used.
    CutShort,
    /// Cut off when the run ended; its partial result is used, and the next run continues it.
    Unfinished,
    Failed,
    /// The step was skipped for lack of time.
    LeftOut,
}

entire_core::names! { State:
    Done "done",
    CutShort "cut short",
    Unfinished "unfinished",
    Failed "failed",
    LeftOut "left out",
}

impl State {
    /// True if the step need not run again.
    pub(crate) fn is_over(self) -> bool {
        matches!(self, Self::Done | Self::CutShort)
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Outcome {
    pub(crate) step: String,
    #[serde(default)]
    pub(crate) arguments: Vec<String>,
    pub(crate) state: State,
    /// Wall seconds of the step.
    pub(crate) seconds: f64,
    /// Last line that the step printed, or the reason why it was left out.
    pub(crate) said: String,
}

/// The outcomes in a folder, stored after each step.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Outcomes(pub(crate) Vec<Outcome>);

impl Outcomes {
    const FILE: &str = "steps.json";

    /// Reads the outcomes of an earlier run in this folder; none if there was no run.
    pub(crate) fn of(folder: &Path) -> Result<Self> {
        let path = folder.join(Self::FILE);
        if !path.exists() {
            return Ok(Self::default());
        }
        serde_json::from_str(&read_text(&path, 1 << 20)?)
            .with_context(|| format!("{} is damaged; remove it to begin anew", path.display()))
    }

    pub(crate) fn has(&self, step: &str, arguments: &[String]) -> bool {
        self.0.iter().any(|o| o.step == step && o.arguments == arguments && o.state.is_over())
    }

    /// Stores an outcome, in place of an earlier one of the same step.
    pub(crate) fn keep(&mut self, outcome: Outcome, folder: &Path) -> Result<()> {
        match self.0.iter_mut().find(|o| o.step == outcome.step) {
            Some(old) => *old = outcome,
            None => self.0.push(outcome),
        }
        write_json(&folder.join(Self::FILE), self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outcomes_are_kept_and_failed_steps_run_again() {
        let dir = tempfile::tempdir().unwrap();
        let mut outcomes = Outcomes::of(dir.path()).unwrap();
        let of = |state| Outcome {
            step: "probe".into(),
            arguments: vec!["--short".into()],
            state,
            seconds: 1.0,
            said: "so".into(),
        };
        let has = |outcomes: &Outcomes| outcomes.has("probe", &["--short".into()]);
        outcomes.keep(of(State::Failed), dir.path()).unwrap();
        assert!(!has(&Outcomes::of(dir.path()).unwrap()));
        outcomes.keep(of(State::Unfinished), dir.path()).unwrap();
        assert!(!has(&Outcomes::of(dir.path()).unwrap()));
        outcomes.keep(of(State::CutShort), dir.path()).unwrap();
        let read = Outcomes::of(dir.path()).unwrap();
        assert!(has(&read) && read.0.len() == 1 && read == outcomes);
        assert!(!read.has("probe", &[]));
        std::fs::write(dir.path().join("steps.json"), "[{").unwrap();
        assert!(Outcomes::of(dir.path()).unwrap_err().to_string().contains("remove it"));
    }
}
