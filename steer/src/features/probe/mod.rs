//! The coarse ray probe: a few rays through the grid of cells, marched once per frame and evaluated for any
//! step.

mod march;
mod packet;
#[cfg(test)]
mod tests;

use self::march::{
    BUSY_LENGTH, CHORD, DEPTH, DRAW, EMPTY_LENGTH, FIELDS, March, OCCUPIED_LENGTH, RUNS, SEGMENTS, SHADOW,
    SHADOW_ALL, SHADOW_ENDED, SHADOW_SEGMENTS, SHADOW_SKIPS, TERMINATED, U, V, VISIBLE_LENGTH,
};
use super::{Footprint, TransferSummary, VolumeSummary};
use entire_core::kernels::Level;
use entire_core::memory::chunks;
use entire_core::scene::{Frame, Shape, Skipping};

/// Default number of rays along each side of the footprint's bounding rectangle.
pub const PROBE_SIDE: usize = 11;

/// Largest number of rays along each side of the probe.
pub const MAX_PROBE_SIDE: usize = 24;

/// Direction towards the light of single scattering in scene space, not normalized.
pub(crate) const SHADOW_DIRECTION: [f32; 3] = [0.4, 0.8, 0.45];

/// Step of shadow rays, as a multiple of the frame's step.
pub(crate) const SHADOW_STEP: f32 = 2.0;

/// Opacity at which a shadow ray stops.
pub(crate) const SHADOW_OPACITY: f32 = 0.75;

const MAX_RAYS: usize = MAX_PROBE_SIDE * MAX_PROBE_SIDE;

/// Number of bins of chord lengths through empty cells: half octaves from 2⁻⁴ to 2¹⁰ reference steps.
const BINS: usize = 28;

/// Mean work of the rays that meet the box, as lengths in reference steps; [`super::FrameFeatures::work`]
/// converts the lengths to counts at a given step.
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Zeroable)]
pub(crate) struct Probe {
    pub(crate) footprint: Footprint,
    /// Number of the probe's rays that met the box.
    pub(crate) rays: u32,
    /// Mean length inside the box, in reference steps.
    pub(crate) mean_chord: f32,
    /// Length inside occupied blocks, up to termination.
    pub(super) occupied: f32,
    /// Length inside empty blocks, up to termination.
    pub(super) empty: f32,
    /// Length over which samples have opacity.
    pub(super) visible: f32,
    /// Length over which at least one of eight adjacent rays has a sample with opacity, if the rays sample a
    /// cell independently; 0 without single scattering.
    pub(super) busy: f32,
    /// For neighboring probe rays that both terminate early: the mean distance of their ends along the rays,
    /// divided by the sum of this distance and the mean visible length; 0 without such rays or without single
    /// scattering.
    pub(super) ends_apart: f32,
    /// Runs of samples between jumps: number of times a ray enters an occupied block from an empty one or
    /// from outside.
    pub(super) runs: f32,
    /// Lookups in a skip map during the runs. The map holds the distance to the nearest empty block, so that
    /// deep among occupied blocks one lookup serves several blocks.
    pub(super) segments: f32,
    /// Distance between the rays at the image's top and bottom, at the mean depth of the samples, in
    /// reference steps.
    pub(super) spread: f32,
    /// Share of rays that terminate early.
    pub(super) terminated: f32,
    /// Mean, over rays, of the maximum length inside occupied blocks among a ray and its neighbors in the
    /// probe.
    pub(super) occupied_max: f32,
    /// Mean, over rays, of the maximum length inside occupied and empty blocks together, among a ray and its
    /// neighbors in the probe.
    pub(super) all_max: f32,
    /// Distance between neighboring probe rays in the image, in units of the image's height.
    pub(super) spacing: f32,
    /// Visible length times the length of a shadow ray in occupied blocks; 0 without single scattering.
    pub(super) shadow: f32,
    /// Visible length times the number of empty cells that a shadow ray skips.
    pub(super) shadow_skips: f32,
    /// Visible length times the length of a shadow ray without skipping.
    pub(super) shadow_all: f32,
    /// Visible length times the number of lookups in the skip map by a shadow ray.
    pub(super) shadow_segments: f32,
    /// Visible length of the rays whose shadow ray ends early.
    pub(super) shadow_ended: f32,
    /// The largest work of a single ray.
    pub(super) longest: Longest,
    /// Standard error of the sampled length, relative to this length; infinite if the error is unknown, 0 if
    /// no ray met the box.
    pub(crate) error: f32,
    block_skips: Chords,
    distance_skips: Chords,
}

