//! Slowdown of frames over time by other programs: recorded once, replayed under any controller.

use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Start and slowdown of a recorded frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Slowdown {
    /// Seconds since the recording began.
    pub start_s: f64,
    /// Wall time of the frame divided by the wall time of an undisturbed frame.
    pub slowdown: f64,
}

/// A recording of slowdowns. A replay that is longer than the recording repeats it.
#[derive(Clone, Debug, PartialEq)]
pub struct Disturbance {
    /// Name in tables.
    pub name: String,
    frames: Vec<Slowdown>,
    /// Length of the recording, seconds.
    length: f64,
}

impl Disturbance {
    /// Reads a table of `start_s` and `slowdown` (`entire-lab disturb`).
    ///
    /// # Errors
    /// For a file of another kind, fewer than two frames, times that do not ascend from 0 or are not finite,
    /// and slowdowns that are not finite and positive.
    pub fn open(file: &Path) -> Result<Self> {
        let place = || format!("{}", file.display());
        let mut reader = csv::Reader::from_path(file).with_context(place)?;
        let frames = reader.deserialize().collect::<Result<Vec<Slowdown>, _>>().with_context(place)?;
        let name = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Self::new(name, frames).with_context(place)
    }

    /// Makes a recording of these frames.
    ///
    /// # Errors
    /// As [`Disturbance::open`].
    pub fn new(name: String, frames: Vec<Slowdown>) -> Result<Self> {
        ensure!(frames.len() >= 2, "a recording of slowdowns needs at least 2 frames, not {}", frames.len());
        ensure!(
            frames[0].start_s == 0.0 && frames.windows(2).all(|w| w[0].start_s < w[1].start_s),
            "the column start_s must ascend from 0"
        );
        ensure!(
            frames.iter().all(|f| f.start_s.is_finite() && f.slowdown.is_finite() && f.slowdown > 0.0),
            "both columns must be finite, and slowdown positive in every row"
        );
        let last = frames.len() - 1;
        // The last frame lasts as long as the one before.
        let length = 2.0 * frames[last].start_s - frames[last - 1].start_s;
        Ok(Self { name, frames, length })
    }

    /// Length of the recording, seconds.
    pub fn length(&self) -> f64 {
        self.length
    }

    /// Wall seconds of a frame that starts at `start` and takes `seconds` without disturbance.
    pub fn wall(&self, start: f64, seconds: f64) -> f64 {
        let begin = start.rem_euclid(self.length);
        let mut i = self.frames.partition_point(|f| f.start_s <= begin).saturating_sub(1);
        let (mut at, mut left, mut wall) = (begin, seconds, 0.0);
        loop {
            let end = self.frames.get(i + 1).map_or(self.length, |f| f.start_s);
            let slowdown = self.frames[i].slowdown;
            let done = (end - at) / slowdown;
            if done >= left {
                return wall + left * slowdown;
            }
            (wall, left) = (wall + end - at, left - done);
            i = (i + 1) % self.frames.len();
            at = self.frames[i].start_s;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(start_s: f64, slowdown: f64) -> Slowdown {
        Slowdown { start_s, slowdown }
    }

    #[test]
    fn a_frame_takes_as_long_as_its_parts_are_slowed_down() {
        let d =
            Disturbance::new("d".into(), vec![frame(0.0, 1.0), frame(1.0, 2.0), frame(3.0, 1.0)]).unwrap();
        assert_eq!(d.length(), 5.0);
        let near = |start: f64, seconds: f64, wall: f64| {
            assert!(
                (d.wall(start, seconds) - wall).abs() < 1e-12,
                "{start} {seconds}: {}",
                d.wall(start, seconds)
            );
        };
        near(0.2, 0.5, 0.5);
        near(1.0, 0.5, 1.0);
        // The first of these frames is half before the slow part and half in it; the second frame ends after
        // the slow part.
        near(0.5, 1.0, 1.5);
        near(2.5, 1.0, 0.5 + 0.75);
        // A frame that lasts longer than the recording: the recording repeats.
        near(4.0, 4.0 * 3.0 + 1.0, 5.0 * 3.0 + 1.0);
    }

    #[test]
    fn what_is_no_recording_is_refused() {
        for (frames, says) in [
            (vec![frame(0.0, 1.0)], "at least 2"),
            (vec![frame(1.0, 1.0), frame(2.0, 1.0)], "ascend from 0"),
            (vec![frame(0.0, 1.0), frame(0.0, 1.0)], "ascend from 0"),
            (vec![frame(0.0, 1.0), frame(1.0, 0.0)], "positive"),
            (vec![frame(0.0, 1.0), frame(f64::INFINITY, 1.0)], "finite"),
        ] {
            let error = Disturbance::new("d".into(), frames).unwrap_err();
            assert!(error.to_string().contains(says), "{error}");
        }
    }
}
