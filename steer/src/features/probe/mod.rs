//! The coarse ray probe: a few rays through the grid of cells, marched once per frame, evaluated for any
//! step.

mod march;
mod packet;
#[cfg(test)]
mod tests;

use self::march::{
    BUSY, CHORD, DEPTH, DRAW, EMPTY, FIELDS, March, OCCUPIED, RUNS, SEGMENTS, SHADOW, SHADOW_ALL,
    SHADOW_SEGMENTS, SHADOW_SKIPS, TERMINATED, U, V, VISIBLE,
};
use super::{Footprint, TransferSummary, VolumeSummary};
use entire_core::kernels::Level;
use entire_core::scene::{Frame, Shape, Skipping};

/// The probe has this many rays along each side of the footprint's bounding rectangle, unless told otherwise.
pub const PROBE_SIDE: usize = 11;

/// The finest probe.
pub const MAX_PROBE_SIDE: usize = 24;

/// Direction towards the light of single scattering in scene space, not normalized.
pub(crate) const SHADOW_DIRECTION: [f32; 3] = [0.4, 0.8, 0.45];

/// Step of shadow rays in steps of the frame.
pub(crate) const SHADOW_STEP: f32 = 2.0;

/// Opacity at which a shadow ray stops.
pub(crate) const SHADOW_OPACITY: f32 = 0.75;

const MAX_RAYS: usize = MAX_PROBE_SIDE * MAX_PROBE_SIDE;

/// Chord lengths through empty cells are kept in half octaves from 2⁻⁴ to 2¹⁰ reference steps.
const BINS: usize = 28;

/// Work of an average ray that meets the box, as lengths in reference steps; [`super::FrameFeatures::work`]
/// turns it into counts for a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Probe {
    pub(super) footprint: Footprint,
    /// Share of the probe's rays that met the box (of those in the bounding rectangle).
    pub(super) rays: u32,
    pub(super) mean_chord: f32,
    pub(super) max_chord: f32,
    /// Length inside occupied blocks up to termination.
    pub(super) occupied: f32,
    /// Length inside empty blocks up to termination.
    pub(super) empty: f32,
    /// Length in which samples have opacity.
    pub(super) visible: f32,
    /// Length in which any of eight rays beside each other meets a sample with opacity, as if each saw a part
    /// of a cell of its own; 0 unless the frame scatters.
    pub(super) busy: f32,
    /// Runs of samples between jumps: how often a ray comes from an empty block (or from outside) into an
    /// occupied one.
    pub(super) runs: f32,
    /// Segments of those runs: how often a renderer looks at a skip map that holds the distance to the nearest
    /// empty block, so that deep among occupied blocks a look lasts for several.
    pub(super) segments: f32,
    /// Distance of rays that are the image's height apart, reference steps, at the mean depth of the samples.
    pub(super) spread: f32,
    /// Share of rays that terminate early.
    pub(super) terminated: f32,
    /// As `occupied` and `occupied + empty`, the largest of a ray and its neighbors in the probe.
    pub(super) occupied_max: f32,
    pub(super) all_max: f32,
    /// Image distance between neighboring probe rays in units of the image's height.
    pub(super) spacing: f32,
    /// Visible length times the length in occupied blocks that a shadow ray covers; 0 unless the frame
    /// scatters.
    pub(super) shadow: f32,
    /// Visible length times the empty blocks that a shadow ray jumps over.
    pub(super) shadow_skips: f32,
    /// Visible length times the length of a shadow ray without skipping.
    pub(super) shadow_all: f32,
    /// Visible length times the segments of a shadow ray.
    pub(super) shadow_segments: f32,
    /// Standard error of the length among samples, as a share of it.
    pub(super) error: f32,
    block_skips: Chords,
    distance_skips: Chords,
}

