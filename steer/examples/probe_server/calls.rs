//! Measures the times of plans, transfer functions and volume summaries.

use crate::scene;
use entire_core::scene::{
    Arcball, Camera, Frame, GaussianLobe, Scalars, Shading, TransferFunction, TransferTable, VolumeView,
};
use entire_steer::features::VolumeSummary;
use std::collections::HashMap;
use std::hint::black_box;
use std::io::BufRead;
use std::time::Instant;

/// Size of the buffer that is written to evict the first two cache levels, in bytes.
const EVICTED_BYTES: usize = 8 << 20;

/// Number of camera poses per transfer function.
const POSES: usize = 12;

/// Number of planes in a volume of bytes; a plane has 512 × 512 voxels. Volumes of other voxel types have
/// fewer planes, so that all volumes take the same number of bytes.
const PLANES: usize = 512;

/// Returns the seconds that a call takes.
pub(crate) fn time(call: impl FnOnce()) -> f64 {
    let start = Instant::now();
    call();
    start.elapsed().as_secs_f64()
}

/// Prints measured seconds as the answer to a request.
pub(crate) fn report(seconds: Vec<f64>) {
    println!("@@{{\"seconds\": {seconds:?}}}");
}

enum Voxels {
    U8(Vec<u8>),
    U16(Vec<u16>),
    F32(Vec<f32>),
}

/// The volumes, made on first use; at most one large volume is kept.
#[derive(Default)]
pub(crate) struct Volumes {
    /// The large volume, with the name of its voxel type.
    large: Option<(String, Voxels)>,
    sessions: HashMap<usize, VolumeSummary>,
    evicted: Vec<u8>,
}

/// A smooth volume in [0, 1] with some noise.
fn blobs<T>(dims: [usize; 3], to: impl Fn(f32) -> T) -> Vec<T> {
    let wave = |n: usize, k: f32| (0..n).map(|i| (k * (i as f32 + 0.5) / n as f32).sin()).collect::<Vec<_>>();
    let [x, y, z] = [wave(dims[0], 9.0), wave(dims[1], 11.0), wave(dims[2], 7.0)];
    let mut state = 1u32;
    let mut out = Vec::with_capacity(dims.iter().product());
    for c in &z {
        for b in &y {
            out.extend(x.iter().map(|a| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let noise = (state >> 8) as f32 / (1 << 24) as f32;
                to(0.49 + 0.48 * a * b * c + 0.02 * noise)
            }));
        }
    }
    out
}

impl Volumes {
    /// A volume of 128 MiB with voxels of type `u8`, `u16` or `f32`; `None` for any other name.
    pub(crate) fn large(&mut self, kind: &str) -> Option<VolumeView<'_>> {
        let dims = |bytes: usize| [512, 512, PLANES / bytes];
        if self.large.as_ref().is_none_or(|(k, _)| *k != kind) {
            self.large = None;
            let voxels = match kind {
                "u8" => Voxels::U8(blobs(dims(1), |v| (255.0 * v) as u8)),
                "u16" => Voxels::U16(blobs(dims(2), |v| (40_000.0 * v) as u16)),
                "f32" => Voxels::F32(blobs(dims(4), |v| 1.0e3 * v - 300.0)),
                _ => return None,
            };
            self.large = Some((kind.to_owned(), voxels));
        }
        let (_, voxels) = self.large.as_ref()?;
        Some(match voxels {
            Voxels::U8(v) => scene::volume(Scalars::U8(v), dims(1), (0.0, 255.0)),
            Voxels::U16(v) => scene::volume(Scalars::U16(v), dims(2), (0.0, 40_000.0)),
            Voxels::F32(v) => scene::volume(Scalars::F32(v), dims(4), (-300.0, 700.0)),
        })
    }

    /// Wrapping sum of the large volume's data, read as 64-bit words; 0 without a large volume.
    fn read(&self) -> u64 {
        let sum = |bytes: &[u64]| {
            let mut lanes = [0u64; 32];
            for chunk in bytes.chunks_exact(32) {
                lanes.iter_mut().zip(chunk).for_each(|(a, b)| *a = a.wrapping_add(*b));
            }
            lanes.into_iter().fold(0, u64::wrapping_add)
        };
        match &self.large {
            Some((_, Voxels::U8(v))) => sum(bytemuck::cast_slice(&v[..v.len() / 8 * 8])),
            Some((_, Voxels::U16(v))) => sum(bytemuck::cast_slice(&v[..v.len() / 8 * 8])),
            Some((_, Voxels::F32(v))) => sum(bytemuck::cast_slice(&v[..v.len() / 8 * 8])),
            None => 0,
        }
    }

    /// The summary of a volume of `edge`³ 16-bit integers.
    fn summary(&mut self, edge: usize) -> VolumeSummary {
        let summary = self.sessions.entry(edge).or_insert_with(|| {
            let voxels = blobs([edge; 3], |v| (40_000.0 * v) as u16);
            let view = scene::volume(Scalars::U16(&voxels), [edge; 3], (0.0, 40_000.0));
            scene::summary(&view)
        });
        summary.clone()
    }

    fn evict(&mut self) {
        self.evicted.resize(EVICTED_BYTES, 1);
        self.evicted.iter_mut().step_by(64).for_each(|byte| *byte = byte.wrapping_add(1));
        black_box(&self.evicted);
    }
}

