//! Metrics of a controller: its frame times against the target, its steps and its picture quality.

use crate::pictures::BEST_PSNR;
use serde::Serialize;

/// Number of frames from a switch on (the switch's own frame first) over which the error at switches is
/// taken.
pub(crate) const SWITCH_FRAMES: usize = 3;

#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Played {
    /// Measured seconds.
    pub(crate) seconds: f64,
    /// Target of the frame, seconds.
    pub(crate) target: f64,
    /// Ray step, reference steps; for a controller that acts on image resolution, pixels of the full image
    /// per pixel drawn.
    pub(crate) step: f64,
    pub(crate) finest: f64,
    pub(crate) coarsest: f64,
    /// PSNR against the picture at the reference step, decibels.
    pub(crate) psnr: f64,
    /// True if the path switches abruptly at this frame, or the volume or the image size changes.
    pub(crate) switched: bool,
}

impl Played {
    /// Returns the relative error of the frame time: (seconds − target) / target.
    pub(crate) fn error(&self) -> f64 {
        (self.seconds - self.target) / self.target
    }

    /// True if the frame time is within 25 % of the target. Shorter times are also on target at the finest
    /// step, longer times also at the coarsest step.
    pub(crate) fn on_target(&self) -> bool {
        let (finest, coarsest) = (self.step <= self.finest * 1.001, self.step >= self.coarsest * 0.999);
        (self.error() <= 0.25 || coarsest) && (self.error() >= -0.25 || finest)
    }
}

/// A controller's figures over a path. Shares are 0 to 1, times are in seconds; t is a frame time.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Metrics {
    pub(crate) frames: usize,
    /// Share of frames that took over 1.1 times the target.
    pub(crate) missed_by_10_percent: f64,
    /// Share of frames that took over 1.25 times the target.
    pub(crate) missed_by_25_percent: f64,
    /// Mean of |t − target| / target.
    pub(crate) mean_error: f64,
    /// Mean of |t − target| / target over the first [`SWITCH_FRAMES`] frames from each switch on; `None`
    /// without switches.
    pub(crate) mean_error_at_switches: Option<f64>,
    /// Mean of |t − target| / target over all frames except the first [`SWITCH_FRAMES`] of the path and the
    /// first [`SWITCH_FRAMES`] from each switch on.
    pub(crate) mean_error_in_calm: Option<f64>,
    /// Number of frames from each switch until two in a row are on target (see [`Played::on_target`]); 0 if
    /// these are the switch's own frame and the next one. Without two such frames, the number of frames to
    /// the next switch or the end.
    pub(crate) recovery_frames: Vec<usize>,
    /// 95th percentile of the frame time (nearest rank).
    pub(crate) p95_seconds: f64,
    /// Longest frame time, in seconds.
    pub(crate) worst_seconds: f64,
    /// Mean over the frames of the PSNR against the picture at the reference step, decibels. A PSNR above
    /// [`BEST_PSNR`] counts as [`BEST_PSNR`].
    pub(crate) mean_psnr: f64,
    pub(crate) mean_step: f64,
}

