//! Marches packets of rays through the grid of cells, one ray per vector lane. The results are bit-identical
//! to those of [`March::ray`]. A lane whose ray has ended idles until its packet is done, so rays that cross
//! similar numbers of cells are put into the same packet.

use super::march::{
    BINNED_CHORDS, BUSY_LENGTH, CHORD, ChordCounts, DEPTH, DRAW, EMPTY_LENGTH, FIELDS, LANES_LOG2,
    MIN_COMPONENT, March, OCCUPIED_LENGTH, RUNS, SEGMENTS, SHADOW, SHADOW_ALL, SHADOW_ENDED, SHADOW_SEGMENTS,
    SHADOW_SKIPS, TERMINATED, U, V, VISIBLE_LENGTH,
};
use super::{MAX_RAYS, SHADOW_DIRECTION};
use crate::features::transfer::packed;
use crate::memory::chunks_mut;
use entire_core::kernels::{Kernel, Level, Simd};

/// Marches the first `count` rays. The length of each array of `rays` must be a multiple of 16.
pub(super) fn march(level: Level, march: &mut March<'_>, rays: &mut [&mut [f32]; FIELDS], count: usize) {
    level.run(Packets { march, rays, count });
}

struct Packets<'a, 'm, 'r> {
    march: &'a mut March<'m>,
    rays: &'a mut [&'r mut [f32]; FIELDS],
    count: usize,
}

impl Kernel for Packets<'_, '_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let mut packet = Packet { simd, march: self.march, kept: [0.0; BINNED_CHORDS], kept_count: 0 };
        let mut order = Order::NONE;
        packet.sort(self.rays, self.count, &mut order);
        let mut sources = ShadowSources { rays: [0; MAX_RAYS + 16], count: 0 };
        let mut at = 0;
        while at < order.len {
            packet.march(self.rays, &order.rays[at..], order.len - at, &mut sources);
            at += S::LANES;
        }
        packet.add_kept();
        if sources.count > 0 {
            packet.sort_shadows(self.rays, &sources, &mut order);
            let mut at = 0;
            while at < order.len {
                packet.march_shadows(self.rays, &order.rays[at..], order.len - at);
                at += S::LANES;
            }
        }
    }
}

/// Fields of a primary ray that hold x, y and z of its shadow ray's origin until the shadow ray is marched.
const SHADOW_ORIGIN: [usize; 3] = [SHADOW, SHADOW_ALL, SHADOW_SKIPS];

/// Primary rays from which a shadow ray starts, at the point in [`SHADOW_ORIGIN`].
struct ShadowSources {
    rays: [i32; MAX_RAYS + 16],
    count: usize,
}

/// Order in which rays are marched: by the number of cells that they cross.
struct Order {
    rays: [i32; MAX_RAYS + 16],
    len: usize,
    /// Group of each ray to be sorted; rays of group 0 are left out.
    groups: [u8; MAX_RAYS + 16],
    /// Working memory of the counting sort. Before the sort, element g + 1 is the number of rays in group g;
    /// after the sort, element g is the end of group g in `rays`.
    ends: [u16; LENGTHS + 1],
}

impl Order {
    const NONE: Self =
        Self { rays: [0; MAX_RAYS + 16], len: 0, groups: [0; MAX_RAYS + 16], ends: [0; LENGTHS + 1] };

    /// Records the groups of consecutive rays from ray `at` on.
    #[inline(always)]
    fn note(&mut self, at: usize, groups: &[i32]) {
        for (i, &group) in groups.iter().enumerate() {
            let group = group as usize % LENGTHS;
            self.groups[at + i] = group as u8;
            self.ends[group + 1] += 1;
        }
    }

