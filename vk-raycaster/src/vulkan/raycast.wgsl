// The ray-casting shader. src/cpu.rs is its CPU version: same names, same operations in the same order. The
// crate documentation defines the picture.

// Lines that start with # are directives of build.rs, which makes one module per mode:
// SHADING   0 none, 1 local, 2 scatter, 3 local and scatter
// SKIPPING  0 none, 1 blocks, 2 distance
// FETCH     source of voxels: 0 sampler, 1 eight texels, 2 two texels of four packed bytes
// COUNTING  1 to count the work of each pixel
// BRICKS    1: the texture holds a part of the volume, and the dispatch takes the samples in that part
// PACKETS   1: the rays of a subgroup are a packet and skip together (same picture; not with COUNTING 1)

const SMALLEST_ADVANCE: f32 = 1e-9;
const NO_SAMPLE: f32 = 3.0e38;
const EMPTY_BIT: u32 = 128u;
const COLORS_PER_ENTRY: f32 = 16.0;
const SHADOW_TERMINATION: f32 = 0.25;
const ROW_SHIFT: u32 = 14u;
// Runs of a packet's rays are merged if their starts are at most this many samples apart.
const PACKET_SLACK: f32 = 4.0;

struct FrameSetup {
    eye: vec3<f32>,
    pixel_width: f32,
    forward: vec3<f32>,
    pixel_height: f32,
    right: vec3<f32>,
    termination: f32,
    up: vec3<f32>,
    jitter: u32,
    advance: vec3<f32>,
    scale: f32,
    dims: vec3<f32>,
    bias: f32,
    gradient_scale: vec3<f32>,
    tile_y: u32,
    light: vec3<f32>,
    tile_x: u32,
    light_inverse: vec3<f32>,
    tile_width: u32,
    tile_height: u32,
    resume: u32,
    window_end: f32,
    block_edge: f32,
    blocks: vec3<u32>,
    block_shift: u32,
    brick_low: vec3<f32>,
    parts: u32,
    brick_high: vec3<f32>,
    pad_high: f32,
    brick_origin: vec3<f32>,
    pad_origin: f32,
    brick_dims: vec3<f32>,
    pad_dims: f32,
    origin_right: vec3<f32>,
    pad_right: f32,
    origin_up: vec3<f32>,
    pad_up: f32,
}

@group(0) @binding(0) var<storage, read> setup: FrameSetup;
// Software devices load from storage images without the arithmetic of mip levels.
#if FETCH == 2
// There are COLORS_PER_ENTRY texels per entry. Each texel holds the bits of two opacities (of the entry and
// of the next entry) and an interpolated color in 11, 11 and 10 bits.
@group(0) @binding(7) var table: texture_storage_2d<rgba32uint, read>;
// A word holds the voxels (x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1) of one slice. The words lie block by
// block (8 × 8 × 8 words), in image rows of 2^ROW_SHIFT words, so that successive samples are close in
// memory.
@group(0) @binding(8) var volume: texture_storage_2d<r32uint, read>;
#if SKIPPING != 0
@group(0) @binding(9) var skip_map: texture_storage_3d<r32uint, read>;
#endif
#else
@group(0) @binding(1) var table: texture_2d<f32>;
@group(0) @binding(2) var volume: texture_3d<f32>;
#if SKIPPING != 0
@group(0) @binding(4) var skip_map: texture_3d<u32>;
#endif
#endif
#if FETCH == 0
@group(0) @binding(3) var volume_sampler: sampler;
#endif
@group(0) @binding(5) var<storage, read_write> image: array<u32>;
#if COUNTING == 1
@group(0) @binding(6) var<storage, read_write> work: array<vec4<u32>>;
#endif

// State of each pixel's ray between two dispatches: color and opacity so far; number of the next sample.
@group(0) @binding(10) var<storage, read_write> state: array<vec4<f32>>;

struct Counts {
    samples: u32,
    skips: u32,
    shaded: u32,
}

var<private> counts: Counts;
// Private copies of the setup values that every sample uses: software devices load values of a buffer lane by
// lane.
var<private> dims: vec3<f32>;
var<private> last: vec3<f32>;
var<private> scale: f32;
var<private> bias: f32;
#if SKIPPING != 0
var<private> block_edge: f32;
var<private> block_shift: u32;
#endif
#if FETCH == 2
// Distance from a block to the next along y and z, in words.
var<private> block_row: i32;
var<private> block_slice: i32;
#endif

