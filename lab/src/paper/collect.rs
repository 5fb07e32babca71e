//! Collects frames of this project's raycaster: volume by volume, in all modes, and also at the low
//! resolution of LVRP.

use super::Work;
use super::description::{Panel, Paper, RAYCASTER_MODES};
use super::volumes::Place;
use anyhow::{Context, Result, bail, ensure};
use entire_cli::collection::{Job, Protocol, differences, time_scene};
use entire_core::scene::{Arcball, Skipping};
use entire_io::dataset::{Manifest, Scene, Writer};
use entire_io::files::make_folder;
use entire_io::identity;
use entire_io::machine;
use entire_io::progress::templated_bar;
use entire_io::scenes::SceneDistribution;
use entire_io::volume::{Reading, Volume};
use entire_vk_raycaster::Renderer;
use indicatif::ProgressBar;
use serde_json::json;
use std::path::{Path, PathBuf};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// Random frames of every volume.
    Random,
    /// Frames of the experiments that vary one parameter at a time, and of both orbits.
    Varied,
}

/// Path of the table of a data set and mode, or of its low-resolution proxy if `low` is true.
pub(crate) fn table_path(out: &Path, set: &str, mode: &str, kind: Kind, low: bool) -> PathBuf {
    let kind = if kind == Kind::Varied { "-varied" } else { "" };
    let low = if low { "-low" } else { "" };
    out.join("tables").join(format!("{set}-{mode}{kind}{low}.csv"))
}

/// Settings by which a mode's frames are collected.
pub(crate) fn protocol(paper: &Paper, mode: &str, low: bool) -> Result<Protocol> {
    let own = paper.in_mode.get(mode).copied().unwrap_or_default();
    Ok(Protocol {
        frames: paper.frames.training,
        repeats: own.repeats.unwrap_or(paper.repeats),
        passes: 1,
        warm_up: paper.warm_up,
        warm_up_repeats: 0,
        seed: paper.seed,
        scenes: SceneDistribution {
            max_size: own.max_size.unwrap_or(paper.scenes.max_size),
            ..paper.scenes.clone()
        },
        shading: mode.parse()?,
        skipping: Skipping::Blocks,
        termination: 0.99,
        enlarge: if low { 1 } else { paper.enlarge },
        proxy: low.then_some(paper.proxy),
        reading: Reading::default(),
    })
}

/// Names of the experiments with one varied parameter. The index is the thousands digit of the frame numbers.
pub(crate) const EXPERIMENTS: [&str; 4] = ["volume", "image resolution", "transfer function", "camera pose"];
/// First frame number of the orbit for load balancing: poses around several volumes.
pub(crate) const ORBIT: u64 = 10_000;
/// First frame number of the same orbit with a random transfer function for every pose.
pub(crate) const DRAWN_ORBIT: u64 = 20_000;
/// Number of frame numbers that are reserved for each experiment.
pub(crate) const PER_EXPERIMENT: u64 = 1_000;

/// A frame to render: its number, the index of its volume among the jobs, and its scene. The scene's shading
/// mode and volume size are set when the frame is rendered.
#[derive(Clone, Debug)]
struct Wanted {
    number: u64,
    job: usize,
    scene: Scene,
}