    /// Sorts the first `count` rays by their recorded groups; `ray` returns the ray of an index in `groups`.
    #[inline(always)]
    fn sort(&mut self, count: usize, ray: impl Fn(usize) -> i32) {
        let ends = &mut self.ends;
        // Rays of group 0 are dropped; the others are compacted to the front.
        ends[1] = 0;
        for group in 1..LENGTHS {
            ends[group + 1] += ends[group];
        }
        for (i, &group) in self.groups.iter().enumerate().take(count).filter(|(_, group)| **group != 0) {
            let place = &mut ends[usize::from(group)];
            self.rays[usize::from(*place)] = ray(i);
            *place += 1;
        }
        self.len = usize::from(ends[LENGTHS - 1]);
    }
}

/// Entry and exit of a packet's rays in the box, and their directions.
struct Chords<S: Simd> {
    origin: Three<S>,
    direction: Three<S>,
    /// `direction`, with components closer to zero than [`MIN_COMPONENT`] replaced by ±[`MIN_COMPONENT`].
    safe: Three<S>,
    t_enter: S::F,
    t_exit: S::F,
}

/// Number of groups by which rays are sorted.
const LENGTHS: usize = 64;

/// Three vectors.
type Three<S> = [<S as Simd>::F; 3];

/// Steps through the cells along each ray (as [`super::march::Walk`]).
struct Walk<S: Simd> {
    next: Three<S>,
    delta: Three<S>,
    last: Three<S>,
    stride: [S::I; 3],
    index: S::I,
}

struct Packet<'a, 'm, S> {
    simd: S,
    march: &'a mut March<'m>,
    /// Lengths, not binned yet, of chords through empty cells.
    kept: [f32; BINNED_CHORDS],
    kept_count: usize,
}

impl<S: Simd> Packet<'_, '_, S> {
    #[inline(always)]
    fn walk(&self, start: Three<S>, direction: Three<S>, t_enter: S::F) -> Walk<S> {
        let simd = self.simd;
        let (zero, one) = (simd.splat(0.0), simd.splat(1.0));
        let none = simd.splat(f32::INFINITY);
        let mut walk = Walk {
            next: [zero; 3],
            delta: [zero; 3],
            last: [zero; 3],
            stride: [simd.splat_i(0); 3],
            index: simd.splat_i(0),
        };
        let mut stride = 1i32;
        for k in 0..3 {
            let furthest = simd.splat((self.march.grid[k] - 1) as f32);
            let whole = simd.trunc(simd.min(simd.max(start[k], zero), furthest));
            let cell = simd.to_f(whole);
            let forward = simd.lt(zero, direction[k]);
            let inverse = simd.div(one, direction[k]);
            let face = simd.select(forward, simd.add(cell, one), cell);
            let left = simd.select(forward, simd.sub(furthest, cell), cell);
            let first = simd.add(t_enter, simd.mul(simd.sub(face, start[k]), inverse));
            let first = simd.max(first, t_enter);
            let delta = simd.max(inverse, simd.sub(zero, inverse));
            walk.delta[k] = delta;
            walk.last[k] = simd.add(first, simd.mul(simd.sub(left, simd.splat(0.5)), delta));
            walk.next[k] = simd.select(simd.lt(zero, left), first, none);
            walk.stride[k] = simd.select_i(forward, simd.splat_i(stride), simd.splat_i(-stride));
            walk.index = simd.add_i(walk.index, simd.mul_i(whole, stride));
            stride *= self.march.grid[k];
        }
        walk
    }

    /// t at which each ray leaves its present cell.
    #[inline(always)]
    fn leaves(&self, walk: &Walk<S>) -> S::F {
        self.simd.min(self.simd.min(walk.next[0], walk.next[1]), walk.next[2])
    }

    /// Steps each ray to its next cell. For a ray that has left the box, the result is unspecified.
    ///
    /// Nothing here depends on the optics of the present cell, so the next cells can be fetched while these
    /// optics are loaded.
    #[inline(always)]
    fn advance(&self, walk: &mut Walk<S>) {
        let simd = self.simd;
        let t = self.leaves(walk);
        let none = simd.splat(f32::INFINITY);
        for k in 0..3 {
            let crosses = simd.le(walk.next[k], t);
            let further = simd.add(walk.next[k], walk.delta[k]);
            let further = simd.select(simd.lt(walk.last[k], further), none, further);
            walk.next[k] = simd.select(crosses, further, walk.next[k]);
            walk.index = simd.add_if(walk.index, crosses, walk.stride[k]);
        }
    }

