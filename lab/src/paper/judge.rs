//! Training and evaluation of predictors on the frames of a data set and mode. The paper's network and this
//! project's predictor (an analytic model times a learned factor) are trained with several seeds. The
//! baselines are LVRP and the mean time of 15 % of the test frames.

use super::Work;
use super::description::RAYCASTER_MODES;
use super::frames::{Loaded, SplitFrames};
use super::interval;
use super::results::{BOX, CONSTANT, LVRP, Row};
use super::volumes::Place;
use crate::latency::Bench;
use crate::study::{Bounds, Line, Low, Runner, by_proxy, line_of, with_twins};
use anyhow::{Context, Result};
use entire_core::model::Model;
use entire_io::dataset::{Clock, TimedFrame};
use entire_io::metrics::{Metrics, median, percentile, usable};
use entire_io::volume::Volume;
use entire_train::evaluation::PROBE_SHARE;
use entire_train::fit::{FitContext, Recipe, predict};
use entire_train::split::TimedFrames;

pub(super) const NETWORK: &str = "the paper's network";
pub(super) const OURS: &str = "ours: analytic × factor";

pub(super) struct At<'a> {
    pub(super) work: &'a Work<'a>,
    pub(super) place: &'a Place,
    pub(super) mode: &'a str,
    pub(super) loaded: &'a Loaded,
    pub(super) clock: Clock,
    pub(super) runner: &'a Runner<'a>,
    pub(super) context: FitContext<'a>,
}

impl At<'_> {
    /// Trains a predictor several times with different seeds, or reads the stored models. `name` stands in
    /// error messages, and `key` in the names of model files: different methods have different keys. Run n
    /// (from 1 on) uses the recipe's seed plus 100 (n − 1). `parts` gives the training and validation frames
    /// of a run.
    pub(super) fn runs<'f>(
        &self,
        name: &str,
        key: &str,
        recipe: &Recipe,
        parts: impl Fn(usize) -> (TimedFrames<'f>, TimedFrames<'f>),
    ) -> Result<Vec<Model>> {
        let of = |run: usize| -> Result<Model> {
            let recipe = Recipe { seed: recipe.seed + 100 * (run as u64 - 1), ..recipe.clone() };
            let (training, validation) = parts(run);
            let none = TimedFrames::default();
            let (set, bounds) = (&self.place.set.name, Bounds::Frames(&none));
            let key = format!("{set}-{}-{key}-{run}", self.mode);
            let (file, _) = self
                .runner
                .made(&key, &recipe, &self.context, (&training, &validation), &bounds)
                .with_context(|| format!("{set}, {}, {name}, run {run}", self.mode))?;
            Ok(file.to_model()?)
        };
        (1..=self.work.paper.runs).map(of).collect()
    }

    /// Trains a predictor as [`At::runs`] does, on the frames of a split.
    pub(super) fn on_split(
        &self,
        name: &str,
        key: &str,
        recipe: &Recipe,
        frames: &SplitFrames<'_>,
    ) -> Result<Vec<Model>> {
        self.runs(name, key, recipe, |_| (frames.training.clone(), frames.validation.clone()))
    }

    pub(super) fn predictions(&self, models: &[Model], frames: &[&TimedFrame]) -> Result<Vec<Vec<f64>>> {
        models.iter().map(|m| predict(m, &self.context, frames)).collect()
    }

    /// Evaluates the baselines on `frames`; the line of LVRP is fitted to `training`. Returns their errors as
    /// a [`Judge`], to which [`At::add`] adds the errors of other predictors on the same frames.
    pub(super) fn judge<'f>(
        &self,
        split: &str,
        frames: &'f TimedFrames<'f>,
        training: &TimedFrames<'_>,
    ) -> Judge<'f> {
        let low = &self.loaded.low;
        Judge::new(low, self.work.paper.runs, split, frames, line_of(low, training))
    }

    /// Adds the errors of models on a judge's frames to the judge; if `bench` is given, also the latency of
    /// the first model.
    pub(super) fn add(
        &self,
        judge: &mut Judge<'_>,
        name: &str,
        models: &[Model],
        bench: Option<&mut Bench>,
    ) -> Result<()> {
        let predicted = self.predictions(models, &judge.frames.frames)?;
        judge.add(name, &predicted);
        if let (Some(bench), Some(row)) = (bench, judge.rows.last_mut()) {
            row.latency = Some(bench.latency(&models[0])?.cold);
        }
        Ok(())
    }

    /// Measurement of latencies on a volume of the data set, enlarged as for rendering; `None` for frames of
    /// yt.
    pub(super) fn bench(&self) -> Result<Option<Bench>> {
        if !RAYCASTER_MODES.contains(&self.mode) {
            return Ok(None);
        }
        let job = self.place.jobs.first().context("no volume")?;
        let volume = Volume::open(self.place.root.join(&job.path))?;
        let factor = self.work.paper.enlarge;
        let volume = volume.enlarged(factor)?;
        let shading = self.loaded.tables[0].frames.first().context("no frame")?.scene.shading;
        Bench::new(&volume, shading).map(Some)
    }
}

/// Errors of predictors on one set of frames, beside the baselines.
pub(super) struct Judge<'a> {
    split: String,
    frames: &'a TimedFrames<'a>,
    /// Predictions of the low-resolution proxy, for frames that were rendered at low resolution.
    proxy: Vec<Option<f64>>,
    constant: Option<Row>,
    lvrp: Option<Row>,
    /// Errors of the baselines and of every predictor that was added.
    pub(super) rows: Vec<Row>,
}