impl Metrics {
    /// Metrics of the frames of a path, in order; `None` for no frames.
    pub(crate) fn of(frames: &[Played]) -> Option<Self> {
        if frames.is_empty() {
            return None;
        }
        let n = frames.len() as f64;
        let share = |limit: f64| frames.iter().filter(|f| f.seconds > limit * f.target).count() as f64 / n;
        let switches: Vec<usize> = (0..frames.len()).filter(|i| frames[*i].switched).collect();
        let near = |i: usize| {
            let before = switches.partition_point(|s| *s <= i);
            before > 0 && i - switches[before - 1] < SWITCH_FRAMES
        };
        let mean_error = |take: &dyn Fn(usize) -> bool| {
            let taken: Vec<f64> =
                (0..frames.len()).filter(|i| take(*i)).map(|i| frames[i].error().abs()).collect();
            (!taken.is_empty()).then(|| taken.iter().sum::<f64>() / taken.len() as f64)
        };
        let mut sorted: Vec<f64> = frames.iter().map(|f| f.seconds).collect();
        sorted.sort_by(f64::total_cmp);
        let rank = ((0.95 * n).ceil() as usize).clamp(1, sorted.len());
        Some(Self {
            frames: frames.len(),
            missed_by_10_percent: share(1.1),
            missed_by_25_percent: share(1.25),
            mean_error: mean_error(&|_| true).unwrap_or(0.0),
            mean_error_at_switches: mean_error(&near),
            mean_error_in_calm: mean_error(&|i| i >= SWITCH_FRAMES && !near(i)),
            recovery_frames: switches
                .iter()
                .enumerate()
                .map(|(k, &s)| {
                    let end = switches.get(k + 1).copied().unwrap_or(frames.len());
                    let settled = |i: usize| {
                        frames[i].on_target()
                            && frames.get(i + 1).filter(|_| i + 1 < end).is_some_and(Played::on_target)
                    };
                    (s..end).find(|i| settled(*i)).unwrap_or(end) - s
                })
                .collect(),
            p95_seconds: sorted[rank - 1],
            worst_seconds: sorted[sorted.len() - 1],
            mean_psnr: frames.iter().map(|f| f.psnr.min(BEST_PSNR)).sum::<f64>() / n,
            mean_step: frames.iter().map(|f| f.step).sum::<f64>() / n,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(seconds: f64) -> Played {
        Played { seconds, target: 0.1, step: 2.0, finest: 1.0, coarsest: 16.0, psnr: 40.0, switched: false }
    }

    #[test]
    fn figures_of_a_scripted_series() {
        // Ten frames at the target, except one 12 % and one 30 % over.
        let mut frames = vec![frame(0.1); 10];
        frames[2].seconds = 0.112;
        frames[7].seconds = 0.13;
        frames[7].psnr = f64::INFINITY;
        frames[9].step = 4.0;
        let m = Metrics::of(&frames).unwrap();
        assert_eq!((m.missed_by_10_percent, m.missed_by_25_percent), (0.2, 0.1));
        assert!((m.mean_error - 0.042).abs() < 1e-12);
        assert_eq!((m.p95_seconds, m.worst_seconds), (0.13, 0.13));
        assert!((m.mean_psnr - 46.0).abs() < 1e-9 && (m.mean_step - 2.2).abs() < 1e-12);
        assert_eq!(m.mean_error_at_switches, None);
        assert!(m.recovery_frames.is_empty());
        // Calm frames are 3…9.
        assert!((m.mean_error_in_calm.unwrap() - 0.3 / 7.0).abs() < 1e-12);
        assert_eq!(Metrics::of(&[]), None);
    }

    #[test]
    fn ninety_fifth_percentile_is_the_nearest_rank() {
        let frames: Vec<Played> = (1..=20).map(|i| frame(f64::from(i))).collect();
        assert_eq!(Metrics::of(&frames).unwrap().p95_seconds, 19.0);
        let frames: Vec<Played> = (1..=21).map(|i| frame(f64::from(i))).collect();
        assert_eq!(Metrics::of(&frames).unwrap().p95_seconds, 20.0);
    }

    #[test]
    fn recovery_counts_until_two_frames_in_a_row_are_on_target() {
        let mut frames = vec![frame(0.1); 16];
        // A switch whose first frame is on target.
        frames[3].switched = true;
        // A switch with a recovery of four frames: a single on-target frame in between does not count.
        frames[7].switched = true;
        for (i, t) in [(7, 0.3), (8, 0.11), (9, 0.2), (10, 0.04)] {
            frames[i].seconds = t;
        }
        // A switch after which no frame is on target.
        frames[13].switched = true;
        for f in &mut frames[13..] {
            f.seconds = 0.5;
        }
        let m = Metrics::of(&frames).unwrap();
        assert_eq!(m.recovery_frames, [0, 4, 3]);
        // A single frame on target before the end does not count either.
        frames[15].seconds = 0.1;
        assert_eq!(Metrics::of(&frames).unwrap().recovery_frames, [0, 4, 3]);
        let at_switches = (0.0 + 2.0 + 0.1 + 1.0 + 4.0 * 3.0) / 9.0;
        assert!((m.mean_error_at_switches.unwrap() - at_switches).abs() < 1e-9);
    }

    #[test]
    fn nothing_more_can_be_done_at_the_limits() {
        let with = |seconds, step| Played { step, ..frame(seconds) }.on_target();
        assert!(with(0.12, 2.0) && with(0.08, 2.0) && !with(0.05, 2.0) && !with(0.2, 2.0));
        assert!(with(0.05, 1.0) && !with(0.2, 1.0));
        assert!(with(0.2, 16.0) && !with(0.05, 16.0));
    }
}
