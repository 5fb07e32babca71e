//! State of a session between calls.

use crate::errors::{NotReadyError, raise};
use crate::plan::Plan;
use crate::transfer::{Transfer, TransferFunction};
use crate::volume::Data;
use entire_core::scene::{Camera as CoreCamera, Frame};
use entire_steer::control::{ObserveFlags, Session as Core, Verdict};
use entire_steer::features::Changes;
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};
use std::collections::VecDeque;
use std::sync::Arc;

/// Maximum number of observed frames that are kept.
const MAX_OBSERVED_FRAMES: usize = 4096;

#[derive(Clone)]
pub(crate) struct Observed {
    pub(crate) plan: Plan,
    pub(crate) measured: f32,
    pub(crate) verdict: Verdict,
}

/// A session of the core, its current inputs, and its observed frames.
pub(crate) struct State {
    pub(crate) core: Core,
    pub(crate) volume: Option<Arc<Data>>,
    transfer: Option<Arc<Transfer>>,
    /// The camera of the last steered frame.
    camera: Option<CoreCamera>,
    /// Identity of this session, which its plans contain.
    pub(crate) identity: Arc<()>,
    /// The last [`MAX_OBSERVED_FRAMES`] observed frames, oldest first.
    pub(crate) history: VecDeque<Observed>,
}

impl State {
    pub(crate) fn new(core: Core) -> Self {
        Self {
            core,
            volume: None,
            transfer: None,
            camera: None,
            identity: Arc::default(),
            history: VecDeque::new(),
        }
    }

    /// Sets a volume or its next time step, with VolumeNet's output for the volume if the model uses this
    /// output.
    pub(crate) fn take_volume(
        &mut self,
        py: Python<'_>,
        volume: &Arc<Data>,
        features: Option<&[f32]>,
    ) -> PyResult<()> {
        let (summary, features) = (volume.summary(py)?.clone(), features.map(<[f32]>::to_vec));
        if self.volume.as_ref().is_some_and(|before| volume.follows(before)) {
            self.core.set_time_step(summary, features).map_err(raise)?;
            self.volume = Some(volume.clone());
            return Ok(());
        }
        self.core.set_volume(summary, features);
        self.volume = Some(volume.clone());
        self.transfer = None;
        Ok(())
    }

    /// Sets a transfer function, if it differs from the present one.
    pub(crate) fn take_transfer(&mut self, transfer: &TransferFunction) -> PyResult<()> {
        if self.transfer.as_ref().is_some_and(|t| Arc::ptr_eq(t, &transfer.0)) {
            return Ok(());
        }
        let Some(volume) = &self.volume else {
            return Err(NotReadyError::new_err(
                "no volume is set; make the session with one, or call set_volume before the first frame",
            ));
        };
        let table = transfer.0.table_for(volume)?;
        self.core.set_transfer(&table, transfer.0.lobes()).map_err(raise)?;
        self.transfer = Some(transfer.0.clone());
        Ok(())
    }

    /// Announces a jump of the camera, if it jumped since the last steered frame.
    pub(crate) fn follow(&mut self, camera: CoreCamera) {
        if self.camera.is_some_and(|before| crate::camera::jumps(&before, &camera)) {
            self.core.mark(Changes { camera: true, ..Changes::default() });
        }
        self.camera = Some(camera);
    }

    pub(crate) fn plan(&mut self, frame: &Frame, target: f32) -> PyResult<Plan> {
        let plan = self.core.plan(frame, target).map_err(raise)?;
        let shrunk = |side: u32| ((f64::from(side) / f64::from(plan.image_sample_distance)) as u32).max(1);
        let size = (shrunk(frame.width), shrunk(frame.height));
        Ok(Plan::new(plan, size, target, &self.identity))
    }

    /// Observes the time of a planned frame, and stores it in the history.
    ///
    /// The times are measured seconds and processor seconds; the latter are NaN if they are unknown.
    pub(crate) fn observe(&mut self, plan: &Plan, times: [f64; 2], flags: ObserveFlags) -> PyResult<Verdict> {
        let [seconds, processor_seconds] = times.map(|seconds| seconds as f32);
        // No plan has the number 0. So plans of other sessions are rejected like forgotten ones.
        let id = if Arc::ptr_eq(&plan.session, &self.identity) { plan.id } else { 0 };
        self.core.set_processor_seconds(processor_seconds);
        let verdict = self.core.observe(id, seconds, flags).map_err(raise)?;
        if self.history.len() == MAX_OBSERVED_FRAMES {
            self.history.pop_front();
        }
        self.history.push_back(Observed { plan: plan.clone(), measured: seconds, verdict });
        Ok(verdict)
    }
}

/// Observed frames as columns: arrays of numbers and lists of words.
pub(crate) fn columns<'py>(py: Python<'py>, frames: &VecDeque<Observed>) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    dict.set_item("plan", PyArray1::from_iter(py, frames.iter().map(|f| f.plan.id)))?;
    type Number = (&'static str, fn(&Observed) -> f32);
    let numbers: [Number; 6] = [
        ("target", |f| f.plan.target),
        ("predicted", |f| f.plan.seconds),
        ("upper", |f| f.plan.upper),
        ("measured", |f| f.measured),
        ("step", |f| f.plan.step),
        ("image_sample_distance", |f| f.plan.image_sample_distance),
    ];
    for (name, number) in numbers {
        dict.set_item(name, PyArray1::from_iter(py, frames.iter().map(number)))?;
    }
    dict.set_item("reason", PyList::new(py, frames.iter().map(|f| f.plan.reason))?)?;
    dict.set_item("verdict", PyList::new(py, frames.iter().map(|f| <&str>::from(f.verdict)))?)?;
    Ok(dict)
}
