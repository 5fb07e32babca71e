//! The coarse ray probe: a few rays through the grid of cells, marched once per frame, evaluated for any
//! step.

use super::{Footprint, Geometry, TransferSummary, VolumeSummary};
use crate::scene::{Frame, Shading};
use glam::Vec3;

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
const FIRST_BIN_EXPONENT: u32 = 127 - 4;

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
    /// Runs of samples between jumps: how often a ray comes from an empty block (or from outside) into an
    /// occupied one.
    pub(super) runs: f32,
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
        runs: 0.0,
        spread: 0.0,
        terminated: 0.0,
        occupied_max: 0.0,
        all_max: 0.0,
        spacing: 1.0,
        shadow: 0.0,
        shadow_skips: 0.0,
        shadow_all: 0.0,
        block_skips: Chords::NOTHING,
        distance_skips: Chords::NOTHING,
    };

    /// Marches the probe's rays through a volume. The image's shape enters, its number of pixels does not.
    ///
    /// A ray ends where the transmittance exp(−∫σ) falls to 1 − termination. `volume` must be the one that
    /// `transfer` was made from; a summary of another grid gives [`Probe::NOTHING`]. `side` rays go along
    /// each side of the footprint's bounding rectangle, [`MAX_PROBE_SIDE`] at most; with 0 the footprint
    /// alone is known.
    pub(crate) fn new(
        volume: &VolumeSummary,
        transfer: &TransferSummary,
        frame: &Frame,
        side: usize,
    ) -> Self {
        let geometry = volume.geometry();
        let footprint = Footprint::new(geometry.half_extent, frame.camera(), frame.width(), frame.height());
        if side == 0 || footprint.share <= 0.0 || transfer.grid() != volume.cells() {
            return Self { footprint, ..Self::NOTHING };
        }
        // Room for as many rays as there are, so that small probes do not pay for clearing that of large
        // ones.
        match side {
            ..=4 => Self::cast::<16>(volume, transfer, frame, footprint, side),
            5..=8 => Self::cast::<64>(volume, transfer, frame, footprint, side),
            9..=12 => Self::cast::<144>(volume, transfer, frame, footprint, side),
            _ => Self::cast::<MAX_RAYS>(volume, transfer, frame, footprint, side.min(MAX_PROBE_SIDE)),
        }
    }

    /// As [`Probe::new`], with room for side² ≤ `ROOM` rays.
    fn cast<const ROOM: usize>(
        volume: &VolumeSummary,
        transfer: &TransferSummary,
        frame: &Frame,
        footprint: Footprint,
        side: usize,
    ) -> Self {
        let geometry = volume.geometry();
        let count = side * side;
        let per_side = 1.0 / side as f32;
        let mut march = March::new(volume, transfer, frame, geometry);
        let (eye, right, up, forward) = frame.camera().ray_basis(frame.width(), frame.height());
        let (low, high) = (footprint.low, footprint.high);
        let size = [high[0] - low[0], high[1] - low[1]];
        let mut room = [Ray::MISS; ROOM];
        let rays = &mut room[..count];
        for (i, ray) in rays.iter_mut().enumerate() {
            let (ix, iy) = (i % side, i / side);
            let u = low[0] + size[0] * (ix as f32 + OFFSETS[i][0]) * per_side;
            let v = low[1] + size[1] * (iy as f32 + OFFSETS[i][1]) * per_side;
            *ray = march.ray(eye, forward + u * right + v * up, OFFSETS[count - 1 - i][0]);
        }
        let mut hits = rays.iter().filter(|r| r.chord > 0.0).count();
        if hits == 0 {
            // A sliver between the rays: its center stands for all of it.
            let [u, v] = footprint.center;
            rays[0] = march.ray(eye, forward + u * right + v * up, 0.5);
            hits = usize::from(rays[0].chord > 0.0);
        }
        if hits == 0 {
            return Self { footprint, ..Self::NOTHING };
        }
        let inv = 1.0 / hits as f32;
        let mut out = Self { footprint, rays: hits as u32, ..Self::NOTHING };
        for (i, ray) in rays.iter().enumerate() {
            out.mean_chord += ray.chord;
            out.max_chord = out.max_chord.max(ray.chord);
            out.occupied += ray.occupied;
            out.empty += ray.empty;
            out.visible += ray.visible;
            out.runs += ray.runs;
            out.spread += ray.depth;
            out.shadow += ray.shadow;
            out.shadow_skips += ray.shadow_skips;
            out.shadow_all += ray.shadow_all;
            out.terminated += f32::from(u8::from(ray.terminated));
            let (mut o, mut a) = (ray.occupied, ray.occupied + ray.empty);
            let (ix, iy) = (i % side, i / side);
            let mut consider = |n: &Ray| {
                o = o.max(n.occupied);
                a = a.max(n.occupied + n.empty);
            };
            if ix > 0 {
                consider(&rays[i - 1]);
            }
            if ix + 1 < side {
                consider(&rays[i + 1]);
            }
            if iy > 0 {
                consider(&rays[i - side]);
            }
            if iy + 1 < side {
                consider(&rays[i + side]);
            }
            // A pixel that misses the box waits for its neighbors too, so misses count.
            out.occupied_max += o;
            out.all_max += a;
        }
        // Depth along the view, weighted by the samples' length; where nothing is sampled, that of the
        // volume's center.
        let depth =
            if out.occupied > 0.0 { out.spread / out.occupied } else { frame.camera().to_arcball().dz };
        out.spread = 2.0 * libm::tanf(0.5 * frame.camera().fov_y()) * depth / geometry.reference_step;
        for total in [
            &mut out.mean_chord,
            &mut out.occupied,
            &mut out.empty,
            &mut out.visible,
            &mut out.runs,
            &mut out.shadow,
            &mut out.shadow_skips,
            &mut out.shadow_all,
            &mut out.terminated,
            &mut out.occupied_max,
            &mut out.all_max,
        ] {
            *total *= inv;
        }
        let aspect = frame.width() as f32 / frame.height() as f32;
        out.spacing = libm::sqrtf((size[0] * aspect * size[1]).max(1.0e-12)) * 0.5 * per_side;
        out.block_skips = march.block_skips;
        out.block_skips.scale(inv);
        out.distance_skips = if march.distance.is_some() {
            march.distance_skips.scale(inv);
            march.distance_skips
        } else {
            out.block_skips
        };
        out
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

/// Chords through empty space by length: how many, and how long together.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Chords {
    count: [f32; BINS],
    length: [f32; BINS],
}

