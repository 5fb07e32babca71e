//! Renderings of the data sets: examples, their change over time, and the camera poses in the figure of the
//! response curve G.

use super::Work;
use super::collect::protocol;
use super::description::{BASE_MODE, Panel, RAYCASTER_MODES};
use super::encode::Encoder;
use super::frames::trained;
use super::results::{Results, kept, write};
use super::volumes::Place;
use anyhow::{Context, Result, bail};
use entire_cli::collection::{Job, Protocol};
use entire_core::scene::Arcball;
use entire_io::dataset::{Scene, parse_lobes};
use entire_io::files::{fnv1a_text, make_folder, write_whole};
use entire_io::volume::Volume;
use entire_report::encode_png;
use entire_vk_raycaster::{Image, Renderer};
use std::collections::BTreeMap;
use std::process::Command;

/// Side of a picture, pixels.
const SIDE: u32 = 192;
/// The transfer function: a faint veil and two shells.
const LOBES: &str = "0.3 0.003 0.012;0.6 0.003 0.04;0.88 0.006 0.6";
/// Poses (rotations rx and ry, degrees) for the figure of G; the paper's figure also has three.
const POSES: [(f32, f32); 3] = [(15.0, 20.0), (35.0, 140.0), (60.0, -100.0)];

pub(crate) fn draw(work: &Work<'_>, places: &[Place], renderer: &mut dyn Renderer) -> Result<()> {
    let folder = work.out.join("pictures");
    make_folder(&folder)?;
    for place in places {
        let Some(mode) = place.set.modes.iter().find(|m| RAYCASTER_MODES.contains(&m.as_str())) else {
            continue;
        };
        // The pictures show reconstructions from the encoders that have as many features as the main encoder.
        let mut encoders = trained(work, Some(&place.set.name))?;
        encoders.retain(|e| e.features == work.paper.encoders.main.1);
        let text = format!("{LOBES} {SIDE} {} {:?}", place.jobs.len(), encoders);
        let mark = fnv1a_text(text.as_bytes());
        let set = &place.set.name;
        if kept(work.out, Panel::Pictures, set, mode, &mark)? {
            continue;
        }
        work.go_on()?;
        let mut results = Results::new(Panel::Pictures, set, mode, mark);
        results.device = renderer.device();
        results.machine = entire_io::machine::machine();
        let protocol = protocol(work.paper, mode, false)?;
        let first = &place.jobs[0].member;
        let of_member: Vec<usize> =
            (0..place.jobs.len()).filter(|j| place.jobs[*j].member == *first).collect();
        let last = of_member.len() - 1;
        let mut shots: Vec<(usize, &str, (f32, f32))> =
            [0, last / 3, 2 * last / 3, last].map(|k| (of_member[k], "over time", POSES[0])).to_vec();
        shots.dedup();
        shots.extend(POSES.map(|pose| (of_member[last], "pose", pose)));
        for (n, (j, what, pose)) in shots.into_iter().enumerate() {
            let job = &place.jobs[j];
            let image = one(renderer, place, job, &protocol, pose)?;
            let name = format!("{set}-{n}.png");
            write_whole(&folder.join(&name), &encode_png(&image)?)?;
            results.pictures.push((name, format!("{what}: {}", job.path.display())));
        }
        for encoder in encoders {
            let name = format!("{set}-{}f{}-reconstruction.png", encoder.size, encoder.features);
            reconstruct(work, place, &encoder, &name)?;
            let caption = format!(
                "reconstruction: middle slices of test volumes above, VolumeNet {}³F{} below",
                encoder.size, encoder.features
            );
            results.pictures.push((name, caption));
        }
        write(work.out, &results)?;
    }
    Ok(())
}

/// Draws the last time step of every member of every data set that has members, in the base mode.
pub(crate) fn draw_renderings(work: &Work<'_>, places: &[Place], renderer: &mut dyn Renderer) -> Result<()> {
    let folder = work.out.join("pictures");
    make_folder(&folder)?;
    for place in places.iter().filter(|p| p.set.members.is_some()) {
        let set = &place.set.name;
        let last: BTreeMap<&str, &Job> = place.jobs.iter().map(|j| (j.member.as_str(), j)).collect();
        let names: Vec<String> = last.values().map(|j| j.name()).collect();
        let mark = fnv1a_text(format!("{LOBES} {SIDE} {names:?}").as_bytes());
        if kept(work.out, Panel::Renderings, set, BASE_MODE, &mark)? {
            continue;
        }
        work.go_on()?;
        let mut results = Results::new(Panel::Renderings, set, BASE_MODE, mark);
        results.device = renderer.device();
        results.machine = entire_io::machine::machine();
        let protocol = protocol(work.paper, BASE_MODE, false)?;
        for job in last.values() {
            let image = one(renderer, place, job, &protocol, POSES[1])?;
            let name = format!("{set}-rendering-{}.png", job.member);
            write_whole(&folder.join(&name), &encode_png(&image)?)?;
            results.pictures.push((name, format!("rendering: {}", job.path.display())));
        }
        write(work.out, &results)?;
    }
    Ok(())
}

/// Draws a volume with the transfer function of all pictures.
fn one(
    renderer: &mut dyn Renderer,
    place: &Place,
    job: &Job,
    protocol: &Protocol,
    (rx, ry): (f32, f32),
) -> Result<Image> {
    let fail = || job.path.display().to_string();
    let volume = protocol.sized(Volume::open(place.root.join(&job.path))?).with_context(fail)?;
    renderer.set_volume(&volume.view()).with_context(fail)?;
    let scene = Scene {
        camera: Arcball { rx, ry, dz: 2.5 },
        width: SIDE,
        height: SIDE,
        lobes: parse_lobes(LOBES)?,
        ..protocol.scene(job, volume.dims(), 0)
    };
    renderer.set_transfer(&scene.to_table()?).with_context(fail)?;
    Ok(renderer.render(&scene.to_frame()?).with_context(fail)?.image)
}

fn reconstruct(work: &Work<'_>, place: &Place, encoder: &Encoder, name: &str) -> Result<()> {
    let Some(parts) = place.main_split() else { return Ok(()) };
    let script = work.paper.encoders.script.with_file_name("reconstruct.py");
    let mut command = Command::new(work.python);
    command.arg(&script).arg("--model").arg(encoder.path(work.out));
    command.arg("--out").arg(work.out.join("pictures").join(name));
    command.args(parts.test.iter().take(4).map(|v| place.root.join(v)));
    let output = command.output().with_context(|| format!("cannot start {}", work.python.display()))?;
    if !output.status.success() {
        bail!(
            "{} failed: {}; use --python to name an interpreter that has the packages of \
             lab/volumenet/requirements.txt",
            script.display(),
            String::from_utf8_lossy(&output.stderr).lines().last().unwrap_or_default()
        );
    }
    Ok(())
}
