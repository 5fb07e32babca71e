//! The paper's use case 2: load balancing of a farm by predicted times.

use super::Work;
use super::description::{Orbit, Panel};
use super::improved::DISTILLED;
use super::judge::{NETWORK, OURS};
use super::results::{Fact, MEASURED, ORBIT_CHART, Results, percentiles, read_all, write};
use super::trials::steering_network;
use crate::trace::{Curve, Trace};
use anyhow::{Context, Result};
use entire_farm::Task;
use entire_farm::list::assign_longest_first;
use entire_io::dataset::{Scene, Table, TimedFrame};
use entire_io::files::{fnv1a_text, make_folder_of, open_model, write_whole};
use entire_train::fit::{FitContext, predict};
use indicatif::ProgressBar;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

pub(crate) const NODES: [usize; 6] = [2, 4, 8, 16, 32, 64];
/// Name of the assignment by equal times, as without any prediction.
const UNIFORM: &str = "uniform";
/// Name of the assignment by measured times.
const GROUND_TRUTH: &str = "GT";
/// Name that results on the tasks of a recorded path have instead of a data set's name.
pub(super) const RECORDED: &str = "recorded";

/// Total time of the slowest node when tasks are assigned by a predictor's times, divided by the total time
/// of the slowest node when they are assigned by measured times; the largest such ratio over all numbers of
/// nodes.
pub(super) fn slowest_node(all: &[Results], predictor: &str) -> Option<f64> {
    let facts = all.iter().filter(|r| r.panel == Panel::Balancing).flat_map(|r| &r.facts);
    facts.filter(|f| f.name == predictor).filter_map(|f| f.values.get("slowest")).copied().reduce(f64::max)
}

/// Path of the list of the orbit's tasks, which `entire-lab farm` reads.
pub(crate) fn tasks_path(out: &Path, set: &str, mode: &str) -> PathBuf {
    out.join("cases").join(format!("tasks-{set}-{mode}.csv"))
}

/// Assigns tasks to nodes, longest first, by measured, predicted and equal times. Returns the percentiles and
/// the maximum of the nodes' total times, divided by the total time of the slowest node in the assignment by
/// measured times.
fn loads(measured: &[f64], predicted: &[(&str, &[f64])]) -> Result<Vec<Fact>> {
    let mut out = Vec::new();
    let uniform = vec![1.0; measured.len()];
    let ends = [(GROUND_TRUTH, measured), (UNIFORM, &uniform[..])];
    let all = [&ends[..1], predicted, &ends[1..]].concat();
    for nodes in NODES.into_iter().filter(|n| *n <= measured.len()) {
        let mut slowest = 0.0;
        for &(name, deciding) in &all {
            // A prediction that is not positive counts as 1 µs.
            let deciding: Vec<f64> = deciding.iter().map(|t| t.max(1e-6)).collect();
            let assignment = assign_longest_first(&deciding, &vec![1.0; nodes])?;
            let mut loads = vec![0.0; nodes];
            for (node, seconds) in assignment.node_of.iter().zip(measured) {
                loads[*node] += *seconds;
            }
            loads.sort_by(f64::total_cmp);
            let most = loads.last().copied().unwrap_or(0.0);
            if name == GROUND_TRUTH {
                slowest = most;
            }
            loads.iter_mut().for_each(|l| *l /= slowest);
            let mut values =
                BTreeMap::from([("nodes".to_owned(), nodes as f64), ("slowest".to_owned(), most / slowest)]);
            values.extend(percentiles(&loads));
            out.push(Fact { name: name.into(), values });
        }
    }
    Ok(out)
}

