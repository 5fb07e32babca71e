//! The report of a farm, from its journal: Gantt chart by node, predicted against measured times, the
//! expected end over time, time saved by the order of tasks.

use super::job::Job;
use super::planner::queue_end;
use super::record::{Answer, Entry, parse_id};
use super::show::duration;
use crate::list::lower_bound;
use anyhow::{Result, ensure};
use entire_io::machine::Provenance;
use entire_report::{Axis, Chart, Mark, Page, Rule, Series, Table};
use std::collections::{BTreeMap, HashMap, HashSet};
use std::path::Path;

/// Maximum number of lanes of the Gantt chart.
const LANES: usize = 48;
/// Maximum number of points of the chart of predictions.
const POINTS: usize = 3000;

struct Run {
    at: f64,
    engine: String,
    slots: usize,
    done: Vec<Answer>,
    etas: Vec<(f64, f64, [f64; 3])>,
}

/// Writes the report of a job's database.
///
/// # Errors
/// When no task is finished yet, or a file cannot be read or written.
pub fn write(job: &Job, file: &Path) -> Result<()> {
    let mut runs: Vec<Run> = Vec::new();
    let run = |at, engine, slots| Run { at, engine, slots, done: Vec::new(), etas: Vec::new() };
    let (mut failed, mut lost) = (0, 0);
    let mut quarantined: BTreeMap<String, (String, String)> = BTreeMap::new();
    for entry in super::journal::entries(&job.state())? {
        match entry {
            Entry::Run { at, engine, slots, .. } => runs.push(run(at, engine, slots)),
            Entry::Done { answer, .. } => {
                quarantined.remove(&answer.task);
                // Images that another farm rendered may precede the first run of this one.
                if runs.is_empty() {
                    runs.push(run(answer.begin, "another farm".into(), 1));
                }
                if let Some(run) = runs.last_mut() {
                    run.done.push(answer);
                }
            }
            Entry::Inputs { .. } => {}
            Entry::Failed { .. } => failed += 1,
            Entry::Lost { .. } => lost += 1,
            Entry::Quarantined { task, error, log } => {
                quarantined.insert(task, (error, log));
            }
            Entry::Eta { at, share, ends } => {
                if let Some(run) = runs.last_mut() {
                    run.etas.push((at, share, ends));
                }
            }
        }
    }
    let all: Vec<&Answer> = runs.iter().flat_map(|r| &r.done).collect();
    ensure!(!all.is_empty(), "{} holds no image yet; render some first", job.output.display());
    let mut wanted: HashSet<u64> = job.numbers().into_keys().collect();
    // The journal also lists tasks of earlier job files and of earlier contents of volume files.
    quarantined.retain(|task, _| parse_id(task).is_some_and(|id| wanted.contains(&id)));
    let images = all.iter().filter(|a| parse_id(&a.task).is_some_and(|id| wanted.remove(&id))).count();
    let work: f64 = all.iter().map(|a| a.seconds + a.load_s).sum();
    let mut page = Page::new(
        format!("Farm: {}", job.name),
        &format!(
            "{images} of {} images are done. All runs together rendered {} images in {} of node time. \
             {failed} attempts failed, {lost} tasks were lost with their workers, {} tasks are quarantined.",
            job.len(),
            all.len(),
            duration(work),
            quarantined.len()
        ),
    );
    let last = runs.iter().rposition(|r| !r.done.is_empty()).unwrap_or(0);
    gantt(&mut page, &runs[last], last + 1, runs.len());
    accuracy(&mut page, &all);
    ends(&mut page, &runs[last]);
    gains(&mut page, &runs[last])?;
    slowest(&mut page, job, &all);
    if !quarantined.is_empty() {
        page.heading("Quarantined tasks");
        let mut table = Table::headed("task | error | log");
        for (task, (error, log)) in &quarantined {
            table.row(vec![task.as_str().into(), error.as_str().into(), log.as_str().into()]);
        }
        page.table(&table, "Tasks that were given up. --resume --retry-quarantined tries them again.");
    }
    page.heading("Where the numbers come from");
    let mut facts = vec![
        ("Database", job.output.display().to_string()),
        ("Expected times", super::predict::source(job)),
        ("Engine", format!("{}, {} slots", runs[last].engine, runs[last].slots)),
    ];
    // The renderer is shown as JSON, whose keys are those of the job file.
    facts.extend(Provenance::of(serde_json::to_string(&job.renderer)?).facts());
    page.facts(facts);
    page.write(file)
}