    /// Returns the packed optics of each lane's cell, without the bits that hold the number of the edit
    /// ([`packed::EDIT`]), and the mask of those `lanes` whose cell is not empty. Before that, computes the
    /// optics of cells that no ray has met since the last edit of the transfer function: those of the present
    /// cells and of each lane's `next` cell, because many cells at once take less time.
    #[inline(always)]
    fn look(&mut self, index: S::I, next: S::I, lanes: S::M) -> (S::I, S::M) {
        let simd = self.simd;
        let (words, edit) = self.march.transfer.words();
        let edit = simd.splat_i(edit as i32);
        let mut found = simd.xor_i(simd.gather(words, index), edit);
        let unknown = self.unknown(found, lanes);
        if simd.any(unknown) {
            let after = self.unknown(simd.xor_i(simd.gather(words, next), edit), lanes);
            let chosen = simd.lane_bits(unknown) | simd.lane_bits(after) << 16;
            let mut cells = [[0i32; 16]; 2];
            simd.write_i(index, &mut cells[0]);
            simd.write_i(next, &mut cells[1]);
            self.march.transfer.compute::<32>(self.march.volume, bytemuck::cast(cells), chosen);
            found = simd.xor_i(simd.gather(self.march.transfer.words().0, index), edit);
        }
        (found, simd.and_m(simd.nonzero(found), lanes))
    }

    /// Mask of those `lanes` whose optics are not those of the present edit; `found` are the packed optics,
    /// XORed with the bits of the edit's number.
    #[inline(always)]
    fn unknown(&self, found: S::I, lanes: S::M) -> S::M {
        let simd = self.simd;
        simd.and_m(simd.nonzero(simd.and_i(found, packed::EDIT as i32)), lanes)
    }

    /// Extinction, visible share, and lookups in the skip map per crossed cell border, from the words that
    /// [`Self::look`] returns.
    #[inline(always)]
    fn optics(&self, found: S::I) -> Three<S> {
        let simd = self.simd;
        let bits = simd.and_i(found, packed::EXTINCTION as i32);
        let extinction = simd.as_f(simd.add_i(bits, simd.splat_i(packed::EXPONENT as i32)));
        let root = simd.to_f(simd.and_i(found, packed::SHOWS as i32));
        let root = simd.mul(root, simd.splat(packed::UNIT));
        let class = simd.mul_i(simd.and_i(found, packed::DEPTH as i32), -(packed::HALVING as i32));
        let looks = simd.as_f(simd.add_i(class, simd.splat_i(1.0f32.to_bits() as i32)));
        [extinction, simd.mul(root, root), looks]
    }

    #[inline(always)]
    fn magnitude(&self, v: S::F) -> S::F {
        self.simd.max(v, self.simd.sub(self.simd.splat(0.0), v))
    }

    /// Returns the values of a field for the rays with the indices `own`.
    #[inline(always)]
    fn of_rays(&self, field: &[f32], own: S::I) -> S::F {
        self.simd.as_f(self.simd.gather(bytemuck::cast_slice(field), own))
    }

    /// Cell borders that rays cross per unit of t, summed over the axes.
    #[inline(always)]
    fn crossings(&self, pace: &Three<S>) -> S::F {
        let simd = self.simd;
        let [x, y, z] = [self.magnitude(pace[0]), self.magnitude(pace[1]), self.magnitude(pace[2])];
        simd.add(simd.add(x, y), z)
    }

    /// Share of each cell's blocks that are occupied.
    #[inline(always)]
    fn share(&self, index: S::I) -> S::F {
        match self.march.transfer.occupied.as_slice() {
            [] => self.simd.splat(1.0),
            shares => self.simd.as_f(self.simd.gather(bytemuck::cast_slice(shares), index)),
        }
    }