/// Assigns the frames of a recorded path as tasks, by the times that the paper's network predicts, unchanged
/// and distilled. Does nothing if the description or the files lack these networks.
pub(crate) fn balance_recorded(work: &Work<'_>, recorded: &Path) -> Result<()> {
    let trace = Trace::open(recorded)?;
    let mode = &trace.draw.shading.to_string();
    let Some(tables) = work.paper.trials.tables.iter().find(|t| t.mode == *mode) else { return Ok(()) };
    let Some(network) = steering_network(work, mode)? else { return Ok(()) };
    let (path, draw) = (trace.path.resolve()?, &trace.draw);
    let mut frames = Vec::new();
    let mut measured = Vec::new();
    let dims = trace.volumes.iter().map(|v| Ok(v.open()?.dims().map(|n| n as u32)));
    let dims: Vec<[u32; 3]> = dims.collect::<Result<_>>()?;
    for (index, at) in path.frames.iter().enumerate() {
        let volume = trace.volume_at(index);
        let frame = trace.frame(&path, index)?;
        let scene = Scene {
            volume: trace.volumes[volume].file.display().to_string(),
            member: String::new(),
            time_step: None,
            dims: dims[volume],
            camera: at.camera,
            fov_y_degrees: path.fov_y_degrees,
            width: frame.width,
            height: frame.height,
            step: frame.step,
            shading: draw.shading,
            skipping: draw.skipping,
            termination: draw.termination,
            lobes: at.transfer.lobes().context("the path's transfer function has no lobes")?,
        };
        measured.push(Curve::of(&trace.frames[index]).seconds(1.0));
        frames.push(TimedFrame { table: 0, number: index as u64, scene, repeats: Vec::new() });
    }
    let all =
        [Table { path: recorded.to_owned(), manifest: None, frames, hash: 0, features: None, root: None }];
    let (hidden, stop) = (ProgressBar::hidden(), || work.stop());
    let context = FitContext { tables: &all, pool: work.pool, bar: &hidden, stop: &stop };
    let tasks: Vec<&TimedFrame> = all[0].frames.iter().collect();
    let by = |path: &Path| predict(&open_model(path)?, &context, &tasks);
    let (network, distilled) = (by(&network)?, by(&tables.distilled)?);
    let mark = fnv1a_text(serde_json::to_string(&(&measured, &network, &distilled))?.as_bytes());
    let mut results = Results::new(Panel::Balancing, RECORDED, mode, mark);
    results.device = trace.provenance["device"].as_str().unwrap_or_default().to_owned();
    results.machine = trace.provenance["machine"].as_str().unwrap_or_default().to_owned();
    results.frames.insert("tasks".into(), [0, 0, measured.len()]);
    results.facts = loads(&measured, &[(NETWORK, &network[..]), (DISTILLED, &distilled[..])])?;
    write(work.out, &results)
}

/// Assigns the orbit's tasks to nodes, and stores percentiles of the nodes' total times. Writes the task
/// list.
pub(crate) fn balance(out: &Path, orbit: &Orbit) -> Result<()> {
    let all = read_all(out, Vec::new())?;
    for from in all.iter().filter(|r| r.panel == Panel::Varied) {
        let times = |name: &str| -> Option<Vec<f64>> {
            let curve = from.curves.iter().find(|c| c.chart == ORBIT_CHART && c.name == name)?;
            Some(curve.points.iter().map(|p| p.1).collect())
        };
        let (Some(measured), Some(network), Some(ours)) = (times(MEASURED), times(NETWORK), times(OURS))
        else {
            continue;
        };
        if measured.is_empty() {
            continue;
        }
        let text = serde_json::to_string(&(&measured, &network, &ours))?;
        let mark = fnv1a_text(text.as_bytes());
        let mut results = Results::new(Panel::Balancing, &from.set, &from.mode, mark);
        (results.device, results.machine) = (from.device.clone(), from.machine.clone());
        results.encoder.clone_from(&from.encoder);
        results.frames.insert("tasks".into(), [0, 0, measured.len()]);
        results.facts = loads(&measured, &[(NETWORK, &network[..]), (OURS, &ours[..])])?;
        write(out, &results)?;
        let mut csv = csv::Writer::from_writer(Vec::new());
        for (i, (t, p)) in measured.iter().zip(&network).enumerate() {
            csv.serialize(Task {
                task: i.to_string(),
                predicted_s: Some(p.max(1e-6)),
                measured_s: Some(*t),
                volume: (i / orbit.poses.max(1)).to_string(),
                load_s: 0.0,
            })?;
        }
        let path = tasks_path(out, &from.set, &from.mode);
        make_folder_of(&path)?;
        write_whole(&path, &csv.into_inner()?)?;
    }
    Ok(())
}