/// Assigns each task to a lane of the Gantt chart: the first lane of its node that is free when the task
/// begins. Returns the lane of each task, and the names of the lanes. A lane has the name of its node; a dot
/// is added except for the node's first lane.
fn lanes(done: &[Answer]) -> (Vec<usize>, Vec<String>) {
    let mut order: Vec<usize> = (0..done.len()).collect();
    order.sort_by(|a, b| done[*a].begin.total_cmp(&done[*b].begin));
    let mut free: BTreeMap<&str, Vec<(usize, f64)>> = BTreeMap::new();
    let mut names = Vec::new();
    let mut out = vec![0; done.len()];
    for i in order {
        let answer = &done[i];
        let node = free.entry(&answer.node).or_default();
        let at = node.iter().position(|(_, end)| *end <= answer.begin + 1e-3).unwrap_or_else(|| {
            names.push(format!("{}{}", answer.node, ".".repeat(usize::from(!node.is_empty()))));
            node.push((names.len() - 1, 0.0));
            node.len() - 1
        });
        node[at].1 = answer.end;
        out[i] = node[at].0;
    }
    (out, names)
}

fn gantt(page: &mut Page, run: &Run, number: usize, of: usize) {
    page.heading("Nodes");
    let (lane, names) = lanes(&run.done);
    let mut order: Vec<usize> = (0..names.len()).collect();
    order.sort_by(|a, b| names[*a].cmp(&names[*b]));
    let shown = names.len().min(LANES);
    let mut place = vec![usize::MAX; names.len()];
    for (row, lane) in order.iter().take(shown).enumerate() {
        place[*lane] = row;
    }
    let (mut loads, mut frames) = (Vec::new(), Vec::new());
    for (i, a) in run.done.iter().enumerate() {
        let row = place[lane[i]];
        if row == usize::MAX {
            continue;
        }
        let (from, to) = (a.begin - run.at, a.end - run.at);
        if a.load_s > 0.0 {
            loads.push((from, from + a.load_s, row as f64));
        }
        frames.push((from + a.load_s, to, row as f64));
    }
    let labels = order.iter().take(shown).map(|l| names[*l].clone()).collect();
    let chart = Chart::new("", Axis::linear("seconds since the run began"), Axis::categories("", labels))
        .size(900.0, 90.0 + 22.0 * shown as f64)
        .series(Series::new("rendering", Mark::Stretches(frames)).color(0))
        .series(Series::new("loading", Mark::Stretches(loads)).color(1));
    let text = format!(
        "Tasks of each node in run {number} of {of}. A node that renders several tasks at once has several \
         rows; {shown} of {} rows are shown.",
        names.len()
    );
    page.chart(&chart, &text);
}

fn accuracy(page: &mut Page, all: &[&Answer]) {
    page.heading("Predicted against measured");
    let stride = all.len().div_ceil(POINTS).max(1);
    let points = all.iter().step_by(stride).map(|a| (a.predicted_s, a.seconds, String::new())).collect();
    let chart = Chart::new("", Axis::log("predicted / s"), Axis::log("measured / s"))
        .series(Series::new("", Mark::Points(points)))
        .rule(Rule::Diagonal("equal".into()));
    let mut errors: Vec<f64> = all.iter().map(|a| (a.predicted_s / a.seconds - 1.0).abs()).collect();
    let middle = entire_io::metrics::median(&mut errors).unwrap_or(f64::NAN);
    let text = format!(
        "Seconds that were expected when a task was sent, and the task's measured seconds without loading. Median \
         error {:.1} %.",
        100.0 * middle
    );
    page.chart(&chart, &text);
}

