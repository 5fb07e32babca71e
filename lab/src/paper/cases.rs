//! The two use cases: how a farm is balanced by predicted times, and how a frame time is held.

use super::description::{Orbit, Panel};
use super::judge::{NETWORK, OURS};
use super::results::{Curve, Fact, MEASURED, ORBIT_CHART, Results, read_all, write};
use crate::calibration::samples_of;
use anyhow::{Context, Result};
use entire_cli::farm::{Method, Plan, Task, plan};
use entire_cli::files::{fnv1a, make_folder_of, read_text, write_whole};
use entire_cli::metrics::percentile;
use entire_cli::steering::calibrate::response;
use entire_core::features::PROBE_SIDE;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Numbers of nodes.
pub const NODES: [usize; 6] = [2, 4, 8, 16, 32, 64];
/// Tasks of unknown times are assigned by an equal one.
const UNIFORM: &str = "uniform";
/// Tasks are assigned by what they take.
const GROUND_TRUTH: &str = "GT";

/// Where the tasks of the orbit are written down for `entire-lab farm`.
pub fn tasks_path(out: &Path, set: &str, mode: &str) -> PathBuf {
    out.join("cases").join(format!("tasks-{set}-{mode}.csv"))
}

/// Static assignments of the orbit's tasks, longest first, by measured, predicted and equal times: the loads of
/// the nodes over that of the slowest node by measured times. Also writes the tasks down.
///
/// # Errors
/// When results cannot be read or written.
pub fn balance(out: &Path, orbit: &Orbit) -> Result<()> {
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
        let mark = format!("{:016x}", fnv1a(text.as_bytes()));
        let mut results = Results::new(Panel::Balancing, &from.set, &from.mode, mark);
        (results.device, results.machine) = (from.device.clone(), from.machine.clone());
        results.encoder.clone_from(&from.encoder);
        results.frames.insert("tasks".into(), [0, 0, measured.len()]);
        let uniform = vec![1.0; measured.len()];
        for nodes in NODES.into_iter().filter(|n| *n <= measured.len()) {
            let mut slowest = 0.0;
            for (name, deciding) in
                [(GROUND_TRUTH, &measured), (NETWORK, &network), (OURS, &ours), (UNIFORM, &uniform)]
            {
                // A prediction that is not positive counts as very short.
                let deciding: Vec<f64> = deciding.iter().map(|t| t.max(1e-6)).collect();
                let Plan::Assigned(assignment, _) = plan(Method::Longest, &deciding, &vec![1.0; nodes])?
                else {
                    continue;
                };
                let mut loads = vec![0.0; nodes];
                for (task, node) in assignment.node_of.iter().enumerate() {
                    loads[*node] += measured[task];
                }
                loads.sort_by(f64::total_cmp);
                let most = loads.last().copied().unwrap_or(0.0);
                if name == GROUND_TRUTH {
                    slowest = most;
                }
                loads.iter_mut().for_each(|l| *l /= slowest);
                let mut values = BTreeMap::from([
                    ("nodes".to_owned(), nodes as f64),
                    ("slowest".to_owned(), most / slowest),
                ]);
                for (key, q) in [("p5", 0.05), ("p25", 0.25), ("p50", 0.5), ("p75", 0.75), ("p95", 0.95)] {
                    values.insert(key.into(), percentile(&loads, q));
                }
                results.facts.push(Fact { name: name.into(), values });
            }
        }
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

/// Takes what `entire-lab replay` wrote into `folder`, and the curves behind G from its calibration table.
///
/// # Errors
/// When a file cannot be read or written.
pub fn steering(out: &Path, folder: &Path, calibration: &Path, (set, mode): (&str, &str)) -> Result<()> {
    let path = folder.join("scores.json");
    let text = read_text(&path, 256 << 20)?;
    let found: serde_json::Value =
        serde_json::from_str(&text).with_context(|| format!("{} holds no scores", path.display()))?;
    let mark = format!("{:016x}", fnv1a(text.as_bytes()));
    let mut results = Results::new(Panel::Steering, set, mode, mark);
    let traces = found["traces"].as_array().cloned().unwrap_or_default();
    let provenance = traces.first().map(|t| t["provenance"].clone()).unwrap_or_default();
    results.device = provenance["device"].as_str().unwrap_or_default().to_owned();
    results.machine = provenance["machine"].as_str().unwrap_or_default().to_owned();
    for (controller, score) in found["controllers"].as_object().into_iter().flatten() {
        let values = score
            .as_object()
            .into_iter()
            .flatten()
            .flat_map(|(k, v)| match v.as_object() {
                Some(inner) => inner.iter().map(|(i, v)| (format!("{k} {i}"), v.as_f64())).collect(),
                None => vec![(k.clone(), v.as_f64())],
            })
            .filter_map(|(k, v)| Some((k, v?)))
            .collect();
        results.facts.push(Fact { name: controller.clone(), values });
    }
    let samples = samples_of(&[calibration.to_owned()], PROBE_SIDE)?;
    let g = response(&samples).context("G needs scenes that were timed at several steps")?;
    let mut by_scene: BTreeMap<usize, Vec<(f64, f64)>> = BTreeMap::new();
    for s in &samples {
        by_scene.entry(s.scene).or_default().push((f64::from(s.setting.step), s.seconds));
    }
    let mut steps: Vec<f64> = samples.iter().map(|s| f64::from(s.setting.step)).collect();
    steps.sort_by(f64::total_cmp);
    steps.dedup();
    for (scene, mut points) in by_scene {
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        let Some(reference) = points.iter().find(|p| p.0 == 1.0).map(|p| p.1) else { continue };
        points.iter_mut().for_each(|p| p.1 /= reference);
        let name = format!("scene {scene}");
        results.curves.push(Curve { chart: "G".into(), name, x: "ray step, reference steps".into(), points });
    }
    results.curves.push(Curve {
        chart: "G".into(),
        name: "G".into(),
        x: "ray step, reference steps".into(),
        points: steps.iter().map(|s| (*s, f64::from(g.time_ratio(*s as f32)))).collect(),
    });
    write(out, &results)
}