fn table(center: f32, height: f32) -> TransferTable {
    let lobe = GaussianLobe { center, width: 0.004, height };
    TransferFunction::Gaussian(vec![lobe]).to_table().expect("a table")
}

/// Transfer functions: one that leaves most cells empty, a transparent one, and an opaque one.
fn tables() -> [TransferTable; 3] {
    [table(0.9, 0.02), table(0.5, 0.02), table(0.7, 0.9)]
}

fn frames(shading: Shading) -> Vec<Frame> {
    (0..POSES)
        .map(|i| {
            let pose = Arcball { rx: 20.0, ry: 30.0 * i as f32, dz: 1.2 + 0.1 * i as f32 };
            let camera = Camera::from_arcball(pose).expect("a camera");
            scene::frame(camera, shading)
        })
        .collect()
}

/// Answers `plan/SIDE/warm|cold/none|scatter`: for each scene, seconds of the fastest of several plans.
fn plans(volumes: &mut Volumes, side: usize, cold: bool, shading: Shading) -> Vec<f64> {
    let summary = volumes.summary(256);
    let mut session = scene::session(side);
    session.set_volume(summary, None);
    let mut out = Vec::new();
    for table in &tables() {
        session.set_transfer(table, None).expect("a volume is set");
        for frame in &frames(shading) {
            let mut best = f64::INFINITY;
            for _ in 0..3 {
                let _ = black_box(session.plan(frame, 0.02).expect("a plan"));
            }
            for _ in 0..if cold { 3 } else { 8 } {
                if cold {
                    volumes.evict();
                }
                best = best.min(time(|| {
                    let _ = black_box(session.plan(black_box(frame), 0.02).expect("a plan"));
                }));
            }
            out.push(best);
        }
    }
    out
}

/// Answers `transfer/EDGE/first`: seconds to set the first transfer function of a volume; `…/edit`: seconds
/// to set another transfer function; `…/plan`: seconds to set another transfer function and make the first
/// plan after it.
fn transfers(volumes: &mut Volumes, edge: usize, what: &str) -> Vec<f64> {
    let summary = volumes.summary(edge);
    let frame = frames(Shading::None)[0];
    let tables = tables();
    let mut out = Vec::new();
    let mut session = scene::session(11);
    for table in tables.iter().cycle().take(6) {
        if what == "first" || out.is_empty() {
            session = scene::session(11);
            session.set_volume(summary.clone(), None);
        }
        if what != "first" {
            session.set_transfer(&tables[2], None).expect("a volume is set");
            let _ = session.plan(&frame, 0.02).expect("a plan");
        }
        volumes.evict();
        out.push(time(|| {
            session.set_transfer(black_box(table), None).expect("a volume is set");
            if what == "plan" {
                let _ = black_box(session.plan(&frame, 0.02).expect("a plan"));
            }
        }));
    }
    out
}

/// Answers requests until the input ends. `also` answers the names that this function does not know.
pub(crate) fn serve(volumes: &mut Volumes, also: &mut dyn FnMut(&mut Volumes, &str) -> Option<()>) {
    for line in std::io::stdin().lock().lines() {
        let line = line.expect("a line");
        let parts: Vec<&str> = line.trim().split('/').collect();
        let shading = |name: &str| if name == "scatter" { Shading::Scatter } else { Shading::None };
        match parts[..] {
            ["plan", side, heat, mode] => {
                let side = side.parse().expect("rays along a side");
                report(plans(volumes, side, heat == "cold", shading(mode)));
            }
            ["transfer", edge, what] => {
                report(transfers(volumes, edge.parse().expect("voxels along an edge"), what));
            }
            [what @ ("summary" | "read"), kind] => {
                let view = volumes.large(kind).expect("a type of voxels");
                if what == "read" {
                    report(vec![time(|| {
                        black_box(volumes.read());
                    })]);
                    continue;
                }
                report(vec![time(|| {
                    black_box(scene::summary(&view));
                })]);
            }
            _ => {
                if also(volumes, line.trim()).is_none() {
                    println!("@@{{\"err\": \"no such name\"}}");
                }
            }
        }
    }
}
