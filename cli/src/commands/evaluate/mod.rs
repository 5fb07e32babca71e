//! `entire evaluate`: errors of predictors on collected frames.

mod report;

use crate::calibrate::place::shading_of;
use anyhow::{Context, Result, ensure};
use entire_core::kernels::Storage;
use entire_core::model::Model;
use entire_io::clock::{ClockChoice, agreed, clock_parser, concrete, unstated};
use entire_io::dataset::{TimedFrame, ensure_no_table, left_out, noise_floor, open_tables, shaded, timed};
use entire_io::files::{fnv1a_text, make_folder, note, parse_model, read_model_bytes};
use entire_io::machine;
use entire_io::metrics::{Metrics, intervals_by_group};
use entire_io::options::thread_pool;
use entire_io::progress::{INPUTS_BAR, templated_bar};
use entire_steer::predict::UpperBound;
use entire_train::bound;
use entire_train::evaluation::{PROBE_SHARE, by_kind, in_session, noise_by_kind, probe_means, warm_latency};
use entire_train::fit::predict_rows;
use entire_train::inputs::Layout;
use entire_train::split::{GroupBy, Split};
use report::{Evaluation, PREDICTIONS, Predictor, detail_table, noise_text, tables_of, write_report};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Measure the errors of predictors on collected frames.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  entire evaluate --model model.safetensors --data frames.csv
  entire evaluate --model a.safetensors b.safetensors --data frames.csv \\
      --unseen --out out/evaluation
        uses only frames of members or volumes that no model was trained on,
        and draws plots
  entire evaluate --model models/unshaded-distilled.safetensors \\
      --data data/timings/none-members.csv.gz --storage int8
        also the errors with weights of 8 bits")]
pub(crate) struct Options {
    /// Model files.
    #[arg(long, required = true, num_args = 1.., value_name = "SAFETENSORS")]
    pub(crate) model: Vec<PathBuf>,
    /// Timing tables of `entire collect` or of any program that writes the same format.
    #[arg(long, required = true, num_args = 1.., value_name = "CSV")]
    pub(crate) data: Vec<PathBuf>,
    /// Clock of the measured seconds; `auto`: the clock that the models state, else the device's timestamps
    /// if all frames have them, or wall time if none has. A model that states another clock is refused.
    #[arg(long, value_parser = clock_parser(), default_value = "auto")]
    pub(crate) clock: ClockChoice,
    /// Only frames with this shading: none, local, scatter or local-scatter.
    #[arg(long)]
    pub(crate) shade: Option<entire_core::scene::Shading>,
    /// Leave out frames of members or volumes that a model was trained or validated on, as its file states.
    #[arg(long)]
    pub(crate) unseen: bool,
    /// Folder for evaluation.json, predictions.csv, report.html and the plots as SVG.
    #[arg(long, value_name = "FOLDER")]
    pub(crate) out: Option<PathBuf>,
    /// Also evaluate each model with its weights stored as f32, f16, bf16 or int8.
    #[arg(long, num_args = 1.., value_name = "STORAGE", value_parser = parse_storage)]
    pub(crate) storage: Vec<Storage>,
    /// Also evaluate each model in a session, which corrects later predictions by the measured time of each
    /// frame. The first FRAMES frames are left out of these errors. Needs the volume files.
    #[arg(long, value_name = "FRAMES")]
    pub(crate) observed: Option<usize>,
    /// Seed of the random choice of frames whose mean time is the prediction of the constant baseline.
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,
    /// Folder of the tables' volumes, if it is neither the working folder nor the folder of the table.
    #[arg(long, value_name = "FOLDER")]
    pub(crate) root: Option<PathBuf>,
    /// Number of threads; default: one per logical processor.
    #[arg(long)]
    pub(crate) threads: Option<usize>,
}

fn parse_storage(text: &str) -> Result<Storage, String> {
    Storage::ALL.into_iter().find(|s| s.to_string() == text).ok_or_else(|| {
        let accepted = Storage::ALL.map(|s| s.to_string()).join(", ");
        format!("not a storage format of weights; accepted are {accepted}")
    })
}

struct Loaded {
    name: String,
    /// FNV-1a hash of the file, hexadecimal.
    hash: String,
    model: Model,
    layout: Layout,
    splits: Vec<Split>,
}