    /// Component `k` of the rays' origins or directions, from their basis, at image coordinates (u, v).
    #[inline(always)]
    fn along(&self, [middle, right, up]: &[glam::Vec3; 3], k: usize, u: S::F, v: S::F) -> S::F {
        let simd = self.simd;
        let along = simd.add(simd.splat(middle[k]), simd.mul(u, simd.splat(right[k])));
        simd.add(along, simd.mul(v, simd.splat(up[k])))
    }

    /// Returns the origins and directions of the rays through image coordinates (u, v), and the t at which
    /// they enter and leave the box.
    #[inline(always)]
    fn chords(&self, u: S::F, v: S::F) -> Chords<S> {
        let simd = self.simd;
        let zero = simd.splat(0.0);
        let mut origins = [zero; 3];
        let mut direction = [zero; 3];
        let mut safe = [zero; 3];
        let (mut t_enter, mut t_exit) = (zero, simd.splat(f32::INFINITY));
        for k in 0..3 {
            let m = &*self.march;
            let (origin, d) = (self.along(&m.origin, k, u, v), self.along(&m.direction, k, u, v));
            let least = simd.select(simd.lt(d, zero), simd.splat(-MIN_COMPONENT), simd.splat(MIN_COMPONENT));
            let magnitude = self.magnitude(d);
            origins[k] = origin;
            direction[k] = d;
            safe[k] = simd.select(simd.lt(magnitude, simd.splat(MIN_COMPONENT)), least, d);
            let inverse = simd.div(simd.splat(1.0), safe[k]);
            let extent = m.half_extent[k];
            let a = simd.mul(simd.sub(simd.splat(-extent), origin), inverse);
            let b = simd.mul(simd.sub(simd.splat(extent), origin), inverse);
            t_enter = simd.max(t_enter, simd.min(a, b));
            t_exit = simd.min(t_exit, simd.max(a, b));
        }
        Chords { origin: origins, direction, safe, t_enter, t_exit }
    }

    /// Returns the group of each ray: 0 for rays outside `met`, otherwise 1 to `LENGTHS` − 1 by the number of
    /// crossed cells.
    #[inline(always)]
    fn group(&self, crossed: S::F, met: S::M) -> S::I {
        let simd = self.simd;
        let cells = self.march.grid.iter().sum::<i32>() as f32;
        let group = simd.mul(crossed, simd.splat((LENGTHS - 2) as f32 / cells));
        let group = simd.add(simd.min(group, simd.splat((LENGTHS - 2) as f32)), simd.splat(1.0));
        simd.trunc(simd.select(met, group, simd.splat(0.0)))
    }

    /// Sorts the rays that meet the box by the number of crossed cells, and sets every chord to zero.
    #[inline(always)]
    fn sort(&self, rays: &mut [&mut [f32]; FIELDS], count: usize, order: &mut Order) {
        let simd = self.simd;
        let zero = simd.splat(0.0);
        let mut lanes = [0i32; 16];
        let mut at = 0;
        while at < count {
            let ray = self.chords(simd.read(&rays[U][at..]), simd.read(&rays[V][at..]));
            let mut pace = zero;
            for k in 0..3 {
                let d = self.magnitude(ray.direction[k]);
                pace = simd.add(pace, simd.mul(d, simd.splat(self.march.scale[k])));
            }
            let crossed = simd.mul(simd.sub(ray.t_exit, ray.t_enter), pace);
            simd.write_i(self.group(crossed, simd.lt(ray.t_enter, ray.t_exit)), &mut lanes);
            order.note(at, &lanes[..S::LANES.min(count - at)]);
            simd.write(zero, &mut rays[CHORD][at..]);
            at += S::LANES;
        }
        order.sort(count, |ray| ray as i32);
    }

