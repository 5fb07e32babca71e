//! Marches single rays through the grid of cells. Defines the state that is shared with packets of rays.

use super::{BINS, Chords, SHADOW_DIRECTION, SHADOW_OPACITY};
use crate::features::{TransferSummary, VolumeSummary};
use entire_core::kernels::Level;
use entire_core::memory::chunks;
use entire_core::scene::Shape;
use entire_core::scene::{Frame, Skipping};
use glam::Vec3;

/// Indices of a ray's fields; each field of all rays is stored in one array. `U` and `V` are image
/// coordinates in [−1, 1].
pub(super) const U: usize = 0;
pub(super) const V: usize = 1;
/// Random number in [0, 1) that selects the visible point from which the shadow ray starts.
pub(super) const DRAW: usize = 2;
/// Length inside the box. This field and those below are results; all lengths are in reference steps.
pub(super) const CHORD: usize = 3;
/// Lengths in occupied blocks, in empty blocks, and of visible samples, all up to termination.
pub(super) const OCCUPIED_LENGTH: usize = 4;
pub(super) const EMPTY_LENGTH: usize = 5;
pub(super) const VISIBLE_LENGTH: usize = 6;
/// Number of runs of samples.
pub(super) const RUNS: usize = 7;
/// Integral of the depth over the length in occupied blocks.
pub(super) const DEPTH: usize = 8;
/// 1 where the ray ended early, otherwise 0.
pub(super) const TERMINATED: usize = 9;
/// Length of the shadow ray in occupied blocks, the number of empty cells that it meets, and its whole
/// length, each times the visible length of the primary ray.
pub(super) const SHADOW: usize = 10;
pub(super) const SHADOW_SKIPS: usize = 11;
pub(super) const SHADOW_ALL: usize = 12;
/// Number of lookups in the skip map by the primary ray; and by its shadow ray, times the visible length of
/// the primary ray.
pub(super) const SEGMENTS: usize = 13;
pub(super) const SHADOW_SEGMENTS: usize = 14;
/// Length over which at least one of 2^[`LANES_LOG2`] adjacent rays has a visible sample; 0 without single
/// scattering.
pub(super) const BUSY_LENGTH: usize = 15;
/// Visible length of the primary ray if its shadow ray ended early, otherwise 0.
pub(super) const SHADOW_ENDED: usize = 16;
/// Number of a ray's fields.
pub(super) const FIELDS: usize = 17;

/// log2 of the number of rays that a renderer on the CPU marches in lockstep.
pub(super) const LANES_LOG2: usize = 3;

/// Smallest magnitude of a direction component; components closer to 0 are set to this magnitude.
pub(super) const MIN_COMPONENT: f32 = 1.0e-9;

/// Number of chords that are binned at a time.
pub(super) const BINNED_CHORDS: usize = 256;

/// Exponent field of an `f32` in the first bin of chords, which begins at 2⁻⁴ reference steps.
const FIRST_BIN_EXPONENT: u32 = 127 - 4;

/// Histogram of chords through empty space by length, in integers, so that sums do not depend on the order of
/// the rays.
#[derive(Clone, Copy)]
pub(super) struct ChordCounts {
    count: [u64; BINS],
    length: [u64; BINS],
}

impl ChordCounts {
    const NOTHING: Self = Self { count: [0; BINS], length: [0; BINS] };

    /// Integer units per chord, and per reference step of length.
    pub(super) const UNIT: f32 = 1048576.0;

    /// Length to which longer chords are clamped, in reference steps.
    pub(super) const MAX_CHORD: f32 = 2040.0;

    #[inline(always)]
    fn bin(length: f32) -> u32 {
        let half_octave = length.to_bits() >> 22;
        half_octave.saturating_sub(FIRST_BIN_EXPONENT << 1).min(BINS as u32 - 1)
    }

