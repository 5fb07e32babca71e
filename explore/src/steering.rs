//! Plans every frame, observes its time, and stores both for the graph.

use crate::host::Steering;
use anyhow::{Context, Result};
use entire_core::GaussianLobe;
use entire_core::scene::{Frame, Shading, TransferTable};
use entire_steer::control::ObserveFlags;
use entire_steer::control::{Reason, StepLimits};
use entire_steer::features::Changes;
use entire_steer::{Plan, Session, VolumeSummary};
use std::collections::{HashMap, VecDeque};
use std::sync::Arc;

/// Number of frames in the graph.
pub(crate) const GRAPH_FRAMES: usize = 300;

/// Number of recent frames from which a frame's time for work other than ray casting is estimated.
const OTHER_WORK: usize = 15;

/// Smallest share of the target that is planned for ray casting, however long all other work of a frame
/// takes.
const LEAST_SHARE: f64 = 0.15;

/// A drawn frame. Times are seconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct FrameRecord {
    pub(crate) number: u64,
    /// Time from the beginning of the frame to the end of its presentation, without a wait for the display's
    /// refresh.
    pub(crate) seconds: f64,
    /// Time of ray casting, a part of `seconds`.
    pub(crate) cast: f64,
    /// Processor time of the thread that lays out and records the interface.
    pub(crate) interface: f64,
    /// Time of all work other than ray casting, as expected when the frame was planned.
    pub(crate) other: f64,
    pub(crate) target: f64,
    /// Predicted time of ray casting and all other work; NaN without a prediction.
    pub(crate) predicted: f64,
    pub(crate) upper: f64,
    pub(crate) step: f32,
    pub(crate) image_sample_distance: f32,
    pub(crate) reason: Reason,
    /// True if camera or transfer function changed abruptly.
    pub(crate) switched: bool,
    /// Predicted time of the frame at full quality; NaN if unknown.
    pub(crate) full: f64,
}

/// A plan with the frame to draw.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Planned {
    pub(crate) plan: Plan,
    /// The frame with the plan's step and image size.
    pub(crate) frame: Frame,
    /// Seconds of the frame besides ray casting: those before the plan, and those expected after it.
    pub(crate) other: f64,
}

/// A session, and the values of `Steer::volume` and `Steer::transfer` when the session last received a volume
/// and a transfer function; 0 if it has received none.
struct Loop {
    session: Session,
    volume: u64,
    transfer: u64,
}

/// Inputs of the sessions.
struct Known {
    summary: VolumeSummary,
    /// The predictor of each mode of [`Shading::ALL`].
    steering: Vec<Arc<dyn Steering>>,
    table: Option<(TransferTable, Option<Vec<GaussianLobe>>)>,
}

/// The render loops of all controllers. One of them steers.
#[derive(Default)]
pub(crate) struct Steer {
    /// Name and title of each controller.
    pub(crate) controllers: Vec<(&'static str, &'static str)>,
    /// Index of the controller that steers.
    pub(crate) controller: usize,
    pub(crate) enabled: bool,
    /// Target frame time, seconds.
    pub(crate) target: f64,
    /// The coarsest allowed step, reference steps.
    pub(crate) coarsest: f32,
    /// The largest allowed number of pixels between rays.
    pub(crate) distance: f32,
    pub(crate) history: VecDeque<FrameRecord>,
    /// Prediction for the current frame at full quality, seconds: expected time and upper bound.
    pub(crate) full: Option<(f64, f64)>,
    loops: HashMap<(usize, usize), Loop>,
    known: Option<Known>,
    /// Number of volumes that were set.
    volume: u64,
    /// Number of transfer functions that were set.
    transfer: u64,
    changes: Changes,
    other: VecDeque<f64>,
}

/// Index of a shading mode's predictor in [`Known::steering`].
fn shading_index(shading: Shading) -> usize {
    Shading::ALL.iter().position(|s| *s == shading).unwrap_or(0)
}

impl Steer {
    pub(crate) fn new(
        controllers: Vec<(&'static str, &'static str)>,
        controller: usize,
        target: f64,
    ) -> Self {
        Self {
            controllers,
            controller,
            enabled: true,
            target,
            coarsest: 16.0,
            distance: 8.0,
            ..Self::default()
        }
    }

