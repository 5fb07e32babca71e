//! Comparison of methods of load balancing, judged by measured times.

use super::bars::worst;
use crate::bars::Bar;
use crate::trace::Trace;
use anyhow::{Context, Result};
use entire_farm::list::lower_bound;
use entire_farm::{
    AffinityTask, By, Farm, Method, Task, plan, play, simulate_affinity, simulate_queue, times,
    volume_numbers,
};
use entire_io::files::make_folder;
use entire_io::machine::Provenance;
use entire_io::metrics::median;
use entire_report::{Axis, Chart, Mark, Page, Series, Table};
use entire_steer::schedule::{assign_longest_first, longest_first};
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use std::collections::HashMap;
use std::path::Path;

/// Returns the excess makespan that measurement noise alone causes: a second measurement serves as the
/// prediction.
///
/// For each repeat, tasks are assigned longest first, once by the medians of the other repeats and once by
/// this repeat. Both makespans are computed with the times of this repeat, and the first is divided by the
/// second. The largest of these ratios at 2 to 64 nodes is the result of the repeat. Returns the least and
/// the largest result over the repeats; `None` with fewer than two repeats.
///
/// # Errors
/// When a time is not finite and positive.
pub(crate) fn second_measurement(trace: &Trace) -> Result<Option<(f64, f64)>> {
    let repeats: Vec<&[f64]> =
        trace.frames.iter().filter_map(|f| f.first()).map(|p| &p.seconds[..]).collect();
    let count = repeats.iter().map(|r| r.len()).min().unwrap_or(0);
    let mut range: Option<(f64, f64)> = None;
    for judge in 0..if count < 2 { 0 } else { count } {
        let judged: Vec<f64> = repeats.iter().map(|r| r[judge]).collect();
        let others = |r: &[f64]| -> Option<f64> {
            let mut rest: Vec<f64> =
                r.iter().enumerate().filter(|(i, _)| *i != judge).map(|(_, t)| *t).collect();
            median(&mut rest)
        };
        let decided: Vec<f64> = repeats.iter().filter_map(|r| others(r)).collect();
        let (worst, _) = worst(&decided, &judged)?;
        range = Some(range.map_or((worst, worst), |(low, high)| (low.min(worst), high.max(worst))));
    }
    Ok(range)
}

/// Methods of the comparison: title, method, times that it plans by, color.
const COMPARED: [(&str, Method, By, usize); 6] = [
    ("static longest first, measured", Method::Longest, By::Measured, 2),
    ("static longest first, predicted", Method::Longest, By::Predicted, 0),
    ("static longest first, uniform", Method::Longest, By::Uniform, 5),
    ("queue, arrival order", Method::Arrival, By::Uniform, 1),
    ("queue, predicted longest first", Method::Queue, By::Predicted, 3),
    ("static with exchanges, predicted", Method::Static, By::Predicted, 4),
];

/// Number of queue entries among which a node searches for a task on its loaded volume.
const WINDOW: usize = 64;

/// Number of random orders over which the makespan of a queue is averaged.
const RANDOM_ORDERS: u64 = 200;

/// Mean makespan of a queue over [`RANDOM_ORDERS`] seeded random orders.
fn any_order(measured: &[f64], farm: &Farm) -> Result<f64> {
    let mut sum = 0.0;
    for seed in 0..RANDOM_ORDERS {
        let mut order: Vec<usize> = (0..measured.len()).collect();
        order.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
        sum += simulate_queue(&order, measured, &farm.speeds, farm.dispatch)?.makespan;
    }
    Ok(sum / RANDOM_ORDERS as f64)
}

/// Inputs of a comparison.
#[derive(Clone, Debug)]
pub(crate) struct Comparison<'a> {
    /// The tasks, with predicted and measured times.
    pub(crate) tasks: &'a [Task],
    /// Origin of the tasks, for the report.
    pub(crate) source: String,
    /// Result of [`second_measurement`].
    pub(crate) noise: Option<(f64, f64)>,
}

