//! Use case 1, steering: recorded paths under every controller, with the paper's network and our predictor.

use super::Work;
use super::description::Panel;
use super::results::{Curve, Fact, Results, write};
use super::section::Section;
use crate::fitted::{response_of, samples_by_volume};
use crate::replay::Replayable;
use crate::trace::Trace;
use anyhow::{Context, Result};
use entire_cli::steering::contenders::ControllerKind;
use entire_cli::steering::model::Sample;
use entire_cli::steering::play::ActsOn;
use entire_core::scene::Frame;
use entire_io::files::{fnv1a_text, make_folder, read_bytes, read_text, write_whole};
use entire_report::{Axis, Chart, Mark, Series, Table, encode_png};
use entire_vk_raycaster::{Image, Renderer};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Names and titles of the controllers in the charts with a value per frame: the paper's three, and ours.
const CHARTED_CONTROLLERS: [(&str, &str); 4] = [
    (ControllerKind::Olp.name(), "OLP"),
    (ControllerKind::Pid.name(), "PID"),
    (ControllerKind::Algorithm1.name(), "Algorithm 1 with the paper's network"),
    (OURS, "ours"),
];

/// Name of the hybrid controller with the predictor that was fitted to the calibration frames.
const OURS: &str = "ours";
/// Last part of the name of a controller with the paper's network, fine-tuned to the calibration frames.
pub(super) const TUNED: &str = ", fine-tuned";

/// A chart with a value per frame: title, axis, value of the controller for a frame, name of the reference
/// (the target or the oracle), value of the reference for a frame.
type Drawing = (&'static str, &'static str, fn(&Row) -> f64, &'static str, fn(&Row) -> f64);

const CHARTS: [Drawing; 3] = [
    ("frame time", "frame time, ms", |r| 1e3 * r.seconds, "target", |r| 1e3 * r.target_s),
    ("ray step", "ray step, reference steps", |r| r.step_ref, "oracle", |r| r.oracle_step_ref),
    ("quality", "PSNR, dB", |r| r.psnr_db, "oracle", |r| r.oracle_psnr_db),
];

/// Frames whose pictures are compared, as fractions of the path: the first frame after an abrupt change, a
/// frame shortly after another change, and a frame far from any change.
const PICTURED: [f64; 3] = [0.255, 0.525, 0.89];

/// Side of a compared picture, pixels.
const SIDE: u32 = 128;

/// A row of `frames.csv`: a frame under one controller with one target.
#[derive(Clone, Debug, Deserialize)]
struct Row {
    trace: String,
    target: String,
    controller: String,
    frame: usize,
    target_s: f64,
    seconds: f64,
    step_ref: f64,
    oracle_step_ref: f64,
    psnr_db: f64,
    oracle_psnr_db: f64,
}

fn rows(folder: &Path) -> Result<Vec<Row>> {
    let path = folder.join("frames.csv");
    let bytes = read_bytes(&path)?;
    csv::Reader::from_reader(&bytes[..])
        .deserialize()
        .collect::<Result<_, _>>()
        .with_context(|| format!("{} is not what entire-lab replay writes", path.display()))
}

/// Returns the recorded paths in a folder that show only volumes of a data set.
pub(crate) fn traces_of(folder: &Path, set: &str) -> Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder).with_context(|| format!("cannot read {}", folder.display()))?;
    let mut files: Vec<PathBuf> = entries.flatten().map(|e| e.path()).collect();
    files.retain(|p| p.to_string_lossy().ends_with(".json") || p.to_string_lossy().ends_with(".json.gz"));
    files.sort();
    let mut out = Vec::new();
    for file in files {
        let shown = Trace::open(&file)?.volumes;
        if shown.iter().all(|v| v.file.components().any(|c| c.as_os_str() == set)) {
            out.push(file);
        }
    }
    Ok(out)
}

