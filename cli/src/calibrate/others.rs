//! Processor use by other programs while frames are timed.

use std::time::Instant;

/// Mean number of processors used by other programs above which a stretch of rendering counts as disturbed.
pub(crate) const DISTURBED_PROCESSORS: f64 = 0.25;

/// A point in time: processor seconds that the machine and this process had used by then.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CpuSnapshot {
    at: Instant,
    machine: Option<f64>,
    own: Option<f64>,
}

/// Clock ticks per second of `/proc`: 100 on x86-64 and Arm.
const TICKS: f64 = 100.0;

impl CpuSnapshot {
    pub(crate) fn now() -> Self {
        Self {
            at: Instant::now(),
            machine: std::fs::read_to_string("/proc/stat").ok().and_then(|t| machine_seconds(&t)),
            own: std::fs::read_to_string("/proc/self/stat").ok().and_then(|t| own_seconds(&t)),
        }
    }

    /// Returns the wall seconds since the snapshot, and the processor seconds that other programs used;
    /// `None` instead of the processor seconds where the system does not report them. The counters have a
    /// resolution of 0.01 s, so the processor seconds of a short stretch may be negative.
    pub(crate) fn others(&self) -> (f64, Option<f64>) {
        let now = Self::now();
        let wall = now.at.duration_since(self.at).as_secs_f64();
        (wall, (|| Some((now.machine? - self.machine?) - (now.own? - self.own?)))())
    }
}

/// Shortest stretch of rendering for which the counters are fine enough, wall seconds.
const MIN_STRETCH: f64 = 0.1;

/// Successive stretches of rendering, joined until they are long enough for the counters.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Joined {
    wall: f64,
    others: Option<f64>,
}

impl Joined {
    pub(crate) const EMPTY: Self = Self { wall: 0.0, others: Some(0.0) };

    /// Adds a stretch of `wall` seconds in which other programs used `others` processor seconds. Returns true
    /// if the stretches are long enough.
    pub(crate) fn add(&mut self, (wall, others): (f64, Option<f64>)) -> bool {
        self.wall += wall;
        self.others = self.others.zip(others).map(|(a, b)| a + b);
        self.wall > MIN_STRETCH
    }

    /// Returns the wall seconds, and the mean number of processors that other programs used; `None` for this
    /// number if it is not known or the stretches are too short.
    pub(crate) fn mean(&self) -> (f64, Option<f64>) {
        let known = self.others.filter(|_| self.wall > MIN_STRETCH);
        (self.wall, known.map(|o| (o / self.wall).max(0.0)))
    }
}

/// Busy processor seconds of all processors: the first line of `/proc/stat` without idle and waiting time.
/// Time stolen by other virtual machines counts as busy.
fn machine_seconds(text: &str) -> Option<f64> {
    let line = text.lines().find_map(|l| l.strip_prefix("cpu "))?;
    let ticks: Vec<f64> = line.split_whitespace().map_while(|w| w.parse().ok()).collect();
    // Columns: user nice system idle iowait irq softirq steal; guest time is part of user time.
    let at = |i: usize| ticks.get(i).copied().unwrap_or(0.0);
    (ticks.len() >= 4).then(|| (at(0) + at(1) + at(2) + at(5) + at(6) + at(7)) / TICKS)
}

/// User and system seconds of `/proc/self/stat`, all threads. The program's name may contain blanks; the
/// fields follow its closing bracket.
fn own_seconds(text: &str) -> Option<f64> {
    let fields: Vec<&str> = text.rsplit_once(')')?.1.split_whitespace().collect();
    Some((fields.get(11)?.parse::<f64>().ok()? + fields.get(12)?.parse::<f64>().ok()?) / TICKS)
}

/// Load of other programs over a calibration.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct BackgroundLoad {
    /// Wall seconds of the stretches of rendering whose load is known.
    pub seconds: f64,
    /// Part of `seconds` in which other programs used more than [`DISTURBED_PROCESSORS`] processors.
    pub disturbed: f64,
    /// Mean number of processors that other programs used; `None` where the system does not report it.
    pub mean: Option<f64>,
    /// Number of frames that have only disturbed repeats.
    pub frames: usize,
}

impl BackgroundLoad {
    /// Adds a stretch of `wall` seconds in which other programs used `others` processors on average; `None`
    /// if this number is not known.
    pub(crate) fn add(&mut self, wall: f64, others: Option<f64>) {
        let Some(others) = others else { return };
        let before = self.mean.unwrap_or(0.0) * self.seconds;
        self.seconds += wall;
        self.mean = Some((before + others * wall) / self.seconds.max(1e-9));
        if others > DISTURBED_PROCESSORS {
            self.disturbed += wall;
        }
    }

    /// Returns a text with the share of disturbed time, and with the number of frames that have only
    /// disturbed repeats. `frames` is the number of all frames.
    pub(crate) fn text(&self, frames: usize) -> String {
        match self.mean {
            Some(_) => format!(
                "other programs disturbed {:.0} % of the measured time; {} of {frames} frames have only \
                 disturbed repeats",
                100.0 * self.disturbed / self.seconds.max(1e-9),
                self.frames
            ),
            None => "this system does not report the processor time of other programs".into(),
        }
    }

    /// True if more than a fifth of the time was disturbed.
    pub(crate) fn busy(&self) -> bool {
        self.disturbed > 0.2 * self.seconds
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_systems_counters_are_read() {
        let stat = "cpu  100 20 30 4000 50 6 7 8 9 10\ncpu0 1 1 1 1\n";
        assert_eq!(machine_seconds(stat), Some(1.71));
        assert_eq!(machine_seconds("intr 5\n"), None);
        let own = "42 (a (odd) name) S 1 1 1 0 -1 4194560 1 2 3 4 250 50 0 0 20 0 2 0 100 1 1";
        assert_eq!(own_seconds(own), Some(3.0));
        assert_eq!(own_seconds("42 cut off"), None);
    }

    #[test]
    fn short_stretches_are_joined() {
        let mut joined = Joined::EMPTY;
        // Each stretch alone is too short for counters with a resolution of 0.01 s.
        assert!(!joined.add((0.04, Some(0.05))) && !joined.add((0.04, Some(-0.01))));
        assert_eq!(joined.mean().1, None);
        assert!(joined.add((0.04, Some(0.02))));
        assert!((joined.mean().1.unwrap() - 0.5).abs() < 1e-12);
        joined.add((1.0, None));
        assert_eq!(joined.mean().1, None);
    }

    #[test]
    fn a_fifth_of_the_time_makes_a_machine_busy() {
        let mut others = BackgroundLoad::default();
        others.add(8.0, Some(0.05));
        others.add(2.0, Some(0.9));
        // A stretch whose load is unknown changes nothing.
        others.add(90.0, None);
        assert!(!others.busy() && (others.mean.unwrap() - 0.22).abs() < 1e-12);
        others.add(1.0, Some(1.0));
        assert!(others.busy());
        others.frames = 3;
        let said = others.text(40);
        assert!(said.contains("27 % of the measured time; 3 of 40 frames"), "{said}");
        let mut blind = BackgroundLoad::default();
        blind.add(5.0, None);
        assert!(!blind.busy() && blind.mean.is_none() && blind.text(1).contains("does not report"));
    }
}
