//! Training and evaluation of the networks of every part of the study.

use super::collect::{DRAWN_ORBIT, EXPERIMENTS, ORBIT, PER_EXPERIMENT};
use super::description::{BY_MODALITY, BY_VOLUMES, Panel, Paper};
use super::frames::{Loaded, SplitFrames, identity, main_encoder, of_panel, trained};
use super::judge::{At, Judge, NETWORK, OURS};
use super::results::{Curve, DRAWN_CHART, Fact, MEASURED, ORBIT_CHART, Results, kept, percentiles, write};
use super::volumes::{Parts, Place, in_words};
use super::{Work, tuning};
use crate::latency::Bench;
use crate::study::{Runner, by_proxy, line_of};
use anyhow::{Context, Result, bail};
use entire_core::kernels::Executor;
use entire_core::model::Model;
use entire_core::nn::VolumeNet;
use entire_io::dataset::feature_table::{code_column, encoder_id};
use entire_io::files::{note, open_model};
use entire_io::progress::templated_bar;
use entire_steer::predict::GroupKind;
use entire_train::fit::{FitContext, Recipe};
use entire_train::split::TimedFrames;
use indicatif::ProgressBar;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::time::Instant;

/// Name of VolumeNet's feature vector among the inputs that an ablation leaves out.
pub(super) const FEATURE_VECTOR: &str = "feature vector";

/// Parts of the study that have separate results for each data set and mode.
const BY_SET: [Panel; 7] = [
    Panel::Overall,
    Panel::Ablation,
    Panel::Varied,
    Panel::Samples,
    Panel::Depth,
    Panel::Encoders,
    Panel::Final,
];

