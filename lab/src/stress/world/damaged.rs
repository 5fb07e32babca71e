//! Scene 28: damaged model files and states.

use super::super::{Limits, Noise, Verdict, judge};
use super::scenes::{Block, shell};
use super::{Machine, fitted};
use anyhow::Result;
use entire_cli::steering::contenders::{ControllerKind, contender};
use entire_cli::steering::rivals::StepResponse;
use entire_core::model::Model;
use entire_core::scene::{Arcball, Camera, Frame, TransferFunction};
use entire_steer::control::Prior;
use entire_steer::features::{Changes, FrameFeatures, Setting, TransferSummary, VolumeSummary};
use entire_steer::predict::{Inputs, load};

pub(super) fn damaged(method: ControllerKind, machine: &mut Machine<'_>) -> Result<Verdict> {
    let mut broken = Vec::new();
    let model = fitted(machine)?;
    let good = model.to_model_file()?.to_bytes()?;
    let block = Block::ball(16, 0.0);
    let summary = VolumeSummary::new(&block.view()?)?;
    let table = TransferFunction::Gaussian(shell()).to_table()?;
    let mut transfer = TransferSummary::new(&summary, &table)?;
    let frame = Frame::new(Camera::from_arcball(Arcball { rx: 0.0, ry: 0.0, dz: 2.0 })?, 64, 64)?;
    let mut features = FrameFeatures::default();
    features.measure(&summary, &mut transfer, &frame)?;
    let mut noise = Noise::new(28);
    let (mut refused, mut read) = (0, 0);
    let mut check = |bytes: &[u8], what: &str| match Model::from_bytes(bytes).and_then(|m| load(&m)) {
        Err(e) if e.to_string().is_empty() => broken.push(format!("{what}: refused without a message")),
        Err(_) => refused += 1,
        Ok(mut predictor) => {
            read += 1;
            let inputs = Inputs {
                features: &features,
                setting: Setting::from(&frame),
                changes: Changes::default(),
                camera: features.pose(),
                volume_features: None,
                lobes: None,
            };
            match predictor.predict(&inputs) {
                Ok(p) if p.seconds.is_finite() && p.seconds > 0.0 => {}
                Ok(p) => broken.push(format!("{what}: predicts {} s", p.seconds)),
                Err(_) => refused += 1,
            }
        }
    };
    for k in 0..200 {
        let mut bytes = good.clone();
        match k % 4 {
            0 => bytes.truncate((noise.uniform() * good.len() as f64) as usize),
            1 => {
                let at = (noise.uniform() * good.len() as f64) as usize;
                bytes[at] ^= 1 << (k % 8);
            }
            2 => {
                let at = (noise.uniform() * (good.len() - 8) as f64) as usize;
                bytes[at..at + 8].fill(0xff);
            }
            _ => bytes.extend_from_slice(b"trailing"),
        }
        check(&bytes, &format!("damage {k}"));
    }
    for (what, bytes) in [("an empty file", &b""[..]), ("text", b"not a model"), ("zeros", &[0; 64])] {
        check(bytes, what);
    }
    if refused < 100 {
        broken.push(format!("only {refused} of 203 damaged files were refused, {read} were read"));
    }
    // Saved states of this method that are cut short must be refused, and so must a state of another format.
    let mut session = contender(
        method,
        2.0,
        Box::new(model),
        &StepResponse::inverse_step(0.1),
        Prior::Fitted { log_sd: 0.2 },
    )
    .session;
    session.set_volume(summary, None);
    session.set_transfer(&table, None)?;
    let state = session.save_state();
    let before = session.plan(&frame, 0.01)?.step;
    for cut in 0..state.len() {
        if session.load_state(&state[..cut]).is_ok() {
            broken.push(format!("a state cut to {cut} bytes was taken"));
        }
    }
    if session.load_state(b"ENS1not a state").is_ok() {
        broken.push("a foreign state was taken".into());
    }
    session.load_state(&state)?;
    let after = session.plan(&frame, 0.01)?.step;
    if !(after.is_finite() && (after / before).ln().abs() < 1.0) {
        broken.push(format!("step {after} after refused states, {before} before"));
    }
    Ok(judge(28, method, &[], Limits::missed(1.0), broken))
}
