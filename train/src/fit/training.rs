//! Training of a network by gradient descent, with a progress bar.

use super::FitContext;
use crate::gradient::{EpochRecord, Network, Progress, Samples, Settings, Standardization, Stop, train};
use anyhow::{Result, bail};
use entire_core::nn::PredNetParts;
use std::ops::ControlFlow;
use std::time::Instant;

pub(super) fn run_training(
    context: &FitContext<'_>,
    network: Network<f32>,
    standardization: Option<Standardization>,
    (training, validation): (Samples<'_>, Samples<'_>),
    settings: &Settings,
) -> Result<(PredNetParts, Vec<EpochRecord>, String)> {
    let started = Instant::now();
    let show = |p: &Progress| {
        context.bar.set_length(p.total_steps);
        if let Some(e) = p.ended
            && (e.epoch == 1 || e.epoch % 5 == 0)
        {
            context.bar.set_message(format!(
                "{}/{} training {:.3e} validation {:.3e} best {:.3e}",
                e.epoch, p.epochs, e.training_loss, e.validation_loss, p.best
            ));
            context.bar.set_position(p.steps);
        }
        if (context.stop)() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let trained = train(context.pool, network, standardization, training, validation, settings, show)?;
    let taken = started.elapsed().as_secs_f64();
    if trained.best_epoch == 0 {
        match trained.stop {
            Stop::Diverged => bail!(
                "training diverged in its first epoch; lower --learning-rate (it was {})",
                settings.learning_rate
            ),
            _ => bail!("stopped before anything was learned; nothing was written"),
        }
    }
    let ran = trained.history.len();
    let why = match trained.stop {
        Stop::Finished => format!("all {ran} epochs done"),
        Stop::Early => format!("stopped early after {ran} epochs"),
        Stop::Interrupted => format!("interrupted after {ran} whole epochs"),
        Stop::Diverged => format!("diverged after {ran} epochs (the weights before are kept)"),
    };
    let frames = training.seconds.len() as f64 * ran as f64;
    let outcome = format!(
        "{why}, best epoch {} with loss {:.4e}, {:.0} frames/s",
        trained.best_epoch,
        trained.best_loss,
        frames / taken
    );
    Ok((trained.to_parts(), trained.history, outcome))
}
