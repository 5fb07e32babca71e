//! Whose seconds: a model and a steered renderer that disagree are compared by a factor that nobody meant.

use entire_core::model::{Key, Model};
use entire_core::names;

/// A clock that frames are timed by.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Clock {
    /// Processor time of the rendering process, over all of its threads.
    Cpu,
    /// Wall time from the start of a frame to its end.
    Wall,
    /// Time on the rendering device, by its own timestamps.
    Device,
}

names! { Clock:
    Cpu "cpu",
    Wall "wall",
    Device "device",
}

impl Clock {
    /// The clock of this name: `cpu`, `wall` or `device`; `None` for any other text.
    pub fn named(name: &str) -> Option<Self> {
        [Self::Cpu, Self::Wall, Self::Device].into_iter().find(|c| c.name() == name)
    }

    /// The clock whose seconds a model predicts, as its file says under [`Key::Clock`]; `None` where it says
    /// nothing.
    pub fn of(model: &Model) -> Option<Self> {
        Self::named(model.metadata().get(Key::Clock.name())?)
    }
}
