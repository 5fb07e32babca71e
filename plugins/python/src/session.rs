//! One render loop.

use crate::calibration::{Fitted, fitted};
use crate::camera::Camera;
use crate::detach::detached;
use crate::errors::{NotReadyError, raise};
use crate::frame::{Shape, cameras, count, sides};
use crate::held::Held;
use crate::lock::Guarded;
use crate::model::{Loaded, Model};
use crate::plan::{Plan, Prediction};
use crate::state::{State, columns};
use crate::transfer::TransferFunction;
use crate::volume::Volume;
use entire_core::scene::Frame;
use entire_steer::calibrate::Picture;
use entire_steer::control::{HybridOptions, ObserveFlags, Quality, Session as Core, StepLimits};
use entire_steer::features::{Changes, PROBE_SIDE, Setting};
use entire_steer::predict::{AnalyticModel, Predictor};
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict, PyTuple};
use std::sync::{Arc, MutexGuard};

/// The native part of `entire.Session`.
#[pyclass(subclass, frozen, module = "entire._native")]
pub(crate) struct Session {
    state: Guarded<State>,
    model: Guarded<Option<Arc<Loaded>>>,
    options: HybridOptions,
}

impl Session {
    fn state(&self, py: Python<'_>) -> PyResult<MutexGuard<'_, State>> {
        self.state.lock(py)
    }

    /// Sets the transfer function among a call's arguments, if there is one. Returns the frame that the arguments
    /// describe, and the locked state.
    fn begin(
        &self,
        py: Python<'_>,
        camera: &Camera,
        tf: Option<&TransferFunction>,
        shape: PyResult<Shape>,
    ) -> PyResult<(Frame, MutexGuard<'_, State>)> {
        let frame = shape?.frame(camera.core)?;
        Ok((frame, self.taking(py, tf)?))
    }

    /// Sets the transfer function, if one is given; returns the locked state.
    fn taking(&self, py: Python<'_>, tf: Option<&TransferFunction>) -> PyResult<MutexGuard<'_, State>> {
        let mut state = self.state(py)?;
        if let Some(tf) = tf {
            state.take_transfer(tf)?;
        }
        Ok(state)
    }
}

#[pymethods]
impl Session {
    #[new]
    #[pyo3(signature = (volume = None, *, model = None, tolerance = 0.1, miss_rate = 0.05,
        trust_limit = 2.0, damping = true, ignore_load = false, probe_side = None,
        probe_tolerance = 0.0))]
    fn new(
        py: Python<'_>,
        volume: Option<&Volume>,
        model: Option<&Model>,
        tolerance: f32,
        miss_rate: f32,
        trust_limit: f32,
        damping: bool,
        ignore_load: bool,
        probe_side: Option<i64>,
        probe_tolerance: f32,
    ) -> PyResult<Self> {
        let defaults = HybridOptions::default();
        let options = HybridOptions { miss_rate, tolerance, trust_limit, damping, ignore_load, ..defaults };
        let predictor: Box<dyn Predictor + Send> = match model {
            Some(model) => model.0.predictor()?,
            None => Box::new(AnalyticModel::default()),
        };
        let mut core = Core::new(predictor, options).map_err(raise)?;
        let accepted = (probe_tolerance != 0.0).then_some(probe_tolerance);
        if probe_side.is_some() || accepted.is_some() {
            core = core.with_probe(probe_side.map_or(PROBE_SIDE, count), accepted).map_err(raise)?;
        }
        let model = Guarded::new(model.map(|m| m.0.clone()));
        let made = Self { state: Guarded::new(State::new(core)), model, options };
        if let Some(volume) = volume {
            made.set_volume(py, volume)?;
        }
        Ok(made)
    }

    /// Sets the volume. The first use of a volume scans its voxels; a model with volume features encodes
    /// them. If `volume` is the next time step of the current volume (:meth:`Volume.next`), the transfer
    /// function and the learned state of the scene are kept.
    ///
    /// Parameters
    /// ----------
    /// volume : Volume
    ///
    /// Raises
    /// ------
    /// ModelError
    ///     If the model takes volume features and has no encoder.
    fn set_volume(&self, py: Python<'_>, volume: &Volume) -> PyResult<()> {
        // The volume is scanned and encoded before the session is locked, with the interpreter lock released.
        volume.0.summary(py)?;
        let model = self.model.lock(py)?.clone();
        let features = match &model {
            Some(model) => model.features_of(py, &volume.0)?,
            None => None,
        };
        self.state(py)?.take_volume(py, &volume.0, features.as_deref())
    }

    /// Sets the transfer function. :meth:`plan` and :meth:`predict` set it too.
    ///
    /// Parameters
    /// ----------
    /// tf : TransferFunction
    ///
    /// Raises
    /// ------
    /// NotReadyError
    ///     Before a volume is set.
    fn set_transfer_function(&self, py: Python<'_>, tf: &TransferFunction) -> PyResult<()> {
        self.state(py)?.take_transfer(tf)
    }

    /// Sets the allowed steps.
    ///
    /// Parameters
    /// ----------
    /// finest, coarsest : float
    ///     Ray steps in reference steps; 1/64 <= finest <= coarsest <= 4096. Initially 1 and 16.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     For other numbers.
    fn set_limits(&self, py: Python<'_>, finest: f32, coarsest: f32) -> PyResult<()> {
        self.state(py)?.core.set_limits(StepLimits { finest, coarsest }).map_err(raise)
    }

    /// Allows plans to make the image smaller.
    ///
    /// Parameters
    /// ----------
    /// coarsest : float
    ///     Maximum number of pixels between rays along each side of the image, 1 to 64. 1, the initial value,
    ///     keeps the full image size.
    /// step_alone : float, optional
    ///     Multiple of the finest step up to which only the step is coarsened, 1 to 64. Default 1; use about
    ///     2 if smaller images are blurred strongly.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     For other numbers.
    #[pyo3(signature = (coarsest, step_alone = 1.0))]
    fn set_max_image_sample_distance(&self, py: Python<'_>, coarsest: f32, step_alone: f32) -> PyResult<()> {
        self.state(py)?.core.set_max_image_sample_distance(coarsest, step_alone).map_err(raise)
    }

    /// Sets the quality law of this renderer (picture error as a function of ray step and image size), so
    /// that plans coarsen step or image, whichever adds less error.
    ///
    /// For a step of s times the finest and rays d pixels apart, a power of the picture's error is
    /// proportional to ``(s - 1)**step_exponent + image_weight * (d - 1)**image_exponent``, and the picture's
    /// time to ``(ray_share + (1 - ray_share) / s) / d**2``. The law replaces `step_alone` of
    /// :meth:`set_max_image_sample_distance`.
    ///
    /// Parameters
    /// ----------
    /// image_weight : float or None
    ///     The power of the error of an image of half the size along each side, divided by the same power of
    ///     the error of a step twice as coarse; 1e-3 to 1e3. With None, the initial value, the session uses
    ///     the model's law, if the model was calibrated with pictures of this renderer, else the law that is
    ///     built in for the renderer.
    /// step_exponent, image_exponent : float, optional
    ///     Exponents of the errors of step and image, 0.05 to 8. Default 1.
    /// ray_share : float, optional
    ///     Share of the time at full quality that is proportional to the number of rays, not of their
    ///     samples, 0 to 0.9. Default 0.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     For other numbers.
    #[pyo3(signature = (image_weight, step_exponent = 1.0, image_exponent = 1.0, ray_share = 0.0))]
    fn set_quality(
        &self,
        py: Python<'_>,
        image_weight: Option<f32>,
        step_exponent: f32,
        image_exponent: f32,
        ray_share: f32,
    ) -> PyResult<()> {
        let known = |image_weight| Quality { image_weight, step_exponent, image_exponent, ray_share };
        self.state(py)?.core.set_quality(image_weight.map(known)).map_err(raise)
    }

    /// (float, float, float, float) or None : The quality law that plans use, in the order of
    /// :meth:`set_quality`: the law that was set, else the model's law, if it is for this renderer, else the
    /// law that is built in for the renderer that :meth:`set_timing_source` names; None without a law.
    #[getter]
    fn quality(&self, py: Python<'_>) -> PyResult<Option<(f32, f32, f32, f32)>> {
        let known = self.state(py)?.core.quality();
        Ok(known.map(|q| (q.image_weight, q.step_exponent, q.image_exponent, q.ray_share)))
    }

    /// Turns steering off or on again. While it is off, every plan returns the frame's own step, for
    /// screenshots and still frames.
    ///
    /// Parameters
    /// ----------
    /// enabled : bool
    ///     True to turn steering on, False to turn it off.
    fn set_enabled(&self, py: Python<'_>, enabled: bool) -> PyResult<()> {
        self.state(py)?.core.set_enabled(enabled);
        Ok(())
    }

    /// Announces that the next frame differs abruptly from the previous one in a way that the session cannot
    /// detect.
    ///
    /// Parameters
    /// ----------
    /// camera : bool, optional
    ///     True if the camera jumped.
    /// mode : bool, optional
    ///     True if the render mode changed.
    /// first : bool, optional
    ///     True if the renderer must build a pipeline first, or draws on another device.
    #[pyo3(signature = (*, camera = false, mode = false, first = false))]
    fn mark(&self, py: Python<'_>, camera: bool, mode: bool, first: bool) -> PyResult<()> {
        self.state(py)?.core.mark(Changes { camera, mode, first, ..Changes::default() });
        Ok(())
    }

    /// Chooses the settings of the next frame, so that it takes at most `target` seconds.
    ///
    /// Parameters
    /// ----------
    /// camera : Camera
    /// tf : TransferFunction or None
    ///     None keeps the previous transfer function. Pass the same object for the same function: another
    ///     object counts as a change.
    /// size : (int, int)
    ///     Width and height of the full image in pixels, 1 to 16384.
    /// target : float
    ///     Target time of the frame in seconds, positive.
    /// step : float, optional
    ///     The frame's own step in reference steps, which the plan returns if steering is off. Default 1.
    /// shading : {"none", "local", "scatter", "local-scatter"}, optional
    ///     Shading of samples: none, local lighting, single scattering, or both.
    /// skipping : {"blocks", "none", "distance"}, optional
    ///     Method by which the renderer skips empty space.
    /// termination : float, optional
    ///     Accumulated opacity at which rays stop, above 0 and at most 1 (never). Default 0.99.
    ///
    /// Returns
    /// -------
    /// Plan
    ///
    /// Raises
    /// ------
    /// NotReadyError
    ///     If no volume or no transfer function is set.
    /// MissingInputError
    ///     If the model needs an input that was not given, such as Gaussian lobes.
    /// ValueError
    ///     For a size, step, target or termination out of range.
    #[pyo3(signature = (camera, tf, size, target, *, step = 1.0, shading = "none", skipping = "blocks",
        termination = 0.99))]
    fn plan(
        &self,
        py: Python<'_>,
        camera: &Camera,
        tf: Option<&TransferFunction>,
        size: [i64; 2],
        target: f32,
        step: f32,
        shading: &str,
        skipping: &str,
        termination: f32,
    ) -> PyResult<Plan> {
        let shape = Shape::new(size, step, shading, skipping, termination);
        let (frame, mut state) = self.begin(py, camera, tf, shape)?;
        state.plan(&frame, target)
    }

    /// For adapters: observes the last frame and plans the next one of a held volume in one call. Jumps of
    /// the camera are detected.
    ///
    /// Parameters
    /// ----------
    /// held : Held
    /// to_eye : tuple of float, shape (16,)
    ///     Rows of the world-to-eye matrix.
    /// fov : float
    ///     Vertical field of view in degrees; not used with `parallel_scale`.
    /// parallel_scale : float or None
    ///     Half of the height that a parallel projection shows, in world units.
    /// size : (int, int)
    ///     Width and height of the full image in pixels, 1 to 16384.
    /// target : float
    ///     Target time of the frame in seconds, positive.
    /// step : float, optional
    ///     The frame's own step in reference steps. Default: that of `held`.
    /// enabled : bool, optional
    ///     True to steer the frame; otherwise the plan returns the frame's own step. Default True.
    /// due : Plan, optional
    ///     The plan of the previous frame, if its time was not observed yet.
    /// seconds : float, optional
    ///     Measured time of that frame. A rejected time has no effect.
    /// processor_seconds : float, optional
    /// cancelled : bool, optional
    ///     As in :meth:`observe`, for that frame.
    ///
    /// Returns
    /// -------
    /// (Plan, float, float)
    ///     The plan, its step and its image sample distance.
    ///
    /// Raises
    /// ------
    /// NotReadyError, MissingInputError
    ///     As :meth:`plan`.
    /// ValueError
    ///     As :meth:`plan` and :meth:`Camera.scene`.
    #[pyo3(signature = (held, to_eye, fov, parallel_scale, size, target, step = None, enabled = true,
        due = None, seconds = f64::NAN, processor_seconds = f64::NAN, cancelled = false))]
    fn steer(
        &self,
        py: Python<'_>,
        held: &Held,
        to_eye: &Bound<'_, PyTuple>,
        fov: f64,
        parallel_scale: Option<f64>,
        size: (i64, i64),
        target: f32,
        step: Option<f32>,
        enabled: bool,
        due: Option<&Plan>,
        seconds: f64,
        processor_seconds: f64,
        cancelled: bool,
    ) -> PyResult<(Plan, f32, f32)> {
        let mut state = self.state(py)?;
        if let Some(due) = due {
            // Rejected times are documented to have no effect.
            let seconds = [seconds, processor_seconds];
            let _ = state.observe(due, seconds, ObserveFlags { unusual: false, cancelled });
        }
        let frame = held.frame(to_eye, fov, parallel_scale, size.into(), step)?;
        state.follow(frame.camera);
        state.core.set_enabled(enabled);
        let planned = state.plan(&frame, target);
        state.core.set_enabled(true);
        let plan = planned?;
        let (step, distance) = (plan.step, plan.image_sample_distance);
        Ok((plan, step, distance))
    }

    /// Chooses a setting from a list that is sorted by picture quality, best first. The choice is the first
    /// setting whose expected time is at most the target and whose upper bound is at most (1 + `tolerance`)
    /// times the target. If there is none, it is the setting with the shortest expected time.
    ///
    /// For renderers that allow only a few steps or sizes.
    ///
    /// Parameters
    /// ----------
    /// camera, tf, size, target, shading, skipping, termination
    ///     As in :meth:`plan`.
    /// settings : sequence of (step, (width, height))
    ///     Ray step in reference steps, and image size in pixels with the aspect ratio of `size`; best
    ///     picture first.
    ///
    /// Returns
    /// -------
    /// (int, Plan)
    ///     Index of the setting to draw with, and its plan for :meth:`observe`.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     If `settings` is empty or a setting is out of range; otherwise as :meth:`plan`.
    #[pyo3(signature = (camera, tf, size, target, settings, *, shading = "none", skipping = "blocks",
        termination = 0.99))]
    fn choose(
        &self,
        py: Python<'_>,
        camera: &Camera,
        tf: Option<&TransferFunction>,
        size: [i64; 2],
        target: f32,
        settings: Vec<[Bound<'_, PyAny>; 2]>,
        shading: &str,
        skipping: &str,
        termination: f32,
    ) -> PyResult<(usize, Plan)> {
        let shape = Shape::new(size, 1.0, shading, skipping, termination);
        // Read while the session is not locked, since reading a sequence may run Python code.
        let read = |[step, size]: &[Bound<'_, PyAny>; 2]| -> PyResult<(f32, (u32, u32))> {
            Ok((step.extract()?, sides(size.extract()?)))
        };
        let settings = settings.iter().map(read).collect::<PyResult<Vec<_>>>()?;
        let (frame, mut state) = self.begin(py, camera, tf, shape)?;
        let settings: Vec<Setting> = settings
            .into_iter()
            .map(|(step, (width, height))| Setting { step, width, height, ..Setting::from(&frame) })
            .collect();
        let (index, mut plan) = state.core.choose(&frame, &settings, target).map_err(raise)?;
        let drawn = settings[index];
        plan.image_sample_distance = (frame.width as f32 / drawn.width as f32).max(1.0);
        Ok((index, Plan::new(plan, (drawn.width, drawn.height), target, &state.identity)))
    }

    /// Observes the time of a planned frame.
    ///
    /// Parameters
    /// ----------
    /// plan : Plan
    ///     One of the last 64 plans of this session.
    /// seconds : float
    ///     Measured time of the frame.
    /// unusual : bool, optional
    ///     True if the time includes work that is not the frame's (a compilation, an upload, a stall).
    /// cancelled : bool, optional
    ///     True if the frame was abandoned; its time is then only a lower bound.
    /// processor_seconds : float, optional
    ///     Processor time of this process in the frame, over all threads, if the renderer runs on the processor
    ///     and ``seconds`` is wall time. If other programs take processors away, this time falls relative to the
    ///     wall time, and the session follows after one slow frame instead of two.
    ///
    /// Returns
    /// -------
    /// str
    ///     "learned"; "clipped" if the time is far from the expected one, so that its influence was limited;
    ///     or "ignored" if the frame was unusual, was cancelled no later than its expected end, or had no
    ///     prediction.
    ///
    /// Raises
    /// ------
    /// RejectedObservationError
    ///     For a plan that is of another session, forgotten or observed before, and for a time that is not
    ///     finite, not positive or over 10,000 s. Nothing is learned then.
    #[pyo3(signature = (plan, seconds, *, unusual = false, cancelled = false, processor_seconds = f64::NAN))]
    fn observe(
        &self,
        py: Python<'_>,
        plan: &Plan,
        seconds: f64,
        unusual: bool,
        cancelled: bool,
        processor_seconds: f64,
    ) -> PyResult<&'static str> {
        let flags = ObserveFlags { unusual, cancelled };
        Ok(self.state(py)?.observe(plan, [seconds, processor_seconds], flags)?.into())
    }

    /// Predicts a frame's seconds at its own step, with the correction learned from observed frames. The call
    /// sets the transfer function and has no other effect on later plans.
    ///
    /// Parameters
    /// ----------
    /// camera, tf, size, step, shading, skipping, termination
    ///     As in :meth:`plan`.
    ///
    /// Returns
    /// -------
    /// Prediction
    #[pyo3(signature = (camera, tf, size, *, step = 1.0, shading = "none", skipping = "blocks",
        termination = 0.99))]
    fn predict(
        &self,
        py: Python<'_>,
        camera: &Camera,
        tf: Option<&TransferFunction>,
        size: [i64; 2],
        step: f32,
        shading: &str,
        skipping: &str,
        termination: f32,
    ) -> PyResult<Prediction> {
        let shape = Shape::new(size, step, shading, skipping, termination);
        let (frame, mut state) = self.begin(py, camera, tf, shape)?;
        Ok(state.core.predict(&frame).map_err(raise)?.into())
    }

    /// Predicts the seconds of many views; bit for bit the same as :meth:`predict` for each view.
    ///
    /// Parameters
    /// ----------
    /// cameras : sequence of Camera, or array_like of shape (n, 3) or (n, 4, 4)
    ///     Cameras, arcball poses (rx, ry in degrees, dz in radii), or world-to-eye matrices.
    /// tf, size, step, shading, skipping, termination
    ///     As in :meth:`plan`.
    /// fov : float, optional
    ///     Vertical field of view in degrees for arrays. Default 45.
    ///
    /// Returns
    /// -------
    /// numpy.ndarray
    ///     float32, shape (n,): seconds.
    #[pyo3(signature = (cameras, tf, size, *, step = 1.0, shading = "none", skipping = "blocks",
        termination = 0.99,
        fov = 45.0))]
    fn predict_many<'py>(
        &self,
        py: Python<'py>,
        cameras: &Bound<'py, PyAny>,
        tf: Option<&TransferFunction>,
        size: [i64; 2],
        step: f32,
        shading: &str,
        skipping: &str,
        termination: f32,
        fov: f32,
    ) -> PyResult<Bound<'py, PyArray1<f32>>> {
        let shape = Shape::new(size, step, shading, skipping, termination)?;
        let volume = self.state(py)?.volume.clone();
        let Some(volume) = volume else {
            return Err(NotReadyError::new_err(
                "no volume is set; make the session with one, or call set_volume",
            ));
        };
        // Read while the session is not locked, since an array-like object may call the session.
        let all = self::cameras(cameras, &Volume(volume), fov)?;
        // Every frame is checked before any is predicted.
        let frames = all.into_iter().map(|camera| shape.frame(camera)).collect::<PyResult<Vec<_>>>()?;
        let mut state = self.taking(py, tf)?;
        let core = &mut state.core;
        let seconds =
            detached(py, || frames.iter().map(|frame| core.predict(frame).map(|p| p.seconds)).collect());
        Ok(PyArray1::from_vec(py, Result::<Vec<f32>, _>::map_err(seconds, raise)?))
    }

    /// Resets the session: observations, plans and history are dropped; volume and transfer function stay.
    fn reset(&self, py: Python<'_>) -> PyResult<()> {
        let mut state = self.state(py)?;
        state.core.reset();
        state.history.clear();
        Ok(())
    }

    /// :meth:`entire.Session.record` with the number of `frames` to keep, and an opened `model` or None.
    #[pyo3(signature = (frames, model))]
    fn record_from(&self, py: Python<'_>, frames: i64, model: Option<&Model>) -> PyResult<()> {
        let prior = model.map(|m| m.0.model_file()).transpose()?;
        self.state(py)?.core.record(prior.as_ref(), count(frames)).map_err(raise)
    }

    /// Number of frames kept since :meth:`record`; ``None`` before it.
    #[getter]
    fn recorded(&self, py: Python<'_>) -> PyResult<Option<usize>> {
        Ok(self.state(py)?.core.recorded())
    }

    /// Records the error of a picture against the same view at full quality, for :meth:`calibrate`. The model
    /// then contains the renderer's quality law (:meth:`set_quality`), if at least 3 scenes were drawn at the
    /// same settings: full quality, coarser steps alone, smaller images alone, and both.
    ///
    /// Parameters
    /// ----------
    /// scene : int
    ///     Number of the view; all pictures of one view have the same number.
    /// step : float
    ///     Ray step as a multiple of the finest; 1 for full quality.
    /// image_sample_distance : float
    ///     Pixels between neighboring rays; 1 for full quality.
    /// seconds : float
    ///     Measured time of the picture.
    /// error : float
    ///     Difference from the picture at full quality, by any measure that is 0 for equal pictures and grows
    ///     with the difference, such as the root mean square difference of colors, or 1 - SSIM.
    ///
    /// Raises
    /// ------
    /// NotReadyError
    ///     Before :meth:`record`.
    /// ValueError
    ///     For numbers out of range.
    fn record_picture(
        &self,
        py: Python<'_>,
        scene: u64,
        step: f32,
        image_sample_distance: f32,
        seconds: f64,
        error: f64,
    ) -> PyResult<()> {
        let picture = Picture { scene, step, distance: image_sample_distance, seconds, error };
        self.state(py)?.core.record_picture(picture).map_err(raise)
    }

    /// Fits a model to the recorded frames; returns the bytes of its file, and its report.
    fn calibrate_bytes<'py>(&self, py: Python<'py>) -> PyResult<Fitted<'py>> {
        fitted(py, &mut self.state(py)?.core)
    }

    /// :meth:`entire.Session.set_model` with an opened `model`.
    fn steer_by(&self, py: Python<'_>, model: &Model) -> PyResult<()> {
        let predictor = model.0.predictor()?;
        let mut kept = self.model.lock(py)?;
        let mut state = self.state(py)?;
        state.core.set_predictor(predictor, self.options).map_err(raise)?;
        state.history.clear();
        *kept = Some(model.0.clone());
        Ok(())
    }

    /// Names the renderer of the observed frames and their clock. A learned correction is valid only for this
    /// renderer and clock: it is forgotten if a name that was not empty changes. Saved states contain both
    /// names, and :meth:`load_state` refuses states with other names. Both names are empty at first.
    ///
    /// A clock named "cpu", "wall" or "device" is compared with the model's (:attr:`model_clock`). If they
    /// differ, the session keeps the model's ratios between scenes and learns the factor between the clocks
    /// from the first frames; its earlier state is dropped.
    ///
    /// Parameters
    /// ----------
    /// renderer, clock : str
    ///     At most 256 bytes each.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     For a longer name.
    fn set_timing_source(&self, py: Python<'_>, renderer: &str, clock: &str) -> PyResult<()> {
        self.state(py)?.core.set_timing_source(renderer, clock).map_err(raise)
    }

    /// str or None : The clock that times the frames, as :meth:`set_timing_source` named it: "cpu", "wall"
    /// or "device"; None for other names, and before a name is set.
    #[getter]
    fn clock(&self, py: Python<'_>) -> PyResult<Option<&'static str>> {
        Ok(self.state(py)?.core.clocks()[0].map(Into::into))
    }

    /// str or None : The clock whose seconds the model predicts: "cpu", "wall" or "device"; None if its file
    /// has no clock, and without a model.
    #[getter]
    fn model_clock(&self, py: Python<'_>) -> PyResult<Option<&'static str>> {
        Ok(self.state(py)?.core.clocks()[1].map(Into::into))
    }

    /// The learned state, as bytes for :meth:`load_state`.
    fn save_state<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyBytes>> {
        Ok(PyBytes::new(py, &self.state(py)?.core.save_state()))
    }

    /// Loads a saved state; on an error nothing changes.
    ///
    /// Parameters
    /// ----------
    /// state : bytes
    ///     From :meth:`save_state`.
    ///
    /// Raises
    /// ------
    /// ValueError
    ///     For bytes that are cut short, damaged or of another controller.
    /// ModelError
    ///     For a valid state of another model, renderer or clock (:meth:`set_timing_source`).
    fn load_state(&self, py: Python<'_>, state: &[u8]) -> PyResult<()> {
        self.state(py)?.core.load_state(state).map_err(raise)
    }

    /// The last observed frames (at most 4096), oldest first, as columns.
    ///
    /// Returns
    /// -------
    /// dict of str to numpy.ndarray or list
    ///     Arrays ``plan`` (number of the plan), ``target``, ``predicted``, ``upper``, ``measured``
    ///     (seconds), ``step`` (reference steps) and ``image_sample_distance`` (pixels); lists ``reason`` and
    ///     ``verdict``.
    fn columns<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let frames = self.state(py)?.history.clone();
        columns(py, &frames)
    }
}
