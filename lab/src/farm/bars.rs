//! The bars of `entire farm` that need no engine (a program that runs tasks on nodes, such as Slurm):
//! schedules of recorded frames, loading of volumes, predicted end times, planning of a million tasks.
//! Simulated runs use the same planner as runs on real engines.

use super::search::{Problem, best_of, shuffled};
use super::tasks::{HELD_OUT, tasks_of_table};
use crate::bars::Bar;
use anyhow::{Context, Result};
use entire_farm::dispatch::Order;
use entire_farm::job::Job;
use entire_farm::learn::{CONSTANT_SD_WITH_MODEL, Shape};
use entire_farm::list::assign_longest_first;
use entire_farm::load::Loads;
use entire_farm::planner::{Planner, Setting};
use entire_farm::simulate::{World, simulate};
use entire_farm::{By, Task, database, drive, predict, times, volume_numbers};
use entire_io::metrics::median;
use rand::SeedableRng;
use rand::rngs::ChaCha8Rng;
use std::path::Path;
use std::time::Instant;

/// Number of tasks of the paper's image database.
const PAPER: usize = 384;
/// Number of simulated runs whose end is predicted.
const RUNS: u64 = 40;

/// Predicted and measured seconds of some tasks, and the indices of their volumes.
fn parts(tasks: &[Task]) -> Result<(Vec<f64>, Vec<f64>, Vec<usize>)> {
    Ok((times(tasks, By::Predicted)?, times(tasks, By::Measured)?, volume_numbers(tasks)))
}

/// Returns a planner of tasks. `base` has their predicted seconds, `volume` the indices of their volumes.
pub(crate) fn plan(base: &[f64], volume: &[usize], loads: Loads, setting: Setting) -> Planner {
    let shape = Shape::of_volumes(base, volume).with_constant(CONSTANT_SD_WITH_MODEL);
    let mut planner = Planner::new(shape, loads, setting);
    planner.add_stage((0..base.len() as u32).collect());
    planner
}

/// Settings of a planner: longest first, each bundle sent to a slot that keeps its volume, no overhead.
pub(crate) fn setting(slots: usize) -> Setting {
    Setting { slots, bound: true, overhead: 0.0, limit: None, order: Order::Longest, learn: true }
}

/// A farm of equal slots. Task i draws volume `volume[i]` and takes `seconds[i]`; loading volume v takes
/// `load[v]` seconds.
pub(crate) fn world(seconds: Vec<f64>, volume: Vec<usize>, load: Vec<f64>, slots: usize) -> World {
    World { seconds, volume, load, speeds: vec![1.0; slots], ..World::default() }
}

/// Returns the largest ratio of two makespans over 2 to 64 nodes, and the number of nodes at which it occurs.
/// The ratio is the makespan of the longest-first assignment by predicted times, divided by the makespan of
/// the longest-first assignment by measured times. Neither assignment is improved by exchanges.
fn worst_static(tasks: &[Task]) -> Result<(f64, usize)> {
    let (predicted, measured) = (times(tasks, By::Predicted)?, times(tasks, By::Measured)?);
    let mut worst = (0.0f64, 0);
    for nodes in 2..=64 {
        let speeds = vec![1.0; nodes];
        let of = |times: &[f64]| assign_longest_first(times, &speeds)?.makespan(&measured, &speeds);
        let ratio = of(&predicted)? / of(&measured)?;
        if ratio > worst.0 {
            worst = (ratio, nodes);
        }
    }
    Ok(worst)
}

/// Returns the makespan of the plan divided by the makespan of the best schedule of a local search. The
/// search knows the measured times and has `starts` random starts. There are 8 nodes, and loading a volume
/// takes as long as 4 mean frames.
fn with_loads(tasks: &[Task], starts: u64) -> Result<f64> {
    let tasks = &tasks[..tasks.len().min(PAPER)];
    let (base, truth, volume) = parts(tasks)?;
    let volumes = volume.iter().max().map_or(1, |v| v + 1);
    let load = vec![4.0 * truth.iter().sum::<f64>() / truth.len() as f64; volumes];
    let mut planner = plan(&base, &volume, Loads::known(load.clone()), setting(8));
    let world = World { bound: true, ..world(truth.clone(), volume.clone(), load.clone(), 8) };
    let out = simulate(&mut planner, &world, &[]);
    let best = best_of(&Problem { seconds: &truth, volume: &volume, load: &load, nodes: 8 }, starts);
    println!(
        "loads: {} tasks of {volumes} volumes, 8 nodes: {:.3} s with {} loads; local search {best:.3} s",
        tasks.len(),
        out.makespan,
        out.loads
    );
    Ok(out.makespan / best)
}

