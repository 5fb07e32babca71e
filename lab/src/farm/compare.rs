//! Comparison of methods of load balancing, judged by measured times.

use crate::bars::Bar;
use anyhow::{Context, Result};
use entire_farm::list::lower_bound;
use entire_farm::{By, Method, Task, plan, play, simulate_queue, times};
use entire_io::files::make_folder;
use entire_io::machine::Provenance;
use entire_io::metrics::median;
use entire_report::{Page, Table};
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use rand::seq::SliceRandom;
use std::path::Path;

/// Methods of the comparison: title, method, times by which the method plans.
const METHODS: [(&str, Method, By); 6] = [
    ("static longest first, measured", Method::Longest, By::Measured),
    ("static longest first, predicted", Method::Longest, By::Predicted),
    ("static longest first, equal times", Method::Longest, By::Uniform),
    ("queue, arrival order", Method::Arrival, By::Uniform),
    ("queue, predicted longest first", Method::Queue, By::Predicted),
    ("static with exchanges, predicted", Method::Static, By::Predicted),
];

/// Number of random orders over which the makespan of a queue is averaged.
const RANDOM_ORDERS: u64 = 200;

/// Mean makespan of a queue over [`RANDOM_ORDERS`] seeded random orders.
fn any_order(measured: &[f64], speeds: &[f64]) -> Result<f64> {
    let mut sum = 0.0;
    for seed in 0..RANDOM_ORDERS {
        let mut order: Vec<usize> = (0..measured.len()).collect();
        order.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
        sum += simulate_queue(&order, measured, &[], speeds)?.makespan;
    }
    Ok(sum / RANDOM_ORDERS as f64)
}

/// Compares every method for 2 to 64 nodes, writes a report into a folder, and returns the bars. `source`
/// states the origin of the tasks.
pub(crate) fn compare(tasks: &[Task], source: String, folder: &Path) -> Result<Vec<Bar>> {
    make_folder(folder)?;
    let measured = times(tasks, By::Measured).context("the comparison judges by measured times")?;
    // Indices: method, number of nodes minus 2.
    let mut makespans = vec![Vec::new(); METHODS.len()];
    let (mut bounds, mut random) = (Vec::new(), Vec::new());
    for nodes in 2..=64usize {
        let speeds = vec![1.0; nodes];
        bounds.push(lower_bound(&measured, &speeds)?);
        random.push(any_order(&measured, &speeds)?);
        for (k, (_, method, by)) in METHODS.into_iter().enumerate() {
            let line = play(&plan(method, &times(tasks, by)?, &speeds)?, &measured, tasks, &speeds)?;
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
    let rows = METHODS.iter().map(|c| c.0).zip(&makespans).chain([(any.as_str(), &random)]);
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
    page.heading("Where the numbers come from");
    let mut facts = vec![("Tasks", source)];
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_queue_in_any_order_ends_when_its_orders_do_on_average() {
        // Two nodes. The task of 2 s comes last in a third of the orders: the end is 3 s then, 2 s otherwise.
        let end = any_order(&[1.0, 1.0, 2.0], &[1.0; 2]).unwrap();
        assert!((end - 7.0 / 3.0).abs() < 0.1, "{end}");
        assert_eq!(end, any_order(&[1.0, 1.0, 2.0], &[1.0; 2]).unwrap());
        assert_eq!(any_order(&[1.0, 1.0], &[1.0; 2]).unwrap(), 1.0);
    }
}