impl Probe {
    /// A probe that met nothing.
    pub(crate) const NOTHING: Self = Self {
        footprint: Footprint::NOTHING,
        rays: 0,
        mean_chord: 0.0,
        max_chord: 0.0,
        occupied: 0.0,
        empty: 0.0,
        visible: 0.0,
        busy: 0.0,
        runs: 0.0,
        segments: 0.0,
        spread: 0.0,
        terminated: 0.0,
        occupied_max: 0.0,
        all_max: 0.0,
        spacing: 1.0,
        shadow: 0.0,
        shadow_skips: 0.0,
        shadow_all: 0.0,
        shadow_segments: 0.0,
        error: 0.0,
        block_skips: Chords::NOTHING,
        distance_skips: Chords::NOTHING,
    };

    /// Marches the probe's rays through a volume. The image's shape enters, its number of pixels does not.
    ///
    /// A ray ends where the transmittance exp(−∫σ) falls to 1 − termination. `volume` must be the one that
    /// `transfer` was made from; a summary of another grid gives [`Probe::NOTHING`]. `side` rays go along
    /// each side of the footprint's bounding rectangle, [`MAX_PROBE_SIDE`] at most; with 0 the footprint
    /// alone is known.
    #[cfg(test)]
    pub(crate) fn new(
        volume: &VolumeSummary,
        transfer: &mut TransferSummary,
        frame: &Frame,
        side: usize,
    ) -> Self {
        Self::on(Level::detect(), volume, transfer, frame, side)
    }

    /// As [`Probe::new`], with the instructions of a level. The numbers are the same on every level, to the
    /// last bit.
    pub(super) fn on(
        level: Level,
        volume: &VolumeSummary,
        transfer: &mut TransferSummary,
        frame: &Frame,
        side: usize,
    ) -> Self {
        Self::measured(Some(level), volume, transfer, frame, side)
    }

    /// With no level, one ray after another.
    fn measured(
        level: Option<Level>,
        volume: &VolumeSummary,
        transfer: &mut TransferSummary,
        frame: &Frame,
        side: usize,
    ) -> Self {
        let shape = volume.shape();
        let footprint = Footprint::new(shape.half_extent, &frame.camera, frame.width, frame.height);
        if side == 0 || footprint.share <= 0.0 || transfer.grid() != volume.cells() {
            return Self { footprint, ..Self::NOTHING };
        }
        // Room for as many rays as there are, so that small probes do not pay for clearing that of large
        // ones.
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

    /// As [`Probe::new`], with room for side² ≤ `ROOM` rays.
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
            // A sliver between the rays: its center stands for all of it.
            [rays[U][0], rays[V][0]] = footprint.center;
            rays[DRAW][0] = 0.5;
            march.all(level, &mut rays, 1);
            hits = usize::from(rays[CHORD][0] > 0.0);
        }
        let (block_skips, distance_skips) = (march.block_skips, march.distance_skips);
        let mapped = march.maps_distance();
        if hits == 0 {
            return Self { footprint, ..Self::NOTHING };
        }
        let inv = 1.0 / hits as f32;
        let total = |field: usize| sum(&rays[field][..count]);
        let occupied = total(OCCUPIED);
        // Depth along the view, weighted by the samples' length; where nothing is sampled, that of the
        // volume's center.
        let depth = if occupied > 0.0 { total(DEPTH) / occupied } else { frame.camera.to_arcball().dz };
        let aspect = frame.width as f32 / frame.height as f32;
        let mut all = [0.0f32; ROOM];
        for ((all, &occupied), &empty) in all.iter_mut().zip(&*rays[OCCUPIED]).zip(&*rays[EMPTY]) {
            *all = occupied + empty;
        }
        // A pixel that misses the box waits for its neighbors too, so misses count.
        let most = if side <= 14 { most_nearby::<16> } else { most_nearby::<32> };
        let (occupied_max, all_max) = (most(&rays[OCCUPIED][..count], side), most(&all[..count], side));
        let sampled = if frame.skipping == Skipping::None { &all[..count] } else { &rays[OCCUPIED][..count] };
        let error = relative_error(sampled, &rays[CHORD][..count], side, hits);
        let block_skips = block_skips.mean(inv);
        Self {
            footprint,
            rays: hits as u32,
            mean_chord: total(CHORD) * inv,
            max_chord: rays[CHORD][..count].iter().fold(0.0, |a, &b| if b > a { b } else { a }),
            occupied: occupied * inv,
            empty: total(EMPTY) * inv,
            visible: total(VISIBLE) * inv,
            busy: total(BUSY) * inv,
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
            error,
            block_skips,
            distance_skips: if mapped { distance_skips.mean(inv) } else { block_skips },
        }
    }

    /// Brings what rays met to another view of the same volume, which must be close to theirs: where the volume
    /// stands in the image is new, what a ray meets there stays. Gives whether there is anything to bring.
    pub(super) fn turn(&mut self, shape: Shape, frame: &Frame) -> bool {
        let footprint = Footprint::new(shape.half_extent, &frame.camera, frame.width, frame.height);
        if self.rays == 0 || footprint.share <= 0.0 {
            return false;
        }
        self.footprint = footprint;
        true
    }

    /// As [`Probe::new`], one ray after another.
    #[cfg(test)]
    pub(super) fn by_single_rays(
        volume: &VolumeSummary,
        transfer: &mut TransferSummary,
        frame: &Frame,
        side: usize,
    ) -> Self {
        Self::measured(None, volume, transfer, frame, side)
    }

    /// Share of the image that the box covers.
    pub(crate) fn footprint(&self) -> &Footprint {
        &self.footprint
    }

    /// Mean length of the box along rays that meet it, reference steps.
    #[cfg(test)]
    pub(crate) fn mean_chord(&self) -> f32 {
        self.mean_chord
    }

    /// Expected jumps per ray at a step, with block skipping or with the distance map.
    pub(super) fn skips(&self, step: f32, distance: bool) -> f32 {
        if distance { self.distance_skips.visited(step) } else { self.block_skips.visited(step) }
    }
}