impl Chords {
    const NOTHING: Self = Self { count: [0.0; BINS], length: [0.0; BINS] };

    /// Adds `count` chords of `length` each.
    #[inline]
    fn add(&mut self, length: f32, count: f32) {
        let half_octave = length.to_bits() >> 22;
        let bin = half_octave.saturating_sub(FIRST_BIN_EXPONENT << 1).min(BINS as u32 - 1) as usize;
        self.count[bin] += count;
        self.length[bin] += length * count;
    }

    fn scale(&mut self, by: f32) {
        for v in self.count.iter_mut().chain(&mut self.length) {
            *v *= by;
        }
    }

    /// Expected number of chords that hold a sample position: Σ min(1, length / step).
    fn visited(&self, step: f32) -> f32 {
        let inv = 1.0 / step;
        self.count.iter().zip(&self.length).map(|(&n, &l)| n.min(l * inv)).sum()
    }
}

#[derive(Clone, Copy)]
struct Ray {
    chord: f32,
    occupied: f32,
    empty: f32,
    visible: f32,
    runs: f32,
    /// ∫ depth over the length in occupied blocks.
    depth: f32,
    shadow: f32,
    shadow_skips: f32,
    shadow_all: f32,
    terminated: bool,
}

impl Ray {
    const MISS: Self = Self {
        chord: 0.0,
        occupied: 0.0,
        empty: 0.0,
        visible: 0.0,
        runs: 0.0,
        depth: 0.0,
        shadow: 0.0,
        shadow_skips: 0.0,
        shadow_all: 0.0,
        terminated: false,
    };
}

struct March<'a> {
    cells: &'a [super::transfer::Cell],
    distance: Option<&'a [u8]>,
    grid: [i32; 3],
    half_extent: Vec3,
    /// Cells per scene unit along each axis.
    scale: Vec3,
    /// Cells begin at voxel centers: half a voxel in cells.
    shift: Vec3,
    scatters: bool,
    /// Scene length of a reference step, inverted.
    per_step: f32,
    /// Optical depth at which a ray ends.
    depth_end: f32,
    /// Edges of a block in scene units where cells hold several blocks.
    block: Option<Vec3>,
    block_skips: Chords,
    distance_skips: Chords,
}

impl<'a> March<'a> {
    fn new(volume: &VolumeSummary, transfer: &'a TransferSummary, frame: &Frame, geometry: Geometry) -> Self {
        let dims = Vec3::from_array(volume.dims().map(|n| n as f32));
        let edge = Vec3::from_array(volume.cell_edge().map(|n| n as f32));
        let block = Vec3::from_array(volume.block_edge().map(|n| n as f32));
        let voxel = 2.0 * geometry.half_extent / dims;
        let termination = frame.termination();
        Self {
            cells: transfer.cells(),
            distance: transfer.distance(),
            grid: volume.cells().map(|n| n as i32),
            half_extent: geometry.half_extent,
            scale: 1.0 / (voxel * edge),
            shift: 0.5 / edge,
            scatters: frame.shading() == Shading::Scatter,
            per_step: 1.0 / geometry.reference_step,
            depth_end: if termination < 1.0 { -libm::log1pf(-termination) } else { f32::INFINITY },
            block: (block != edge).then_some(block * voxel),
            block_skips: Chords::NOTHING,
            distance_skips: Chords::NOTHING,
        }
    }

