//! Renders the chosen frames in rounds, and the frames of each round in several passes.

mod pictures;

use super::Settings;
use super::design::Design;
use super::others::{BackgroundLoad, CpuSnapshot, Joined};
use super::pool::{Candidate, Pool};
use crate::collection::timed_repeats;
use anyhow::{Context, Result, bail, ensure};
use entire_io::dataset::{Clock, NoiseFloor, TimedFrame, Timing, noise_floor};
use entire_io::identity;
use entire_io::metrics::median;
use entire_io::volume::{Volume, VolumeData};
use entire_vk_raycaster::Renderer;
use indicatif::ProgressBar;
use std::collections::{BTreeMap, HashMap};
use std::time::Instant;

/// Shortest frame time, in wall seconds, at which no warm-up is discarded: the first rendering of such a
/// frame is not slower than the second one.
const WARM_UP_LIMIT: f64 = 0.12;

/// Noise of a round (see [`Measuring::spread`]) below which the round gets no further pass, once it had the
/// minimum number of passes.
const SETTLED_NOISE: f64 = 0.02;

/// Minimum and maximum number of passes of a round.
const PASSES: (usize, usize) = (2, 4);

/// Initial estimate of the time to pass another volume to the renderer, seconds.
const SWITCH: f64 = 0.15;

/// Maximum number of bytes of the volumes that stay in memory.
const KEPT_BYTES: usize = 512 << 20;

#[derive(Clone, Debug)]
struct Visit {
    repeats: Vec<Timing>,
    disturbed: bool,
}

pub(crate) struct Measuring<'a> {
    settings: &'a Settings,
    pool: &'a Pool,
    renderer: &'a mut dyn Renderer,
    deadline: Instant,
    start: Instant,
    stop: &'a dyn Fn() -> bool,
    bar: &'a ProgressBar,
    volumes: HashMap<(usize, usize), Volume>,
    visits: BTreeMap<usize, Vec<Visit>>,
    /// Ratio of expected wall seconds on this machine to the seconds that the prior predicts for its own
    /// machine.
    scale: f64,
    switch: f64,
    /// Load of the machine by other programs.
    pub(crate) others: BackgroundLoad,
    pub(crate) rounds: usize,
    /// Number of renderings that were discarded as warm-up.
    pub(crate) warm_ups: usize,
}

impl<'a> Measuring<'a> {
    pub(crate) fn new(
        settings: &'a Settings,
        pool: &'a Pool,
        renderer: &'a mut dyn Renderer,
        deadline: Instant,
        start: Instant,
        stop: &'a dyn Fn() -> bool,
        bar: &'a ProgressBar,
    ) -> Self {
        Self {
            settings,
            pool,
            renderer,
            deadline,
            start,
            stop,
            bar,
            volumes: HashMap::new(),
            visits: BTreeMap::new(),
            scale: 1.0,
            switch: SWITCH,
            others: BackgroundLoad::default(),
            rounds: 0,
            warm_ups: 0,
        }
    }

    fn left(&self) -> f64 {
        self.deadline.saturating_duration_since(Instant::now()).as_secs_f64()
    }

    /// Expected wall seconds of a candidate.
    fn wall(&self, i: usize) -> f64 {
        self.scale * self.pool.expected[i]
    }

    /// Returns the numbers of discarded and of timed renderings in the first pass over a frame of `wall`
    /// expected seconds.
    fn renderings(wall: f64) -> (u32, usize) {
        match wall {
            w if w < 0.006 => (2, 3),
            w if w < 0.03 => (1, 2),
            w if w < WARM_UP_LIMIT => (1, 1),
            _ => (0, 1),
        }
    }