    /// Sorts the shadow rays by the number of cells up to the border of the box.
    #[inline(always)]
    fn sort_shadows(&self, rays: &[&mut [f32]; FIELDS], sources: &ShadowSources, order: &mut Order) {
        let simd = self.simd;
        *order = Order::NONE;
        let direction = glam::Vec3::from_array(SHADOW_DIRECTION);
        let pace = simd.splat((direction * self.march.scale).element_sum());
        let mut lanes = [0i32; 16];
        let mut at = 0;
        while at < sources.count {
            let (_, t_exit) = self.shadow_ends(self.origins(rays, &sources.rays[at..]));
            let all = simd.le(simd.splat(0.0), simd.splat(0.0));
            simd.write_i(self.group(simd.mul(simd.max(t_exit, simd.splat(0.0)), pace), all), &mut lanes);
            order.note(at, &lanes[..S::LANES.min(sources.count - at)]);
            at += S::LANES;
        }
        order.sort(sources.count, |i| sources.rays[i]);
    }

    /// Origins of the rays' shadow rays.
    #[inline(always)]
    fn origins(&self, rays: &[&mut [f32]; FIELDS], order: &[i32]) -> Three<S> {
        let simd = self.simd;
        let own = simd.read_i(order);
        let [x, y, z] = SHADOW_ORIGIN.map(|field| &*rays[field]);
        [self.of_rays(x, own), self.of_rays(y, own), self.of_rays(z, own)]
    }

    /// Bins the kept chords.
    #[inline(always)]
    fn add_kept(&mut self) {
        let simd = self.simd;
        let mut units = [0u32; BINNED_CHORDS];
        for (lengths, units) in self.kept.chunks_exact(16).zip(chunks_mut::<16, _>(&mut units).0) {
            let mut at = 0;
            while at < 16 {
                let length = simd.min(simd.read(&lengths[at..]), simd.splat(ChordCounts::MAX_CHORD));
                let mut lanes = [0i32; 16];
                simd.write_i(simd.trunc(simd.mul(length, simd.splat(ChordCounts::UNIT))), &mut lanes);
                units[at..at + S::LANES].copy_from_slice(bytemuck::cast_slice(&lanes[..S::LANES]));
                at += S::LANES;
            }
        }
        self.march.block_skips.add_all(&self.kept, &units, self.kept_count);
        self.kept_count = 0;
    }

    /// Stores values to a field of the first `count` rays of a packet.
    #[inline(always)]
    fn spread(&self, value: S::F, field: &mut [f32], order: &[i32], count: usize) {
        let mut lanes = [0.0f32; 16];
        self.simd.write(value, &mut lanes);
        for (&lane, &ray) in lanes.iter().zip(order).take(S::LANES.min(count)) {
            field[ray as usize] = lane;
        }
    }