impl Probe {
    /// A probe that meets nothing.
    pub(crate) fn nothing() -> Self {
        Self { spacing: 1.0, ..bytemuck::Zeroable::zeroed() }
    }

    /// Marches the probe's rays through a volume, with the instructions of a SIMD level; without a level, one
    /// by one. Results are bit-identical in every case. They depend on the image's aspect ratio, not on its
    /// number of pixels.
    ///
    /// A ray ends where its opacity reaches the frame's `termination`. `transfer` must be made from `volume`.
    /// `side` is the number of rays along each side of the footprint's bounding rectangle, reduced to
    /// [`MAX_PROBE_SIDE`] if larger. If `side` is 0 or `transfer` has other cells or blocks than `volume`, no
    /// ray is cast and only the footprint is computed.
    pub(super) fn on(
        level: Option<Level>,
        volume: &VolumeSummary,
        transfer: &mut TransferSummary,
        frame: &Frame,
        side: usize,
    ) -> Self {
        let shape = volume.shape();
        let footprint = Footprint::new(shape.half_extent, &frame.camera, frame.width, frame.height);
        if side == 0 || footprint.share <= 0.0 || !transfer.suits(volume) {
            return Self { footprint, ..Self::nothing() };
        }
        // The buffers' size follows the number of rays, so that small probes do not clear large buffers.
        match side {
            ..=4 => Self::cast::<16>(level, volume, transfer, frame, footprint, side),
            5..=8 => Self::cast::<64>(level, volume, transfer, frame, footprint, side),
            9..=12 => Self::cast::<144>(level, volume, transfer, frame, footprint, side),
            _ => {
                let side = side.min(MAX_PROBE_SIDE);
                Self::cast::<MAX_RAYS>(level, volume, transfer, frame, footprint, side)
            }
        }
    }

    /// Marches the rays of [`Probe::on`] with a given footprint and with buffers for `ROOM` rays, at least
    /// `side`².
    fn cast<const ROOM: usize>(
        level: Option<Level>,
        volume: &VolumeSummary,
        transfer: &mut TransferSummary,
        frame: &Frame,
        footprint: Footprint,
        side: usize,
    ) -> Self {
        let shape = volume.shape();
        let count = side * side;
        let per_side = 1.0 / side as f32;
        let (low, high) = (footprint.low, footprint.high);
        let size = [high[0] - low[0], high[1] - low[1]];
        let mut room = [[0.0f32; ROOM]; FIELDS];
        let mut rays = room.each_mut().map(|field| field.as_mut_slice());
        for iy in 0..side {
            for ix in 0..side {
                let i = iy * side + ix;
                rays[U][i] = low[0] + size[0] * (ix as f32 + OFFSETS[i][0]) * per_side;
                rays[V][i] = low[1] + size[1] * (iy as f32 + OFFSETS[i][1]) * per_side;
                rays[DRAW][i] = OFFSETS[i][2];
            }
        }
        let mut march = March::new(volume, transfer, frame, shape);
        march.all(level, &mut rays, count);
        let mut hits = rays[CHORD][..count].iter().filter(|&&c| c > 0.0).count();
        if hits == 0 {
            // The footprint is so narrow that every ray misses the box: one ray through the footprint's
            // center replaces these rays.
            [rays[U][0], rays[V][0]] = footprint.center;
            rays[DRAW][0] = 0.5;
            march.all(level, &mut rays, 1);
            hits = usize::from(rays[CHORD][0] > 0.0);
        }
        let (block_skips, distance_skips) = (march.block_skips, march.distance_skips);
        let mapped = march.maps_distance();
        if hits == 0 {
            return Self { footprint, ..Self::nothing() };
        }
        let inv = 1.0 / hits as f32;
        let total = |field: usize| sum(&rays[field][..count]);
        let occupied = total(OCCUPIED_LENGTH);
        // Mean depth of the samples along the view axis, or the depth of the volume's center if there are no
        // samples.
        let depth = if occupied > 0.0 { total(DEPTH) / occupied } else { frame.camera.to_arcball().dz };
        let aspect = frame.width as f32 / frame.height as f32;
        let mut all = [0.0f32; ROOM];
        for ((all, &occupied), &empty) in
            all.iter_mut().zip(&*rays[OCCUPIED_LENGTH]).zip(&*rays[EMPTY_LENGTH])
        {
            *all = occupied + empty;
        }
        // In lockstep, a pixel whose ray misses the box waits for its neighbors too, so such rays are
        // included.
        let most = if side <= 14 { most_nearby::<16> } else { most_nearby::<32> };
        let (occupied_max, all_max) =
            (most(&rays[OCCUPIED_LENGTH][..count], side), most(&all[..count], side));
        let sampled =
            if frame.skipping == Skipping::None { &all[..count] } else { &rays[OCCUPIED_LENGTH][..count] };
        let error = relative_error(sampled, &rays[CHORD][..count], side, hits);
        let block_skips = block_skips.mean(inv);
        let longest = |field: usize| largest(&rays[field][..count]);
        Self {
            footprint,
            rays: hits as u32,
            mean_chord: total(CHORD) * inv,
            occupied: occupied * inv,
            empty: total(EMPTY_LENGTH) * inv,
            visible: total(VISIBLE_LENGTH) * inv,
            busy: total(BUSY_LENGTH) * inv,
            ends_apart: if frame.shading.scatters() { ends_apart(&all[..count], &rays, side) } else { 0.0 },
            runs: total(RUNS) * inv,
            segments: total(SEGMENTS) * inv,
            spread: frame.camera.height_at(depth) / shape.reference_step,
            terminated: total(TERMINATED) * inv,
            occupied_max: occupied_max * inv,
            all_max: all_max * inv,
            spacing: libm::sqrtf((size[0] * aspect * size[1]).max(1.0e-12)) * 0.5 * per_side,
            shadow: total(SHADOW) * inv,
            shadow_skips: total(SHADOW_SKIPS) * inv,
            shadow_all: total(SHADOW_ALL) * inv,
            shadow_segments: total(SHADOW_SEGMENTS) * inv,
            shadow_ended: total(SHADOW_ENDED) * inv,
            longest: Longest {
                occupied: longest(OCCUPIED_LENGTH),
                all: largest(&all[..count]),
                segments: longest(SEGMENTS),
                shadow: longest(SHADOW),
                shadow_all: longest(SHADOW_ALL),
                shadow_segments: longest(SHADOW_SEGMENTS),
            },
            error,
            block_skips,
            distance_skips: if mapped { distance_skips.mean(inv) } else { block_skips },
        }
    }