// Converts a whole number in 0…2²³ − 1 to an integer, without the range checks of a cast.
fn whole(v: vec3<f32>) -> vec3<i32> {
    return bitcast<vec3<i32>>(v + 8388608.0) & vec3<i32>(0x7fffff);
}

fn whole1(v: f32) -> i32 {
    return bitcast<i32>(v + 8388608.0) & 0x7fffff;
}

fn jitter(x: u32, y: u32) -> f32 {
    var h = (x * 0x9e3779b1u) ^ (y * 0x85ebca77u);
    h = (h ^ (h >> 15u)) * 0x2c1b3c6du;
    h = (h ^ (h >> 12u)) * 0x297a2d39u;
    h = h ^ (h >> 15u);
    return f32(h >> 8u) * (1.0 / 16777216.0);
}

#if SKIPPING != 0
struct Segment {
    empty: bool,
    end: f32,
}

// Returns the run of samples from k on that are all skipped or all taken.
fn segment(first: vec3<f32>, advance: vec3<f32>, inverse: vec3<f32>, k: f32, count: f32) -> Segment {
    let cell = floor(min(max(first + k * advance - 0.5, vec3<f32>(0.0)), last));
    let block = whole(cell) >> vec3<u32>(block_shift);
#if FETCH == 2
    let entry = textureLoad(skip_map, block).x;
#else
    let entry = textureLoad(skip_map, block, 0).x;
#endif
    let empty = (entry & EMPTY_BIT) != 0u;
    var distance = f32(entry & 127u);
#if SKIPPING == 1
    distance = select(distance, 1.0, empty);
#endif
    let corner = vec3<f32>(block);
    let ahead = (corner + distance) * block_edge + 0.5;
    let behind = (corner - distance + 1.0) * block_edge + 0.5;
    let face = select(behind, ahead, advance > vec3<f32>(0.0));
    let t = (face - first) * inverse;
    let exit = min(min(t.x, t.y), t.z);
    return Segment(empty, min(max(ceil(exit - 1e-3), k + 1.0), count));
}
#endif

// A run of samples to take: `begin` is its first sample, `end` is the sample after its last one.
struct Samples {
    begin: f32,
    end: f32,
}

#if SKIPPING != 0
// Returns the ray's next run of samples, from `start` on.
fn next_run(first: vec3<f32>, advance: vec3<f32>, inverse: vec3<f32>, start: f32, count: f32) -> Samples {
    var k = start;
    var end = count;
    loop {
        let run = segment(first, advance, inverse, k, count);
        end = run.end;
        if run.empty {
            counts.skips += 1u;
            k = run.end;
        }
        continuing {
            break if !(run.empty && k < count);
        }
    }
    return Samples(k, end);
}
#endif

// Returns the next samples to take, from k on. `own` is the ray's current run, kept between the calls.
fn next_samples(first: vec3<f32>, advance: vec3<f32>, inverse: vec3<f32>, k: f32, count: f32, own: ptr<function, Samples>) -> Samples {
#if SKIPPING == 0
    return Samples(k, count);
#else
#if PACKETS == 0
    return next_run(first, advance, inverse, k, count);
#else
    // A subgroup runs in lockstep: a ray that skips while its neighbor takes samples gains nothing. All rays
    // go on to the first sample that any of them needs, and take the samples of the runs that begin there. In
    // blocks that are empty for a ray, these samples are transparent.
    var run = *own;
    if k >= run.end {
        run = next_run(first, advance, inverse, k, count);
        *own = run;
    }
    let begin = subgroupMin(max(run.begin, k));
    let end = subgroupMax(select(0.0, run.end, run.begin <= begin + PACKET_SLACK));
    return Samples(max(begin, k), min(end, count));
#endif
#endif
}

#if FETCH == 2
// Returns the word at an index of the packed volume.
fn word_at(index: i32) -> u32 {
    return textureLoad(volume, vec2<i32>(index & ((1 << ROW_SHIFT) - 1), index >> ROW_SHIFT)).x;
}
#endif

