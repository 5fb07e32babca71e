//! Report of a calibration, printed and stored in the model file.

use super::others::BackgroundLoad;
use anyhow::{Context, Result};
use entire_core::model::ModelFile;
use entire_core::scene::Shading;
use entire_io::dataset::{Clock, NoiseFloor};
use entire_io::identity::Identity;
use entire_io::machine;
use entire_io::metrics::{Metrics, bootstrap_by_group};
use entire_steer::calibrate::{Chosen, FittedQuality, Observed, write_metadata};
use entire_steer::predict::{Quality, UpperBound};
use entire_train::bound;
use serde::Serialize;
use serde_json::json;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

/// Drift between passes above which the report warns, as a share of the frame time.
const DRIFT: f64 = 0.05;

/// Minimum of ln(upper bound / prediction) in a model that was calibrated on a busy machine.
const BUSY_LOG_FACTOR: f32 = 0.5;

/// Report of a calibration.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Shading mode.
    pub shading: &'static str,
    /// The clock whose seconds the model predicts.
    pub clock: &'static str,
    /// Number of frames that the model was fitted to.
    pub frames: usize,
    /// Number of volumes that the frames show.
    pub volumes: usize,
    /// Number of rounds in which frames were rendered; 0 where nothing was rendered.
    pub rounds: usize,
    /// Renderings that were discarded as warm-up.
    pub warm_ups: usize,
    /// Wall seconds of the whole calibration.
    pub seconds: f64,
    /// Names of the prior models; `None` for typical unit costs of this kind of renderer.
    pub prior: Option<String>,
    /// Number of folds of the cross-validation by volume; 0 where there were too few volumes.
    pub folds: usize,
    /// Number of frames on which the error was measured.
    pub judged: usize,
    /// Median of |predicted / measured − 1| on held-out volumes; on the training frames if `folds` is 0.
    pub median_error: f64,
    /// 95 % interval of the median error, by bootstrap over volumes.
    pub median_error_interval: Option<(f64, f64)>,
    /// RMSE divided by the standard deviation of the measured seconds, on the frames of `median_error`.
    pub rmse_over_sd: f64,
    /// Noise of repeated frames; `None` if no frame was repeated.
    pub noise: Option<NoiseFloor>,
    /// Load of the machine by other programs.
    pub others: BackgroundLoad,
    /// Quality law of pictures; `None` if too few pictures were compared.
    pub pictures: Option<Pictures>,
    /// Files of the volumes, by the volumes' names; empty where they are unknown.
    pub files: BTreeMap<String, Vec<Identity>>,
}

/// Fit of the quality law to compared pictures.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Pictures {
    /// Error measure between a picture and the picture at full quality: `rmse`, or `given` by a table.
    pub error: &'static str,
    /// The law, and the picture error of the steps and image sizes that it chooses.
    #[serde(flatten)]
    pub fitted: FittedQuality,
}

impl Report {
    /// Returns the report of a calibration in which nothing was rendered. The error is measured on the frames
    /// for whose index `judged` returns true.
    pub(crate) fn new(
        (shading, clock): (Shading, Clock),
        prior: Option<String>,
        observed: &[Observed],
        chosen: &Chosen,
        judged: impl Fn(usize) -> bool,
        noise: Option<NoiseFloor>,
        seconds: f64,
    ) -> Result<Self> {
        let (mut predicted, mut measured, mut groups) = (Vec::new(), Vec::new(), Vec::new());
        for (_, (f, p)) in observed.iter().zip(&chosen.crossed).enumerate().filter(|(i, _)| judged(*i)) {
            predicted.push(*p);
            measured.push(f.seconds);
            groups.push(f.group);
        }
        let metrics = Metrics::new(&predicted, &measured).context("there are no test frames")?;
        let volumes: BTreeSet<u64> = observed.iter().map(|f| f.group).collect();
        Ok(Self {
            shading: shading.into(),
            clock: clock.name(),
            frames: observed.len(),
            volumes: volumes.len(),
            rounds: 0,
            warm_ups: 0,
            seconds,
            prior,
            folds: chosen.folds,
            judged: measured.len(),
            median_error: metrics.mdape,
            median_error_interval: bootstrap_by_group(&predicted, &measured, &groups, 400, |m| m.mdape),
            rmse_over_sd: metrics.rmse_over_sd,
            noise,
            others: BackgroundLoad::default(),
            pictures: None,
            files: BTreeMap::new(),
        })
    }

    /// Reasons why the measured times or the error may not be typical of this machine; empty if there are
    /// none.
    pub(crate) fn warnings(&self) -> Vec<String> {
        let mut out = Vec::new();
        if self.others.busy() {
            out.push(format!(
                "the machine was busy: other programs used {:.1} processors on average, and more than {3} \
                 processors during {:.1} of {:.1} seconds. Repeats rendered in these busy seconds are used \
                 only for frames that have no repeat from quiet seconds. Calibrate again on a quiet machine",
                self.others.mean.unwrap_or(0.0),
                self.others.disturbed,
                self.others.seconds,
                super::others::DISTURBED_PROCESSORS
            ));
        }
        if let Some(drift) = self.noise.and_then(|n| n.drift).filter(|d| d.exp_m1() > DRIFT) {
            out.push(format!(
                "passes over the same frames differ by {:.0} %: the machine's speed changed during the \
                 calibration",
                100.0 * drift.exp_m1()
            ));
        }
        if self.folds == 0 {
            out.push(
                "there are fewer than three volumes, so none was held out, and the error was measured on the \
                 training frames"
                    .into(),
            );
        }
        out
    }

