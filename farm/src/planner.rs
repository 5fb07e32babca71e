//! Plan of a run, used by driver and simulator: tasks, their expected times, the predicted end.

use super::dispatch::{Ask, Dispatcher, Order, Time};
use super::learn::{Learner, Shape};
use super::load::Loads;
use std::collections::{BTreeMap, HashSet, VecDeque};

#[path = "eta.rs"]
mod eta;
pub(crate) use eta::queue_end;

/// While less than this share of the tasks is finished, some requests are answered with a task that is chosen
/// so that the model of times learns about every volume. Second number: interval of these answers, in
/// requests.
const EXPLORATION: (f64, u32) = (0.1, 4);

/// State of a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// The task was not queued yet, or is not part of this run.
    Idle,
    /// The task waits to be sent.
    Waits,
    /// The task was sent to a slot.
    Sent,
    /// The task is done.
    Done,
    /// The task was given up.
    Quarantined,
}

/// Settings of a plan.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Setting {
    /// Number of slots that work at once.
    pub slots: usize,
    /// True if each bundle goes to a given slot, which keeps its volume between bundles. Otherwise, a bundle
    /// goes to any slot, and the slot loads the volume.
    pub bound: bool,
    /// Overhead of a bundle on its slot, seconds.
    pub overhead: f64,
    /// Longest time that the engine grants a bundle, seconds; `None` for no limit.
    pub limit: Option<f64>,
    /// Order in which tasks are sent.
    pub order: Order,
    /// True if expected times are corrected by measured ones.
    pub learn: bool,
}

#[derive(Clone, Debug, Default)]
struct Slot {
    held: Option<usize>,
    loaded: HashSet<u32>,
}

/// A bundle that was sent.
#[derive(Clone, Debug, PartialEq)]
pub struct Sent {
    /// Number of the bundle.
    pub bundle: u64,
    /// Tasks of the bundle.
    pub tasks: Vec<u32>,
    /// Slot of the bundle, if it is bound to one.
    pub slot: Option<usize>,
    /// Index of the volume that all tasks of the bundle draw.
    pub volume: usize,
    /// Expected seconds of the bundle on its slot, with loading.
    pub expected_s: f64,
    /// Expected seconds of each task on a node of speed 1.
    pub predicted_s: Vec<f32>,
}

#[derive(Clone, Debug)]
struct Running {
    sent: Sent,
    open: Vec<u32>,
    at: f64,
    /// Start of the bundle's first task, if known.
    begun: Option<f64>,
    busy: f64,
    /// True if a task of the bundle has failed. The seconds of failed tasks are not part of `busy`.
    failed: bool,
}

/// The plan.
#[derive(Clone, Debug)]
pub struct Planner {
    setting: Setting,
    learner: Learner,
    /// The model of loading times.
    pub loads: Loads,
    dispatcher: Dispatcher,
    stages: VecDeque<Vec<u32>>,
    states: Vec<State>,
    slots: Vec<Slot>,
    running: BTreeMap<u64, Running>,
    bundles: u64,
    /// Measured overhead of a bundle, seconds.
    pub(crate) overhead: f64,
    overheads: u32,
    done: usize,
    wanted: usize,
    stale: bool,
}

impl Planner {
    /// Returns a plan for tasks with the base seconds of `shape`.
    pub fn new(shape: Shape, loads: Loads, setting: Setting) -> Self {
        let learner = Learner::new(shape);
        let shape = learner.shape();
        let volume = (0..shape.len()).map(|t| shape.volume(t) as u32).collect();
        let seconds = learner.all_seconds();
        let dispatcher = Dispatcher::new(seconds, volume, shape.volumes(), setting.order);
        let states = vec![State::Idle; shape.len()];
        Self {
            overhead: setting.overhead,
            overheads: 0,
            slots: vec![Slot::default(); setting.slots],
            setting,
            learner,
            loads,
            dispatcher,
            stages: VecDeque::new(),
            states,
            running: BTreeMap::new(),
            bundles: 0,
            done: 0,
            wanted: 0,
            stale: false,
        }
    }