    /// Renders round after round until the time is over, the maximum number of frames is reached, or `stop`
    /// returns true.
    pub(crate) fn run(&mut self) -> Result<()> {
        let mut design = Design::new(self.pool, &self.pool.prior.seconds);
        // The prior predicts seconds of another machine. The first round is small and measures the ratio of
        // the two machines' times.
        let mut share = 0.12;
        while self.left() > 1.5 && !(self.stop)() && self.visits.len() < self.settings.frames {
            let same = |a: &Candidate, b: &Candidate| (a.volume, a.factor) == (b.volume, b.factor);
            let groups = self.pool.candidates.chunk_by(same).count();
            let passes = PASSES.0 as f64;
            let seconds: Vec<f64> = (0..self.pool.candidates.len())
                .map(|i| {
                    let wall = self.wall(i);
                    let (discarded, timed) = Self::renderings(wall);
                    passes * (wall * (f64::from(discarded) + timed as f64) + 0.002)
                })
                .collect();
            let budget = share * self.left() - passes * self.switch * groups as f64 * share.min(0.6);
            let most = self.settings.frames - self.visits.len();
            let most = if self.rounds == 0 { most.min((self.settings.frames / 4).max(12)) } else { most };
            let round = design.choose(self.pool, &seconds, budget.max(0.5), most);
            if round.is_empty() {
                break;
            }
            self.rounds += 1;
            for pass in 0..PASSES.1 {
                if pass >= PASSES.0
                    && (self.spread(&round) < SETTLED_NOISE || self.left() < 0.1 * self.settings.seconds)
                {
                    break;
                }
                self.pass(&round, pass)?;
            }
            self.learn_speed();
            share = if self.rounds == 1 { 0.6 } else { 0.95 };
        }
        Ok(())
    }

    /// Renders the frames of a round, volume by volume. Every second pass takes the volumes in reverse order,
    /// so that a drift of the machine's speed is not mistaken for a difference between volumes.
    fn pass(&mut self, round: &[usize], pass: usize) -> Result<()> {
        let mut groups: BTreeMap<(usize, usize), Vec<usize>> = BTreeMap::new();
        for &i in round {
            let c = &self.pool.candidates[i];
            groups.entry((c.volume, c.factor)).or_default().push(i);
        }
        let mut groups: Vec<((usize, usize), Vec<usize>)> = groups.into_iter().collect();
        if pass % 2 == 1 {
            groups.reverse();
        }
        // A volume's frames may take less time than the counters of processor time resolve.
        let (mut stretches, mut seen) = (Joined::EMPTY, Vec::new());
        for ((volume, factor), members) in groups {
            if (self.stop)() || self.left() <= 0.0 {
                break;
            }
            self.bar.set_message(format!(
                "{} frames, round {}, pass {}",
                self.visits.len().max(1),
                self.rounds,
                pass + 1
            ));
            let begin = Instant::now();
            self.show(volume, factor)?;
            self.switch = 0.7 * self.switch + 0.3 * begin.elapsed().as_secs_f64();
            let snapshot = CpuSnapshot::now();
            for i in members {
                if let Some(repeats) = self.visit(i)? {
                    seen.push((i, repeats));
                }
                self.bar.set_position(self.start.elapsed().as_secs());
            }
            if stretches.add(snapshot.others()) {
                self.keep(&stretches, &mut seen);
                stretches = Joined::EMPTY;
            }
        }
        self.keep(&stretches, &mut seen);
        Ok(())
    }

    /// Counts the load of the stretches in which the frames in `seen` were rendered. Stores the repeats of
    /// these frames, and leaves `seen` empty.
    fn keep(&mut self, stretches: &Joined, seen: &mut Vec<(usize, Vec<Timing>)>) {
        let (wall, others) = stretches.mean();
        self.others.add(wall, others);
        let disturbed = others.is_some_and(|o| o > super::others::DISTURBED_PROCESSORS);
        for (i, repeats) in seen.drain(..) {
            self.visits.entry(i).or_default().push(Visit { repeats, disturbed });
        }
        self.others.frames = self.visits.values().filter(|v| v.iter().all(|v| v.disturbed)).count();
    }

    fn show(&mut self, volume: usize, factor: usize) -> Result<()> {
        let key = (volume, factor);
        let path = &self.settings.volumes[volume];
        let named = || path.display().to_string();
        if !self.volumes.contains_key(&key) {
            let opened = Volume::open_as(path, &self.settings.reading, None)?;
            if let Some(what) = identity::difference(&self.pool.files[volume], &identity::of_volume(path)?) {
                bail!("{} changed during the calibration: {what}; calibrate again", path.display());
            }
            let opened = opened.enlarged(factor).with_context(named)?;
            let bytes = |v: &Volume| match v.data() {
                VolumeData::U8(voxels) => size_of_val(&voxels[..]),
                VolumeData::U16(voxels) => size_of_val(&voxels[..]),
                VolumeData::I16(voxels) => size_of_val(&voxels[..]),
                VolumeData::F32(voxels) => size_of_val(&voxels[..]),
            };
            if self.volumes.values().map(bytes).sum::<usize>() + bytes(&opened) > KEPT_BYTES {
                self.volumes.clear();
            }
            self.volumes.insert(key, opened);
        }
        self.renderer.set_volume(&self.volumes[&key].view()).with_context(named)?;
        Ok(())
    }