    /// Sets a volume and its predictors. A session keeps its correction if its predictor stays the same.
    pub(crate) fn set_volume(&mut self, summary: VolumeSummary, steering: Vec<Arc<dyn Steering>>) {
        if let Some(known) = &self.known {
            let old = &known.steering;
            self.loops.retain(|&(_, shading), _| old[shading].identity() == steering[shading].identity());
        }
        self.known = Some(Known { summary, steering, table: None });
        self.volume += 1;
        self.full = None;
    }

    pub(crate) fn set_transfer(&mut self, table: TransferTable, lobes: Option<&[GaussianLobe]>) {
        if let Some(known) = &mut self.known {
            known.table = Some((table, lobes.map(<[GaussianLobe]>::to_vec)));
            self.transfer += 1;
        }
    }

    /// Tells the next plan that the camera jumped.
    pub(crate) fn camera_cut(&mut self) {
        self.changes.camera = true;
    }

    /// Resets every controller.
    pub(crate) fn forget(&mut self) {
        self.loops.clear();
        self.other.clear();
    }

    /// Name of the predictor, for display.
    pub(crate) fn predictor(&self, shading: Shading) -> String {
        self.known.as_ref().map_or(String::new(), |k| k.steering[shading_index(shading)].title())
    }

    /// Number of rays along each side of the probe, and number of its rays that met the volume.
    pub(crate) fn probe(&self, shading: Shading) -> Option<(usize, u32)> {
        Some(self.loops.get(&(self.controller, shading_index(shading)))?.session.probe())
    }

    /// Returns the session that steers, with the current volume and transfer function.
    fn session(&mut self, shading: Shading) -> Result<&mut Session> {
        let known = self.known.as_ref().context("no volume is open")?;
        let key = (self.controller, shading_index(shading));
        let steering = &known.steering[key.1];
        if !self.loops.contains_key(&key) {
            let session = steering.session(self.controllers[self.controller].0)?;
            self.loops.insert(key, Loop { session, volume: 0, transfer: 0 });
        }
        let running = self.loops.get_mut(&key).context("a session that was made")?;
        if running.volume != self.volume {
            running
                .session
                .set_volume(known.summary.clone(), steering.volume_features().map(<[f32]>::to_vec));
            running.volume = self.volume;
            running.transfer = 0;
        }
        if running.transfer != self.transfer
            && let Some((table, lobes)) = &known.table
        {
            running.session.set_transfer(table, lobes.as_deref())?;
            running.transfer = self.transfer;
        }
        Ok(&mut running.session)
    }

    /// Returns the expected seconds of a frame's work after its plan, except ray casting: the 75 % quantile
    /// of the last frames. A quantile above the median is taken because the plan's bound covers ray casting
    /// only.
    fn other_work(&self) -> f64 {
        let mut all: Vec<f64> = self.other.iter().copied().collect();
        all.sort_by(f64::total_cmp);
        all.get(all.len() * 3 / 4).copied().unwrap_or(0.0)
    }

    /// Returns the expected seconds of ray casting for a frame, and their upper bound.
    pub(crate) fn predict(&mut self, frame: &Frame) -> Result<(f64, f64)> {
        let p = self.session(frame.shading)?.predict(frame)?;
        Ok((f64::from(p.seconds), f64::from(p.upper)))
    }

    /// Predicts the frame at full quality, for [`Steer::full`].
    pub(crate) fn predict_full(&mut self, frame: &Frame) -> Result<()> {
        self.full = Some(self.predict(&Frame { step: 1.0, ..*frame }.checked()?)?);
        Ok(())
    }

    /// Plans a frame. `frame` has the size of the view and the reference step; `spent`: seconds of the frame
    /// so far.
    pub(crate) fn plan(&mut self, frame: &Frame, spent: f64) -> Result<Planned> {
        let rest = self.other_work();
        let other = spent + rest;
        let target = (self.target - other).max(LEAST_SHARE * self.target);
        let (enabled, limits) = (self.enabled, StepLimits { finest: 1.0, coarsest: self.coarsest });
        let known = self.known.as_ref().context("no volume is open")?;
        let steering = &known.steering[shading_index(frame.shading)];
        let both = steering.chooses_image_sample_distance(self.controllers[self.controller].0);
        let distance = if both { self.distance } else { 1.0 };
        let changes = std::mem::take(&mut self.changes);
        let session = self.session(frame.shading)?;
        session.set_enabled(enabled);
        session.set_limits(limits)?;
        // The second argument has no effect on a session with a quality law.
        session.set_max_image_sample_distance(distance, 1.0)?;
        session.mark(changes);
        let plan = session.plan(frame, target as f32)?;
        let side = |n: u32| ((n as f32 / plan.image_sample_distance) as u32).max(1);
        let (width, height) = (side(frame.width), side(frame.height));
        let drawn = Frame { width, height, step: plan.step, jitter: false, ..*frame }.checked()?;
        Ok(Planned { plan, frame: drawn, other })
    }

