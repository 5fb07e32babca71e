//! Frames with their seconds, and parts of them that share no ensemble member.

use super::{GroupBy, shuffled};
use entire_io::dataset::{Clock, Timed, TimedFrame};
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use rand::seq::SliceRandom;
use std::collections::BTreeSet;

/// Largest number of folds of a cross-validation.
const FOLDS: usize = 5;

/// Frames with their seconds, owned.
#[derive(Clone, Debug, Default)]
pub struct TimedFrames<'a> {
    /// The frames.
    pub frames: Vec<&'a TimedFrame>,
    /// Seconds of each frame.
    pub seconds: Vec<f64>,
}

impl<'a> TimedFrames<'a> {
    /// Returns the frames that have seconds by the clock.
    pub fn of(frames: impl IntoIterator<Item = &'a TimedFrame>, clock: Clock) -> Self {
        let (frames, seconds) = frames.into_iter().filter_map(|f| Some((f, f.seconds(clock)?))).unzip();
        Self { frames, seconds }
    }

    /// The frames and their seconds, borrowed.
    pub fn timed(&self) -> Timed<'_> {
        Timed { frames: &self.frames, seconds: &self.seconds }
    }

    /// Returns these frames, followed by those of `other`.
    pub fn and(&self, other: Self) -> Self {
        let frames = self.frames.iter().copied().chain(other.frames).collect();
        let seconds = self.seconds.iter().copied().chain(other.seconds).collect();
        Self { frames, seconds }
    }

    /// Returns the frames that `wanted` accepts, and all others.
    pub fn parted(&self, wanted: impl Fn(&TimedFrame) -> bool) -> (Self, Self) {
        self.divided(|i| wanted(self.frames[i]))
    }

    /// Returns the kind of groups, and at most five folds of groups for cross-validation. Groups are ensemble
    /// members, or volumes if there are fewer than three members. There are no folds for fewer than three
    /// volumes.
    pub fn folds(&self) -> (GroupBy, Vec<BTreeSet<String>>) {
        let by = self.groups_at_least(3);
        let groups: BTreeSet<String> = self.frames.iter().map(|f| by.group(&f.scene)).collect();
        if groups.len() < 3 {
            return (by, Vec::new());
        }
        let mut groups: Vec<String> = groups.into_iter().collect();
        groups.shuffle(&mut ChaCha8Rng::seed_from_u64(3));
        let mut folds = vec![BTreeSet::new(); FOLDS.min(groups.len())];
        let count = folds.len();
        for (i, group) in groups.into_iter().enumerate() {
            folds[i % count].insert(group);
        }
        (by, folds)
    }

    fn divided(&self, first: impl Fn(usize) -> bool) -> (Self, Self) {
        let (mut chosen, mut rest) = (Self::default(), Self::default());
        for (i, (&frame, &seconds)) in self.frames.iter().zip(&self.seconds).enumerate() {
            let part = if first(i) { &mut chosen } else { &mut rest };
            part.frames.push(frame);
            part.seconds.push(seconds);
        }
        (chosen, rest)
    }

    /// Returns the kind of groups that a split keeps together: ensemble members, or volumes if there are
    /// fewer than `needed` members.
    pub fn groups_at_least(&self, needed: usize) -> GroupBy {
        let members: BTreeSet<String> = self.frames.iter().map(|f| GroupBy::Member.group(&f.scene)).collect();
        if members.len() < needed { GroupBy::Volume } else { GroupBy::Member }
    }

    /// Returns validation frames and training frames: the frames of a random tenth of the groups (at least
    /// one group), and all others. With fewer than three groups, all frames are for training.
    pub fn hold_out(&self, by: GroupBy, seed: u64) -> (Self, Self) {
        let of_frame: Vec<String> = self.frames.iter().map(|f| by.group(&f.scene)).collect();
        let groups: BTreeSet<String> = of_frame.iter().cloned().collect();
        if groups.len() < 3 {
            return (Self::default(), self.clone());
        }
        let (order, tenth) = shuffled(&groups, seed);
        self.divided(|i| order[..tenth].contains(&&of_frame[i]))
    }

    /// Returns `count` random frames, and all others.
    pub fn sample(&self, count: usize, seed: u64) -> (Self, Self) {
        let mut order: Vec<usize> = (0..self.frames.len()).collect();
        order.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
        let mut chosen = vec![false; order.len()];
        order.iter().take(count).for_each(|&i| chosen[i] = true);
        self.divided(|i| chosen[i])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use entire_io::dataset::Timing;

    fn timed(volume: &str, member: &str) -> TimedFrame {
        let repeats = vec![Timing { wall: Some(0.5), cpu: Some(0.25), ..Timing::default() }];
        TimedFrame { repeats, ..TimedFrame::of_no_volume(volume, member) }
    }

    /// Returns frames that belong to the ensemble members in turn. Each frame shows another time step of its
    /// member.
    fn of_members(frames: usize, members: usize) -> Vec<TimedFrame> {
        let frame = |i: usize| {
            let (member, step) = (i % members, i / members);
            timed(&format!("e/m{member}/t{step}.nrrd"), &format!("m{member}"))
        };
        (0..frames).map(frame).collect()
    }

    #[test]
    fn whole_members_are_held_out_and_volumes_where_there_are_too_few_of_them() {
        let many = of_members(40, 4);
        let part = TimedFrames::of(&many, Clock::Cpu);
        let by = part.groups_at_least(4);
        assert_eq!(by, GroupBy::Member);
        let (held, rest) = part.hold_out(by, 1);
        assert_eq!((held.frames.len(), rest.frames.len()), (10, 30));
        let member = &held.frames[0].scene.member;
        assert!(held.frames.iter().all(|f| f.scene.member == *member));
        assert!(rest.frames.iter().all(|f| f.scene.member != *member));
        assert_eq!(part.groups_at_least(5), GroupBy::Volume);
        let (held, rest) = part.hold_out(GroupBy::Volume, 1);
        assert_eq!((held.frames.len(), rest.frames.len()), (4, 36));

        let alone = [timed("a.nrrd", ""), timed("b.nrrd", "")];
        let part = TimedFrames::of(&alone, Clock::Cpu);
        let (held, rest) = part.hold_out(part.groups_at_least(3), 1);
        assert_eq!((held.frames.len(), rest.frames.len()), (0, 2));
    }

    #[test]
    fn folds_share_no_member_and_leave_none_out() {
        let frames = of_members(60, 7);
        let part = TimedFrames::of(&frames, Clock::Cpu);
        let (by, folds) = part.folds();
        assert_eq!((by, folds.len()), (GroupBy::Member, FOLDS));
        let all: Vec<&String> = folds.iter().flatten().collect();
        assert_eq!((all.len(), all.iter().collect::<BTreeSet<_>>().len()), (7, 7));
        let held: usize =
            folds.iter().map(|f| part.parted(|x| f.contains(&by.group(&x.scene))).0.frames.len()).sum();
        assert_eq!(held, part.frames.len());
        // With two members, volumes are held out. With two volumes, there are no folds.
        let few = [timed("e/a/t0.nrrd", "a"), timed("e/a/t1.nrrd", "a"), timed("e/b/t0.nrrd", "b")];
        let (by, folds) = TimedFrames::of(&few, Clock::Cpu).folds();
        assert_eq!((by, folds.len()), (GroupBy::Volume, 3));
        let pair = [timed("a.nrrd", ""), timed("b.nrrd", "")];
        assert!(TimedFrames::of(&pair, Clock::Cpu).folds().1.is_empty());
    }
}