    /// Converts a length in reference steps to integer units, [`Self::UNIT`] per reference step.
    #[inline(always)]
    fn units(length: f32) -> u32 {
        let length = if length < Self::MAX_CHORD { length } else { Self::MAX_CHORD };
        (length * Self::UNIT) as i32 as u32
    }

    #[inline(always)]
    pub(super) fn add_one(&mut self, length: f32) {
        let bin = Self::bin(length) as usize;
        self.count[bin] += Self::UNIT as u64;
        self.length[bin] += u64::from(Self::units(length));
    }

    /// Adds the first `count` chords; `units` holds their lengths in the integer units of [`Self::UNIT`].
    #[inline(always)]
    pub(super) fn add_all(
        &mut self,
        lengths: &[f32; BINNED_CHORDS],
        units: &[u32; BINNED_CHORDS],
        count: usize,
    ) {
        /// One chord in a packed sum, which holds the count in bits 40 to 63 and the length in bits 0 to 39.
        const ONE: u64 = 1 << 40;
        let bins = lengths.map(Self::bin);
        // Four tables in turn: in a single table, equal neighboring bins would serialize the additions.
        let mut sums = [[0u64; 32]; 4];
        let [a, b, c, d] = &mut sums;
        let one = |sums: &mut [u64; 32], bin: u32, units: u32| {
            sums[bin as usize % 32] += ONE + u64::from(units);
        };
        let (fours, rest) = chunks::<4, _>(&bins[..count]);
        for (&[i, j, k, l], &[s, t, u, v]) in fours.iter().zip(chunks::<4, _>(units).0) {
            one(a, i, s);
            one(b, j, t);
            one(c, k, u);
            one(d, l, v);
        }
        for (&bin, &units) in rest.iter().zip(&units[count - rest.len()..]) {
            one(a, bin, units);
        }
        for bin in 0..BINS {
            let sum: u64 = sums.iter().map(|s| s[bin]).sum();
            self.count[bin] += (sum / ONE) * Self::UNIT as u64;
            self.length[bin] += sum % ONE;
        }
    }

    /// Adds chords of length `length` with the total length `together`.
    #[inline(always)]
    pub(super) fn add_many(&mut self, length: f32, together: f32) {
        let bin = Self::bin(length) as usize;
        self.count[bin] += (together / length * Self::UNIT) as u64;
        self.length[bin] += (together.min(16_777_216.0) * Self::UNIT) as u64;
    }

    /// Mean over rays; `inv` is the reciprocal of their number.
    pub(super) fn mean(&self, inv: f32) -> Chords {
        let scale = |v: u64| v as f32 * (inv / Self::UNIT);
        Chords { count: self.count.map(scale), length: self.length.map(scale) }
    }
}

/// Data shared by all rays of a frame.
pub(super) struct March<'a> {
    pub(super) volume: &'a VolumeSummary,
    pub(super) transfer: &'a mut TransferSummary,
    pub(super) grid: [i32; 3],
    /// Ray basis, see [`entire_core::scene::Camera::ray_basis`].
    pub(super) origin: [Vec3; 3],
    pub(super) direction: [Vec3; 3],
    pub(super) half_extent: Vec3,
    /// Number of cells per scene unit along each axis.
    pub(super) scale: Vec3,
    /// Half a voxel, in units of cells; cells begin at voxel centers.
    pub(super) shift: Vec3,
    pub(super) scatters: bool,
    /// True if the frame skips by a distance map.
    maps: bool,
    /// Reference steps per scene unit.
    pub(super) per_step: f32,
    /// Optical depth at which a ray ends.
    pub(super) depth_end: f32,
    /// Optical depth at which a shadow ray ends.
    pub(super) shadow_end: f32,
    /// Edges of a block in scene units; `None` unless cells hold several blocks.
    pub(super) block: Option<Vec3>,
    pub(super) block_skips: ChordCounts,
    pub(super) distance_skips: ChordCounts,
}

