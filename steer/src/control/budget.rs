//! Divides the frame time of a window among its passes. A pass draws one volume once.

/// Number of recent frames over which the median of the time outside of the passes is taken.
const REST_FRAMES: usize = 5;
/// Smallest share of the target that all passes together get, however long the window's other work takes.
const LEAST_SHARE: f32 = 0.2;
/// Weight of a pass's newest time in the mean of its times.
const NEWEST_WEIGHT: f32 = 0.3;

/// Divides the target time of a window's frame among its passes. A window has several passes if it draws
/// several volumes, draws for two eyes, or has several renderers. The time of the window's other work is
/// first subtracted from the target. Each pass gets a share in proportion to its time at full quality, so all
/// passes are coarsened by the same factor.
///
/// The caller reports each frame: [`FrameBudget::begin`], then for each pass [`FrameBudget::share`] before
/// and [`FrameBudget::drew`] after it, then [`FrameBudget::end`]. The value of a new budget is all zeros.
///
/// ```
/// use entire_steer::control::{FrameBudget, PassShare};
///
/// let (mut budget, mut left, mut right) = (FrameBudget::default(), PassShare::default(), PassShare::default());
/// for _ in 0..3 {
///     budget.begin(2);
///     budget.drew(&mut left, 0.010, 0.010);
///     budget.drew(&mut right, 0.030, 0.030);
///     // Besides its passes, the window takes 5 ms.
///     budget.end(0.045, true);
/// }
/// budget.begin(2);
/// assert!((budget.share(&left, 0.025) - 0.005).abs() < 1e-6);
/// assert!((budget.share(&right, 0.025) - 0.015).abs() < 1e-6);
/// ```
#[derive(Clone, Copy, Debug, Default, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct FrameBudget {
    /// Seconds outside of the passes in the last frames, as a ring buffer.
    rests: [f32; REST_FRAMES],
    /// Number of entries added to `rests` so far.
    count: u32,
    /// Number of the current frame, from 1; frames without passes are not counted. 0 before the first frame.
    frame: u32,
    /// Sum of the passes' seconds at full quality, in the last frame with passes and in the current frame.
    full: [f32; 2],
    /// Number of passes, in the last frame with passes and in the current frame.
    passes: [u32; 2],
    /// Seconds of the passes of the current frame.
    drawn: f32,
    /// Number of volumes that the current frame is expected to draw.
    expected: u32,
    /// 1 after an unusual frame, else 0.
    unusual: u32,
}

/// State of one object, such as a volume, that is drawn once or several times in a window's frame. See
/// [`FrameBudget`]. The value of a new state is all zeros.
#[derive(Clone, Copy, Debug, Default, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct PassShare {
    /// Mean seconds at full quality, after the last pass; 0 before the first pass.
    mean: f32,
    /// Value of `mean` before the current frame.
    before: f32,
    /// Number of the last frame that drew the object; 0 before the first.
    frame: u32,
    /// Number of the object's passes in frame number `frame`.
    passes: u32,
}

impl FrameBudget {
    /// Begins a frame of the window, which will draw about `volumes` volumes; 0 if the number is unknown.
    pub fn begin(&mut self, volumes: u32) {
        // Frames without passes change nothing.
        if self.passes[1] > 0 || self.frame == 0 {
            (self.full[0], self.passes[0]) = (self.full[1], self.passes[1]);
            self.frame = self.frame.checked_add(1).unwrap_or(1);
        }
        (self.full[1], self.passes[1], self.drawn) = (0.0, 0, 0.0);
        self.expected = volumes;
    }

    /// Returns the seconds that the next pass may take if the whole frame may take `target` seconds.
    pub fn share(&self, pass: &PassShare, target: f32) -> f32 {
        let left = (target - self.rest()).max(LEAST_SHARE * target);
        let (mut total, mut passes) = (self.full[0], self.passes[0]);
        let own = self.expected_seconds(pass);
        if self.is_new(pass) {
            total += own;
            passes += 1;
        }
        if total > 0.0 {
            left * (own / total).min(1.0)
        } else {
            left / passes.max(self.expected).max(1) as f32
        }
    }

    /// True if neither the last frame with passes nor the current frame has drawn the object.
    fn is_new(&self, pass: &PassShare) -> bool {
        pass.frame == 0 || pass.frame.saturating_add(1) < self.frame
    }

    /// Seconds that a pass of the object is expected to take at full quality. An object that was never drawn
    /// before this frame is assumed to take the mean time of the other passes.
    fn expected_seconds(&self, pass: &PassShare) -> f32 {
        let known = if pass.frame == self.frame { pass.before } else { pass.mean };
        if known > 0.0 { known } else { self.full[0] / self.passes[0].max(1) as f32 }
    }

