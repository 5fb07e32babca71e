//! Clocks of frame times. If a model predicts times of one clock and a renderer reports times of another
//! clock, these times differ by a factor that is neither the model's error nor the machine's speed.

use core::str::FromStr;
use entire_core::model::{Key, Model};
use entire_core::{Error, Result, bail, names};

/// A clock of frame times.
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
    /// Returns the clock with this name; `None` for any other text.
    pub(crate) fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|c| c.name() == name)
    }

    /// Returns the clock whose seconds a model predicts, from [`Key::Clock`] of its file; `None` if the file
    /// states no clock.
    pub(crate) fn of(model: &Model) -> Option<Self> {
        Self::named(model.metadata.get(Key::Clock.name())?)
    }
}

impl FromStr for Clock {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        let Some(clock) = Self::named(name) else {
            bail!(InvalidArgument, "clock is {name:?}; cpu, wall or device is expected")
        };
        Ok(clock)
    }
}