/// Compares every method for 2 to 64 nodes, writes a report into a folder, and returns the bars.
///
/// # Errors
/// When tasks lack a time, or the report cannot be written.
pub(crate) fn compare(comparison: &Comparison<'_>, folder: &Path) -> Result<Vec<Bar>> {
    let tasks = comparison.tasks;
    make_folder(folder)?;
    let measured = times(tasks, By::Measured).context("the comparison judges by measured times")?;
    let all: Vec<usize> = (2..=64).collect();
    // Indices: method, number of nodes minus 2.
    let mut makespans = vec![Vec::new(); COMPARED.len()];
    let mut loads: HashMap<(usize, usize), Vec<f64>> = HashMap::new();
    let (mut bounds, mut random) = (Vec::new(), Vec::new());
    for &nodes in &all {
        let farm = Farm { speeds: vec![1.0; nodes], dispatch: 0.0, window: WINDOW };
        bounds.push(lower_bound(&measured, &farm.speeds)?);
        random.push(any_order(&measured, &farm)?);
        for (k, &(_, method, by, _)) in COMPARED.iter().enumerate() {
            let line = play(&plan(method, &times(tasks, by)?, &farm.speeds)?, &measured, tasks, &farm)?;
            let mut load = vec![0.0; nodes];
            for s in &line.spans {
                load[s.node] += s.end - s.start;
            }
            load.sort_by(f64::total_cmp);
            loads.insert((k, nodes), load);
            makespans[k].push(line.makespan);
        }
    }
    let shown = [2usize, 4, 8, 16, 32, 64];
    let at = |nodes: usize| nodes - 2;
    let mut errors: Vec<f64> = tasks
        .iter()
        .filter_map(|t| Some((t.predicted_s? / t.measured_s.filter(|m| *m > 0.0)? - 1.0).abs()))
        .collect();
    let middle = median(&mut errors).unwrap_or(f64::NAN);
    let mut page = Page::new(
        "Balancing a render farm",
        &format!(
            "{} tasks on 2 to 64 nodes, judged by measured times ({:.1} s in all); median error of the \
             predictions {:.1} %.",
            tasks.len(),
            measured.iter().sum::<f64>(),
            100.0 * middle
        ),
    );
    let columns: String = shown.iter().map(|n| format!(" | #N = {n}")).collect();
    let mut table = Table::headed(&format!("method{columns}"));
    let any = format!("queue, any order (mean of {RANDOM_ORDERS})");
    let rows = COMPARED.iter().map(|c| c.0).zip(&makespans).chain([(any.as_str(), &random)]);
    for (title, ends) in rows {
        let mut row = vec![title.into()];
        row.extend(shown.iter().map(|&n| format!("{:.3}", ends[at(n)] / bounds[at(n)]).into()));
        table.row(row);
    }
    page.table(
        &table,
        "Time until the last node is done, divided by its lower bound (from the mean work per node and \
         from the longest tasks).",
    );
    println!("{}", table.to_text());
    let mut chart = Chart::new(
        "Node loads",
        Axis::categories("nodes", shown.iter().map(ToString::to_string).collect()),
        Axis::linear("node's time / longest node's time with measured times, longest first"),
    )
    .size(900.0, 400.0);
    for (k, (title, _, _, hue)) in COMPARED.iter().enumerate() {
        let boxes = shown
            .iter()
            .enumerate()
            .map(|(slot, &n)| {
                let unit = makespans[0][at(n)];
                let load = &loads[&(k, n)];
                let q = |p: f64| load[((p * (n - 1) as f64).round() as usize).min(n - 1)] / unit;
                let place = slot as f64;
                (place, [q(0.05), q(0.25), q(0.5), q(0.75), q(0.95)])
            })
            .collect();
        chart = chart.series(Series::new(*title, Mark::Boxes(boxes)).color(*hue));
    }
    page.chart(
        &chart,
        "Distribution of node loads per method, relative to the longest load of static balancing by measured \
         times. 5th, 25th, 50th, 75th and 95th percentile.",
    );
    let mut chart = Chart::new(
        "Longest load",
        Axis::log("nodes"),
        Axis::linear("longest load / longest first, measured"),
    )
    .size(900.0, 360.0);
    for (k, (title, _, _, hue)) in COMPARED.iter().enumerate() {
        let line = all.iter().map(|&n| (n as f64, makespans[k][at(n)] / makespans[0][at(n)])).collect();
        chart = chart.series(Series::new(*title, Mark::Line(line)).color(*hue));
    }
    let bound = all.iter().map(|&n| (n as f64, bounds[at(n)] / makespans[0][at(n)])).collect();
    chart = chart.series(Series::new("lower bound", Mark::Line(bound)).color(6));
    let line = all.iter().map(|&n| (n as f64, random[at(n)] / makespans[0][at(n)])).collect();
    chart = chart.series(Series::new(any, Mark::Line(line)).color(7));
    page.chart(
        &chart,
        "Longest load, which is the end of the job, relative to static balancing by measured \
                        times.",
    );
    if let Some((low, high)) = comparison.noise {
        let text = format!(
            "Effect of noise: tasks are assigned longest first, once by the medians of all repeats but one and once by \
             the remaining repeat. By the times of this repeat, the first assignment takes at most {low:.3} to \
             {high:.3} times as long as the second."
        );
        println!("{text}");
        page.paragraph(&text);
    }
    mixed(tasks, &measured, &mut page)?;
    page.heading("Where this comes from");
    let mut facts = vec![("Tasks", comparison.source.clone())];
    facts.extend(Provenance::of("scheduled, not rendered".into()).facts());
    page.facts(facts);
    page.write(&folder.join("report.html"))?;
    println!("report     {}", folder.join("report.html").display());
    let worst =
        |a: usize, b: usize| makespans[a].iter().zip(&makespans[b]).map(|(x, y)| x / y).fold(0.0, f64::max);
    Ok(vec![
        Bar::at_most("farm-queue-of-bound-16", Some(makespans[4][at(16)] / bounds[at(16)]), 1.02),
        Bar::at_most("farm-queue-of-bound-64", Some(makespans[4][at(64)] / bounds[at(64)]), 1.04),
        Bar::at_most("farm-queue-of-arrival-worst", Some(worst(4, 3)), 1.0),
        Bar::at_most("farm-static-predicted-of-measured-worst", Some(worst(1, 0)), 1.04),
    ])
}