    /// Adds a pass that took `seconds` and would have taken about `full` seconds at full quality.
    pub fn drew(&mut self, pass: &mut PassShare, seconds: f32, full: f32) {
        if pass.frame != self.frame {
            if self.is_new(pass) && self.passes[0] > 0 {
                // From now on, the sum includes the object, so that its second pass, such as the other eye's,
                // gets the same share as its first.
                self.full[0] += self.expected_seconds(pass);
                self.passes[0] += 1;
            }
            (pass.frame, pass.passes, pass.before) = (self.frame, 0, pass.mean);
        }
        // Each pass of the object counts with the same mean. So the old mean of the earlier passes is subtracted
        // from the sum, and the new mean is added for all passes. The next frame's shares are computed from this
        // sum.
        self.full[1] -= pass.passes as f32 * pass.mean;
        if full.is_finite() && full > 0.0 {
            pass.mean = if pass.mean > 0.0 { pass.mean + NEWEST_WEIGHT * (full - pass.mean) } else { full };
        }
        pass.passes += 1;
        self.full[1] += pass.passes as f32 * pass.mean;
        self.passes[1] += 1;
        self.drawn += seconds;
    }

    /// Ends a frame that took `seconds` in all; `usual` is false if the frame included work that most frames
    /// do not include. The time that an unusual frame spends outside of its passes counts only if the
    /// previous frame was unusual, too. A frame without passes and the first frame with passes never count.
    pub fn end(&mut self, seconds: f32, usual: bool) {
        let rest = seconds - self.drawn;
        let counts = usual || self.unusual > 0;
        self.unusual = u32::from(!usual);
        if counts && self.passes[1] > 0 && self.passes[0] > 0 && rest.is_finite() {
            self.rests[self.count as usize % REST_FRAMES] = rest.max(0.0);
            self.count = self.count.checked_add(1).unwrap_or(REST_FRAMES as u32);
        }
    }