    /// Marches one ray. `draw` in [0, 1) picks the visible point that a shadow ray starts from.
    fn ray(&mut self, origin: Vec3, direction: Vec3, mut draw: f32) -> Ray {
        let tiny = 1.0e-9;
        let safe = Vec3::select(
            direction.abs().cmplt(Vec3::splat(tiny)),
            Vec3::splat(tiny).copysign(direction),
            direction,
        );
        let inverse = 1.0 / safe;
        let (a, b) = ((-self.half_extent - origin) * inverse, (self.half_extent - origin) * inverse);
        let t_enter = a.min(b).max_element().max(0.0);
        let t_exit = a.max(b).min_element();
        if !(t_enter < t_exit) {
            return Ray::MISS;
        }
        // Reference steps per unit of t.
        let rate = direction.length() * self.per_step;
        let mut out = Ray { chord: (t_exit - t_enter) * rate, ..Ray::MISS };
        let start = (origin + t_enter * safe + self.half_extent) * self.scale - self.shift;
        let mut walk = Walk::new(start, safe * self.scale, t_enter, self.grid);
        let mean_block_chord = self.block.map(|b| {
            let d = direction.abs();
            rate * (b.x * b.y * b.z) / (d.x * b.y * b.z + d.y * b.x * b.z + d.z * b.x * b.y)
        });
        let mut t = t_enter;
        let mut depth = 0.0f32;
        // Current jump of the distance map: where it began, how far it reaches, its length so far.
        let mut jump = Jump::NONE;
        let mut was_occupied = false;
        // Where on the ray the shadow ray starts; negative for none.
        let mut lit = -1.0f32;
        loop {
            let t_next = walk.leaves().min(t_exit);
            let length = (t_next - t).max(0.0) * rate;
            let Some(&here) = self.cells.get(walk.index as usize) else { break };
            if here.occupied == 0.0 {
                was_occupied = false;
                out.empty += length;
                match mean_block_chord {
                    None => self.block_skips.add(length, 1.0),
                    Some(chord) => self.block_skips.add(chord, length / chord),
                }
                if let Some(distance) = self.distance {
                    let index = walk.index;
                    let (nx, ny) = (self.grid[0], self.grid[1]);
                    let place = [index % nx, index / nx % ny, index / nx / ny];
                    if !jump.covers(place) {
                        jump.finish(&mut self.distance_skips);
                        jump = Jump {
                            from: place,
                            reach: i32::from(distance[walk.index as usize]),
                            length: 0.0,
                        };
                    }
                    jump.length += length;
                }
            } else {
                jump.finish(&mut self.distance_skips);
                jump = Jump::NONE;
                let d = here.extinction * length;
                let (used, ends) = if depth + d >= self.depth_end {
                    ((self.depth_end - depth) / d * length, true)
                } else {
                    (length, false)
                };
                let inside = used * here.occupied;
                out.occupied += inside;
                // A view's rays have unit length along its axis: t is depth.
                out.depth += inside * 0.5 * (t + t_next);
                out.runs += if was_occupied { 0.0 } else { 1.0 };
                was_occupied = true;
                let shown = used * here.visible;
                out.visible += shown;
                if self.scatters && shown > 0.0 {
                    // Keeps one visible point with the probability of its length, reusing the draw.
                    let keep = shown / out.visible;
                    if draw < keep {
                        draw /= keep;
                        lit = t + draw * (t_next - t);
                    } else {
                        draw = (draw - keep) / (1.0 - keep);
                    }
                }
                if here.occupied < 1.0 {
                    let empty = used - inside;
                    out.empty += empty;
                    if let Some(chord) = mean_block_chord {
                        out.runs += empty / chord * here.occupied;
                        self.block_skips.add(chord, empty / chord);
                        self.distance_skips.add(chord, empty / chord);
                    }
                }
                if ends {
                    out.terminated = true;
                    break;
                }
                depth += d;
            }
            if t_next >= t_exit {
                break;
            }
            t = t_next;
            walk.advance();
        }
        jump.finish(&mut self.distance_skips);
        if lit >= 0.0 {
            let (occupied, all, skips) = self.shadow(origin + lit * safe);
            out.shadow = out.visible * occupied;
            out.shadow_all = out.visible * all;
            out.shadow_skips = out.visible * skips;
        }
        out
    }