    /// Adds a stage of tasks, which are sent after the tasks of earlier stages.
    pub fn add_stage(&mut self, tasks: Vec<u32>) {
        for &t in &tasks {
            self.states[t as usize] = State::Waits;
        }
        self.wanted += tasks.len();
        self.stages.push_back(tasks);
        self.next_stage();
    }

    fn next_stage(&mut self) {
        if self.dispatcher.pending() == 0
            && let Some(stage) = self.stages.pop_front()
        {
            self.dispatcher.add(stage);
        }
    }

    /// Records a task that an earlier run has finished. If [`Setting::learn`] is true, also adds the task's
    /// time to the model.
    pub fn done_before(&mut self, task: u32, node: usize, seconds: f64) {
        if self.states[task as usize] != State::Done {
            self.states[task as usize] = State::Done;
            self.done += 1;
            self.wanted += 1;
        }
        if self.setting.learn {
            self.stale |= self.learner.observe(task as usize, node, seconds);
        }
    }

    pub(crate) fn quarantine(&mut self, bundle: Option<u64>, task: u32) {
        if let Some(bundle) = bundle {
            self.fail(bundle, task);
        }
        self.states[task as usize] = State::Quarantined;
    }

    /// Removes a task from the unfinished tasks of a running bundle. Returns the bundle.
    fn close(&mut self, bundle: u64, task: u32) -> Option<&mut Running> {
        let running = self.running.get_mut(&bundle)?;
        running.open.retain(|t| *t != task);
        Some(running)
    }

    fn fail(&mut self, bundle: u64, task: u32) {
        if let Some(r) = self.close(bundle, task) {
            r.failed = true;
        }
    }

    /// State of a task.
    pub fn state(&self, task: u32) -> State {
        self.states[task as usize]
    }

    /// The model of times.
    pub fn learner(&self) -> &Learner {
        &self.learner
    }

    /// Number of finished tasks and of all tasks, both including those that earlier runs have finished.
    pub(crate) fn progress(&self) -> (usize, usize) {
        (self.done, self.wanted)
    }

    pub(crate) fn pending(&self) -> usize {
        self.dispatcher.pending() + self.stages.iter().map(Vec::len).sum::<usize>()
    }

    pub(crate) fn running(&self) -> usize {
        self.running.len()
    }

    pub(crate) fn bundles(&self) -> Vec<u64> {
        self.running.keys().copied().collect()
    }

    /// Numbers of the running bundles of which no task has begun, ascending.
    pub(crate) fn not_begun(&self) -> Vec<u64> {
        self.running.iter().filter(|(_, r)| r.begun.is_none()).map(|(bundle, _)| *bundle).collect()
    }

    /// Slots to which no running bundle is bound.
    pub(crate) fn free_slots(&self) -> Vec<usize> {
        let busy: HashSet<usize> = self.running.values().filter_map(|r| r.sent.slot).collect();
        (0..self.slots.len()).filter(|slot| !busy.contains(slot)).collect()
    }

    /// True if no task waits and no bundle runs.
    pub(crate) fn is_over(&self) -> bool {
        self.pending() == 0 && self.running.is_empty()
    }

    /// Current expected seconds of a task.
    pub fn expected(&self, task: u32) -> f64 {
        f64::from(self.dispatcher.seconds(task))
    }

    /// Sorts the queue by the corrected times if they have changed. Returns true if they have changed.
    pub fn refresh(&mut self) -> bool {
        let changed = std::mem::take(&mut self.stale);
        if changed {
            self.dispatcher.reorder(self.learner.all_seconds());
        }
        changed
    }

    /// True if expected times are only assumed: no model file or list gives them, and few tasks were
    /// measured.
    pub(crate) fn is_blind(&self) -> bool {
        self.setting.learn && self.learner.observed() < 8 && !self.learner.shape().has_model()
    }