/// Chords through empty space by length: how many a ray meets on average, and how long they are together.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Chords {
    count: [f32; BINS],
    length: [f32; BINS],
}

impl Chords {
    const NOTHING: Self = Self { count: [0.0; BINS], length: [0.0; BINS] };

    /// Expected number of chords that hold a sample position: Σ min(1, length / step).
    fn visited(&self, step: f32) -> f32 {
        let inv = 1.0 / step;
        self.count.iter().zip(&self.length).map(|(&n, &l)| n.min(l * inv)).sum()
    }
}

/// The sum, in an order that suits vectors of any width and is the same for all of them.
fn sum(values: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 16];
    let (chunks, rest) = values.as_chunks::<16>();
    for chunk in chunks {
        lanes.iter_mut().zip(chunk).for_each(|(a, b)| *a += b);
    }
    lanes.iter_mut().zip(rest).for_each(|(a, b)| *a += b);
    let mut width = 16;
    while width > 1 {
        width /= 2;
        for i in 0..width {
            lanes[i] += lanes[i + width];
        }
    }
    lanes[0]
}

/// The sum, over rays, of the largest value of a ray and its four neighbors; no value is negative. `W` must
/// exceed
/// `side` by 2.
fn most_nearby<const W: usize>(values: &[f32], side: usize) -> f32 {
    let larger = |a: f32, b: f32| if b > a { b } else { a };
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

/// Standard error of the mean over the rays that hit, as a share of it, from how much rays beside each other
/// differ: too large rather than too small, since each ray keeps to a part of the image of its own.
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
        // Nothing was sampled, or no two rays beside each other met the box: nobody knows.
        f32::INFINITY
    }
}

/// Where in its stratum each ray goes: the additive recurrence of the plastic number, which fills the square
/// evenly. Beside it the draw of its shadow ray: that of the golden ratio, which goes with neither.
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