/// Adds a table of further cases to the page: nodes of different speeds, and volumes that take time to load.
fn mixed(tasks: &[Task], measured: &[f64], page: &mut Page) -> Result<()> {
    page.heading("Unequal nodes, and volumes that must be loaded");
    let mut table = Table::headed(
        "case | #static, predicted | #queue, arrival | #queue, predicted longest first | \
         #the same, loaded volume first",
    );
    let mean = measured.iter().sum::<f64>() / measured.len() as f64;
    for nodes in [8usize, 16, 32] {
        for (name, speeds, load) in [
            ("equal nodes, no loading", vec![1.0; nodes], 0.0),
            ("speeds 0.5, 1, 1, 2", (0..nodes).map(|i| [0.5, 1.0, 1.0, 2.0][i % 4]).collect(), 0.0),
            ("loading a volume takes 4 mean frames", vec![1.0; nodes], 4.0 * mean),
        ] {
            let loaded: Vec<Task> = tasks.iter().map(|t| Task { load_s: load, ..t.clone() }).collect();
            let predicted = times(&loaded, By::Predicted)?;
            let volumes = volume_numbers(&loaded);
            let with_loads: Vec<AffinityTask> = (0..loaded.len())
                .map(|i| AffinityTask { volume: volumes[i], seconds: measured[i], load })
                .collect();
            let bound = lower_bound(measured, &speeds)?;
            let assigned = assign_longest_first(&predicted, &speeds)?;
            // Each node renders its tasks volume by volume, so that it loads each of its volumes once.
            let mut held = vec![std::collections::BTreeSet::new(); nodes];
            let mut ends = vec![0.0f64; nodes];
            for (task, &node) in assigned.node_of.iter().enumerate() {
                ends[node] += measured[task] / speeds[node];
                if held[node].insert(volumes[task]) {
                    ends[node] += load;
                }
            }
            let fixed = ends.into_iter().fold(0.0, f64::max);
            let arrival: Vec<usize> = (0..loaded.len()).collect();
            let longest = longest_first(&predicted)?;
            let row = [
                fixed,
                simulate_affinity(&arrival, &with_loads, &speeds, 1, 0.0)?.makespan,
                simulate_affinity(&longest, &with_loads, &speeds, 1, 0.0)?.makespan,
                simulate_affinity(&longest, &with_loads, &speeds, WINDOW, 0.0)?.makespan,
            ];
            let mut cells = vec![format!("{nodes} nodes, {name}").into()];
            cells.extend(row.iter().map(|m| format!("{:.3}", m / bound).into()));
            table.row(cells);
        }
    }
    page.table(&table, "Time until the last node is done, divided by the lower bound without loading.");
    println!("{}", table.to_text());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_queue_in_any_order_ends_when_its_orders_do_on_average() {
        // Two nodes. The task of 2 s comes last in a third of the orders: the end is 3 s then, 2 s otherwise.
        let farm = Farm { speeds: vec![1.0; 2], dispatch: 0.0, window: 1 };
        let end = any_order(&[1.0, 1.0, 2.0], &farm).unwrap();
        assert!((end - 7.0 / 3.0).abs() < 0.1, "{end}");
        assert_eq!(end, any_order(&[1.0, 1.0, 2.0], &farm).unwrap());
        assert_eq!(any_order(&[1.0, 1.0], &farm).unwrap(), 1.0);
    }
}