    /// Returns the next bundle for a slot, or for any free slot if `slot` is `None`. `now`: time in seconds.
    pub fn next(&mut self, slot: Option<usize>, now: f64) -> Option<Sent> {
        self.refresh();
        self.next_stage();
        let early = (self.done as f64) < EXPLORATION.0 * self.wanted as f64;
        let explores = early && self.setting.learn && self.setting.order == Order::Longest;
        let (learner, loads, slots) = (&self.learner, &self.loads, &self.slots);
        let of_slot = slot.map(|s| &slots[s]);
        let load = |v: usize| loads.seconds(v, of_slot.is_some_and(|s| s.loaded.contains(&(v as u32))));
        let speed = slot.map_or(1.0, |s| learner.speed(s));
        let ask = Ask {
            held: of_slot.and_then(|s| s.held),
            keeps: of_slot.is_some(),
            load: &load,
            overhead: self.overhead,
            slots: slots.len(),
            limit: self.setting.limit.unwrap_or(f64::INFINITY),
            blind: self.is_blind(),
            explore: if explores { EXPLORATION.1 } else { 0 },
        };
        let tasks = self.dispatcher.next(&ask)?;
        let volume = learner.shape().volume(tasks[0] as usize);
        let loading = if ask.held == Some(volume) { 0.0 } else { load(volume) };
        let predicted_s: Vec<f32> = tasks.iter().map(|t| self.dispatcher.seconds(*t)).collect();
        let expected_s = loading + predicted_s.iter().map(|s| f64::from(*s)).sum::<f64>() / speed;
        for &t in &tasks {
            self.states[t as usize] = State::Sent;
        }
        if let Some(s) = slot {
            let before = self.slots[s].held.replace(volume);
            self.slots[s].loaded.insert(volume as u32);
            self.dispatcher.hold(before, Some(volume));
        }
        let bundle = self.bundles;
        self.bundles += 1;
        let sent = Sent { bundle, tasks: tasks.clone(), slot, volume, expected_s, predicted_s };
        let running =
            Running { sent: sent.clone(), open: tasks, at: now, begun: None, busy: 0.0, failed: false };
        self.running.insert(bundle, running);
        Some(sent)
    }

    /// Sets the number of the next bundle, so that numbers differ from those of an earlier run.
    pub(crate) fn number_from(&mut self, bundle: u64) {
        self.bundles = self.bundles.max(bundle);
    }

    pub(crate) fn begun(&mut self, bundle: u64, at: f64) {
        if let Some(r) = self.running.get_mut(&bundle) {
            r.begun.get_or_insert(at);
        }
    }

    pub(crate) fn done(&mut self, bundle: u64, task: u32, node: usize, seconds: f64, load: f64) {
        if let Some(r) = self.close(bundle, task) {
            r.busy += seconds + load;
        }
        if self.states[task as usize] == State::Done {
            return;
        }
        self.states[task as usize] = State::Done;
        self.done += 1;
        if self.setting.learn {
            self.stale |= self.learner.observe(task as usize, node, seconds);
        }
    }

    pub(crate) fn again(&mut self, bundle: u64, task: u32) {
        self.fail(bundle, task);
        if self.states[task as usize] == State::Sent {
            self.states[task as usize] = State::Waits;
            self.dispatcher.add_again(task);
        }
    }

    /// Records the end of a bundle; its unfinished tasks are queued again.
    pub(crate) fn ended(&mut self, bundle: u64, now: f64) {
        let Some(r) = self.running.remove(&bundle) else { return };
        if self.setting.bound && r.open.is_empty() && !r.failed {
            // Time in which the slot neither rendered nor loaded.
            let gap = (now - r.at - r.busy).clamp(0.0, 60.0);
            self.overheads += 1;
            let weight = f64::from(self.overheads.min(50)).recip();
            self.overhead += weight * (gap - self.overhead);
        }
        for task in r.open {
            self.again(bundle, task);
        }
    }

    pub(crate) fn forget(&mut self, slot: usize) {
        let before = self.slots[slot].held.take();
        self.dispatcher.hold(before, None);
    }

    pub(crate) fn open(&self, bundle: u64) -> &[u32] {
        self.running.get(&bundle).map_or(&[], |r| &r.open)
    }

    pub(crate) fn slot_of(&self, bundle: u64) -> Option<usize> {
        self.running.get(&bundle).and_then(|r| r.sent.slot)
    }
}