/// Simulates [`RUNS`] runs, and predicts the end of each run after a tenth of its work. Returns the median
/// error of the predicted median end, and the share of the runs that end within the predicted 90 % interval.
fn foretold(pools: &[(String, Vec<Task>)]) -> Result<(f64, f64)> {
    let (mut errors, mut hits) = (Vec::new(), 0);
    for run in 0..RUNS {
        let mut rng = ChaCha8Rng::seed_from_u64(1000 + run);
        let (name, pool) = &pools[run as usize % pools.len()];
        let mut chosen = shuffled(pool.len(), &mut rng);
        chosen.truncate(PAPER);
        let tasks: Vec<Task> = chosen.iter().map(|i| pool[*i].clone()).collect();
        let (base, truth, volume) = parts(&tasks)?;
        let slots = [4, 8, 16, 32][(run / pools.len() as u64) as usize % 4];
        let volumes = volume.iter().max().map_or(1, |v| v + 1);
        let load = vec![0.0; volumes];
        let mut planner = plan(&base, &volume, Loads::known(load.clone()), setting(slots));
        let world = World { bound: true, ..world(truth, volume, load, slots) };
        let out = simulate(&mut planner, &world, &[0.1]);
        let [low, middle, high] = *out.said.first().context("no end was predicted")?;
        let hit = (low..=high).contains(&out.makespan);
        hits += u32::from(hit);
        errors.push((middle / out.makespan - 1.0).abs());
        println!(
            "eta: run {run}, {name}, {slots} nodes: end {:.3} s, predicted {middle:.3} s ({low:.3} to \
             {high:.3}){}",
            out.makespan,
            if hit { "" } else { ", outside" }
        );
    }
    Ok((median(&mut errors).context("no runs")?, f64::from(hits) / RUNS as f64))
}

/// Plans a job of 10⁶ tasks. Returns the seconds from reading the job file to the first bundle, the seconds
/// from reading it to the last bundle, and the peak memory of the process in GB.
fn at_scale(folder: &Path) -> Result<(f64, f64, f64)> {
    let volumes = folder.join("volumes");
    entire_io::files::make_folder(&volumes)?;
    for i in 0..100 {
        std::fs::write(volumes.join(format!("v{i}.raw")), vec![0u8; 1000 + i])?;
    }
    let transfers: String =
        (0..10).map(|i| format!("[[transfer]]\nname = \"t{i}\"\nlobes = [[0.{i}5, 0.01, 0.5]]\n")).collect();
    let text = format!(
        "name = \"scale\"\nsizes = [\"256x256\", \"512x512\"]\n[[volumes]]\nfiles = [\"volumes/*.raw\"]\n\
         [[cameras]]\nkind = \"semi-sphere\"\nviews = 500\ndistances_radii = [2.0]\n{transfers}\
         [renderer]\nkind = \"command\"\ncommand = [\"draw\", \"{{volume}}\", \"{{out}}\"]\n"
    );
    let file = folder.join("scale.toml");
    std::fs::write(&file, text)?;
    let clock = Instant::now();
    let job = Job::open(&file)?;
    let base = predict::base(&job)?;
    let how = Setting { overhead: 0.05, ..setting(1000) };
    let mut planner = database::planner(&job, base, how);
    drive::queue(&mut planner, &job, false);
    let eta = planner.eta(0.0);
    let first = clock.elapsed().as_secs_f64();
    let (mut tasks, mut bundles, mut slot) = (0, 0, 0);
    // Tasks are bundled by number until some times are known, and by time from then on.
    for task in 0..16 {
        planner.done_before(task * 62_001, 0, 0.3);
    }
    while let Some(sent) = planner.next(Some(slot % 1000), 0.0) {
        tasks += sent.tasks.len();
        bundles += 1;
        slot += 1;
    }
    let all = clock.elapsed().as_secs_f64();
    println!(
        "planning: {} tasks in {bundles} bundles: {first:.2} s to the first bundle and the expected end \
         ({:.0} s), {all:.2} s to the last bundle",
        tasks, eta[1]
    );
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    let kib: f64 = peak.and_then(|l| l.split_whitespace().next()?.parse().ok()).unwrap_or(f64::NAN);
    Ok((first, all, kib / 1e6 * 1.024))
}

pub(crate) fn all(folder: &Path) -> Result<Vec<Bar>> {
    // The job of a million tasks comes first, since the peak memory of the whole process so far is measured.
    let (first, last, peak) = at_scale(folder)?;
    let mut pools = Vec::new();
    for (table, model) in HELD_OUT {
        pools.push((table.to_owned(), tasks_of_table(table, model)?));
    }
    for (name, pool) in &pools {
        let (worst, nodes) = worst_static(pool)?;
        println!("static: {name}, {} tasks: worst makespan ratio {worst:.4} ({nodes} nodes)", pool.len());
    }
    let main = &pools[0].1;
    let first_384 = &main[..main.len().min(PAPER)];
    let (all_frames, paper) = (worst_static(main)?.0, worst_static(first_384)?.0);
    println!("static: {PAPER} tasks of {}: worst makespan ratio {paper:.4}", pools[0].0);
    let loads = with_loads(&pools[1].1, 1000)?;
    let (error, share) = foretold(&pools)?;
    println!("planning: peak memory {peak:.3} GB, {first:.2} s to the first bundle");
    let mut bars = vec![
        Bar::at_most("farm-static-random-scenes-worst", Some(all_frames.max(paper)), 1.04),
        Bar::at_most("farm-loads-of-local-search", Some(loads), 1.05),
        Bar::at_most("farm-eta-median-error", Some(error), 0.05),
        Bar::at_least("farm-eta-interval-holds", Some(share), 0.85),
        Bar::at_most("farm-eta-interval-holds-not-too-wide", Some(share), 0.95),
        Bar::at_most("farm-plan-million-seconds", Some(last), 2.0),
        Bar::at_most("farm-plan-million-gigabytes", Some(peak), 1.0),
    ];
    bars.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(bars)
}