impl<'a> March<'a> {
    pub(super) fn new(
        volume: &'a VolumeSummary,
        transfer: &'a mut TransferSummary,
        frame: &Frame,
        shape: Shape,
    ) -> Self {
        let dims = Vec3::from_array(shape.dims.map(|n| n as f32));
        let edge = Vec3::from_array(volume.edge.map(|n| n as f32));
        let block = Vec3::from_array(volume.block.map(|n| n as f32));
        let voxel = 2.0 * shape.half_extent / dims;
        let termination = frame.termination;
        let (origin, direction) = frame.camera.ray_basis(frame.width, frame.height);
        Self {
            volume,
            transfer,
            grid: volume.cells.map(|n| n as i32),
            origin,
            direction,
            half_extent: shape.half_extent,
            scale: 1.0 / (voxel * edge),
            shift: 0.5 / edge,
            scatters: frame.shading.scatters(),
            per_step: 1.0 / shape.reference_step,
            depth_end: if termination < 1.0 { -libm::log1pf(-termination) } else { f32::INFINITY },
            shadow_end: -libm::log1pf(-SHADOW_OPACITY),
            maps: frame.skipping == Skipping::Distance,
            block: (block != edge).then_some(block * voxel),
            block_skips: ChordCounts::NOTHING,
            distance_skips: ChordCounts::NOTHING,
        }
    }

    /// True if the frame skips by a distance map, whose jumps are counted separately.
    pub(super) fn maps_distance(&self) -> bool {
        self.maps && self.transfer.distance().is_some()
    }

    /// Marches the first `count` rays, in packets if a SIMD level is given. With a distance map, rays are
    /// marched one by one.
    pub(super) fn all(&mut self, level: Option<Level>, rays: &mut [&mut [f32]; FIELDS], count: usize) {
        match level {
            Some(level) if !self.maps_distance() => super::packet::march(level, self, rays, count),
            _ => self.one_by_one(rays, count),
        }
    }

    /// Upper bound of the number of cells along a ray: it crosses each plane between cells at most once. If
    /// cells are nearly as thin as the rounding error of the ray parameter t, [`Walk`] may leave the grid
    /// before t reaches the exit.
    pub(super) fn most_cells(&self) -> i32 {
        self.grid.iter().sum::<i32>() + 3
    }

    /// Marches the first `count` rays one by one.
    #[allow(clippy::needless_range_loop, reason = "the index runs over the arrays of all fields")]
    fn one_by_one(&mut self, rays: &mut [&mut [f32]; FIELDS], count: usize) {
        for i in 0..count {
            let at = |[middle, right, up]: [Vec3; 3]| middle + rays[U][i] * right + rays[V][i] * up;
            let ray = self.ray(at(self.origin), at(self.direction), rays[DRAW][i]);
            for (field, value) in rays.iter_mut().zip(ray).skip(CHORD) {
                field[i] = value;
            }
        }
    }

