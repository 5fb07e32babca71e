//! Latency of predictions: the time of a prediction with cold caches (as between two frames) and with warm
//! caches, and the time that a new transfer function adds.

use anyhow::{Context, Result};
use entire_core::model::Model;
use entire_core::scene::{Camera, Frame, GaussianLobe, Shading, TransferFunction, TransferTable};
use entire_io::scenes::SceneDistribution;
use entire_io::volume::Volume;
use entire_steer::features::{Changes, FrameFeatures, Setting, TransferSummary, VolumeSummary};
use entire_steer::predict::{GroupKind, Inputs, load};
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Bytes that are read and written before each cold call: more than the first two cache levels hold.
const EVICTED_BYTES: usize = 8 << 20;

const FRAMES: u64 = 200;

const ROUNDS: usize = 5;

/// Seconds of one prediction in one thread, scene features included. Work per volume is not included; work
/// per transfer function is separate. The opacity of a cell is computed when a ray first meets the cell. In
/// the first frame of a transfer function, this counts as work per transfer function. In later frames, after
/// the camera has turned, it counts as part of the prediction.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Latency {
    /// Median with cold caches, seconds.
    pub(crate) cold: f64,
    /// Median over consecutive calls, seconds.
    pub(crate) warm: f64,
    /// Median for a new transfer function, seconds: its immediate work, plus the time by which its first
    /// prediction exceeds its second prediction; 0 for models that do not use the scene.
    pub(crate) transfer: f64,
}

/// Number of frames over which the cost of a new transfer function is spread.
const FRAMES_PER_TRANSFER: f64 = 30.0;

/// Turn of the camera from one frame to the next, degrees.
const TURN: f32 = 3.0;

impl Latency {
    /// Seconds of a cold prediction in a session in which every 30th frame has a new transfer function.
    pub(crate) fn with_changes(&self) -> f64 {
        self.cold + self.transfer / FRAMES_PER_TRANSFER
    }
}

/// A frame, the frame before it, and the transfer function of both.
#[derive(Debug)]
struct Shot {
    frame: Frame,
    before: Frame,
    table: TransferTable,
    lobes: Vec<GaussianLobe>,
}

#[derive(Debug)]
pub(crate) struct Bench {
    summary: VolumeSummary,
    scenes: Vec<Shot>,
    evicted: Vec<u8>,
}

impl Bench {
    /// Chooses random frames of a volume by the default distribution of `entire collect`.
    pub(crate) fn new(volume: &Volume, shading: Shading) -> Result<Self> {
        let summary = VolumeSummary::new(&volume.view())?;
        let drawn = SceneDistribution::default();
        let scenes = (0..FRAMES)
            .map(|i| {
                let s = drawn.draw(99, "latency", i);
                let seen = |camera| -> Result<Frame> {
                    Ok(Frame { shading, ..Frame::new(Camera::from_arcball(camera)?, s.width, s.height)? })
                };
                let (frame, mut turned) = (seen(s.camera)?, s.camera);
                turned.ry += TURN;
                let table = TransferFunction::Gaussian(s.lobes.clone()).to_table()?;
                Ok(Shot { frame, before: seen(turned)?, table, lobes: s.lobes })
            })
            .collect::<Result<_>>()?;
        Ok(Self { summary, scenes, evicted: vec![1; EVICTED_BYTES] })
    }

    /// Latency of a model: the minimum over a few rounds, since other programs only add time.
    pub(crate) fn latency(&mut self, model: &Model) -> Result<Latency> {
        let mut predictor = load(model)?;
        let looks = model.input_size(GroupKind::SceneFeatures).is_some();
        let codes = model.volumenet.as_ref().map_or(0, |v| v.fc.outputs);
        let side = predictor.probe_side();
        self.latency_of(looks.then_some(side), codes, |inputs| {
            Ok(f64::from(predictor.predict(inputs)?.seconds))
        })
    }

    /// Returns the latency of any predictor, measured as in [`Bench::latency`]. `probe_side` is `None` if the
    /// predictor does not use the scene; `codes` is its number of volume features.
    pub(crate) fn latency_of(
        &mut self,
        probe_side: Option<usize>,
        codes: usize,
        mut predict: impl FnMut(&Inputs<'_>) -> Result<f64>,
    ) -> Result<Latency> {
        let looks = probe_side.is_some();
        let code = vec![0.1f32; codes];
        let first = self.scenes.first().context("no scenes")?;
        let mid = |mut v: Vec<f64>| entire_io::metrics::median(&mut v).unwrap_or(0.0);
        let mut best = [f64::INFINITY; 3];
        for _ in 0..ROUNDS {
            let mut features = FrameFeatures::default();
            let mut transfer = TransferSummary::new(&self.summary, &first.table)?;
            let (mut cold, mut warm, mut transfers) = (Vec::new(), Vec::new(), Vec::new());
            for Shot { frame, before, table, lobes } in &self.scenes {
                let start = Instant::now();
                if looks {
                    transfer.update(&self.summary, table)?;
                }
                let update = start.elapsed().as_secs_f64();
                let mut call = |frame: &Frame| -> Result<f64> {
                    let start = Instant::now();
                    if let Some(side) = probe_side {
                        let frame = std::hint::black_box(frame);
                        features = FrameFeatures::of(&self.summary, &mut transfer, frame, side)?;
                    }
                    let inputs = Inputs {
                        features: &features,
                        setting: Setting::from(frame),
                        changes: Changes::default(),
                        camera: frame.camera.to_arcball(),
                        volume_features: Some(&code),
                        lobes: Some(lobes),
                    };
                    std::hint::black_box(predict(&inputs)?);
                    Ok(start.elapsed().as_secs_f64())
                };
                let mut evict = || {
                    self.evicted.iter_mut().step_by(64).for_each(|byte| *byte = byte.wrapping_add(1));
                    std::hint::black_box(&self.evicted);
                };
                evict();
                let first = call(before)?;
                evict();
                let next = call(frame)?;
                cold.push(next);
                if looks {
                    transfers.push(update + (first - next).max(0.0));
                }
                for _ in 0..3 {
                    call(frame)?;
                }
                warm.push(call(frame)?);
            }
            for (least, times) in best.iter_mut().zip([cold, warm, transfers]) {
                *least = least.min(mid(times));
            }
        }
        let [cold, warm, transfer] = best;
        Ok(Latency { cold, warm, transfer })
    }
}