    /// Adapts the results to another view of the same volume, close to the measured one: recomputes the
    /// footprint and keeps the results of the rays. Returns false if no ray met the box or the footprint is
    /// empty.
    pub(super) fn turn(&mut self, shape: Shape, frame: &Frame) -> bool {
        let footprint = Footprint::new(shape.half_extent, &frame.camera, frame.width, frame.height);
        if self.rays == 0 || footprint.share <= 0.0 {
            return false;
        }
        self.footprint = footprint;
        true
    }

    /// Expected jumps per ray at a step, with block skipping or with the distance map.
    pub(super) fn skips(&self, step: f32, distance: bool) -> f32 {
        if distance { self.distance_skips.visited(step) } else { self.block_skips.visited(step) }
    }
}

/// Largest value over all rays, for each kind of work. Units are those of the fields of [`Probe`] with the
/// same names.
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Zeroable)]
pub(super) struct Longest {
    pub(super) occupied: f32,
    /// Sum of the lengths in occupied and in empty blocks.
    pub(super) all: f32,
    pub(super) segments: f32,
    pub(super) shadow: f32,
    pub(super) shadow_all: f32,
    pub(super) shadow_segments: f32,
}

/// Histogram of chords through empty space by length. Each bin holds the mean per ray of the number of
/// chords, and the mean per ray of their total length in reference steps.
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Zeroable)]
struct Chords {
    count: [f32; BINS],
    length: [f32; BINS],
}

impl Chords {
    /// Expected number of chords per ray that contain a sample position: Σ min(1, length / step).
    fn visited(&self, step: f32) -> f32 {
        let inv = 1.0 / step;
        self.count.iter().zip(&self.length).map(|(&n, &l)| n.min(l * inv)).sum()
    }
}

/// Sum of the values. The order of additions does not depend on the width of the CPU's vectors, so neither
/// does the result.
fn sum(values: &[f32]) -> f32 {
    in_lanes(values, |a, b| a + b)
}

/// The largest of the values, which are not negative; 0 without values.
fn largest(values: &[f32]) -> f32 {
    in_lanes(values, larger)
}

fn larger(a: f32, b: f32) -> f32 {
    if b > a { b } else { a }
}