fn load(path: &Path) -> Result<Loaded> {
    let bytes = read_model_bytes(path)?;
    let model = parse_model(path, &bytes)?;
    let layout = Layout::of_model(&model).with_context(|| format!("{}", path.display()))?;
    let name =
        path.file_stem().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into_owned());
    Ok(Loaded { name, hash: fnv1a_text(&bytes), splits: Split::all_of(&model), model, layout })
}

impl Loaded {
    fn has_seen(&self, frame: &TimedFrame) -> bool {
        self.splits.iter().any(|split| split.has_seen(&frame.scene))
    }
}

pub(crate) fn run(options: &Options) -> Result<()> {
    let pool = thread_pool(options.threads)?;
    if let Some(out) = &options.out {
        make_folder(out)?;
        ensure_no_table(&out.join(PREDICTIONS)).context("--out")?;
    }
    let mut models: Vec<Loaded> = options.model.iter().map(|p| load(p)).collect::<Result<_>>()?;
    let names: BTreeSet<String> = models.iter().map(|m| m.name.clone()).collect();
    if names.len() < models.len() {
        for (model, path) in models.iter_mut().zip(&options.model) {
            model.name = path.display().to_string();
        }
    }
    let tables = open_tables(&options.data, options.root.as_deref())?;
    let named = || models.iter().map(|m| (m.name.as_str(), &m.model));
    let clock = concrete(agreed(options.clock, named())?, shaded(&tables, options.shade))?;
    let mut frames = timed(&tables, clock, options.shade)?;
    let said = [unstated(clock, named()), left_out(&tables, clock, options.shade)];
    said.into_iter().flatten().for_each(|text| note(&text));
    for m in &models {
        let Some(shading) = shading_of(&m.model) else { continue };
        let others = frames.iter().filter(|(f, _)| f.scene.shading != shading).count();
        if others > 0 {
            note(&format!(
                "{} was fitted to frames with --shade {shading}, and {others} of the {} frames have another \
                 shading; --shade {shading} leaves these out",
                m.name,
                frames.len()
            ));
        }
    }
    if options.unseen {
        for m in models.iter().filter(|m| m.splits.is_empty()) {
            note(&format!(
                "{} does not state its training data, so --unseen cannot leave out its training frames",
                m.name
            ));
        }
        frames.retain(|(f, _)| !models.iter().any(|m| m.has_seen(f)));
        ensure!(
            !frames.is_empty(),
            "every frame shows a volume or an ensemble member that a model was trained or validated on; give \
             other data, or leave out --unseen"
        );
    }
    let (refs, measured): (Vec<&TimedFrame>, Vec<f64>) = frames.into_iter().unzip();
    if let Some(heard) = options.observed {
        ensure!(
            heard < refs.len(),
            "--observed is {heard}; it must be smaller than the number of frames, {}",
            refs.len()
        );
    }
    let groups: Vec<String> = refs.iter().map(|f| GroupBy::Member.group(&f.scene)).collect();
    let passes = |f: &TimedFrame| tables[f.table].passes();
    let noise = noise_floor(refs.iter().copied(), clock, passes);
    let noise_by_kind = noise_by_kind(&refs, clock, passes);

    let assess = |name: String, predicted: Vec<f64>, upper| {
        assess(name, predicted, (&refs, &measured, &groups), upper)
    };
    let frames_seen =
        |m: &Loaded| (!m.splits.is_empty()).then(|| refs.iter().filter(|f| m.has_seen(f)).count());
    let (mut predictors, mut inputs) = (Vec::new(), Vec::new());
    for m in &models {
        let bar = templated_bar(INPUTS_BAR);
        let rows = m.layout.rows(&tables, &refs, &pool, &bar).with_context(|| m.name.clone())?;
        bar.finish_and_clear();
        let predicted = predict_rows(&m.model, &m.layout, &rows, None)?;
        let latency = match warm_latency(&m.model, &m.layout, &tables, &refs) {
            Ok(latency) => Some(latency),
            Err(e) => {
                note(&format!("{}: no latency was measured ({e:#})", m.name));
                None
            }
        };
        predictors.push(Predictor {
            fnv1a: Some(m.hash.clone()),
            latency,
            frames_seen: frames_seen(m),
            ..assess(m.name.clone(), predicted, bound::of(&m.model))?
        });
        inputs.push(rows);
    }
    for (m, rows) in models.iter().zip(&inputs) {
        for &storage in &options.storage {
            let predicted = predict_rows(&m.model, &m.layout, rows, Some(storage));
            let name = format!("{}, {} weights", m.name, storage);
            let stored = assess(name, predicted.with_context(|| m.name.clone())?, bound::of(&m.model))?;
            predictors.push(Predictor { frames_seen: frames_seen(m), ..stored });
        }
    }
    let constant = probe_means(&refs, &measured, options.seed);
    let name = format!("mean time of {:.0} % of each volume's frames", 100.0 * PROBE_SHARE);
    predictors.push(Predictor { constant: true, ..assess(name, constant, None)? });

    let (mut sessions, mut lines) = (BTreeMap::new(), Vec::new());
    if let Some(heard) = options.observed {
        for m in &models {
            let predicted =
                in_session(&m.model, &tables, &refs, &measured).with_context(|| m.name.clone())?;
            let metrics =
                Metrics::new(&predicted[heard..], &measured[heard..]).context("no frames are left")?;
            lines.push(format!(
                "{} in a session, after {heard} observed frames: RMSE/SD {:.3}, median error {:.2} % on the \
                 other {} frames",
                m.name,
                metrics.rmse_over_sd,
                100.0 * metrics.mdape,
                metrics.frames
            ));
            sessions.insert(m.name.clone(), metrics);
        }
    }

    let evaluation = Evaluation {
        program: format!("entire {}", machine::version()),
        machine: machine::machine(),
        date: machine::now(),
        load_average: machine::load_average(),
        data: options.data.iter().map(|p| p.display().to_string()).collect(),
        clock: clock.name(),
        shading: options.shade.map(Into::into),
        unseen_only: options.unseen,
        frames: refs.len(),
        noise_floor: noise,
        noise_by_kind: &noise_by_kind,
        in_session: &sessions,
        predictors: &predictors,
    };
    let (overall, bias, by_group) = tables_of(&predictors);
    let more = detail_table(&predictors, &noise_by_kind);
    // The files are written before anything is printed: a closed standard output ends the command.
    let written = options.out.as_deref().map_or(Ok(()), |out| {
        write_report(out, &evaluation, &refs, &measured, &groups, [&overall, &bias, &by_group, &more])
    });
    lines.iter().for_each(|line| println!("{line}"));
    println!("{}", overall.to_text());
    println!("{}", more.to_text());
    println!(
        "median of predicted / measured - 1, in %, of each tenth of the frames, from the fastest to the \
         slowest"
    );
    println!("{}", bias.to_text());
    println!("{}", by_group.to_text());
    println!("{}", noise_text(noise));
    written?;
    if let Some(out) = &options.out {
        println!("wrote {}", out.join("report.html").display());
    }
    Ok(())
}