/// Stores the results of the replay of recorded paths (`traces`): scores; values per frame of one path, with
/// pictures of three frames; the curve of each scene in the table `calibration`; and the curve G, which is
/// computed from the curves of the scenes. `network`, `tuned` and `ours` are the folders of the replays with
/// the paper's network, with this network fine-tuned to the calibration frames, and with our predictor.
pub(crate) fn keep(
    work: &Work<'_>,
    (traces, calibration): (&[PathBuf], &Path),
    [network, tuned, ours]: [&Path; 3],
    (set, mode): (&str, &str),
    renderer: &mut dyn Renderer,
) -> Result<()> {
    let mut frames = rows(network)?;
    frames.extend(rows(ours)?.into_iter().map(|r| Row { controller: OURS.into(), ..r }));
    let scores = |folder: &Path| -> Result<(String, serde_json::Value)> {
        let path = folder.join("scores.json");
        let text = read_text(&path, 256 << 20)?;
        let found =
            serde_json::from_str(&text).with_context(|| format!("{} holds no scores", path.display()))?;
        Ok((text, found))
    };
    let (text, network) = scores(network)?;
    let (tuned_text, tuned) = scores(tuned)?;
    let (ours_text, ours) = scores(ours)?;
    let mark = fnv1a_text((text + &tuned_text + &ours_text).as_bytes());
    let mut results = Results::new(Panel::Steering, set, mode, mark);
    let recorded = network["traces"].as_array().cloned().unwrap_or_default();
    let provenance = recorded.first().map(|t| t["provenance"].clone()).unwrap_or_default();
    results.device = provenance["device"].as_str().unwrap_or_default().to_owned();
    results.machine = provenance["machine"].as_str().unwrap_or_default().to_owned();
    results.frames.insert("paths".into(), [0, 0, recorded.len()]);
    results.facts = facts(&network, str::to_owned);
    results.facts.extend(facts(&tuned, |name| format!("{name}{TUNED}")));
    results.facts.extend(facts(&ours, |_| OURS.into()));
    if let Some(drawn) = one_path(&frames) {
        results.curves = curves(&drawn);
        let name = &drawn[0].trace;
        for file in traces {
            let trace = Trace::open(file)?;
            if trace.name == *name {
                results.pictures = pictures(work, set, trace, &drawn, renderer)?;
            }
        }
    }
    results.curves.extend(step_curves(calibration)?);
    write(work.out, &results)
}

fn facts(found: &serde_json::Value, name: impl Fn(&str) -> String) -> Vec<Fact> {
    let mut out = Vec::new();
    for (controller, score) in found["controllers"].as_object().into_iter().flatten() {
        let on_image = found["acts_on"][controller].as_str() == Some(IMAGE.name());
        let values = score
            .as_object()
            .into_iter()
            .flatten()
            .flat_map(|(k, v)| match v.as_object() {
                Some(inner) => inner.iter().map(|(i, v)| (format!("{k} {i}"), v.as_f64())).collect(),
                None => vec![(k.clone(), v.as_f64())],
            })
            .filter_map(|(k, v)| Some((k, v?)))
            .chain([(ON_IMAGE.to_owned(), f64::from(u8::from(on_image)))])
            .collect();
        out.push(Fact { name: name(controller), values });
    }
    out
}

/// Returns the frames of one path under the median of its targets. The path is the first one with abrupt
/// changes; if there is none, it is the first of all paths.
fn one_path(frames: &[Row]) -> Option<Vec<Row>> {
    let mut names: Vec<&str> = frames.iter().map(|r| r.trace.as_str()).collect();
    names.dedup();
    let name = names.iter().find(|n| n.contains("switches")).or(names.first())?;
    let of_path = |r: &&Row| r.trace == *name && r.target.ends_with("fps");
    let mut targets: Vec<(f64, &str)> =
        frames.iter().filter(of_path).map(|r| (r.target_s, r.target.as_str())).collect();
    targets.sort_by(|a, b| a.0.total_cmp(&b.0));
    targets.dedup();
    let target = targets.get(targets.len() / 2)?.1;
    Some(frames.iter().filter(of_path).filter(|r| r.target == target).cloned().collect())
}

fn curves(drawn: &[Row]) -> Vec<Curve> {
    let mut out = Vec::new();
    for (chart, _, value, beside, best) in CHARTS {
        let mut add = |name: &str, controller: &str, y: fn(&Row) -> f64| {
            let points: Vec<(f64, f64)> =
                drawn.iter().filter(|r| r.controller == controller).map(|r| (r.frame as f64, y(r))).collect();
            if !points.is_empty() {
                out.push(Curve::new(chart, name, "frame", points));
            }
        };
        for (controller, title) in CHARTED_CONTROLLERS {
            add(title, controller, value);
        }
        // The reference is the same for every controller.
        add(beside, &drawn[0].controller, best);
    }
    out
}

