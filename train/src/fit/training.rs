//! Training of a network by gradient descent, with a progress bar.

use super::FitContext;
use crate::gradient::{
    EpochRecord, Network, Progress, Samples, Settings, Standardization, Stop, Trained, train,
};
use anyhow::{Result, bail};
use entire_core::nn::PredNetParts;
use std::ops::ControlFlow;
use std::time::Instant;

/// Error of a fit that was stopped before it gave a model.
pub(super) const NOTHING_LEARNED: &str = "stopped before anything was learned; nothing was written";

pub(super) fn run_training(
    context: &FitContext<'_>,
    network: Network<f32>,
    standardization: Option<Standardization>,
    (training, validation): (Samples<'_>, Samples<'_>),
    settings: &Settings,
) -> Result<(PredNetParts, Vec<EpochRecord>, String)> {
    let started = Instant::now();
    let mut steps = 0;
    let show = |p: &Progress| {
        steps = p.steps;
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
            _ => bail!(NOTHING_LEARNED),
        }
    }
    let frames = passed(training.seconds.len(), settings.batch, steps);
    let outcome = format!("{}, {:.0} frames/s", ending(&trained), frames as f64 / taken);
    Ok((trained.to_parts(), trained.history, outcome))
}

/// Returns a text that states why the training ended, and the epoch of the weights that are kept.
fn ending(trained: &Trained) -> String {
    let ran = trained.history.len();
    let why = match trained.stop {
        Stop::Finished => format!("all {ran} epochs done"),
        Stop::Early => format!("stopped early after {ran} epochs"),
        Stop::Interrupted => format!("interrupted after {ran} whole epochs"),
        Stop::Diverged => format!("diverged after {ran} epochs (the best weights before that are kept)"),
    };
    let best = match trained.best_epoch {
        unfinished if unfinished > ran => "weights of the unfinished epoch".to_owned(),
        epoch => format!("best epoch {epoch}"),
    };
    format!("{why}, {best} with loss {:.4e}", trained.best_loss)
}

/// Returns the number of frames in `steps` training steps. Every epoch takes `frames` frames in batches of
/// `batch`.
fn passed(frames: usize, batch: usize, steps: u64) -> u64 {
    let (frames, batch) = (frames as u64, batch.min(frames).max(1) as u64);
    let per_epoch = frames.div_ceil(batch).max(1);
    steps / per_epoch * frames + steps % per_epoch * batch
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_that_ends_in_its_first_epoch_says_what_it_has() {
        let inputs: Vec<f32> = (0..20).map(|i| i as f32).collect();
        let seconds: Vec<f64> = (1..=10).map(f64::from).collect();
        let training = Samples { inputs: &inputs, seconds: &seconds };
        let none = Samples { inputs: &[], seconds: &[] };
        let pool = entire_io::options::thread_pool(Some(1)).unwrap();
        let bar = indicatif::ProgressBar::hidden();
        let settings = Settings { batch: 4, ..Settings::default() };
        let run = |stop: &dyn Fn() -> bool| {
            let context = FitContext { tables: &[], pool: &pool, bar: &bar, stop };
            let network = Network::random(&[2, 3, 1], 1).unwrap();
            run_training(&context, network, None, (training, none), &settings).unwrap().2
        };
        let said = run(&|| true);
        let start = "interrupted after 0 whole epochs, weights of the unfinished epoch with loss ";
        assert!(said.starts_with(start) && !said.ends_with(" 0 frames/s"), "{said}");
    }

    #[test]
    fn frames_are_counted_in_whole_and_unfinished_epochs() {
        // Ten frames form batches of 4, 4 and 2.
        assert_eq!([0, 1, 2, 3, 4, 7].map(|steps| passed(10, 4, steps)), [0, 4, 8, 10, 14, 24]);
        assert_eq!(passed(3, 256, 5), 15);
    }
}