    /// Marches a shadow ray from a point in the box: length in occupied blocks, length in all, and empty
    /// blocks met.
    fn shadow(&self, from: Vec3) -> (f32, f32, f32) {
        let direction = Vec3::from_array(SHADOW_DIRECTION);
        let mut t_exit = f32::INFINITY;
        for k in 0..3 {
            // The direction's components are all positive.
            t_exit = t_exit.min((self.half_extent[k] - from[k]) / direction[k]);
        }
        let start = (from + self.half_extent) * self.scale - self.shift;
        let mut walk = Walk::new(start, direction * self.scale, 0.0, self.grid);
        let rate = direction.length() * self.per_step;
        let end = -libm::log1pf(-SHADOW_OPACITY);
        let (mut t, mut depth, mut occupied, mut skips) = (0.0f32, 0.0f32, 0.0f32, 0.0f32);
        while t < t_exit {
            let t_next = walk.leaves().min(t_exit);
            let length = (t_next - t).max(0.0) * rate;
            let Some(&here) = self.cells.get(walk.index as usize) else { break };
            if here.occupied == 0.0 {
                skips += 1.0;
            } else {
                let d = here.extinction * length;
                if depth + d >= end {
                    let used = (end - depth) / d;
                    return (
                        occupied + used * length * here.occupied,
                        (t + used * (t_next - t)) * rate,
                        skips,
                    );
                }
                depth += d;
                occupied += length * here.occupied;
            }
            if t_next >= t_exit {
                break;
            }
            t = t_next;
            walk.advance();
        }
        (occupied, t_exit.max(0.0) * rate, skips)
    }
}

/// The cells along a ray, one after another, without branches (Amanatides and Woo). Several faces met at once
/// are crossed at once.
struct Walk {
    /// t at which the ray leaves the present cell along each axis; infinite in the outermost cell, which
    /// reaches to the box.
    next: [f32; 3],
    /// Growth of t from face to face.
    delta: [f32; 3],
    /// Later faces than this are not crossed.
    last: [f32; 3],
    stride: [i32; 3],
    index: i32,
}

impl Walk {
    /// From `start` (in cells) at t = `t_enter` along `direction` (cells per t, no component zero).
    fn new(start: Vec3, direction: Vec3, t_enter: f32, grid: [i32; 3]) -> Self {
        let mut out = Self { next: [0.0; 3], delta: [0.0; 3], last: [0.0; 3], stride: [0; 3], index: 0 };
        let mut stride = 1;
        for k in 0..3 {
            let cell = (start[k] as i32).clamp(0, grid[k] - 1);
            let forward = direction[k] > 0.0;
            let inverse = 1.0 / direction[k];
            let face = if forward { cell + 1 } else { cell };
            let left = if forward { grid[k] - 1 - cell } else { cell };
            let first = (t_enter + (face as f32 - start[k]) * inverse).max(t_enter);
            out.delta[k] = inverse.abs();
            out.last[k] = first + (left as f32 - 0.5) * out.delta[k];
            out.next[k] = if left == 0 { f32::INFINITY } else { first };
            out.stride[k] = if forward { stride } else { -stride };
            out.index += cell * stride;
            stride *= grid[k];
        }
        out
    }

    /// t at which the ray leaves the present cell.
    #[inline(always)]
    fn leaves(&self) -> f32 {
        let [x, y, z] = self.next;
        let xy = if x < y { x } else { y };
        if xy < z { xy } else { z }
    }

    /// Goes on to the next cell.
    #[inline(always)]
    fn advance(&mut self) {
        let t = self.leaves();
        for k in 0..3 {
            let crosses = self.next[k] <= t;
            let further = self.next[k] + self.delta[k];
            let further = if further > self.last[k] { f32::INFINITY } else { further };
            self.next[k] = if crosses { further } else { self.next[k] };
            self.index += if crosses { self.stride[k] } else { 0 };
        }
    }
}

/// A jump of the distance map, in cells.
#[derive(Clone, Copy)]
struct Jump {
    from: [i32; 3],
    reach: i32,
    length: f32,
}

impl Jump {
    const NONE: Self = Self { from: [0; 3], reach: 0, length: 0.0 };

    fn covers(&self, place: [i32; 3]) -> bool {
        self.reach > 0 && (0..3).all(|k| (place[k] - self.from[k]).abs() < self.reach)
    }

    fn finish(&self, into: &mut Chords) {
        if self.reach > 0 {
            into.add(self.length, 1.0);
        }
    }
}

/// Where in its stratum each ray goes: the additive recurrence of the plastic number, which fills the square
/// evenly.
static OFFSETS: [[f32; 2]; MAX_RAYS] = {
    let mut out = [[0.0; 2]; MAX_RAYS];
    let mut i = 0;
    while i < MAX_RAYS {
        let u = 0.5 + i as f64 * 0.754_877_666_246_692_8;
        let v = 0.5 + i as f64 * 0.569_840_290_998_053_2;
        out[i] = [(u - u as u64 as f64) as f32, (v - v as u64 as f64) as f32];
        i += 1;
    }
    out
};