    /// Marches one ray and returns its results, by field. `draw` in [0, 1) selects the visible point from
    /// which a shadow ray starts.
    fn ray(&mut self, origin: Vec3, direction: Vec3, mut draw: f32) -> [f32; FIELDS] {
        let mut out = [0.0; FIELDS];
        let safe = Vec3::from_array(direction.to_array().map(|d| {
            let least = if d < 0.0 { -MIN_COMPONENT } else { MIN_COMPONENT };
            if d.abs() < MIN_COMPONENT { least } else { d }
        }));
        let inverse = 1.0 / safe;
        let (a, b) = ((-self.half_extent - origin) * inverse, (self.half_extent - origin) * inverse);
        let t_enter = a.min(b).max_element().max(0.0);
        let t_exit = a.max(b).min_element();
        if !(t_enter < t_exit) {
            return out;
        }
        // Reference steps per unit of the ray parameter t.
        let rate = direction.length() * self.per_step;
        out[CHORD] = (t_exit - t_enter) * rate;
        let start = (origin + t_enter * safe + self.half_extent) * self.scale - self.shift;
        let mut walk = Walk::new(start, safe * self.scale, t_enter, self.grid);
        let mean_block_chord = self.block.map(|b| {
            let d = direction.abs();
            rate * (b.x * b.y * b.z) / (d.x * b.y * b.z + d.y * b.x * b.z + d.z * b.x * b.y)
        });
        // Cell borders crossed per reference step.
        let crossings = crossings(safe * self.scale) / rate;
        let mut t = t_enter;
        let mut depth = 0.0f32;
        // Current jump of the distance map: start, reach, length so far.
        let mut jump = Jump::NONE;
        let mut was_occupied = false;
        // t at which the shadow ray starts; negative for none.
        let mut lit = -1.0f32;
        for _ in 0..self.most_cells() {
            let t_next = walk.leaves().min(t_exit);
            let length = (t_next - t).max(0.0) * rate;
            let cell = walk.index as usize;
            if let Some(here) = self.transfer.optics(self.volume, cell) {
                jump.finish(&mut self.distance_skips);
                jump = Jump::NONE;
                let d = here.extinction * length;
                let (used, ends) = if depth + d >= self.depth_end {
                    ((self.depth_end - depth) / d * length, true)
                } else {
                    (length, false)
                };
                let inside = used * here.occupied;
                out[OCCUPIED_LENGTH] += inside;
                // Ray directions have length 1 along the view axis, so t is the depth.
                out[DEPTH] += inside * (t + t_next);
                out[SEGMENTS] += used * here.looks * crossings;
                out[RUNS] += if was_occupied { 0.0 } else { 1.0 };
                was_occupied = true;
                let shown = used * here.visible;
                out[VISIBLE_LENGTH] += shown;
                if self.scatters && shown > 0.0 {
                    // After the loop, `miss` is the probability that none of the 2^LANES_LOG2 lanes hits a
                    // visible value, if the lanes sample the cell independently.
                    let mut miss = 1.0 - here.visible;
                    for _ in 0..LANES_LOG2 {
                        miss *= miss;
                    }
                    out[BUSY_LENGTH] += used * (1.0 - miss);
                    // Reservoir sampling keeps one visible point, each with a probability proportional to the
                    // visible length around it. `draw` is scaled to [0, 1) again for the next cell.
                    let keep = shown / out[VISIBLE_LENGTH];
                    if draw < keep {
                        draw /= keep;
                        lit = t + draw * (t_next - t);
                    } else {
                        draw = (draw - keep) / (1.0 - keep);
                    }
                }
                if here.occupied < 1.0 {
                    let empty = used - inside;
                    out[EMPTY_LENGTH] += empty;
                    if let Some(chord) = mean_block_chord {
                        let more = empty / chord * here.occupied;
                        out[RUNS] += more;
                        out[SEGMENTS] += more;
                        self.distance_skips.add_many(chord, empty);
                    }
                }
                if ends {
                    out[TERMINATED] = 1.0;
                    break;
                }
                depth += d;
            } else {
                was_occupied = false;
                out[EMPTY_LENGTH] += length;
                if mean_block_chord.is_none() {
                    self.block_skips.add_one(length);
                }
                let reach = self.transfer.distance().filter(|_| self.maps).and_then(|map| map.get(cell));
                if let Some(&reach) = reach {
                    let index = walk.index;
                    let (nx, ny) = (self.grid[0], self.grid[1]);
                    let place = [index % nx, index / nx % ny, index / nx / ny];
                    if !jump.covers(place) {
                        jump.finish(&mut self.distance_skips);
                        jump = Jump { from: place, reach: i32::from(reach), length: 0.0 };
                    }
                    jump.length += length;
                }
            }
            if t_next >= t_exit {
                break;
            }
            t = t_next;
            walk.advance();
        }
        out[DEPTH] *= 0.5;
        jump.finish(&mut self.distance_skips);
        if let Some(chord) = mean_block_chord {
            self.block_skips.add_many(chord, out[EMPTY_LENGTH]);
        }
        if lit >= 0.0 {
            let found = self.shadow(origin + lit * safe);
            let fields = [SHADOW, SHADOW_ALL, SHADOW_SKIPS, SHADOW_SEGMENTS, SHADOW_ENDED];
            for (field, value) in fields.into_iter().zip(found) {
                out[field] = out[VISIBLE_LENGTH] * value;
            }
        }
        out
    }

