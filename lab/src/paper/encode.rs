//! Trains VolumeNets of all required sizes by the Python script: for each data set, for all data sets
//! together, and with other numbers of channels for the capacity sweep.

use super::Work;
use super::description::Encoders;
use super::volumes::Place;
use crate::child;
use anyhow::{Context, Result, bail, ensure};
use entire_io::files::{make_folder, read_text, write_json};
use nix::sys::signal::Signal;
use serde::{Deserialize, Serialize};
use serde_json::json;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

/// Time that a training has to end by itself after it was asked to end: it completes its batch, evaluates
/// every volume with the best weights, and writes the weights. A training that is killed after this time
/// continues from its last epoch at the next run.
const END_TIME_LIMIT: Duration = Duration::from_secs(600);

/// Name of the encoder that is trained on all data sets.
pub(crate) const ALL: &str = "all";
/// Name of the shipped encoders, which were trained on all data sets, with whole members held out.
pub(crate) const SHIPPED: &str = "shipped";

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Encoder {
    /// A data set, or [`ALL`].
    pub(crate) set: String,
    pub(crate) size: usize,
    pub(crate) features: usize,
    /// Output channels of the blocks; if empty, the script's default.
    pub(crate) channels: Vec<usize>,
}

impl Encoder {
    /// The study's encoders of a data set or [`ALL`]: one for each pair of input side and number of features,
    /// then those of the capacity sweep.
    pub(crate) fn of_set(asked: &Encoders, set: &str) -> Vec<Self> {
        let one = |size: usize, features: usize, channels: &[usize]| Self {
            set: set.to_owned(),
            size,
            features,
            channels: channels.to_vec(),
        };
        let sweep = &asked.capacity;
        let pairs = asked.sizes.iter().flat_map(|s| asked.features.iter().map(|f| one(*s, *f, &[])));
        pairs.chain(sweep.channels.iter().map(|c| one(sweep.size, sweep.features, c))).collect()
    }

    pub(crate) fn is_trained(&self, out: &Path) -> Result<bool> {
        Ok(self.record(out)?.is_some_and(|r| r.complete()))
    }

    pub(crate) fn path(&self, out: &Path) -> PathBuf {
        let Self { set, size, features, channels } = self;
        let widths: Vec<String> = channels.iter().map(ToString::to_string).collect();
        let widths = if widths.is_empty() { String::new() } else { format!("-c{}", widths.join("-")) };
        out.join("volumenet").join(format!("{set}-{size}f{features}{widths}.safetensors"))
    }

    /// Reads the record that the training script wrote; `None` if there is no record.
    pub(crate) fn record(&self, out: &Path) -> Result<Option<Record>> {
        let path = self.path(out).with_extension("json");
        if !path.exists() {
            return Ok(None);
        }
        let text = read_text(&path, 64 << 20)?;
        serde_json::from_str(&text).map(Some).with_context(|| format!("{} is no record", path.display()))
    }
}

/// Record that the training script writes beside a model.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Record {
    pub(crate) provenance: Provenance,
    pub(crate) seconds: f64,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Provenance {
    /// Mean peak signal-to-noise ratio over volumes, dB, by part and data set.
    pub(crate) psnr_db: BTreeMap<String, BTreeMap<String, f64>>,
    pub(crate) epochs_run: usize,
    /// Reason for the end of the training.
    pub(crate) stopped: String,
}

impl Record {
    pub(crate) fn complete(&self) -> bool {
        !self.provenance.stopped.starts_with("interrupted")
    }

    /// Mean peak signal-to-noise ratio over the volumes of a part (`train`, `validation`, `test`) of a data
    /// set, dB.
    pub(crate) fn psnr(&self, part: &str, set: &str) -> Option<f64> {
        self.provenance.psnr_db.get(part)?.get(set).copied()
    }
}

/// Every encoder of the study that can be trained on the available data sets.
fn encoders(work: &Work<'_>, places: &[Place]) -> Vec<Encoder> {
    let asked = &work.paper.encoders;
    let swept = |e: &Encoder| e.channels.is_empty() || asked.capacity.data_sets.contains(&e.set);
    let names = places.iter().filter(|p| !p.splits.is_empty()).map(|p| p.set.name.as_str()).chain([ALL]);
    let mut out: Vec<Encoder> = names.flat_map(|set| Encoder::of_set(asked, set)).filter(swept).collect();
    // Encoders of the main size for single data sets come first, encoders of the capacity sweep last.
    let main = asked.main;
    out.sort_by_key(|e| {
        (!e.channels.is_empty(), e.set == ALL, (e.size, e.features) != main, e.size, e.features)
    });
    out
}

pub(crate) fn encode(work: &Work<'_>, places: &[Place], threads: Option<usize>) -> Result<()> {
    make_folder(&work.out.join("volumenet"))?;
    let encoders = encoders(work, places);
    let root = places.first().context("no data set")?.root.clone();
    for (i, encoder) in encoders.iter().enumerate() {
        if encoder.is_trained(work.out)? {
            continue;
        }
        work.go_on()?;
        let parts_of: Vec<&Place> = places
            .iter()
            .filter(|p| !p.splits.is_empty() && (encoder.set == ALL || p.set.name == encoder.set))
            .collect();
        ensure!(
            parts_of.iter().all(|p| p.root == root),
            "the data sets lie in several folders; put all of them into one folder"
        );
        let Encoder { set, size, features, .. } = encoder;
        println!("encode {} of {}: {set}, {size}³, F = {features}", i + 1, encoders.len());
        train(work, encoder, &parts_of, &root, threads)?;
    }
    Ok(())
}

fn train(
    work: &Work<'_>,
    encoder: &Encoder,
    places: &[&Place],
    root: &Path,
    threads: Option<usize>,
) -> Result<()> {
    let asked = &work.paper.encoders;
    let union = |part: fn(&super::volumes::Parts) -> &BTreeSet<String>| -> Vec<String> {
        places.iter().filter_map(|p| p.main_split()).flat_map(|s| part(s).iter().cloned()).collect()
    };
    let to = encoder.path(work.out);
    let parts = to.with_extension("parts.json");
    write_json(
        &parts,
        &json!({ "train": union(|s| &s.training), "validation": union(|s| &s.validation), "test": union(|s| &s.test) }),
    )?;
    let names: Vec<&str> = places.iter().map(|p| p.set.name.as_str()).collect();
    let mut command = Command::new(work.python);
    command
        .arg(&asked.script)
        .args(["--datasets", &names.join(","), "--resume"])
        .args(["--size", &encoder.size.to_string(), "--features", &encoder.features.to_string()])
        .args(["--epochs", &asked.epochs.to_string(), "--patience", &asked.patience.to_string()]);
    for (option, path) in [("--data", root), ("--parts", parts.as_path()), ("--out", to.as_path())] {
        command.arg(option).arg(path);
    }
    if !encoder.channels.is_empty() {
        let widths: Vec<String> = encoder.channels.iter().map(ToString::to_string).collect();
        command.args(["--channels", &widths.join(",")]);
    }
    if let Some(threads) = threads {
        command.args(["--threads", &threads.to_string()]);
    }
    let mut child = command.spawn().with_context(|| format!("cannot start {}", work.python.display()))?;
    let (status, stopped) = child::wait(&mut child, || work.stop(), Signal::SIGTERM, END_TIME_LIMIT)?;
    if stopped {
        bail!("{}", work.stopped());
    }
    ensure!(
        status.success(),
        "{} failed; use --python to name an interpreter that has the packages of \
         lab/volumenet/requirements.txt",
        asked.script.display()
    );
    Ok(())
}