fn mix1(a: f32, b: f32, f: f32) -> f32 {
    return a + f * (b - a);
}

// Returns the table position (0…255) of the volume at p.
fn position(p: vec3<f32>) -> f32 {
#if FETCH == 0
#if BRICKS == 1
    let inside = min(max(p, vec3<f32>(0.0)), dims) - setup.brick_origin;
    let value = textureSampleLevel(volume, volume_sampler, inside / setup.brick_dims, 0.0).x;
#else
    let value = textureSampleLevel(volume, volume_sampler, p / dims, 0.0).x;
#endif
#else
    let q = min(max(p - 0.5, vec3<f32>(0.0)), last);
    let cell = floor(q);
    let f = q - cell;
#if FETCH == 1
#if BRICKS == 1
    let low = whole(cell - setup.brick_origin);
    let high = whole(min(cell + 1.0, last) - setup.brick_origin);
#else
    let low = whole(cell);
    let high = whole(min(cell + 1.0, last));
#endif
    let v000 = textureLoad(volume, low, 0).x;
    let v100 = textureLoad(volume, vec3<i32>(high.x, low.y, low.z), 0).x;
    let v010 = textureLoad(volume, vec3<i32>(low.x, high.y, low.z), 0).x;
    let v110 = textureLoad(volume, vec3<i32>(high.x, high.y, low.z), 0).x;
    let v001 = textureLoad(volume, vec3<i32>(low.x, low.y, high.z), 0).x;
    let v101 = textureLoad(volume, vec3<i32>(high.x, low.y, high.z), 0).x;
    let v011 = textureLoad(volume, vec3<i32>(low.x, high.y, high.z), 0).x;
    let v111 = textureLoad(volume, high, 0).x;
#else
    let low = whole(cell);
    let next = whole1(min(cell.z + 1.0, last.z));
    let inside = low.xy & vec2<i32>(7);
    let row = ((low.x - inside.x) << 6u) + inside.x + (low.y >> 3u) * block_row + (inside.y << 3u);
    let near = word_at(row + (low.z >> 3u) * block_slice + ((low.z & 7) << 6u));
    let far = word_at(row + (next >> 3u) * block_slice + ((next & 7) << 6u));
    let v000 = f32(near & 255u);
    let v100 = f32((near >> 8u) & 255u);
    let v010 = f32((near >> 16u) & 255u);
    let v110 = f32(near >> 24u);
    let v001 = f32(far & 255u);
    let v101 = f32((far >> 8u) & 255u);
    let v011 = f32((far >> 16u) & 255u);
    let v111 = f32(far >> 24u);
#endif
    let near_slice = mix1(mix1(v000, v100, f.x), mix1(v010, v110, f.x), f.y);
    let far_slice = mix1(mix1(v001, v101, f.x), mix1(v011, v111, f.x), f.y);
    let value = mix1(near_slice, far_slice, f.z);
#endif
    return min(max(value * scale + bias, 0.0), 255.0);
}

#if FETCH == 2
fn classify_texel(position: f32, texel: vec4<u32>) -> f32 {
    let f = position - floor(min(position, 254.0));
    return mix1(bitcast<f32>(texel.x), bitcast<f32>(texel.y), f);
}
#endif

// Returns the opacity at a table position.
fn opacity(position: f32) -> f32 {
#if FETCH == 2
    return classify_texel(position, textureLoad(table, vec2<i32>(whole1(floor(position * COLORS_PER_ENTRY)), 0)));
#else
    let i = floor(min(position, 254.0));
    let index = whole1(i);
    let a = textureLoad(table, vec2<i32>(index, 0), 0).w;
    let b = textureLoad(table, vec2<i32>(index + 1, 0), 0).w;
    return mix1(a, b, position - i);
#endif
}

// Returns color and opacity at a table position.
fn classify(position: f32) -> vec4<f32> {
#if FETCH == 2
    let texel = textureLoad(table, vec2<i32>(whole1(floor(position * COLORS_PER_ENTRY)), 0));
    let word = texel.z;
    let color = vec3<f32>(f32(word & 2047u), f32((word >> 11u) & 2047u), f32(word >> 22u));
    return vec4<f32>(color * vec3<f32>(1.0 / 2047.0, 1.0 / 2047.0, 1.0 / 1023.0), classify_texel(position, texel));
#else
    let i = floor(min(position, 254.0));
    let f = position - i;
    let index = whole1(i);
    let a = textureLoad(table, vec2<i32>(index, 0), 0);
    let b = textureLoad(table, vec2<i32>(index + 1, 0), 0);
    return a + f * (b - a);
#endif
}

