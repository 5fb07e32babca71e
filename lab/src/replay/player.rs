//! Controllers in a replay, and the quantities that they set.

use super::Replayable;
use clap::ValueEnum;
use entire_cli::steering::contenders::ControllerKind;
use entire_cli::steering::play::ActsOn;
use entire_io::files::note;

/// A controller in a replay.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Player {
    /// The controller.
    pub kind: ControllerKind,
    /// The quantity that the controller sets in this replay.
    pub acts_on: ActsOn,
    /// True if the controller's steps ignore a detected load
    /// ([`entire_steer::control::HybridOptions::ignore_load`]).
    pub ignore_load: bool,
}

impl Player {
    /// Returns players of the given controllers; of all controllers if `kinds` is empty.
    ///
    /// If a trace holds no smaller images, rules that act on image resolution act on the ray step instead, on
    /// all traces, so that each row of a table has one meaning. A note and the tables say so.
    pub fn all(kinds: &[ControllerKind], traces: &[Replayable]) -> Vec<Self> {
        let kinds = if kinds.is_empty() { ControllerKind::value_variants() } else { kinds };
        let without: Vec<&str> =
            traces.iter().filter(|t| t.images.is_none()).map(|t| t.trace.name.as_str()).collect();
        let players: Vec<Self> = kinds
            .iter()
            .map(|&kind| Self {
                kind,
                acts_on: if without.is_empty() { kind.acts_on() } else { ActsOn::RayStep },
                ignore_load: false,
            })
            .collect();
        let standing_in: Vec<&str> =
            players.iter().filter(|p| p.stands_in()).map(|p| p.kind.name()).collect();
        if !standing_in.is_empty() {
            note(&format!(
                "played on the ray step instead of image resolution: {}; {} of {} traces hold no smaller images \
                 ({}), which `entire-lab record` adds when it records them again",
                standing_in.join(", "),
                without.len(),
                traces.len(),
                without.join(", ")
            ));
        }
        players
    }

    /// True if the controller sets the ray step instead of its own quantity.
    pub fn stands_in(&self) -> bool {
        self.acts_on != self.kind.acts_on()
    }

    /// Name of the quantity that the controller sets, for tables.
    pub const fn acts_on_name(&self) -> &'static str {
        match (self.acts_on, self.kind.acts_on()) {
            (ActsOn::RayStep, ActsOn::ImageResolution { .. }) => "ray step instead",
            (acts_on, _) => acts_on.name(),
        }
    }
}