    /// Gives the session the seconds of ray casting, `cast`, and the processor seconds of a software renderer.
    pub(crate) fn observe(
        &mut self,
        planned: &Planned,
        shading: Shading,
        cast: f64,
        processor: Option<f64>,
    ) -> Result<()> {
        let session = self.session(shading)?;
        if let Some(processor) = processor {
            session.set_processor_seconds(processor as f32);
        }
        // An impossible time (of a suspended machine) is refused and has no effect.
        let _ = session.observe(planned.plan.id, cast as f32, ObserveFlags::default());
        Ok(())
    }

    /// Stores a finished frame. `rest`: seconds after the plan without ray casting.
    pub(crate) fn remember(&mut self, record: FrameRecord, rest: f64) {
        if self.other.len() == OTHER_WORK {
            self.other.pop_front();
        }
        self.other.push_back(rest);
        if self.history.len() == GRAPH_FRAMES {
            self.history.pop_front();
        }
        self.history.push_back(record);
    }
}

/// Returns a sentence on a frame's plan, its reason, and its expected and measured time.
pub(crate) fn words(record: &FrameRecord, controller: &str) -> String {
    let ms = |seconds: f64| format!("{:.1} ms", seconds * 1e3);
    let drawn = if record.image_sample_distance > 1.01 {
        format!(
            "step {:.2} and one ray for {:.1} × {:.1} pixels",
            record.step, record.image_sample_distance, record.image_sample_distance
        )
    } else {
        format!("step {:.2} and a ray for every pixel", record.step)
    };
    let expected = match (record.predicted.is_nan(), record.upper.is_nan()) {
        (true, _) => "No prediction".to_owned(),
        (false, true) => format!("{} expected", ms(record.predicted)),
        (false, false) => format!("{} expected, upper bound {}", ms(record.predicted), ms(record.upper)),
    };
    let target = ms(record.target);
    // `Steer::plan` gives ray casting at least this share of the target.
    let squeezed = record.target - record.other < LEAST_SHARE * record.target;
    let why = match record.reason {
        Reason::Fits | Reason::Damped | Reason::Held | Reason::FinestAllowed if squeezed => format!(
            "ray casting was planned for {:.0} % of {target}, because the frame's other work takes {}",
            LEAST_SHARE * 1e2,
            ms(record.other)
        ),
        Reason::Fits => format!("a setting that is expected to fit {target}"),
        Reason::Damped => {
            format!("a gradual approach to the step that fits {target}, because nothing changed abruptly")
        }
        Reason::Held => {
            format!("the setting of the last frame, which still fits {target} and is close to the best")
        }
        Reason::FinestAllowed => format!("full quality fits {target}"),
        Reason::TargetUnreachable => {
            format!("even the coarsest setting allowed is not expected to fit {target}")
        }
        Reason::History => "the prediction was not trusted (out of range, or large recent errors), so \
                            recent frame times were used"
            .to_owned(),
        Reason::NoInformation => "the coarsest setting allowed, because nothing is known yet".to_owned(),
        Reason::Off => "steering is off".to_owned(),
        Reason::Reactive => "chosen by a rule that uses past frames only".to_owned(),
        _ => record.reason.to_string(),
    };
    format!("{controller}: {drawn}; {why}. {expected}; the frame took {}.", ms(record.seconds))
}

#[cfg(test)]
mod tests {
    use super::*;
    use entire_core::scene::{Arcball, Camera, Scalars, TransferFunction, VolumeView};

    /// A predictor without a model; the number is the predictor's identity.
    struct Untrained(u32);

    impl Steering for Untrained {
        fn title(&self) -> String {
            "untrained".into()
        }

        fn identity(&self) -> u32 {
            self.0
        }

        fn volume_features(&self) -> Option<&[f32]> {
            None
        }

        fn session(&self, _: &str) -> Result<Session> {
            Ok(Session::default())
        }

        fn chooses_image_sample_distance(&self, controller: &str) -> bool {
            controller == "a"
        }
    }