#if LIT == 1
// Returns `color` with Blinn–Phong lighting by a headlight, which shines along the ray.
fn light(p: vec3<f32>, view: vec3<f32>, color: vec3<f32>) -> vec3<f32> {
    let x = (position(p + vec3<f32>(1.0, 0.0, 0.0)) - position(p - vec3<f32>(1.0, 0.0, 0.0))) * setup.gradient_scale.x;
    let y = (position(p + vec3<f32>(0.0, 1.0, 0.0)) - position(p - vec3<f32>(0.0, 1.0, 0.0))) * setup.gradient_scale.y;
    let z = (position(p + vec3<f32>(0.0, 0.0, 1.0)) - position(p - vec3<f32>(0.0, 0.0, 1.0))) * setup.gradient_scale.z;
    let square = x * x + y * y + z * z;
    if square < 1e-6 {
        return color;
    }
    let cosine = min(abs(x * view.x + y * view.y + z * view.z) / sqrt(square), 1.0);
    let diffuse = 0.3 + 0.7 * cosine;
    let c2 = cosine * cosine;
    let c4 = c2 * c2;
    let c8 = c4 * c4;
    let c16 = c8 * c8;
    let specular = 0.2 * (c16 * c16);
    return min(color * diffuse + specular, vec3<f32>(1.0));
}
#endif

#if SCATTERS == 1
// Returns `color` after single scattering: a shadow ray towards the light attenuates it.
fn scatter(p: vec3<f32>, color: vec3<f32>) -> vec3<f32> {
    let face = select(vec3<f32>(0.0), dims, setup.light > vec3<f32>(0.0));
    let t = (face - p) * setup.light_inverse;
    let count = ceil(min(min(t.x, t.y), t.z));
    let step = setup.light;
    let inverse = setup.light_inverse;
    var transmittance = 1.0;
    var k = 1.0;
    var own = Samples(0.0, 0.0);
    while k < count {
        let run = next_samples(p, step, inverse, k, count, &own);
        k = run.begin;
        if k < count {
            loop {
                counts.samples += 1u;
                let clear = 1.0 - opacity(position(p + k * step));
                // One multiplication for each of the SHADOW_STEP steps.
                transmittance *= clear;
                transmittance *= clear;
                k += 1.0;
                if transmittance < SHADOW_TERMINATION {
                    k = count;
                }
                continuing {
                    break if !(k < run.end);
                }
            }
        }
    }
    let lit = 0.25 + 0.75 * transmittance;
    return color * lit;
}
#endif