    /// Marches a shadow ray from a point in the box. Returns the length in occupied blocks, the whole length,
    /// the number of empty cells, the number of lookups in the skip map, and 1 if the ray ended early, else
    /// 0.
    fn shadow(&mut self, from: Vec3) -> [f32; 5] {
        let direction = Vec3::from_array(SHADOW_DIRECTION);
        let mut t_exit = f32::INFINITY;
        for k in 0..3 {
            // All components of the light's direction are positive, so the ray leaves through an upper face.
            t_exit = t_exit.min((self.half_extent[k] - from[k]) / direction[k]);
        }
        let start = (from + self.half_extent) * self.scale - self.shift;
        let mut walk = Walk::new(start, direction * self.scale, 0.0, self.grid);
        let rate = direction.length() * self.per_step;
        let crossings = crossings(direction * self.scale) / rate;
        let end = self.shadow_end;
        let (mut t, mut depth, mut occupied, mut skips, mut segments) =
            (0.0f32, 0.0f32, 0.0f32, 0.0f32, 0.0f32);
        for _ in 0..self.most_cells() {
            if !(t < t_exit) {
                break;
            }
            let t_next = walk.leaves().min(t_exit);
            let length = (t_next - t).max(0.0) * rate;
            let cell = walk.index as usize;
            if let Some(here) = self.transfer.optics(self.volume, cell) {
                let d = here.extinction * length;
                if depth + d >= end {
                    let used = (end - depth) / d;
                    return [
                        occupied + used * length * here.occupied,
                        (t + used * (t_next - t)) * rate,
                        skips,
                        segments + used * length * here.looks * crossings,
                        1.0,
                    ];
                }
                depth += d;
                occupied += length * here.occupied;
                segments += length * here.looks * crossings;
            } else {
                skips += 1.0;
            }
            t = t_next;
            walk.advance();
        }
        [occupied, t_exit.max(0.0) * rate, skips, segments, 0.0]
    }
}

/// Cell borders crossed per unit of t, summed over the axes.
fn crossings(pace: Vec3) -> f32 {
    let pace = pace.abs();
    pace.x + pace.y + pace.z
}

/// Steps through the cells along a ray, without branches (Amanatides and Woo). Faces met at the same t are
/// crossed together.
struct Walk {
    /// t of the next face between cells along each axis; infinite if the present cell is the last one in the
    /// ray's direction.
    next: [f32; 3],
    /// Increment of t between faces.
    delta: [f32; 3],
    /// Upper limit of finite values in `next`: along each axis, the t that lies half a cell beyond the last
    /// face between cells. If `next` exceeds this limit, `next` becomes infinite.
    last: [f32; 3],
    stride: [i32; 3],
    index: i32,
}

impl Walk {
    /// Starts at `start` (in cells) at t = `t_enter`, along `direction` (cells per t, no component zero).
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

    /// Steps to the next cell.
    #[inline(always)]
    fn advance(&mut self) {
        let t = self.leaves();
        for k in 0..3 {
            let crosses = self.next[k] <= t;
            let further = self.next[k] + self.delta[k];
            let further = if further > self.last[k] { f32::INFINITY } else { further };
            self.next[k] = if crosses { further } else { self.next[k] };
            self.index = self.index.wrapping_add(if crosses { self.stride[k] } else { 0 });
        }
    }
}

/// A jump by the distance map: its first cell, its reach in cells, and its length so far in reference steps.
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

    fn finish(&self, into: &mut ChordCounts) {
        if self.reach > 0 {
            into.add_one(self.length);
        }
    }
}