/// Computes the missing results of the selected parts (default: all).
pub(crate) fn train(work: &Work<'_>, panels: &[Panel]) -> Result<()> {
    let clock = work.paper.clock.parse()?;
    let wanted = |p: Panel| panels.is_empty() || panels.contains(&p);
    let bar = templated_bar("train [{bar:30}] {pos}/{len} parts  {wide_msg}");
    let stop = || work.stop();
    let runner = Runner { pool: work.pool, models: work.out.join("models"), bar: &bar, stop: &stop };
    let mut todo: Vec<(Place, String, Vec<Panel>)> = Vec::new();
    for panel in BY_SET.into_iter().filter(|p| wanted(*p)) {
        for (place, mode) in of_panel(work, panel)? {
            match todo.iter_mut().find(|t| t.0.set.name == place.set.name && t.1 == mode) {
                Some(t) => t.2.push(panel),
                None => todo.push((place, mode, vec![panel])),
            }
        }
    }
    bar.set_length(todo.iter().map(|t| t.2.len() as u64).sum::<u64>() + u64::from(wanted(Panel::Tuning)));
    for (place, mode, panels) in &todo {
        let Some(loaded) = Loaded::read(work, place, mode, clock)? else {
            note(&format!("no frames of {} in mode {mode}; collect them first", place.set.name));
            bar.inc(panels.len() as u64);
            continue;
        };
        let hidden = ProgressBar::hidden();
        let context = FitContext { tables: &loaded.tables, pool: work.pool, bar: &hidden, stop: &stop };
        let at = At { work, place, mode, loaded: &loaded, clock, runner: &runner, context };
        for &panel in panels {
            work.go_on()?;
            let mark = identity(work, panel, &place.set.name, &loaded.tables, &loaded.low)?;
            if !kept(work.out, panel, &place.set.name, mode, &mark)? {
                let mut results = Results::new(panel, &place.set.name, mode, mark);
                let made = at.make(panel, &mut results);
                // If the study was stopped, the error says so, even if the part ended with another error.
                work.go_on()?;
                made.with_context(|| format!("{} of {} in mode {mode}", panel.name(), place.set.name))?;
                results.measured_as(&loaded.tables[0]);
                write(work.out, &results)?;
            }
            bar.inc(1);
        }
    }
    if wanted(Panel::Tuning) {
        tuning::tune(work, clock, &runner)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(())
}

impl At<'_> {
    fn make(&self, panel: Panel, results: &mut Results) -> Result<()> {
        if panel == Panel::Overall {
            return self.overall(results);
        }
        let split = self.main()?;
        let frames = self.frames(split)?;
        self.note_frames(results, split, &frames)?;
        if panel == Panel::Varied {
            return self.varied(results, split, &frames);
        }
        let mut judge = self.judge(split, &frames.test, &frames.training);
        match panel {
            Panel::Ablation => self.ablation(split, &frames, &mut judge)?,
            Panel::Samples => self.samples(split, &frames, &mut judge)?,
            Panel::Depth => self.depth(split, &frames, &mut judge)?,
            Panel::Encoders => self.encoders(&frames, &mut judge)?,
            Panel::Final => self.finalists(&frames, &mut judge)?,
            other => bail!("{} is not trained on frames", other.name()),
        }
        results.rows.append(&mut judge.rows);
        if panel == Panel::Ablation {
            results.facts.extend(between_volumes(&frames.training));
        }
        Ok(())
    }

    fn paper(&self) -> &Paper {
        self.work.paper
    }

    fn parts(&self, split: &str) -> Result<&Parts> {
        self.place.split(split).with_context(|| format!("{} has no split by {split}", self.place.set.name))
    }

    /// Name of the data set's main split.
    fn main(&self) -> Result<&'static str> {
        let main = self.place.main_split().map(|parts| parts.name);
        main.with_context(|| format!("{} has no split", self.place.set.name))
    }

    fn frames(&self, split: &str) -> Result<SplitFrames<'_>> {
        Ok(self.loaded.split(self.work, self.parts(split)?, self.clock))
    }

    /// Recipe of the paper's network with the main encoder, and the encoder's description.
    fn network(&self, split: &str) -> Result<(Recipe, String)> {
        let own = (self.main()? == split).then_some(self.place.set.name.as_str());
        let (path, what) = main_encoder(self.work, own)?;
        Ok((Recipe { volumenet: Some(path), ..self.paper().network.clone() }, what))
    }

    fn networks(&self, split: &str, frames: &SplitFrames<'_>) -> Result<Vec<Model>> {
        let (recipe, _) = self.network(split)?;
        let key = format!("{split}-network");
        self.on_split(NETWORK, &key, &recipe, frames)
    }

    fn ours(&self, split: &str, frames: &SplitFrames<'_>) -> Result<Vec<Model>> {
        let key = format!("{split}-ours");
        self.on_split(OURS, &key, self.paper().ours_for(self.mode)?, frames)
    }

    /// Trains the paper's network without one of its inputs, and returns the models.
    fn without(&self, input: &str, frames: &SplitFrames<'_>) -> Result<Vec<Model>> {
        let split = self.main()?;
        let (mut recipe, _) = self.network(split)?;
        recipe.inputs.retain(|i| i != input);
        if input == GroupKind::VolumeFeatures.to_string() {
            recipe.volumenet = None;
        }
        let key = format!("{split}-without-{input}");
        self.on_split(input, &key, &recipe, frames)
    }

    fn note_frames(&self, results: &mut Results, split: &str, frames: &SplitFrames<'_>) -> Result<()> {
        let main = self.main()?;
        let what = self.network(main)?.1;
        results.encoder = format!("In the split by {}, the network's encoder is {what}", in_words(main));
        let count = |f: &TimedFrames<'_>| f.frames.len();
        let counts = [count(&frames.training), count(&frames.validation), count(&frames.test)];
        results.frames.insert(split.to_owned(), counts);
        Ok(())
    }

    fn overall(&self, results: &mut Results) -> Result<()> {
        let all = self.loaded.all(0, self.clock);
        let n = all.seconds.len() as f64;
        let mean = all.seconds.iter().sum::<f64>() / n;
        let sd = (all.seconds.iter().map(|t| (t - mean).powi(2)).sum::<f64>() / n).sqrt();
        let mut sorted = all.seconds.clone();
        sorted.sort_by(f64::total_cmp);
        let dims = all.frames.first().map_or([0; 3], |f| f.scene.dims);
        let jobs = &self.place.jobs;
        let members: BTreeSet<&str> = jobs.iter().map(|j| j.member.as_str()).collect();
        let expected = jobs.iter().map(|j| f64::from(self.place.frames_of(j, self.paper()))).sum();
        let mut values: BTreeMap<String, f64> = [
            ("frames", n),
            ("expected frames", expected),
            ("mean", mean),
            ("sd", sd),
            ("members", members.len() as f64),
            ("volumes", jobs.len() as f64),
            ("x", f64::from(dims[0])),
            ("y", f64::from(dims[1])),
            ("z", f64::from(dims[2])),
        ]
        .map(|(k, v)| (k.to_owned(), v))
        .into();
        values.extend(percentiles(&sorted));
        results.facts.push(Fact { name: "times".into(), values });
        self.code_curves(results)?;
        let mut bench = self.bench()?;
        for parts in &self.place.splits {
            let frames = self.frames(parts.name)?;
            if frames.training.frames.is_empty() || frames.test.frames.is_empty() {
                continue;
            }
            self.note_frames(results, parts.name, &frames)?;
            let networks = self.networks(parts.name, &frames)?;
            let ours = self.ours(parts.name, &frames)?;
            let mut test = |split: &str, on: &TimedFrames<'_>, mut bench: Option<&mut Bench>| -> Result<()> {
                let mut judge = self.judge(split, on, &frames.training);
                for (name, models) in [(NETWORK, &networks), (OURS, &ours)] {
                    self.add(&mut judge, name, models, bench.as_deref_mut())?;
                }
                results.rows.append(&mut judge.rows);
                Ok(())
            };
            test(parts.name, &frames.test, bench.as_mut())?;
            for (title, table) in self.loaded.modalities.iter().filter(|_| parts.name == BY_VOLUMES) {
                test(&format!("{BY_MODALITY}: {title}"), &self.loaded.all(*table, self.clock), None)?;
            }
        }
        Ok(())
    }

    /// Stores the first two features of all volumes, as computed by the main encoder and by the shipped one:
    /// a curve per ensemble member.
    fn code_curves(&self, results: &mut Results) -> Result<()> {
        let features = self.loaded.tables[0].features.as_ref().context("no features")?;
        let encoders = [
            (main_encoder(self.work, Some(&self.place.set.name))?.0, "own"),
            (self.paper().encoders.shipped[0].clone(), "shipped"),
        ];
        for (path, chart) in encoders {
            let model = open_model(&path)?;
            let id = encoder_id(model.volumenet.as_ref().context("no VolumeNet")?);
            let (Some(x), Some(y)) =
                (features.column(&code_column(&id, 0)), features.column(&code_column(&id, 1)))
            else {
                continue;
            };
            for table in std::iter::once(&self.loaded.tables[0])
                .chain(self.loaded.modalities.iter().map(|(_, t)| &self.loaded.tables[*t]))
            {
                let mut by_member: BTreeMap<String, BTreeMap<String, (f64, f64)>> = BTreeMap::new();
                let Some(kept) = &table.features else { continue };
                for f in &table.frames {
                    let Some(row) = kept.row(f.number) else { continue };
                    let set = f.scene.volume.split('/').next().unwrap_or_default();
                    let member = format!("{set}/{}", f.scene.member);
                    let code = (f64::from(row[x]), f64::from(row[y]));
                    by_member.entry(member).or_default().insert(f.scene.volume.clone(), code);
                }
                let chart = format!("features, {chart}");
                results.curves.extend(by_member.into_iter().map(|(member, codes)| {
                    let points = codes.into_values().collect();
                    Curve::new(&chart, member.trim_end_matches('/'), "feature 1", points)
                }));
            }
        }
        Ok(())
    }

    fn ablation(&self, split: &str, frames: &SplitFrames<'_>, judge: &mut Judge<'_>) -> Result<()> {
        self.add(judge, NETWORK, &self.networks(split, frames)?, None)?;
        for input in &self.paper().network.inputs {
            let models = self.without(input, frames)?;
            self.add(judge, &format!("without {}", plain(input)), &models, None)?;
        }
        Ok(())
    }

    fn varied(&self, results: &mut Results, split: &str, frames: &SplitFrames<'_>) -> Result<()> {
        let table = self.loaded.varied.context(
            "there are no frames in which one parameter varies; `entire-lab paper collect` collects them",
        )?;
        let line = line_of(&self.loaded.low, &frames.training);
        let networks = self.networks(split, frames)?;
        let ours = self.ours(split, frames)?;
        let all = self.loaded.all(table, self.clock);
        let inputs = [
            GroupKind::VolumeFeatures,
            GroupKind::Resolution,
            GroupKind::TransferFunction,
            GroupKind::Camera,
        ];
        for (i, (experiment, input)) in EXPERIMENTS.iter().zip(inputs).enumerate() {
            let of = all.parted(|f| f.number < ORBIT && f.number / PER_EXPERIMENT == i as u64).0;
            let models = self.without(&input.to_string(), frames)?;
            let mut judge = self.judge(experiment, &of, &frames.training);
            let by_network = self.predictions(&networks, &of.frames)?;
            let by_ours = self.predictions(&ours, &of.frames)?;
            judge.add(NETWORK, &by_network);
            self.add(&mut judge, &format!("without {}", plain(&input.to_string())), &models, None)?;
            judge.add(OURS, &by_ours);
            results.rows.append(&mut judge.rows);
            let x = |k: usize| {
                if i == 1 { f64::from(of.frames[k].scene.width) } else { k as f64 }
            };
            let axis = if i == 1 { "image side, pixels" } else { "frame" };
            let mut curve = |name: &str, y: &[f64]| {
                let points = y.iter().enumerate().map(|(k, t)| (x(k), *t)).collect();
                results.curves.push(Curve::new(experiment, name, axis, points));
            };
            curve(MEASURED, &of.seconds);
            curve(NETWORK, &by_network[0]);
            curve(OURS, &by_ours[0]);
            let proxy = by_proxy(&self.loaded.low, line, &of.frames);
            if let Some(p) = proxy.into_iter().collect::<Option<Vec<f64>>>() {
                curve(super::results::LVRP, &p);
            }
        }
        // Times along the orbit, for load balancing.
        let orbit = all.parted(|f| (ORBIT..DRAWN_ORBIT).contains(&f.number)).0;
        let by_network = self.predictions(&networks[..1], &orbit.frames)?;
        let by_ours = self.predictions(&ours[..1], &orbit.frames)?;
        for (name, y) in [(MEASURED, &orbit.seconds), (NETWORK, &by_network[0]), (OURS, &by_ours[0])] {
            results.curves.push(Curve::by_index(ORBIT_CHART, name, "task", y));
        }
        let drawn = all.parted(|f| f.number >= DRAWN_ORBIT).0;
        for (v, times) in drawn.seconds.chunks(self.paper().orbit.poses.max(1)).enumerate() {
            let volume = &drawn.frames[v * self.paper().orbit.poses].scene.volume;
            results.curves.push(Curve::by_index(DRAWN_CHART, volume, "pose of the orbit", times));
        }
        Ok(())
    }

    fn samples(&self, split: &str, frames: &SplitFrames<'_>, judge: &mut Judge<'_>) -> Result<()> {
        let (recipe, _) = self.network(split)?;
        for &share in self.paper().shares.iter().chain([&1.0]) {
            let count = ((share * frames.training.frames.len() as f64).round() as usize).max(2);
            let models = if share < 1.0 {
                let key = format!("{split}-network-{share:.2}");
                self.runs(NETWORK, &key, &recipe, |run| {
                    (frames.training.sample(count, run as u64).0, frames.validation.clone())
                })?
            } else {
                self.networks(split, frames)?
            };
            self.add(judge, &format!("{share:.2}"), &models, None)?;
            if let Some(row) = judge.rows.last_mut() {
                row.more.insert("training frames".into(), count as f64);
                row.more.insert("share".into(), share);
            }
        }
        Ok(())
    }

    fn depth(&self, split: &str, frames: &SplitFrames<'_>, judge: &mut Judge<'_>) -> Result<()> {
        let mut bench = self.bench()?;
        for preset in &self.paper().depths {
            let models = self.with_layers(preset, self.network(split)?.0, "", frames)?;
            self.add(judge, preset, &models, bench.as_mut())?;
        }
        Ok(())
    }

    /// Returns networks with the layers of `preset` and the encoder of `network`: the main networks if their
    /// recipe is the same, else networks that are trained for the comparison.
    fn with_layers(
        &self,
        preset: &str,
        network: Recipe,
        encoder: &str,
        frames: &SplitFrames<'_>,
    ) -> Result<Vec<Model>> {
        let split = self.main()?;
        let same = self.network(split)?.0;
        let recipe = Recipe { preset: Some(preset.to_owned()), ..network };
        if recipe == same {
            return self.networks(split, frames);
        }
        let key = format!("{split}-{encoder}{preset}");
        self.on_split(preset, &key, &recipe, frames)
    }

    fn encoders(&self, frames: &SplitFrames<'_>, judge: &mut Judge<'_>) -> Result<()> {
        let set = &self.place.set.name;
        for encoder in trained(self.work, Some(set))? {
            let path = encoder.path(self.work.out);
            let name = format!("{}³F{}", encoder.size, encoder.features);
            let record = encoder.record(self.work.out)?.context("no record")?;
            let network = Recipe { volumenet: Some(path.clone()), ..self.paper().network.clone() };
            let key = format!("{}f{}-", encoder.size, encoder.features);
            let models = self.with_layers(&self.paper().encoder_depth, network, &key, frames)?;
            self.add(judge, &name, &models, None)?;
            let Some(row) = judge.rows.last_mut() else { continue };
            row.latency = Some(self.encoding(&path)?);
            row.more.insert("size".into(), encoder.size as f64);
            row.more.insert("features".into(), encoder.features as f64);
            row.more.insert("epochs".into(), record.provenance.epochs_run as f64);
            row.more.insert("training seconds".into(), record.seconds);
            for part in ["train", "validation", "test"] {
                row.more.extend(record.psnr(part, set).map(|v| (format!("psnr {part}"), v)));
            }
        }
        Ok(())
    }

    /// Seconds to encode a volume, on one thread.
    fn encoding(&self, path: &Path) -> Result<f64> {
        let model = open_model(path)?;
        let net = VolumeNet::new(model.volumenet.as_ref().context("no VolumeNet")?)?;
        let job = self.place.jobs.first().context("no volume")?;
        let volume = entire_io::volume::Volume::open(self.place.root.join(&job.path))?;
        let (mut scratch, mut code) = (net.scratch(), vec![0.0; net.feature_len()]);
        let mut times = Vec::new();
        for _ in 0..5 {
            let started = Instant::now();
            net.encode(&volume.view(), &mut scratch, Executor::Serial, &mut code)?;
            times.push(started.elapsed().as_secs_f64());
        }
        entire_io::metrics::median(&mut times).context("no time")
    }

    fn finalists(&self, frames: &SplitFrames<'_>, judge: &mut Judge<'_>) -> Result<()> {
        let trained = trained(self.work, Some(&self.place.set.name))?;
        for (size, features, preset) in &self.paper().finalists {
            let Some(encoder) = trained.iter().find(|e| e.size == *size && e.features == *features) else {
                note(&format!(
                    "{} has no VolumeNet {size}³F{features}; train it with `entire-lab paper encode`",
                    self.place.set.name
                ));
                continue;
            };
            let path = encoder.path(self.work.out);
            let network = Recipe { volumenet: Some(path), ..self.paper().network.clone() };
            let models = self.with_layers(preset, network, &format!("{size}f{features}-"), frames)?;
            self.add(judge, &format!("{size}³F{features}→{preset}"), &models, None)?;
        }
        Ok(())
    }
}