    /// Seconds of a frame outside of the passes: the median of the last five frames that counted; 0 before a
    /// frame has counted.
    pub(crate) fn rest(&self) -> f32 {
        let n = (self.count as usize).min(REST_FRAMES);
        if n == 0 {
            return 0.0;
        }
        let mut sorted = self.rests;
        sorted[..n].sort_unstable_by(f32::total_cmp);
        sorted[n / 2]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(a: f32, b: f32) -> bool {
        (a - b).abs() <= 1e-5 * b.abs()
    }

    /// Simulates a frame of `passes`, each given with its seconds at full quality. Each pass takes 1/`coarse`
    /// of that time, and other work takes 5 ms. Returns the passes' shares of a target of 50 ms, in seconds.
    fn frame(budget: &mut FrameBudget, passes: &mut [(PassShare, f32)], coarse: f32) -> Vec<f32> {
        budget.begin(0);
        let mut total = 0.005;
        let mut shares = Vec::new();
        for (pass, full) in passes {
            shares.push(budget.share(pass, 0.050));
            budget.drew(pass, *full / coarse, *full);
            total += *full / coarse;
        }
        budget.end(total, true);
        shares
    }

    #[test]
    fn one_pass_gets_all_but_the_rest() {
        let mut budget = FrameBudget::default();
        let mut passes = [(PassShare::default(), 0.1)];
        assert_eq!(frame(&mut budget, &mut passes, 1.0), [0.050]);
        frame(&mut budget, &mut passes, 2.0);
        assert!(near(frame(&mut budget, &mut passes, 3.0)[0], 0.045));
    }

    #[test]
    fn passes_share_by_their_time_at_full_quality_however_coarse() {
        let mut budget = FrameBudget::default();
        let mut passes =
            [(PassShare::default(), 0.1), (PassShare::default(), 0.02), (PassShare::default(), 0.06)];
        for coarse in [1.0, 4.0, 2.0] {
            frame(&mut budget, &mut passes, coarse);
        }
        let shares = frame(&mut budget, &mut passes, 3.0);
        assert!(near(shares.iter().sum(), 0.045), "{shares:?}");
        assert!(near(shares[0] / shares[1], 5.0) && near(shares[0] / shares[2], 5.0 / 3.0), "{shares:?}");
    }

    #[test]
    fn two_eyes_of_one_volume_get_half_each() {
        let mut budget = FrameBudget::default();
        let mut volume = PassShare::default();
        for _ in 0..4 {
            budget.begin(0);
            for _eye in 0..2 {
                budget.drew(&mut volume, 0.03, 0.09);
            }
            budget.end(0.06, true);
        }
        budget.begin(0);
        for _eye in 0..2 {
            assert!(near(budget.share(&volume, 0.05), 0.025));
            budget.drew(&mut volume, 0.03, 0.09);
        }
    }

    #[test]
    fn shares_of_a_frame_add_up_however_times_scatter() {
        let (mut budget, mut left, mut right) =
            (FrameBudget::default(), PassShare::default(), PassShare::default());
        for n in 0..20 {
            budget.begin(0);
            let mut sum = 0.0;
            for eye in 0..2 {
                for pass in [&mut left, &mut right] {
                    sum += budget.share(pass, 0.05);
                    let full = 0.01 * (1.0 + (7 * n + 3 * eye) as f32 % 5.0);
                    budget.drew(pass, full, full);
                }
            }
            budget.end(budget.drawn, true);
            assert!(n == 0 || near(sum, 0.05), "{n}: {sum}");
        }
    }

    #[test]
    fn hidden_volumes_have_no_share_and_shown_ones_get_one_at_once() {
        let mut budget = FrameBudget::default();
        let mut passes = [(PassShare::default(), 0.1), (PassShare::default(), 0.1)];
        for _ in 0..3 {
            frame(&mut budget, &mut passes, 2.0);
        }
        for _ in 0..2 {
            frame(&mut budget, &mut passes[..1], 2.0);
        }
        assert!(near(frame(&mut budget, &mut passes[..1], 2.0)[0], 0.045));
        budget.begin(0);
        assert!(near(budget.share(&passes[1].0, 0.050), 0.0225));
        // A third object, never drawn before, is assumed to take the mean time of the other two objects.
        assert!(near(budget.share(&PassShare::default(), 0.050), 0.0225));
    }

    #[test]
    fn two_eyes_of_a_volume_that_replaces_another_get_half_each() {
        let mut budget = FrameBudget::default();
        let mut passes = [(PassShare::default(), 0.1)];
        for _ in 0..3 {
            frame(&mut budget, &mut passes, 2.0);
        }
        let (mut never_drawn, mut hidden) = (PassShare::default(), passes[0].0);
        hidden.frame -= 2;
        for volume in [&mut never_drawn, &mut hidden] {
            let mut budget = budget;
            budget.begin(1);
            for _eye in 0..2 {
                assert!(near(budget.share(volume, 0.05), 0.0225), "{budget:?}");
                budget.drew(volume, 0.02, 0.1);
            }
        }
    }

    #[test]
    fn two_slow_frames_of_five_do_not_change_the_rest_and_three_do() {
        let mut budget = FrameBudget::default();
        let mut pass = PassShare::default();
        let mut draw = |rest: f32| {
            budget.begin(0);
            budget.drew(&mut pass, 0.01, 0.01);
            budget.end(0.01 + rest, true);
            budget.rest()
        };
        for _ in 0..6 {
            draw(0.004);
        }
        for (rest, seen) in
            [(0.02, 0.004), (0.03, 0.004), (0.02, 0.02), (0.004, 0.02), (0.004, 0.02), (0.004, 0.004)]
        {
            let found = draw(rest);
            assert!(near(found, seen), "{rest}: {found}, not {seen}");
        }
    }

    #[test]
    fn unusual_frames_count_if_they_are_the_rule() {
        let mut budget = FrameBudget::default();
        let mut pass = PassShare::default();
        let mut draw = |rest: f32, usual: bool| {
            budget.begin(1);
            budget.drew(&mut pass, 0.01, 0.01);
            budget.end(0.01 + rest, usual);
            budget.rest()
        };
        draw(0.5, true);
        for _ in 0..5 {
            draw(0.004, true);
        }
        // A single frame that reads a volume does not change the median; several such frames in a row do.
        assert!(near(draw(0.02, false), 0.004) && near(draw(0.004, true), 0.004));
        let last = [0; 4].map(|_| draw(0.02, false))[3];
        assert!(near(last, 0.02), "{last}");
    }

    #[test]
    fn frames_without_passes_change_no_share() {
        let mut budget = FrameBudget::default();
        let mut passes = [(PassShare::default(), 0.1), (PassShare::default(), 0.1)];
        for _ in 0..3 {
            frame(&mut budget, &mut passes, 2.0);
        }
        for _ in 0..4 {
            budget.begin(2);
            budget.end(0.001, true);
        }
        assert!(near(frame(&mut budget, &mut passes, 2.0).iter().sum(), 0.045));
    }

    #[test]
    fn after_the_largest_frame_number_the_shares_stay() {
        let mut budget = FrameBudget { frame: u32::MAX - 3, ..FrameBudget::default() };
        let mut passes = [(PassShare::default(), 0.1)];
        for n in 0..6 {
            let share = frame(&mut budget, &mut passes, 2.0)[0];
            assert!(n < 2 || near(share, 0.045), "{n}: {share}");
        }
        assert_eq!(budget.frame, 2);
    }

    #[test]
    fn first_frames_are_shared_by_the_number_of_volumes() {
        let mut budget = FrameBudget::default();
        budget.begin(3);
        assert!(near(budget.share(&PassShare::default(), 0.3), 0.1));
    }

    #[test]
    fn a_rest_over_the_target_leaves_a_fifth() {
        let mut budget = FrameBudget::default();
        let mut pass = PassShare::default();
        for _ in 0..6 {
            budget.begin(0);
            budget.drew(&mut pass, 0.01, 0.01);
            budget.end(1.0, true);
        }
        assert!(near(budget.share(&pass, 0.05), 0.01));
    }

    #[test]
    fn no_time_makes_a_share_that_is_not_finite() {
        let mut budget = FrameBudget::default();
        let mut pass = PassShare::default();
        for odd in [f32::NAN, f32::INFINITY, -1.0, 0.0, 1e-30, 1e30] {
            budget.begin(0);
            budget.drew(&mut pass, odd, odd);
            budget.end(odd, true);
            let share = budget.share(&pass, 0.05);
            assert!((0.0..=0.05).contains(&share), "{odd}: {share}");
        }
    }
}