impl<'a> Judge<'a> {
    /// Evaluates the baselines.
    pub(super) fn new(
        low: &Low,
        runs: usize,
        split: &str,
        frames: &'a TimedFrames<'a>,
        line: Option<Line>,
    ) -> Self {
        let proxy = by_proxy(low, line, &frames.frames);
        let mut out =
            Self { split: split.to_owned(), frames, proxy, constant: None, lvrp: None, rows: Vec::new() };
        let draws: Vec<Vec<f64>> = (1..=runs.max(5) as u64)
            .map(|seed| {
                let count = (PROBE_SHARE * frames.frames.len() as f64).ceil().max(1.0) as usize;
                let seen = frames.sample(count, seed).0.seconds;
                let mean = seen.iter().sum::<f64>() / seen.len().max(1) as f64;
                vec![mean; frames.frames.len()]
            })
            .collect();
        out.constant = out.judged(CONSTANT, &draws, frames);
        let twins = with_twins(frames, &out.proxy);
        if !twins.frames.is_empty() {
            let seconds: Vec<f64> = out.proxy.iter().copied().flatten().collect();
            let took = |f: &&TimedFrame| low.get(&(f.table, f.number)).copied();
            let mut times: Vec<f64> = twins.frames.iter().filter_map(took).collect();
            let judged = out.judged(LVRP, &[seconds], &twins);
            out.lvrp = judged.map(|row| Row { latency: median(&mut times), ..row });
        }
        for mut row in [&out.constant, &out.lvrp].into_iter().flatten().cloned().collect::<Vec<Row>>() {
            out.compare(&mut row);
            out.rows.push(row);
        }
        out
    }

    /// Evaluates a predictor, given the predictions of each of its runs; does nothing without frames.
    pub(super) fn add(&mut self, name: &str, runs: &[Vec<f64>]) {
        if let Some(mut row) = self.judged(name, runs, self.frames) {
            self.compare(&mut row);
            self.rows.push(row);
        }
    }

    /// Returns the errors of a predictor's runs on `frames`: all frames of this judge, or only those that
    /// were also rendered at low resolution. `None` without frames.
    fn judged(&self, name: &str, runs: &[Vec<f64>], frames: &TimedFrames<'_>) -> Option<Row> {
        let measured = &frames.seconds;
        // The proxy's line and a network may predict times that are not positive.
        let runs: Vec<Vec<f64>> = runs.iter().map(|p| p.iter().copied().map(usable).collect()).collect();
        let metrics: Vec<Metrics> = runs.iter().filter_map(|p| Metrics::new(p, measured)).collect();
        let first = metrics.first()?;
        let n = metrics.len() as f64;
        let rmse = metrics.iter().map(|m| m.rmse).sum::<f64>() / n;
        let squares = metrics.iter().map(|m| (m.rmse - rmse).powi(2)).sum::<f64>();
        let mut errors: Vec<f64> =
            runs.iter().flat_map(|p| p.iter().zip(measured).map(|(p, t)| (p - t).powi(2))).collect();
        errors.sort_by(f64::total_cmp);
        let by_volume = |of: &TimedFrames<'_>, runs: &[Vec<f64>]| {
            interval::by_volume(of.frames.iter().map(|f| f.scene.volume.as_str()), &of.seconds, runs)
        };
        let of_twins = if frames.frames.len() < self.frames.frames.len() {
            by_volume(frames, &runs)
        } else {
            let of =
                |run: &Vec<f64>| run.iter().zip(&self.proxy).filter_map(|(p, l)| l.map(|_| *p)).collect();
            by_volume(&with_twins(self.frames, &self.proxy), &runs.iter().map(of).collect::<Vec<Vec<f64>>>())
        };
        Some(Row {
            name: name.to_owned(),
            split: self.split.clone(),
            frames: first.frames,
            runs: metrics.len(),
            rmse,
            rmse_sd: if metrics.len() > 1 { (squares / (n - 1.0)).sqrt() } else { 0.0 },
            sd: first.sd,
            mdape: metrics.iter().map(|m| m.mdape).sum::<f64>() / n,
            squared_errors: BOX.map(|(_, share)| percentile(&errors, share)),
            by_volume: by_volume(frames, &runs),
            of_twins,
            ..Row::default()
        })
    }

    /// Sets a row's errors relative to those of the baselines, on the frames that both have.
    fn compare(&self, row: &mut Row) {
        let all = row.frames == self.frames.frames.len();
        let errors = |r: &Row| interval::rmse(if all { &r.by_volume } else { &r.of_twins });
        row.over_constant = self.constant.as_ref().and_then(|c| Some(errors(row)? / errors(c)?));
        let twins = |r: &Row| interval::rmse(&r.of_twins);
        row.over_lvrp = self.lvrp.as_ref().and_then(|l| Some(twins(row)? / twins(l)?));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use entire_io::dataset::Table;
    use std::path::Path;

    #[test]
    fn a_time_that_is_not_positive_counts_alike_in_all_errors() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/timings/none-h100-members.csv.gz");
        let table = Table::read_without_features(&path, 0).unwrap();
        let frames = TimedFrames::of(&table.frames[..40], Clock::Device);
        let mut judge = Judge::new(&Low::new(), 5, "members", &frames, None);
        let predicted = (0..40).map(|i| if i % 3 == 0 { -1.0 } else { 1e-4 }).collect();
        judge.add("a network", &[predicted]);
        let row = judge.rows.last().unwrap();
        let by_volume = interval::rmse(&row.by_volume).unwrap();
        assert!((by_volume / row.rmse - 1.0).abs() < 1e-9, "{by_volume} {}", row.rmse);
    }
}