    /// Marches the first `LANES` rays of `order`, or all `count` rays if these are fewer; collects those that
    /// start a shadow ray.
    #[inline(always)]
    fn march(
        &mut self,
        rays: &mut [&mut [f32]; FIELDS],
        order: &[i32],
        count: usize,
        sources: &mut ShadowSources,
    ) {
        let simd = self.simd;
        let zero = simd.splat(0.0);
        let own = simd.read_i(order);
        let (u, v) = (self.of_rays(rays[U], own), self.of_rays(rays[V], own));
        let mut draw = self.of_rays(rays[DRAW], own);
        let existing = simd.lt(simd.read(&LANE_NUMBERS), simd.splat(count.min(S::LANES) as f32));
        let Chords { origin, direction, safe, t_enter, t_exit } = self.chords(u, v);
        let mut alive = simd.and_m(simd.lt(t_enter, t_exit), existing);
        let [x, y, z] = direction;
        let length = simd.sqrt(simd.add(simd.add(simd.mul(x, x), simd.mul(y, y)), simd.mul(z, z)));
        // Reference steps per unit of the ray parameter t.
        let rate = simd.mul(length, simd.splat(self.march.per_step));
        let chord = simd.select(alive, simd.mul(simd.sub(t_exit, t_enter), rate), zero);
        self.spread(chord, rays[CHORD], order, count);

        let m = &*self.march;
        let mut start = [zero; 3];
        let mut pace = [zero; 3];
        for k in 0..3 {
            let entry = simd.add(origin[k], simd.mul(t_enter, safe[k]));
            let inside = simd.add(entry, simd.splat(m.half_extent[k]));
            start[k] = simd.sub(simd.mul(inside, simd.splat(m.scale[k])), simd.splat(m.shift[k]));
            pace[k] = simd.mul(safe[k], simd.splat(m.scale[k]));
        }
        let split = m.block;
        let mut block_chord = None;
        if let Some(b) = split {
            // The factors are multiplied in the same order as in `March::ray`, because |d|·b·c and |d|·(b·c)
            // are rounded differently.
            let [x, y, z] = [self.magnitude(x), self.magnitude(y), self.magnitude(z)];
            let x = simd.mul(simd.mul(x, simd.splat(b.y)), simd.splat(b.z));
            let y = simd.mul(simd.mul(y, simd.splat(b.x)), simd.splat(b.z));
            let z = simd.mul(simd.mul(z, simd.splat(b.x)), simd.splat(b.y));
            let volume = simd.mul(rate, simd.splat(b.x * b.y * b.z));
            block_chord = Some(simd.div(volume, simd.add(simd.add(x, y), z)));
        }
        let scatters = m.scatters;
        let depth_end = simd.splat(m.depth_end);
        let crossings = simd.div(self.crossings(&pace), rate);
        let mut walk = self.walk(start, pace, t_enter);
        let mut t = t_enter;
        let mut depth = zero;
        let (mut occupied, mut empty, mut visible, mut busy) = (zero, zero, zero, zero);
        let (mut runs, mut segments, mut far, mut terminated) = (zero, zero, zero, zero);
        let mut lit = simd.splat(-1.0);
        let mut was_occupied = simd.lt(zero, zero);
        let mut kept_count = self.kept_count;
        let mut left = self.march.most_cells();
        while simd.any(alive) && left > 0 {
            left -= 1;
            let t_next = simd.min(self.leaves(&walk), t_exit);
            let length = simd.mul(simd.max(simd.sub(t_next, t), zero), rate);
            let cell = walk.index;
            self.advance(&mut walk);
            let (found, full) = self.look(cell, walk.index, alive);
            let hollow = simd.and_not_m(alive, full);
            if simd.any(hollow) {
                empty = simd.select(hollow, simd.add(empty, length), empty);
                if split.is_none() {
                    kept_count += simd.compress(hollow, length, &mut self.kept[kept_count..]);
                    if kept_count > BINNED_CHORDS - 16 {
                        self.kept_count = kept_count;
                        self.add_kept();
                        kept_count = 0;
                    }
                }
            }
            let mut goes_on = simd.and_m(simd.lt(t_next, t_exit), alive);
            if simd.any(full) {
                let ([extinction, shows, looks], share) = (self.optics(found), self.share(cell));
                let d = simd.mul(extinction, length);
                let sum = simd.add(depth, d);
                let ends = simd.and_m(simd.le(depth_end, sum), full);
                let mut used = length;
                if simd.any(ends) {
                    let part = simd.mul(simd.div(simd.sub(depth_end, depth), d), length);
                    used = simd.select(ends, part, length);
                    terminated = simd.select(ends, simd.splat(1.0), terminated);
                    goes_on = simd.and_not_m(goes_on, ends);
                }
                depth = simd.select(full, sum, depth);
                let inside = simd.mul(used, share);
                occupied = simd.select(full, simd.add(occupied, inside), occupied);
                let moment = simd.mul(inside, simd.add(t, t_next));
                far = simd.select(full, simd.add(far, moment), far);
                let looked = simd.mul(simd.mul(used, looks), crossings);
                segments = simd.select(full, simd.add(segments, looked), segments);
                let begins = simd.and_not_m(full, was_occupied);
                runs = simd.select(begins, simd.add(runs, simd.splat(1.0)), runs);
                let shown = simd.mul(used, shows);
                visible = simd.select(full, simd.add(visible, shown), visible);
                if scatters {
                    let shines = simd.and_m(simd.lt(zero, shown), full);
                    let mut miss = simd.sub(simd.splat(1.0), shows);
                    for _ in 0..LANES_LOG2 {
                        miss = simd.mul(miss, miss);
                    }
                    let any = simd.mul(used, simd.sub(simd.splat(1.0), miss));
                    busy = simd.select(shines, simd.add(busy, any), busy);
                    let keep = simd.div(shown, visible);
                    let keeps = simd.and_m(simd.lt(draw, keep), shines);
                    let redrawn = simd.div(draw, keep);
                    let there = simd.add(t, simd.mul(redrawn, simd.sub(t_next, t)));
                    lit = simd.select(keeps, there, lit);
                    let passed = simd.div(simd.sub(draw, keep), simd.sub(simd.splat(1.0), keep));
                    draw = simd.select(shines, simd.select(keeps, redrawn, passed), draw);
                }
                if let Some(chord) = block_chord {
                    let partial = simd.and_m(simd.lt(share, simd.splat(1.0)), full);
                    let hollow = simd.sub(used, inside);
                    empty = simd.select(partial, simd.add(empty, hollow), empty);
                    let more = simd.mul(simd.div(hollow, chord), share);
                    runs = simd.select(partial, simd.add(runs, more), runs);
                    segments = simd.select(partial, simd.add(segments, more), segments);
                }
            }
            was_occupied = full;
            t = t_next;
            alive = goes_on;
        }
        self.kept_count = kept_count;
        for (field, value) in [
            (OCCUPIED_LENGTH, occupied),
            (EMPTY_LENGTH, empty),
            (VISIBLE_LENGTH, visible),
            (RUNS, runs),
            (SEGMENTS, segments),
            (DEPTH, simd.mul(far, simd.splat(0.5))),
            (TERMINATED, terminated),
        ] {
            self.spread(value, rays[field], order, count);
        }
        if let Some(chord) = block_chord {
            let mut chords = [0.0f32; 16];
            simd.write(chord, &mut chords);
            for (&chord, &ray) in chords.iter().zip(order).take(count.min(S::LANES)) {
                let ray = ray as usize;
                if rays[CHORD][ray] > 0.0 {
                    self.march.block_skips.add_many(chord, rays[EMPTY_LENGTH][ray]);
                }
            }
        }
        let lights = simd.le(zero, lit);
        if scatters {
            self.spread(busy, rays[BUSY_LENGTH], order, count);
        }
        if scatters && simd.any(lights) {
            let mut from = [[0.0f32; 16]; 3];
            for k in 0..3 {
                simd.write(simd.add(origin[k], simd.mul(lit, safe[k])), &mut from[k]);
            }
            let mut lanes = simd.lane_bits(lights);
            while lanes != 0 {
                let lane = lanes.trailing_zeros() as usize % 16;
                let ray = order[lane];
                for (field, from) in SHADOW_ORIGIN.into_iter().zip(&from) {
                    rays[field][ray as usize] = from[lane];
                }
                sources.rays[sources.count] = ray;
                sources.count += 1;
                lanes &= lanes - 1;
            }
        }
    }