/// Returns the errors of a predictor. The caller sets the file's hash, the latency and the number of seen
/// frames; here they are `None`.
fn assess(
    name: String,
    predicted: Vec<f64>,
    (frames, measured, groups): (&[&TimedFrame], &[f64], &[String]),
    upper: Option<UpperBound>,
) -> Result<Predictor> {
    let metrics = Metrics::new(&predicted, measured).context("there are no frames to compare")?;
    let mut pairs: BTreeMap<&str, (Vec<f64>, Vec<f64>)> = BTreeMap::new();
    for ((p, t), g) in predicted.iter().zip(measured).zip(groups) {
        let (ps, ts) = pairs.entry(g).or_default();
        ps.push(*p);
        ts.push(*t);
    }
    let by_group =
        pairs.into_iter().filter_map(|(g, (p, t))| Some((g.to_owned(), Metrics::new(&p, &t)?))).collect();
    let bound = upper.and_then(|u| bound::judge(&u, &predicted, measured));
    let bound_coverage = bound.as_ref().map(|b| b.coverage);
    // Both intervals are computed from the same bootstrap samples.
    let both = |m: &Metrics| [m.rmse_over_sd, m.mdape];
    let intervals = intervals_by_group(&predicted, measured, groups, (BOOTSTRAP_ROUNDS, 0.95), both);
    let [rmse_over_sd_interval, mdape_interval] = intervals.map_or([None; 2], |both| both.map(Some));
    let by_kind = by_kind(frames, &predicted, measured);
    Ok(Predictor {
        name,
        fnv1a: None,
        metrics,
        by_group,
        latency: None,
        frames_seen: None,
        bound_coverage,
        bound,
        rmse_over_sd_interval,
        mdape_interval,
        by_kind,
        predicted,
        constant: false,
    })
}

/// Number of bootstrap samples over ensemble members.
const BOOTSTRAP_ROUNDS: usize = 400;