    /// Renders a frame and returns the times of its repeats; `None` if the time ran out or `stop` returned
    /// true before the last repeat.
    fn visit(&mut self, i: usize) -> Result<Option<Vec<Timing>>> {
        let scene = &self.pool.candidates[i].scene;
        let place = || format!("{}, calibration frame {i}", scene.volume);
        let frame = scene.to_frame().with_context(place)?;
        self.renderer.set_transfer(&scene.to_table().with_context(place)?).with_context(place)?;
        // The frame's measured time, from an earlier pass, is more exact than the expected time.
        let seen = self.visits.get(&i).and_then(|v| v.first()?.repeats.first()?.wall);
        let (discarded, timed) = match self.visits.get(&i) {
            Some(v) => (u32::from(seen.is_none_or(|s| s < WARM_UP_LIMIT)), v[0].repeats.len()),
            None => Self::renderings(self.wall(i)),
        };
        let (stop, deadline) = (self.stop, self.deadline);
        let over = || stop() || Instant::now() >= deadline;
        let mut left = discarded;
        let repeats = timed_repeats(self.renderer, &frame, timed, &mut left, &over).with_context(place)?;
        self.warm_ups += (discarded - left) as usize;
        let clock = self.settings.clock;
        ensure!(
            repeats.iter().flatten().all(|r| r.seconds(clock).is_some()),
            "{}: the renderer has no clock {}; choose another --clock (every renderer has wall)",
            place(),
            clock.name()
        );
        Ok(repeats)
    }

    /// Returns the noise of a round: the larger one of the standard deviation of ln(median time of a frame's
    /// repeats) and a quarter of the drift between passes; infinite if no frame was repeated.
    fn spread(&self, round: &[usize]) -> f64 {
        let frames: Vec<TimedFrame> = round.iter().filter_map(|&i| self.frame(i)).collect();
        let noise = self.noise(&frames);
        noise.map_or(f64::INFINITY, |n| n.log_sd_of_median.max(n.drift.unwrap_or(0.0) / 4.0))
    }

    fn learn_speed(&mut self) {
        let mut ratios: Vec<f64> = self
            .visits
            .keys()
            .filter_map(|&i| Some(self.frame(i)?.seconds(Clock::Wall)? / self.pool.expected[i]))
            .collect();
        // The scale is 10 % above the median ratio, so that rounds of slower frames do not overrun the time.
        if let Some(scale) = median(&mut ratios) {
            self.scale = 1.1 * scale;
        }
    }

    /// The undisturbed visits of a frame, or all its visits if none was undisturbed.
    fn counted(&self, i: usize) -> Vec<&Visit> {
        let Some(visits) = self.visits.get(&i) else { return Vec::new() };
        let calm: Vec<&Visit> = visits.iter().filter(|v| !v.disturbed).collect();
        if calm.is_empty() { visits.iter().collect() } else { calm }
    }

    /// Returns the noise of the frames' repeats by the calibration's clock; `None` if no frame was repeated.
    pub(crate) fn noise(&self, frames: &[TimedFrame]) -> Option<NoiseFloor> {
        noise_floor(frames, self.settings.clock, |f| self.counted(f.number as usize).len().max(1))
    }

    fn frame(&self, i: usize) -> Option<TimedFrame> {
        let repeats: Vec<Timing> = self.counted(i).iter().flat_map(|v| v.repeats.iter().copied()).collect();
        let scene = self.pool.candidates[i].scene.clone();
        (!repeats.is_empty()).then_some(TimedFrame { table: 0, number: i as u64, scene, repeats })
    }

    /// Every frame with its undisturbed repeats, or with all its repeats if none was undisturbed.
    pub(crate) fn frames(&self) -> Vec<TimedFrame> {
        self.visits.keys().filter_map(|&i| self.frame(i)).collect()
    }
}