/// Draws three frames, each at the reference step and, beside it, at the step of every controller in
/// [`CHARTED_CONTROLLERS`]. Returns the names of the pictures' files and their captions.
fn pictures(
    work: &Work<'_>,
    set: &str,
    trace: Trace,
    drawn: &[Row],
    renderer: &mut dyn Renderer,
) -> Result<Vec<(String, String)>> {
    let folder = work.out.join("pictures");
    make_folder(&folder)?;
    let recorded = Replayable::new(trace)?;
    let n = recorded.path.frames.len();
    let mut out = Vec::new();
    for share in PICTURED {
        let index = ((share * n as f64) as usize).min(n.saturating_sub(1));
        let fail = || format!("frame {index} of {}", recorded.trace.name);
        let volume = recorded.trace.volumes[recorded.trace.volume_at(index)].open()?;
        renderer.set_volume(&volume.view()).with_context(fail)?;
        let table = recorded.path.frames[index].transfer.function().to_table().with_context(fail)?;
        renderer.set_transfer(&table).with_context(fail)?;
        let frame = recorded.trace.frame(&recorded.path, index).with_context(fail)?;
        let mut steps = vec![("reference step", 1.0)];
        for (controller, title) in CHARTED_CONTROLLERS {
            let row = drawn.iter().find(|r| r.controller == controller && r.frame == index);
            steps.extend(row.map(|r| (title, r.step_ref)));
        }
        let mut images = Vec::new();
        for (_, step) in &steps {
            let frame = Frame { width: SIDE, height: SIDE, step: *step as f32, ..frame }.checked()?;
            images.push(renderer.render(&frame).with_context(fail)?.image);
        }
        let name = format!("{set}-control-{index}.png");
        write_whole(&folder.join(&name), &encode_png(&side_by_side(&images))?)?;
        let titles: Vec<String> =
            steps.iter().map(|(title, step)| format!("{title} (step {step:.2})")).collect();
        out.push((name, format!("control: frame {index}, from left to right: {}", titles.join(", "))));
    }
    Ok(out)
}

fn side_by_side(images: &[Image]) -> Image {
    let width: u32 = images.iter().map(|i| i.width).sum();
    let height = images.iter().map(|i| i.height).max().unwrap_or(0);
    let mut rgba = Vec::with_capacity(4 * width as usize * height as usize);
    for y in 0..height as usize {
        for i in images {
            let row = 4 * i.width as usize;
            rgba.extend_from_slice(&i.rgba[y * row..(y + 1) * row]);
        }
    }
    Image { width, height, rgba }
}

/// Curves over the ray step: each calibration scene's time divided by its time at the reference step, and G.
fn step_curves(calibration: &Path) -> Result<Vec<Curve>> {
    let samples = samples_by_volume(&[calibration.to_owned()])?;
    let samples: Vec<Sample> = samples.into_iter().map(|(_, sample)| sample).collect();
    let g = response_of(&samples)?;
    let mut by_scene: BTreeMap<usize, Vec<(f64, f64)>> = BTreeMap::new();
    for s in &samples {
        by_scene.entry(s.scene).or_default().push((f64::from(s.setting.step), s.seconds));
    }
    let mut steps: Vec<f64> = samples.iter().map(|s| f64::from(s.setting.step)).collect();
    steps.sort_by(f64::total_cmp);
    steps.dedup();
    let curve = |name: &str, points| Curve::new("G", name, "ray step, reference steps", points);
    let mut out = Vec::new();
    for (scene, mut points) in by_scene {
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        let Some(reference) = points.iter().find(|p| p.0 == 1.0).map(|p| p.1) else { continue };
        points.iter_mut().for_each(|p| p.1 /= reference);
        out.push(curve(&format!("scene {scene}"), points));
    }
    let ratios = steps.iter().map(|s| (*s, f64::from(g.time_ratio(*s as f32)))).collect();
    out.push(curve("G", ratios));
    Ok(out)
}

/// Key of a score: mean of |time − target| / target over all reachable frames.
pub(super) const ALL_FRAMES: &str = "all deviation";
/// Key of a score: mean of |time − target| / target over the reachable first frames after abrupt changes.
pub(super) const FIRST_FRAMES: &str = "first_frame_deviation";

/// Returns a score under Algorithm 1 with the paper's network, divided by the same score under OLP; `None` if
/// one of these controllers was not played. `distance` is the key: [`ALL_FRAMES`] or [`FIRST_FRAMES`].
/// `network` is empty, or [`TUNED`] for the fine-tuned network.
pub(super) fn algorithm1_over_olp(all: &[Results], distance: &str, network: &str) -> Option<f64> {
    let played = all.iter().find(|r| r.panel == Panel::Steering)?;
    let of = |name: &str| played.facts.iter().find(|f| f.name == name)?.values.get(distance).copied();
    Some(of(&format!("{}{network}", ControllerKind::Algorithm1.name()))? / of(ControllerKind::Olp.name())?)
}

