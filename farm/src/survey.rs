//! Forecast of a job before it runs: end, node hours and price for several numbers of nodes, and the smallest
//! number of nodes that meets a deadline.

use super::job::Job;
use super::planner::{Planner, Setting, State};
use super::show::duration;
use entire_report::Table;

/// Maximum number of nodes that is considered.
const MAX_NODES: usize = 4096;

/// A number of nodes, with the job's end and its node hours on these nodes.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Offer {
    nodes: usize,
    /// Quantiles 0.05, 0.5 and 0.95 of the end, seconds.
    end: [f64; 3],
    /// Node hours up to the median end.
    node_hours: f64,
}

/// Returns the forecast for a number of nodes. `plan` returns a plan for a number of nodes.
fn offer(plan: &dyn Fn(usize) -> Planner, nodes: usize) -> Offer {
    let end = plan(nodes).eta(0.0);
    Offer { nodes, end, node_hours: nodes as f64 * end[1] / 3600.0 }
}

/// Returns the smallest number of nodes that meets a deadline in 95 of 100 cases; `None` if no number is
/// enough. The search assumes that more nodes never end later.
fn cheapest(plan: &dyn Fn(usize) -> Planner, tasks: usize, deadline: f64) -> Option<Offer> {
    let (mut low, mut high) = (1, MAX_NODES.min(tasks.max(1)));
    let enough = |o: &Offer| o.end[2] <= deadline;
    let mut best = offer(plan, high);
    if !enough(&best) {
        return None;
    }
    while low < high {
        let middle = low.midpoint(high);
        let found = offer(plan, middle);
        if enough(&found) {
            (high, best) = (middle, found);
        } else {
            low = middle + 1;
        }
    }
    Some(best)
}

/// Returns the text that a dry run prints. `deadline`: in seconds; `price`: price of a node hour.
pub fn text(
    job: &Job,
    plan: &dyn Fn(usize) -> Planner,
    setting: Setting,
    deadline: Option<f64>,
    price: Option<f64>,
) -> String {
    let planner = &plan(setting.slots);
    let (done, all) = planner.progress();
    let tasks = |state: State| (0..job.len() as u32).filter(move |t| planner.state(*t) == state);
    let work: f64 = tasks(State::Waits).map(|t| planner.expected(t)).sum();
    let given_up = match tasks(State::Quarantined).count() {
        0 => String::new(),
        n => format!(", {n} given up"),
    };
    let [volumes, views, transfers, sizes, steps] = job.dims();
    let mut out = format!(
        "{} tasks: {volumes} volumes x {views} views x {transfers} transfer functions x {sizes} sizes x \
         {steps} steps; {done} of {all} done{given_up}\n",
        job.len()
    );
    let bytes: u64 = job.volumes.iter().map(|v| v.bytes).sum();
    out += &format!(
        "expected times are from {}; the work takes {} on one node; the files of all volumes have {:.1} MB\n",
        super::predict::source(job),
        duration(work),
        bytes as f64 / 1e6
    );
    if planner.learner().observed() == 0 && job.predict.model.is_none() && job.predict.list.is_none() {
        out += "no task has been measured, so the times below are rough. For better ones, let the job run \
                for a moment, end it with Ctrl-C, and repeat the dry run\n";
    }
    let priced = if price.is_some() { " | #price" } else { "" };
    let mut table = Table::headed(&format!("#nodes | done after | 90 % interval | #node hours{priced}"));
    let mut counts: Vec<usize> = (0..8).map(|k| 1usize << k).filter(|n| *n <= all.max(1)).collect();
    counts.push(setting.slots);
    counts.sort_unstable();
    counts.dedup();
    for nodes in counts {
        let Offer { end, node_hours, .. } = offer(plan, nodes);
        let mut cells = vec![
            nodes.to_string().into(),
            duration(end[1]).into(),
            format!("{} to {}", duration(end[0]), duration(end[2])).into(),
            format!("{node_hours:.2}").into(),
        ];
        cells.extend(price.map(|price| format!("{:.2}", node_hours * price).into()));
        table.row(cells);
    }
    out += &table.to_text();
    if let Some(deadline) = deadline {
        match cheapest(plan, all - done, deadline) {
            Some(o) => {
                let money = price.map_or(String::new(), |p| format!(", price {:.2}", o.node_hours * p));
                out += &format!(
                    "fewest nodes that meet the deadline of {}: {} nodes, done after {} (95 % quantile {}), \
                     {:.2} node hours{money}\n",
                    duration(deadline),
                    o.nodes,
                    duration(o.end[1]),
                    duration(o.end[2]),
                    o.node_hours
                );
            }
            None => {
                out += &format!(
                    "even with {} nodes, the job does not end within {} (95 % quantile); the longest task, \
                     with the loading of its volume, may take longer than the deadline\n",
                    MAX_NODES.min(all - done),
                    duration(deadline)
                );
            }
        }
    }
    out
}