fn trace(pixel: vec2<u32>, index: u32) -> vec4<f32> {
    let u = (f32(pixel.x) + 0.5) * setup.pixel_width - 1.0;
    let v = 1.0 - (f32(pixel.y) + 0.5) * setup.pixel_height;
    let eye = setup.eye + u * setup.origin_right + v * setup.origin_up;
    let d = setup.forward + u * setup.right + v * setup.up;
    let length = sqrt(d.x * d.x + d.y * d.y + d.z * d.z);
    let direction = d / length;
    let product = direction * setup.advance;
    let advance = select(product, vec3<f32>(SMALLEST_ADVANCE), abs(product) < vec3<f32>(SMALLEST_ADVANCE));
    let inverse = 1.0 / advance;
    let near = (vec3<f32>(0.0) - eye) * inverse;
    let far = (dims - eye) * inverse;
    let closer = min(near, far);
    let farther = max(near, far);
    let enter = max(max(max(closer.x, closer.y), closer.z), 0.0);
    let exit = min(min(farther.x, farther.y), farther.z);
    var sum = vec4<f32>(0.0);
    if exit <= enter {
        return vec4<f32>(-1.0);
    }
    var offset = 0.5;
    if setup.jitter != 0u {
        offset = jitter(pixel.x, pixel.y);
    }
    let start = enter + offset;
    let first = eye + start * advance;
    let count = ceil(exit - start);
    let termination = setup.termination;
    var k = 0.0;
    if setup.resume != 0u {
        sum = state[2u * index];
        k = state[2u * index + 1u].x;
    }
    let window = min(count, setup.window_end);
    var own = Samples(0.0, 0.0);
#if BRICKS == 1
    var outside = false;
#endif
    while k < window {
        let run = next_samples(first, advance, inverse, k, count, &own);
        k = run.begin;
        let end = min(run.end, window);
        if k < end {
            loop {
                let p = first + k * advance;
#if BRICKS == 1
                let cell = floor(min(max(p - 0.5, vec3<f32>(0.0)), last));
                if any(cell < setup.brick_low) || any(cell > setup.brick_high) {
                    outside = true;
                    break;
                }
#endif
                counts.samples += 1u;
                let found = classify(position(p));
                k += 1.0;
#if SHADING == 0
                let weight = (1.0 - sum.w) * found.w;
                sum += weight * vec4<f32>(found.xyz, 1.0);
#else
                if found.w > 0.0 {
                    var color = found.xyz;
#if LIT == 1
                    color = light(p, direction, color);
#endif
#if SCATTERS == 1
                    color = scatter(p, color);
#endif
                    counts.shaded += 1u;
                    let weight = (1.0 - sum.w) * found.w;
                    sum += weight * vec4<f32>(color, 1.0);
                }
#endif
                k = select(k, count, sum.w >= termination);
                continuing {
                    break if !(k < end);
                }
            }
        }
#if BRICKS == 1
        if outside {
            break;
        }
#endif
    }
#if BRICKS == 1
    let kept = true;
#else
    let kept = setup.window_end < NO_SAMPLE;
#endif
    if kept {
        state[2u * index] = sum;
        state[2u * index + 1u] = vec4<f32>(k, 0.0, 0.0, 0.0);
    }
    return sum;
}

// Row of the image's workgroups that row `row` of the dispatch draws. A software device splits a dispatch
// into `parts` runs of successive workgroups, one for each thread. The rows of the image are dealt to these
// runs in turn, so that every thread gets a similar share of each region of the image. `parts` 1 changes
// nothing.
fn dealt(row: u32, rows: u32) -> u32 {
    let each = rows / setup.parts;
    let more = rows % setup.parts;
    let longer = more * (each + 1u);
    if row < longer {
        return row % (each + 1u) * setup.parts + row / (each + 1u);
    }
    return (row - longer) % each * setup.parts + more + (row - longer) / each;
}

// A workgroup is 8 × 8 pixels in Morton order: eight successive invocations cover 4 × 2 pixels.
@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let x = group.x * 8u + ((lane & 1u) | ((lane >> 1u) & 2u) | ((lane >> 2u) & 4u));
    let y = dealt(group.y, (setup.tile_height + 7u) / 8u) * 8u + (((lane >> 1u) & 1u) | ((lane >> 2u) & 2u) | ((lane >> 3u) & 4u));
    dims = setup.dims;
    last = dims - 1.0;
    scale = setup.scale;
    bias = setup.bias;
#if SKIPPING != 0
    block_edge = setup.block_edge;
    block_shift = setup.block_shift;
#endif
#if FETCH == 2
    let blocks = (vec3<i32>(dims) + 7) >> vec3<u32>(3u);
    block_row = blocks.x * 512;
    block_slice = block_row * blocks.y;
#endif
    if x < setup.tile_width && y < setup.tile_height {
        let index = y * setup.tile_width + x;
#if COUNTING == 1
        if setup.resume != 0u {
            let before = work[index];
            counts = Counts(before.y, before.z, before.w);
        }
#endif
        let sum = trace(vec2<u32>(setup.tile_x + x, setup.tile_y + y), index);
        let hit = sum.w >= 0.0;
        let bytes = vec4<u32>(min(max(sum, vec4<f32>(0.0)), vec4<f32>(1.0)) * 255.0 + 0.5);
        image[index] = bytes.x | (bytes.y << 8u) | (bytes.z << 16u) | (bytes.w << 24u);
#if COUNTING == 1
        work[index] = vec4<u32>(u32(hit), counts.samples, counts.skips, counts.shaded);
#endif
    }
}