/// Columns of the table of controllers: key of a score, its title, and true if it is a share.
const COLUMNS: [(&str, &str, bool); 7] = [
    (ALL_FRAMES, "mean error", true),
    ("all missed", "frames over 1.1 × target", true),
    ("all quality", "quality", true),
    ("calm deviation", "mean error in calm phases", true),
    (FIRST_FRAMES, "mean error in first frames after a change", true),
    ("psnr_loss", "oracle's PSNR minus the controller's, dB", false),
    ("worst", "slowest frame / target", false),
];

/// Key of the score that is 1 if the controller acted on image resolution, and 0 if it acted on the step.
const ON_IMAGE: &str = "on_image";
const IMAGE: ActsOn = ActsOn::ImageResolution { coarsest: 1.0 };

/// Adds use case 1 to the report: tables and charts of the controllers.
pub(super) fn section(of: &[&Results], s: &mut Section) {
    for r in of.iter().filter(|r| !r.facts.is_empty()) {
        let columns = COLUMNS.map(|(_, title, _)| format!(" | #{title}")).concat();
        let mut table = Table::headed(&format!("controller | acts on{columns}"));
        for f in &r.facts {
            let (name, tuned) =
                f.name.strip_suffix(TUNED).map_or((f.name.as_str(), ""), |name| (name, TUNED));
            let title = match name {
                OURS => "entire's controller with entire's predictor",
                name if name == ControllerKind::Hybrid.name() => {
                    "entire's controller with the paper's network"
                }
                name if name == ControllerKind::Algorithm1.name() => "Algorithm 1 with the paper's network",
                name => ControllerKind::from_name(name).map_or(name, |k| k.title()),
            };
            let on_image = f.values.get(ON_IMAGE) == Some(&1.0);
            let acts_on = if on_image { IMAGE } else { ActsOn::RayStep };
            let mut cells = vec![format!("{title}{tuned}").into(), acts_on.name().into()];
            cells.extend(COLUMNS.map(|(key, _, share)| {
                f.values
                    .get(key)
                    .map(|v| if share { format!("{:.1} %", 100.0 * v) } else { format!("{v:.2}") })
                    .into()
            }));
            table.row(cells);
        }
        let paths = r.frames.get("paths").map_or(0, |f| f[2]);
        let caption = format!(
            "All controllers play {paths} recorded paths of {}. A target of 5, 10, 20 or 40 frames per \
             second is used for a path if, in at least half of the path's frames, some ray step takes \
             exactly the target time. A path with several such targets is also played with a series in \
             which they alternate. The mean error is the mean of |time − target| / target over the frames \
             that take exactly the target time at some ray step. The quality is the oracle's ray step \
             divided by the controller's, at most 1, averaged over frames. For a controller of the image \
             resolution, the quality is the smallest image reduction that meets the target, divided by the \
             controller's. The oracle knows the recorded time of every ray step.",
            r.set
        );
        s.tables.push((table, caption));
        for (title, axis, ..) in CHARTS {
            let mut drawn = Chart::new(title, Axis::linear("frame"), Axis::linear(axis));
            let shown: Vec<&Curve> = r.curves.iter().filter(|c| c.chart == title).collect();
            for c in &shown {
                let color = CHARTED_CONTROLLERS.iter().position(|(_, t)| *t == c.name).map_or(0, |p| p + 1);
                drawn = drawn.series(Series::new(&c.name, Mark::Line(c.points.clone())).color(color));
            }
            if !shown.is_empty() {
                let what =
                    "One of the paths, frame by frame. `ours` is this project's controller and predictor.";
                s.charts.push((drawn, what.into()));
            }
        }
        s.pictures.extend(
            r.pictures
                .iter()
                .map(|(file, caption)| (file.clone(), caption.replacen("control: frame", "Frame", 1))),
        );
        s.summary = format!("{} controllers on {paths} paths", r.facts.len());
    }
}

/// Adds G to the report: the frame time as a function of the ray step, divided by the time at the reference
/// step.
pub(super) fn response_section(of: &[&Results], s: &mut Section) {
    for r in of {
        let shown: Vec<&Curve> = r.curves.iter().filter(|c| c.chart == "G").collect();
        let x = shown.first().map_or(String::new(), |c| c.x.clone());
        let mut drawn = Chart::new("G", Axis::linear(x), Axis::linear("time / time at the reference step"));
        for c in &shown {
            let own = c.name == "G";
            let name = if own { c.name.as_str() } else { "" };
            drawn = drawn.series(Series::new(name, Mark::Line(c.points.clone())).color(usize::from(!own)));
        }
        if !shown.is_empty() {
            let what = "Each line has the times of one scene at different ray steps, divided by the time of \
                        this scene at the reference step. G is the median over the scenes, made monotone.";
            s.charts.push((drawn, what.into()));
            s.summary = format!("{} curves", shown.len() - 1);
        }
    }
}