/// Combines 0 and all values, in an order that does not depend on the width of the CPU's vectors.
fn in_lanes(values: &[f32], combine: impl Fn(f32, f32) -> f32) -> f32 {
    let mut lanes = [0.0f32; 16];
    let (chunks, rest) = chunks::<16, _>(values);
    for chunk in chunks {
        lanes.iter_mut().zip(chunk).for_each(|(a, b)| *a = combine(*a, *b));
    }
    lanes.iter_mut().zip(rest).for_each(|(a, b)| *a = combine(*a, *b));
    let mut width = 16;
    while width > 1 {
        width /= 2;
        for i in 0..width {
            lanes[i] = combine(lanes[i], lanes[i + width]);
        }
    }
    lanes[0]
}

/// Sum, over rays, of the maximum value among a ray and its four neighbors; values are not negative. `W` must
/// exceed `side` by at least 2.
fn most_nearby<const W: usize>(values: &[f32], side: usize) -> f32 {
    let mut padded = [[0.0f32; W]; MAX_PROBE_SIDE + 2];
    for (line, values) in padded[1..=side].iter_mut().zip(values.chunks_exact(side)) {
        line[1..=side].copy_from_slice(values);
    }
    let mut sums = [0.0f32; W];
    for lines in padded[..side + 2].windows(3) {
        for x in 1..W - 1 {
            let across = larger(lines[1][x - 1], lines[1][x + 1]);
            let along = larger(lines[0][x], lines[2][x]);
            sums[x] += larger(larger(across, along), lines[1][x]);
        }
    }
    sums[1..=side].iter().sum()
}

/// Computes [`Probe::ends_apart`] from the lengths of the rays up to their ends, `ends`, and from their
/// visible lengths.
fn ends_apart(ends: &[f32], rays: &[&mut [f32]; FIELDS], side: usize) -> f32 {
    let (visible, terminated) = (&rays[VISIBLE_LENGTH], &rays[TERMINATED]);
    let (mut distance, mut length) = (0.0f32, 0.0f32);
    let mut add = |i: usize, j: usize| {
        let both = terminated[i] * terminated[j];
        distance += both * (ends[i] - ends[j]).abs();
        length += both * 0.5 * (visible[i] + visible[j]);
    };
    for y in 0..side {
        for i in y * side..(y + 1) * side - 1 {
            add(i, i + 1);
        }
    }
    for i in 0..side * (side - 1) {
        add(i, i + side);
    }
    if distance > 0.0 { distance / (distance + length) } else { 0.0 }
}

/// Relative standard error of the mean over the rays that hit the box, estimated from the differences of
/// neighboring rays. It is an overestimate, since the rays are stratified.
fn relative_error(values: &[f32], chords: &[f32], side: usize, hits: usize) -> f32 {
    let (mut squares, mut pairs) = (0.0f32, 0.0f32);
    for (values, chords) in values.chunks_exact(side).zip(chords.chunks_exact(side)) {
        for x in 1..side {
            let both = if chords[x - 1] > 0.0 && chords[x] > 0.0 { 1.0 } else { 0.0 };
            let apart = values[x] - values[x - 1];
            squares += both * apart * apart;
            pairs += both;
        }
    }
    let total = sum(values);
    if total > 0.0 && pairs > 0.0 {
        libm::sqrtf(0.5 * squares / pairs * hits as f32) / total
    } else {
        // Nothing was sampled, or no two neighboring rays met the box: the error is unknown.
        f32::INFINITY
    }
}

/// Three numbers in [0, 1) for each ray. The first two are the offset of the ray in its stratum, from the
/// additive recurrence of the plastic number, a low-discrepancy sequence. The third selects the start of the
/// shadow ray ([`DRAW`]); it comes from the recurrence of the golden ratio, independent of the first two.
static OFFSETS: [[f32; 3]; MAX_RAYS] = {
    let mut out = [[0.0; 3]; MAX_RAYS];
    let mut i = 0;
    while i < MAX_RAYS {
        let u = 0.5 + i as f64 * 0.754_877_666_246_692_8;
        let v = 0.5 + i as f64 * 0.569_840_290_998_053_2;
        let w = 0.5 + i as f64 * 0.618_033_988_749_894_8;
        out[i] = [(u - u as u64 as f64) as f32, (v - v as u64 as f64) as f32, (w - w as u64 as f64) as f32];
        i += 1;
    }
    out
};