    /// Marches the shadow rays of the first `LANES` rays of `order`, of which `count` exist.
    #[inline(always)]
    fn march_shadows(&mut self, rays: &mut [&mut [f32]; FIELDS], order: &[i32], count: usize) {
        let simd = self.simd;
        let from = self.origins(rays, order);
        let own = simd.read_i(order);
        let visible = self.of_rays(rays[VISIBLE_LENGTH], own);
        let existing = simd.lt(simd.read(&LANE_NUMBERS), simd.splat(count.min(S::LANES) as f32));
        let [inside, all, skips, segments, ended] = self.shadow(from, existing);
        for (field, value) in [
            (SHADOW, inside),
            (SHADOW_ALL, all),
            (SHADOW_SKIPS, skips),
            (SHADOW_SEGMENTS, segments),
            (SHADOW_ENDED, ended),
        ] {
            self.spread(simd.mul(visible, value), rays[field], order, count);
        }
    }

    /// For shadow rays from points in the box, returns the start in units of cells and the t at which they
    /// leave the box.
    #[inline(always)]
    fn shadow_ends(&self, from: Three<S>) -> (Three<S>, S::F) {
        let simd = self.simd;
        let mut t_exit = simd.splat(f32::INFINITY);
        let mut start = [simd.splat(0.0); 3];
        for k in 0..3 {
            let m = &*self.march;
            let extent = simd.splat(m.half_extent[k]);
            let ahead = simd.sub(extent, from[k]);
            t_exit = simd.min(t_exit, simd.div(ahead, simd.splat(SHADOW_DIRECTION[k])));
            let inside = simd.mul(simd.add(from[k], extent), simd.splat(m.scale[k]));
            start[k] = simd.sub(inside, simd.splat(m.shift[k]));
        }
        (start, t_exit)
    }