/// Name of the share of the variance of ln(time per pixel) that lies between volumes.
pub(super) const BETWEEN_VOLUMES: &str = "between volumes";

/// Share of the variance of ln(time per pixel) that lies between volumes. The part of the variance of the
/// volumes' means that comes from the scatter within volumes is subtracted. `None` with fewer than two
/// volumes.
fn between_volumes(of: &TimedFrames<'_>) -> Option<Fact> {
    let mut by_volume: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
    for (f, seconds) in of.frames.iter().zip(&of.seconds) {
        let pixels = f64::from(f.scene.width) * f64::from(f.scene.height);
        by_volume.entry(&f.scene.volume).or_default().push((seconds / pixels).ln());
    }
    let share = share_between(&by_volume.values().map(Vec::as_slice).collect::<Vec<_>>())?;
    let values = [("share", share), ("volumes", by_volume.len() as f64), ("frames", of.frames.len() as f64)];
    Some(Fact { name: BETWEEN_VOLUMES.into(), values: values.map(|(k, v)| (k.to_owned(), v)).into() })
}

/// Estimated share of the variance of all values that lies between groups; it may be below 0 by chance.
fn share_between(groups: &[&[f64]]) -> Option<f64> {
    let n: usize = groups.iter().map(|g| g.len()).sum();
    let k = groups.len();
    if k < 2 || n <= k {
        return None;
    }
    let mean = |g: &[f64]| g.iter().sum::<f64>() / g.len() as f64;
    let all = groups.iter().map(|g| g.iter().sum::<f64>()).sum::<f64>() / n as f64;
    let within: f64 = groups.iter().flat_map(|g| g.iter().map(|v| (v - mean(g)).powi(2))).sum();
    let between: f64 = groups.iter().map(|g| g.len() as f64 * (mean(g) - all).powi(2)).sum();
    let (within, between) = (within / (n - k) as f64, between / (k - 1) as f64);
    let squares: f64 = groups.iter().map(|g| (g.len() as f64).powi(2)).sum();
    let size = (n as f64 - squares / n as f64) / (k - 1) as f64;
    let variance = (between - within) / size;
    Some(variance / (variance + within))
}

/// Name of an input group in words.
fn plain(input: &str) -> String {
    match input {
        "volume_features" => FEATURE_VECTOR.into(),
        "resolution" => "image resolution".into(),
        "transfer_function" => "transfer function".into(),
        "camera" => "camera pose".into(),
        other => other.replace('_', " "),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn variance_between_groups_is_what_their_means_add() {
        // Two groups with means 0 and 10, and a variance of 2 within each: the means' variance is 50 − 2 / 2.
        let (a, b) = ([-1.0, 1.0], [9.0, 11.0]);
        let share = share_between(&[&a, &b]).unwrap();
        assert!((share - 49.0 / 51.0).abs() < 1e-12, "{share}");
        // Equal means are closer to each other than chance alone makes them.
        assert!(share_between(&[&a, &a]).unwrap() < 0.0);
        assert_eq!(share_between(&[&a]), None);
    }
}