    pub(crate) fn text(&self) -> String {
        let rendered = match self.rounds {
            0 => String::new(),
            rounds => {
                format!("; rounds: {rounds}; discarded warm-up renderings: {}", self.warm_ups)
            }
        };
        let (frames, volumes, shading, clock) = (self.frames, self.volumes, self.shading, self.clock);
        let measured =
            format!("{frames} frames of {volumes} volumes, shading {shading}, clock {clock}{rendered}");
        let prior = self.prior.as_deref().unwrap_or("typical unit costs of this kind of renderer").into();
        let interval = self
            .median_error_interval
            .map_or(String::new(), |(low, high)| format!(" ({:.1} to {:.1} %)", 100.0 * low, 100.0 * high));
        let (place, how) = match self.folds {
            0 => ("on the training frames (the error on other volumes is larger)", String::new()),
            folds => ("on held-out volumes", format!(", cross-validated by volume in {folds} folds")),
        };
        let expected = format!(
            "{place}: median error {:.1} %{interval}, RMSE/SD {:.3} ({} frames{how})",
            100.0 * self.median_error,
            self.rmse_over_sd,
            self.judged
        );
        let pictures = match &self.pictures {
            Some(pictures) => Some(law_text(pictures)),
            None => (self.rounds > 0).then(|| {
                "too few were compared within the time limit, so the model has no quality law".to_owned()
            }),
        };
        let mut out = String::new();
        for (name, value) in [
            ("measured", Some(measured)),
            ("others", (self.rounds > 0).then(|| self.others.text(self.frames))),
            ("noise", self.noise.map(|noise| noise.describe())),
            ("prior", Some(prior)),
            ("to expect", Some(expected)),
            ("pictures", pictures),
        ] {
            if let Some(value) = value {
                let _ = writeln!(out, "{name:<11}{value}");
            }
        }
        out
    }

    /// Writes clock, upper bound and provenance into the model file.
    pub(crate) fn write_into(
        &self,
        file: &mut ModelFile,
        (renderer, device): (&str, &str),
        observed: &[Observed],
        crossed: &[f64],
    ) -> Result<()> {
        let measured: Vec<f64> = observed.iter().map(|f| f.seconds).collect();
        let residuals = bound::log_residuals(crossed, &measured);
        let mut upper = UpperBound::from_groups(residuals.into_iter().zip(observed.iter().map(|f| f.group)));
        if self.others.busy() {
            // Residuals that were measured on a busy machine do not show the errors on a quiet machine. A
            // session derives from the bound how far it trusts the prediction. With a wide bound, the
            // session's own observations weigh more.
            upper = UpperBound { log_factor: upper.log_factor.max(BUSY_LOG_FACTOR) };
        }
        let provenance = json!({
            "what": "Calibrated to a machine",
            "clock": self.clock,
            "shading": self.shading,
            "calibration": { "frames": self.frames, "volumes": self.volumes, "files": self.files.values().flatten().collect::<Vec<_>>(), "rounds": self.rounds,
                "seconds": self.seconds, "prior": self.prior, "folds": self.folds,
                "judged": self.judged, "median_error": self.median_error, "rmse_over_sd": self.rmse_over_sd,
                "noise": self.noise, "pictures": self.pictures, "others": self.others, "busy": self.others.busy() },
            "machine": machine::machine(),
            "load_average": machine::load_average(),
            "program": format!("entire {}", machine::version()),
            "date": machine::now(),
        });
        let law = self.pictures.as_ref().map(|pictures| &pictures.fitted.quality);
        write_metadata(file, [renderer, device, self.clock], upper, law, provenance.to_string())?;
        Ok(())
    }
}

/// Returns one line of text about the quality law and its fit to the errors of pictures.
fn law_text(Pictures { error, fitted }: &Pictures) -> String {
    let error = if *error == "rmse" { "root mean squared difference" } else { "in the table's unit" };
    let Quality { image_weight, step_exponent, image_exponent, ray_share } = fitted.quality;
    format!(
        "{} scenes at {} ray steps and image sizes. The picture error ({error}) rises with \
         (s - 1)^{step_exponent:.2} + {image_weight:.2} (d - 1)^{image_exponent:.2}, where s is the ray step \
         and d is the number of pixels between rays; {:.0} % of the time at full quality depends on the \
         number of rays only. At equal time, the error is {:.2} times the smallest one if this formula \
         chooses step and image size, and {} times if only the step is changed. A coarser step alone saves \
         at most {:.0} % of the time{}",
        fitted.scenes,
        fitted.settings,
        100.0 * ray_share,
        fitted.over_best,
        fitted.step_over_best.map_or("an unknown number of".into(), |over| format!("{over:.2}")),
        100.0 * (1.0 - fitted.step_least_time),
        fitted.over_prior.map_or_else(String::new, |over| {
            let kept = if over < 1.0 { "" } else { ", so the built-in law is kept" };
            format!(
                ". In cross-validation on held-out scenes, the settings of laws that were fitted with the \
                 built-in law as the prior have {over:.2} times the picture error of the built-in law's \
                 settings at equal time{kept}"
            )
        })
    )
}