    /// Marches shadow rays from points in the box, in the lanes `lights`. Returns the length in occupied
    /// blocks, the whole length, the number of empty cells, the number of lookups in the skip map, and 1 for
    /// rays that ended early, else 0.
    #[inline(always)]
    fn shadow(&mut self, from: Three<S>, lights: S::M) -> [S::F; 5] {
        let simd = self.simd;
        let zero = simd.splat(0.0);
        let direction = glam::Vec3::from_array(SHADOW_DIRECTION);
        let (start, t_exit) = self.shadow_ends(from);
        let scale = self.march.scale;
        let mut pace = [zero; 3];
        for k in 0..3 {
            pace[k] = simd.mul(simd.splat(direction[k]), simd.splat(scale[k]));
        }
        let rate = simd.splat(direction.length() * self.march.per_step);
        let end = simd.splat(self.march.shadow_end);
        let mut walk = self.walk(start, pace, zero);
        let crossings = simd.div(self.crossings(&pace), rate);
        let (mut t, mut depth, mut occupied, mut skips, mut segments) = (zero, zero, zero, zero, zero);
        let mut all = simd.mul(simd.max(t_exit, zero), rate);
        let mut ended = zero;
        let mut alive = simd.and_m(simd.lt(zero, t_exit), lights);
        let mut left = self.march.most_cells();
        while simd.any(alive) && left > 0 {
            left -= 1;
            let t_next = simd.min(self.leaves(&walk), t_exit);
            let length = simd.mul(simd.max(simd.sub(t_next, t), zero), rate);
            let cell = walk.index;
            self.advance(&mut walk);
            let (found, full) = self.look(cell, walk.index, alive);
            let hollow = simd.and_not_m(alive, full);
            skips = simd.select(hollow, simd.add(skips, simd.splat(1.0)), skips);
            let mut goes_on = simd.and_m(simd.lt(t_next, t_exit), alive);
            if simd.any(full) {
                let ([extinction, _, looks], share) = (self.optics(found), self.share(cell));
                let d = simd.mul(extinction, length);
                let sum = simd.add(depth, d);
                let ends = simd.and_m(simd.le(end, sum), full);
                let mut inside = simd.mul(length, share);
                let mut looked = simd.mul(simd.mul(length, looks), crossings);
                if simd.any(ends) {
                    let used = simd.div(simd.sub(end, depth), d);
                    let last = simd.mul(simd.mul(used, length), share);
                    inside = simd.select(ends, last, inside);
                    let last = simd.mul(simd.mul(simd.mul(used, length), looks), crossings);
                    looked = simd.select(ends, last, looked);
                    let reached = simd.add(t, simd.mul(used, simd.sub(t_next, t)));
                    all = simd.select(ends, simd.mul(reached, rate), all);
                    ended = simd.select(ends, simd.splat(1.0), ended);
                    goes_on = simd.and_not_m(goes_on, ends);
                }
                depth = simd.select(full, sum, depth);
                occupied = simd.select(full, simd.add(occupied, inside), occupied);
                segments = simd.select(full, simd.add(segments, looked), segments);
            }
            t = t_next;
            alive = goes_on;
        }
        [occupied, all, skips, segments, ended]
    }
}

static LANE_NUMBERS: [f32; 16] =
    [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0];