/// Returns the frames of the experiments and of both orbits. The base frame is a random frame of the first
/// test volume of the data set's main split. Every experiment varies one parameter of the base frame. The
/// experiment `volume` shows all held-out volumes of that split.
fn varied(place: &Place, paper: &Paper, mode: &str) -> Result<Vec<Wanted>> {
    let Some(parts) = place.main_split() else { return Ok(Vec::new()) };
    let protocol = protocol(paper, mode, false)?;
    let find = |name: &String| place.jobs.iter().position(|j| j.name() == *name);
    let middle = parts.test.first().and_then(find).context("no test volume")?;
    let (least, most) = (f64::from(protocol.scenes.min_size), f64::from(protocol.scenes.max_size));
    let side = (least * most).sqrt().round() as u32;
    let count = paper.frames.varied;
    // The scenes' indices are larger than those of all random frames, so that no model was trained on these
    // scenes.
    let drawn = |job: usize, index: u64| protocol.scene(&place.jobs[job], [1; 3], 1_000_000 + index);
    let base = Scene { width: side, height: side, ..drawn(middle, 0) };
    let mut out = Vec::new();
    let mut add = |experiment: u64, i: u32, job: usize, scene: Scene| {
        out.push(Wanted { number: experiment * PER_EXPERIMENT + u64::from(i), job, scene });
    };
    let held_out: Vec<usize> = parts.test.iter().chain(&parts.validation).filter_map(find).collect();
    for (i, &job) in (0..).zip(&held_out) {
        add(0, i, job, base.clone());
    }
    for i in 0..count {
        let share = f64::from(i) / f64::from((count - 1).max(1));
        let side = (least + (most - least) * share).round() as u32;
        add(1, i, middle, Scene { width: side, height: side, ..base.clone() });
        let lobes = drawn(middle, 1 + u64::from(i)).lobes;
        add(2, i, middle, Scene { lobes, ..base.clone() });
        // The camera makes three turns while it rises, at the distance of the base frame.
        let angle = 3.0 * 360.0 * share;
        let camera = Arcball {
            rx: (80.0 * share) as f32,
            ry: ((angle + 180.0).rem_euclid(360.0) - 180.0) as f32,
            dz: base.camera.dz,
        };
        add(3, i, middle, Scene { camera, ..base.clone() });
    }
    for (v, &job) in held_out.iter().take(paper.orbit.volumes).enumerate() {
        for p in 0..paper.orbit.poses {
            let share = p as f64 / paper.orbit.poses as f64;
            let camera = Arcball { rx: 20.0, ry: (360.0 * share - 180.0) as f32, dz: base.camera.dz };
            let size = paper.orbit.size;
            let scene = Scene { camera, width: size, height: size, ..base.clone() };
            let index = (v * paper.orbit.poses + p) as u64;
            let lobes = drawn(job, 1 + index).lobes;
            out.push(Wanted { number: ORBIT + index, job, scene: scene.clone() });
            out.push(Wanted { number: DRAWN_ORBIT + index, job, scene: Scene { lobes, ..scene } });
        }
    }
    Ok(out)
}

/// A timing table that is being written, with the frames that it lacks.
struct Open {
    writer: Writer,
    manifest: Manifest,
    path: PathBuf,
    protocol: Protocol,
    frames: Vec<Wanted>,
    kind: Kind,
    low: bool,
}

impl Open {
    fn new(
        path: PathBuf,
        protocol: Protocol,
        (kind, low): (Kind, bool),
        (jobs, root): (&[Job], &Path),
        renderer: &dyn Renderer,
    ) -> Result<Self> {
        let mut manifest = protocol.manifest(jobs, renderer)?;
        for job in jobs {
            manifest.files.insert(job.name(), identity::of_volume(&root.join(&job.path))?);
        }
        let mut runs = Vec::new();
        if let Some(old) = Manifest::read(&path)? {
            let found = differences(&old, &manifest);
            ensure!(
                found.is_empty(),
                "cannot continue {}: {}; remove this table, or choose another --out",
                path.display(),
                found.join("; ")
            );
            runs = old.other.get("runs").and_then(|r| r.as_array().cloned()).unwrap_or_default();
            manifest.created = old.created;
        }
        runs.push(json!({ "started": machine::now(), "load_average_at_start": machine::load_average(),
            "commit": machine::version() }));
        manifest.other.insert("runs".into(), json!(runs));
        let writer = Writer::resume(&path, manifest.repeats)?;
        manifest.write(&path)?;
        Ok(Self { writer, manifest, path, protocol, frames: Vec::new(), kind, low })
    }

    /// Stores the end of this run in the manifest.
    fn close(mut self) -> Result<()> {
        if let Some(last) = self.manifest.other.get_mut("runs").and_then(|r| r.as_array_mut()?.last_mut()) {
            last["ended"] = json!(machine::now());
            last["load_average_at_end"] = json!(machine::load_average());
        }
        self.manifest.write(&self.path)
    }
}