fn ends(page: &mut Page, run: &Run) {
    let Some(end) = run.done.iter().map(|a| a.end - run.at).reduce(f64::max) else { return };
    let known: Vec<&(f64, f64, [f64; 3])> =
        run.etas.iter().filter(|e| e.2.iter().all(|v| v.is_finite())).collect();
    if known.len() < 2 {
        return;
    }
    page.heading("The expected end over time");
    let band = known.iter().map(|(at, _, e)| (at - run.at, e[0] - run.at, e[2] - run.at)).collect();
    let line = known.iter().map(|(at, _, e)| (at - run.at, e[1] - run.at)).collect();
    let axis = Axis::linear("predicted end / s").from(0.0).to(2.0 * end);
    let chart = Chart::new("", Axis::linear("seconds since the run began"), axis)
        .series(Series::new("90 % interval", Mark::Band(band)).color(0))
        .series(Series::new("expected end", Mark::Line(line)).color(0))
        .rule(Rule::Horizontal(end, "the end".into()));
    page.chart(&chart, "The predicted end and the actual end, both in seconds since the run began.");
}

fn gains(page: &mut Page, run: &Run) -> Result<()> {
    page.heading("Time saved by the order of tasks");
    let mut tasks: Vec<&Answer> = run.done.iter().collect();
    tasks.sort_by(|a, b| a.task.cmp(&b.task));
    let slots = run.slots.max(1);
    let speeds = vec![1.0; slots];
    let busy = vec![0.0; slots];
    let seconds: Vec<f64> = tasks.iter().map(|a| a.seconds).collect();
    let replay =
        |order: &[usize]| queue_end(&order.iter().map(|i| seconds[*i]).collect::<Vec<_>>(), &busy, &speeds);
    let mut order: Vec<usize> = (0..tasks.len()).collect();
    // Without predictions no order is better than another, so `any` is the mean of 32 random orders.
    let any: f64 = (0..32u64)
        .map(|seed| {
            let mut order = order.clone();
            order.sort_by_key(|i| entire_io::files::fnv1a(&[seed.to_le_bytes(), i.to_le_bytes()].concat()));
            replay(&order)
        })
        .sum::<f64>()
        / 32.0;
    order.sort_by(|a, b| tasks[*b].predicted_s.total_cmp(&tasks[*a].predicted_s));
    let longest = replay(&order);
    let mut share = vec![0.0; slots];
    for (i, s) in seconds.iter().enumerate() {
        share[i % slots] += s;
    }
    let dealt = share.into_iter().fold(0.0, f64::max);
    let bound = lower_bound(&seconds, &speeds)?;
    let took = run.done.iter().map(|a| a.end - run.at).fold(0.0, f64::max);
    let mut table = Table::headed("order | #end / s | #end / bound");
    for (name, end) in [
        ("lower bound: no order is faster", bound),
        ("queue, longest predicted first", longest),
        ("queue, mean of 32 random orders", any),
        ("assigned beforehand, all tasks assumed equally long", dealt),
        ("this run, with loading, bundles and corrected predictions", took),
    ] {
        table.row(vec![name.into(), format!("{end:.2}").into(), format!("{:.3}", end / bound).into()]);
    }
    let text = format!(
        "Time until the last task ends on {slots} equal slots, computed for each order from the tasks' \
         measured seconds, without loading. The last line is the measured time of the run."
    );
    page.table(&table, &text);
    Ok(())
}

fn slowest(page: &mut Page, job: &Job, all: &[&Answer]) {
    page.heading("Slower than expected");
    let mut late = all.to_vec();
    late.sort_by(|a, b| (b.seconds / b.predicted_s).total_cmp(&(a.seconds / a.predicted_s)));
    let names: HashMap<u64, u32> = if job.len() <= 1_000_000 { job.numbers() } else { HashMap::new() };
    let mut table = Table::headed("task | volume | node | #predicted / s | #measured / s");
    for a in late.into_iter().take(10) {
        let task = parse_id(&a.task).and_then(|id| names.get(&id));
        let volume = task.map(|t| job.volumes[job.place(*t as usize).volume].name.clone());
        table.row(vec![
            a.task.as_str().into(),
            volume.unwrap_or_default().into(),
            a.node.as_str().into(),
            format!("{:.3}", a.predicted_s).into(),
            format!("{:.3}", a.seconds).into(),
        ]);
    }
    page.table(&table, "The ten tasks with the largest ratio of measured to expected time.");
}