    /// Sets a volume whose predictors have a given identity.
    fn set_volume(steer: &mut Steer, identity: u32) {
        let voxels = vec![100u8; 32 * 32 * 32];
        let view = VolumeView::new(Scalars::U8(&voxels), [32; 3]).unwrap();
        let one: Arc<dyn Steering> = Arc::new(Untrained(identity));
        let summary = VolumeSummary::new(&view).unwrap();
        steer.set_volume(summary, vec![one; Shading::ALL.len()]);
    }

    fn steer() -> (Steer, Frame) {
        let lobes = vec![GaussianLobe { center: 0.4, width: 0.1, height: 0.1 }];
        let mut steer = Steer::new(vec![("a", "A"), ("b", "B")], 0, 0.03);
        set_volume(&mut steer, 1);
        steer.set_transfer(TransferFunction::Gaussian(lobes.clone()).to_table().unwrap(), Some(&lobes));
        let camera = Camera::from_arcball(Arcball { rx: 10.0, ry: 20.0, dz: 2.0 }).unwrap();
        (steer, Frame::new(camera, 640, 480).unwrap())
    }

    const RECORD: FrameRecord = FrameRecord {
        number: 0,
        seconds: 0.03,
        cast: 0.02,
        interface: 0.001,
        other: 0.005,
        target: 0.03,
        predicted: 0.028,
        upper: 0.031,
        step: 2.0,
        image_sample_distance: 1.5,
        reason: Reason::Fits,
        switched: false,
        full: 0.1,
    };

    /// Returns the seconds of a frame with fixed costs per ray and per sample.
    fn cost(frame: &Frame) -> f64 {
        f64::from(frame.width) * f64::from(frame.height) * (2e-8 + 4e-7 / f64::from(frame.step))
    }

    #[test]
    fn the_whole_frame_is_held_with_its_other_work() {
        let (mut steer, frame) = steer();
        let (before, after) = (0.004, 0.006);
        let mut last = 0.0;
        for number in 0..40 {
            let planned = steer.plan(&frame, before).unwrap();
            let cast = cost(&planned.frame);
            last = before + cast + after;
            steer.observe(&planned, frame.shading, cast, None).unwrap();
            steer.remember(FrameRecord { number, seconds: last, cast, ..RECORD }, after);
        }
        assert!((last / steer.target - 1.0).abs() < 0.1, "{last}");
        // With steering off, the full frame is drawn.
        steer.enabled = false;
        let planned = steer.plan(&frame, before).unwrap();
        assert_eq!(planned.frame, frame);
        steer.predict_full(&frame).unwrap();
        let (expected, _) = steer.full.unwrap();
        assert!((expected / cost(&frame) - 1.0).abs() < 0.5, "{expected} {}", cost(&frame));
    }

    #[test]
    fn a_session_lasts_as_long_as_its_predictor() {
        let (mut steer, frame) = steer();
        steer.plan(&frame, 0.0).unwrap();
        set_volume(&mut steer, 1);
        assert_eq!(steer.loops.len(), 1, "another volume with the same model");
        set_volume(&mut steer, 2);
        assert!(steer.loops.is_empty(), "another model");
    }

    #[test]
    fn only_a_controller_that_chooses_it_changes_the_image_size() {
        let (mut steer, frame) = steer();
        steer.target = 1e-4;
        for (controller, smaller) in [(0, true), (1, false)] {
            steer.controller = controller;
            let planned = steer.plan(&frame, 0.0).unwrap();
            assert_eq!(planned.frame.width < frame.width, smaller, "{:?}", planned.plan);
            assert!(planned.frame.step > 1.0, "{:?}", planned.plan);
        }
    }

    #[test]
    fn controllers_learn_for_themselves_and_every_reason_has_words() {
        let (mut steer, frame) = steer();
        let first = steer.plan(&frame, 0.0).unwrap();
        steer.observe(&first, frame.shading, 0.5, None).unwrap();
        let learned = steer.plan(&frame, 0.0).unwrap();
        steer.controller = 1;
        let other = steer.plan(&frame, 0.0).unwrap();
        assert!(other.plan.seconds != learned.plan.seconds);
        let text = words(&RECORD, "hybrid");
        assert!(text.contains("1.5 × 1.5 pixels") && text.contains("upper bound 31.0 ms"), "{text}");
        assert!(text.contains("expected to fit 30.0 ms"), "{text}");
        let text = words(&FrameRecord { other: 0.04, predicted: 0.045, ..RECORD }, "hybrid");
        assert!(text.contains("15 % of 30.0 ms, because the frame's other work takes 40.0 ms"), "{text}");
    }
}