/// Opens the tables of a data set, each with the frames that it lacks.
fn missing(work: &Work<'_>, place: &Place, renderer: &dyn Renderer) -> Result<Vec<Open>> {
    let paper = work.paper;
    let mut tables = Vec::new();
    let modes = place.set.modes.iter().filter(|m| RAYCASTER_MODES.contains(&m.as_str()));
    for mode in modes.filter(|m| work.selection.has_mode(m)) {
        let asked = |panel: &Panel| {
            let of = paper.panels.get(panel);
            of.is_some_and(|p| p.iter().any(|(s, m)| *s == place.set.name && m == mode))
        };
        let varied = if asked(&Panel::Varied) { varied(place, paper, mode)? } else { Vec::new() };
        for (kind, low) in
            [(Kind::Random, false), (Kind::Random, true), (Kind::Varied, false), (Kind::Varied, true)]
        {
            if (kind == Kind::Varied && varied.is_empty()) || (low && paper.teacher.is_some()) {
                continue;
            }
            let protocol = protocol(paper, mode, low)?;
            let path = table_path(work.out, &place.set.name, mode, kind, low);
            let mut open = Open::new(path, protocol, (kind, low), (&place.jobs, &place.root), renderer)?;
            if kind == Kind::Varied {
                open.frames.clone_from(&varied);
            } else {
                for (j, job) in place.jobs.iter().enumerate() {
                    let count = if low { paper.frames.held_out } else { place.frames_of(job, paper) };
                    open.frames.extend((0..u64::from(count)).map(|i| Wanted {
                        number: j as u64 * u64::from(paper.frames.training) + i,
                        job: j,
                        scene: open.protocol.scene(job, [1; 3], i),
                    }));
                }
            }
            open.frames.retain(|w| !open.writer.done().contains(&w.number));
            tables.push(open);
        }
    }
    Ok(tables)
}

/// Collects missing frames: first as many of every volume as a held-out volume needs, then the remaining
/// frames of training volumes. So a collection that is stopped early holds frames for every split.
pub(crate) fn collect(work: &Work<'_>, places: &[Place], renderer: &mut dyn Renderer) -> Result<()> {
    make_folder(&work.out.join("tables"))?;
    let template = "collect [{bar:30}] {pos}/{len}, {eta} left  {wide_msg}";
    for place in places {
        let mut tables = missing(work, place, renderer)?;
        let bar = templated_bar(template);
        bar.set_length(tables.iter().map(|t| t.frames.len() as u64).sum());
        bar.reset_eta();
        let mut result = Ok(());
        for round in 0..2 {
            for j in 0..place.jobs.len() {
                let now = |table: &Open, w: &Wanted| {
                    let of_few = table.kind == Kind::Varied || work.paper.frames.is_of_few(w.number);
                    w.job == j && of_few == (round == 0)
                };
                if result.is_ok() {
                    result = of_volume(work, place, j, &mut tables, &now, renderer, &bar);
                }
            }
        }
        bar.finish_and_clear();
        tables.into_iter().try_for_each(Open::close)?;
        result.with_context(|| format!("{}: finished frames are kept", place.set.name))?;
    }
    Ok(())
}

/// Renders the missing frames of volume `j`, at both resolutions and in all modes. Only frames for which
/// `now` returns true are rendered.
fn of_volume(
    work: &Work<'_>,
    place: &Place,
    j: usize,
    tables: &mut [Open],
    now: &dyn Fn(&Open, &Wanted) -> bool,
    renderer: &mut dyn Renderer,
    bar: &ProgressBar,
) -> Result<()> {
    let job = &place.jobs[j];
    let shown = job.path.display().to_string();
    let mut source: Option<Volume> = None;
    for low in [false, true] {
        let mut loaded: Option<[usize; 3]> = None;
        for table in tables.iter_mut().filter(|t| t.low == low) {
            let wanted: Vec<Wanted> = table.frames.iter().filter(|w| now(table, w)).cloned().collect();
            let mut warm_up = table.protocol.warm_up;
            for w in wanted {
                work.go_on()?;
                let fail = || format!("{shown}, frame {}", w.number);
                let dims = match loaded {
                    Some(dims) => dims,
                    None => {
                        bar.set_message(shown.clone());
                        if source.is_none() {
                            source = Some(Volume::open(place.root.join(&job.path))?);
                        }
                        let volume = source.clone().context("no volume")?;
                        let volume = table.protocol.sized(volume).with_context(fail)?;
                        renderer.set_volume(&volume.view()).with_context(fail)?;
                        *loaded.insert(volume.dims())
                    }
                };
                let scene = Scene {
                    volume: job.name(),
                    member: job.member.clone(),
                    time_step: job.time_step,
                    dims: dims.map(|n| n as u32),
                    shading: table.protocol.shading,
                    ..w.scene
                };
                let stop = || work.stop();
                let timed = time_scene(renderer, &scene, &table.protocol, &mut warm_up, &stop);
                let Some(repeats) = timed.with_context(fail)?.repeats else { bail!("{}", work.stopped()) };
                table.writer.append(w.number, &scene, &repeats)?;
                table.frames.retain(|f| f.number != w.number);
                bar.inc(1);
            }
        }
    }
    Ok(())
}
