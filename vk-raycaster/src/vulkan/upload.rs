//! Conversion of a volume's voxels to texels.

use super::VoxelFetch;
use super::engine::{MAX_BRICKS, texel_bytes};
use super::gpu::Gpu;
use super::resources::Shape;
use crate::error::{Error, Result};
use crate::table::StepTable;
use crate::voxels::{PreparedVolume, Voxels};
use ash::vk;
use entire_core::scene::TABLE_LEN;
use rayon::prelude::*;

/// Number of texels per table entry in a packed table.
const COLORS_PER_ENTRY: usize = 16;

/// Number of texels of a packed table.
const PACKED_TEXELS: usize = 4096;

/// Number of words along a row of a packed volume's image.
const PACKED_ROW: usize = 16384;

/// Words in a block of a packed volume, and voxels along its edge.
const PACKED_BLOCK: usize = PACKED_EDGE * PACKED_EDGE * PACKED_EDGE;
const PACKED_EDGE: usize = 8;

/// Format and meaning of the texels.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct TexelLayout {
    pub(crate) fetch: VoxelFetch,
    pub(crate) format: vk::Format,
    /// Voxel value that the shader reads as 1.
    pub(crate) unit: f32,
    /// Part of the volume in each texture, x fastest.
    pub(crate) bricks: Vec<Brick>,
    /// Number of bricks along each axis.
    pub(crate) grid: [usize; 3],
}

/// A part of the volume in a separate texture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Brick {
    /// First and last cell whose samples use the brick.
    pub(crate) low: [usize; 3],
    pub(crate) high: [usize; 3],
    /// First voxel of the brick, and number of its voxels along each axis. The brick holds all voxels that
    /// its samples and their gradients read.
    pub(crate) origin: [usize; 3],
    pub(crate) dims: [usize; 3],
}

/// Voxels of a brick beyond its cells along an axis: one before and two after.
const APRON: usize = 3;

/// Cuts a volume so that no brick has more than `limit` voxels along an axis or `most` voxels in all. Returns
/// the bricks and their number along each axis; `None` if there would be more than [`MAX_BRICKS`].
pub(crate) fn cut(dims: [usize; 3], limit: usize, most: u64) -> Option<(Vec<Brick>, [usize; 3])> {
    let mut grid = dims.map(|n| if n <= limit { 1 } else { n.div_ceil(limit.saturating_sub(APRON).max(1)) });
    let held = |grid: [usize; 3]| {
        let edge = [0, 1, 2].map(|a| if grid[a] == 1 { dims[a] } else { dims[a].div_ceil(grid[a]) + APRON });
        edge.iter().map(|&n| n as u64).product::<u64>()
    };
    while grid.iter().product::<usize>() <= MAX_BRICKS && held(grid) > most {
        // Cuts along the axis on which bricks are longest.
        let axis = (0..3).max_by_key(|&a| dims[a].div_ceil(grid[a])).unwrap_or(2);
        grid[axis] += 1;
    }
    let count = grid.iter().try_fold(1usize, |n, &g| n.checked_mul(g)).filter(|&n| n <= MAX_BRICKS)?;
    let bricks = (0..count).map(|i| {
        let at = [i % grid[0], i / grid[0] % grid[1], i / (grid[0] * grid[1])];
        let low = [0, 1, 2].map(|a| at[a] * dims[a] / grid[a]);
        let high = [0, 1, 2].map(|a| (at[a] + 1) * dims[a] / grid[a] - 1);
        let origin = low.map(|l| l.saturating_sub(1));
        let dims = [0, 1, 2].map(|a| (high[a] + APRON).min(dims[a]) - origin[a]);
        Brick { low, high, origin, dims }
    });
    Some((bricks.collect(), grid))
}

/// Maximum number of voxels along an axis of a texture.
fn texture_limit(gpu: &Gpu, wish: Option<u32>) -> usize {
    let limit = gpu.limits.max_image_dimension3_d;
    wish.map_or(limit, |w| w.clamp(8, limit)) as usize
}

/// Refuses volumes that the device's textures cannot hold, before any work.
pub(crate) fn check_size(gpu: &Gpu, dims: [usize; 3], wish: Option<u32>) -> Result<()> {
    let limit = texture_limit(gpu, wish);
    if cut(dims, limit, u64::MAX).is_none() {
        return Err(Error::new(format!(
            "the volume has {} x {} x {} voxels, but {} takes at most {limit} along each axis of a texture \
             and {MAX_BRICKS} textures; crop or downsample it, or render on the CPU",
            dims[0], dims[1], dims[2], gpu.name
        )));
    }
    Ok(())
}

/// Chooses the source of voxels in the shader (as requested, else the fastest on the device), the format of
/// the texels, and the bricks.
pub(crate) fn plan(
    gpu: &Gpu,
    volume: &PreparedVolume,
    wish: Option<VoxelFetch>,
    largest: Option<u32>,
) -> Result<TexelLayout> {
    let (plain, unit) = match &volume.voxels {
        Voxels::U8(_) => (vk::Format::R8_UNORM, 255.0),
        Voxels::U16(_) => (vk::Format::R16_UNORM, 65535.0),
        Voxels::F32(_) => (vk::Format::R32_SFLOAT, 1.0),
    };
    let (can_sample, can_filter) = gpu.sampling(plain);
    let is_bytes = matches!(volume.voxels, Voxels::U8(_));
    let packed = packed_shape(volume.geometry.dims);
    let dims = volume.geometry.dims;
    let limit = texture_limit(gpu, largest);
    let can_pack = is_bytes
        && dims.iter().all(|&n| n <= limit)
        && packed.extent[..2].iter().all(|&n| n <= gpu.limits.max_image_dimension2_d)
        && u64::from(packed.extent[0]) * u64::from(packed.extent[1]) * 4 <= gpu.max_allocation;
    let fetch = wish.unwrap_or(match (gpu.is_software, can_filter) {
        (true, _) if can_pack => VoxelFetch::Packed,
        (true, _) => VoxelFetch::Texels,
        (_, true) => VoxelFetch::Sampler,
        _ => VoxelFetch::Texels,
    });
    let format = match fetch {
        VoxelFetch::Packed if !is_bytes => Err(Error::new(
            "VoxelFetch::Packed needs 8-bit voxels; choose VoxelFetch::Sampler, VoxelFetch::Texels, or None",
        )),
        VoxelFetch::Packed if !can_pack => Err(Error::new(format!(
            "the volume has {:?} voxels, more than VoxelFetch::Packed holds on {}; choose \
             VoxelFetch::Texels, or None",
            volume.geometry.dims, gpu.name
        ))),
        // Software samplers interpolate 8-bit textures in 8 bits; with 16 bits they keep the fractions.
        VoxelFetch::Sampler if is_bytes && gpu.is_software && gpu.sampling(vk::Format::R16_UNORM).1 => {
            Ok((vk::Format::R16_UNORM, 255.0))
        }
        VoxelFetch::Packed => Ok((vk::Format::R32_UINT, 1.0)),
        VoxelFetch::Sampler if !can_filter => Err(Error::new(format!(
            "{} has no linear filter for {plain:?}; choose VoxelFetch::Texels, or None",
            gpu.name
        ))),
        _ if !can_sample => Err(Error::new(format!(
            "{} cannot sample {plain:?} textures; convert the volume to bytes, or render on the CPU",
            gpu.name
        ))),
        _ => Ok((plain, unit)),
    };
    let (format, unit) = format?;
    let whole = Brick { low: [0; 3], high: dims.map(|n| n - 1), origin: [0; 3], dims };
    // A driver may pad rows and slices, so a sixteenth of the largest allocation stays free.
    let most = gpu.max_allocation / 16 * 15 / texel_bytes(format);
    let (bricks, grid) = match fetch {
        VoxelFetch::Packed => (vec![whole], [1; 3]),
        _ => cut(dims, limit, most).ok_or_else(|| {
            Error::new(format!(
                "the volume has {dims:?} voxels, but {} takes at most {most} in a texture and {MAX_BRICKS} \
                 textures; crop or downsample it, or render on the CPU",
                gpu.name
            ))
        })?,
    };
    Ok(TexelLayout { fetch, format, unit, bricks, grid })
}

/// Writes the texels of whole slices (rows, if packed) of a brick, starting at slice or row `first`.
pub(crate) fn fill_slices(
    volume: &PreparedVolume,
    plan: &TexelLayout,
    brick: &Brick,
    first: usize,
    out: &mut [u8],
) {
    let texel = texel_bytes(plan.format);
    match &volume.voxels {
        Voxels::U8(v) if plan.fetch == VoxelFetch::Packed => pack_rows(v, volume.geometry.dims, first, out),
        Voxels::U8(v) if plan.format == vk::Format::R16_UNORM => {
            for_rows(v, volume.geometry.dims, brick, first, (out, texel), |out, row| {
                for (o, v) in out.as_chunks_mut::<2>().0.iter_mut().zip(row) {
                    *o = (u16::from(*v) * 257).to_ne_bytes();
                }
            });
        }
        Voxels::U8(v) => for_rows(v, volume.geometry.dims, brick, first, (out, texel), copy),
        Voxels::U16(v) => for_rows(v, volume.geometry.dims, brick, first, (out, texel), copy),
        Voxels::F32(v) => for_rows(v, volume.geometry.dims, brick, first, (out, texel), copy),
    }
}

fn copy<T: bytemuck::NoUninit>(out: &mut [u8], row: &[T]) {
    out.copy_from_slice(bytemuck::cast_slice(row));
}

/// Calls `write` for every row of a brick, starting at slice `first`, with the row's destination bytes and
/// its voxels.
fn for_rows<T: Sync>(
    voxels: &[T],
    [nx, ny, _]: [usize; 3],
    brick: &Brick,
    first: usize,
    (out, texel): (&mut [u8], u64),
    write: impl Fn(&mut [u8], &[T]) + Sync,
) {
    let [width, height, _] = brick.dims;
    out.par_chunks_mut(width * texel as usize).enumerate().for_each(|(i, out)| {
        let (y, z) = (brick.origin[1] + i % height, brick.origin[2] + first + i / height);
        write(out, &voxels[(z * ny + y) * nx + brick.origin[0]..][..width]);
    });
}

pub(crate) fn packed_shape(dims: [usize; 3]) -> Shape {
    let blocks: usize = dims.iter().map(|n| n.div_ceil(PACKED_EDGE)).product();
    let rows = (blocks * PACKED_BLOCK).div_ceil(PACKED_ROW);
    let rows = u32::try_from(rows).unwrap_or(u32::MAX);
    Shape { extent: [PACKED_ROW as u32, rows, 0], format: vk::Format::R32_UINT, storage: true }
}

/// Writes whole rows of a packed volume's image, from row `first_row` on. Each word holds a voxel and its
/// neighbors at x + 1, y + 1 and both, clamped to the edge, lowest byte first. Words lie block by block, x
/// fastest in a block and among blocks.
fn pack_rows(voxels: &[u8], [nx, ny, nz]: [usize; 3], first_row: usize, out: &mut [u8]) {
    let [bx, by, bz] = [nx, ny, nz].map(|n| n.div_ceil(PACKED_EDGE));
    let first = first_row * (PACKED_ROW / PACKED_BLOCK);
    out.par_chunks_mut(4 * PACKED_BLOCK).enumerate().for_each(|(i, out)| {
        let block = first + i;
        if block >= bx * by * bz {
            out.fill(0);
            return;
        }
        let corner = [block % bx, block / bx % by, block / (bx * by)].map(|b| b * PACKED_EDGE);
        for (row, out) in out.as_chunks_mut::<{ 4 * PACKED_EDGE }>().0.iter_mut().enumerate() {
            let y = (corner[1] + row % PACKED_EDGE).min(ny - 1);
            let z = (corner[2] + row / PACKED_EDGE).min(nz - 1);
            let line = |y: usize| &voxels[(z * ny + y) * nx..][..nx];
            let (near, far) = (line(y), line((y + 1).min(ny - 1)));
            for (x, word) in out.as_chunks_mut::<4>().0.iter_mut().enumerate() {
                let x = (corner[0] + x).min(nx - 1);
                let next = (x + 1).min(nx - 1);
                *word = [near[x], near[next], far[x], far[next]];
            }
        }
    });
}

pub(crate) fn table_shape(fetch: VoxelFetch) -> Shape {
    let (texels, format, storage) = match fetch {
        VoxelFetch::Packed => (PACKED_TEXELS, vk::Format::R32G32B32A32_UINT, true),
        _ => (TABLE_LEN, vk::Format::R32G32B32A32_SFLOAT, false),
    };
    Shape { extent: [texels as u32, 1, 0], format, storage }
}

pub(crate) fn skip_map_shape(fetch: VoxelFetch, dims: [usize; 3]) -> Shape {
    let storage = fetch == VoxelFetch::Packed;
    let format = if storage { vk::Format::R32_UINT } else { vk::Format::R8_UINT };
    Shape { extent: dims.map(|n| n as u32), format, storage }
}

/// Writes whole slices of the skip map.
pub(crate) fn fill_skip_map(fetch: VoxelFetch, bytes: &[u8], out: &mut [u8]) {
    if fetch == VoxelFetch::Packed {
        for (word, byte) in out.chunks_exact_mut(4).zip(bytes) {
            word.copy_from_slice(&u32::from(*byte).to_ne_bytes());
        }
    } else {
        out.copy_from_slice(&bytes[..out.len()]);
    }
}

/// Returns the table's texels. Unpacked, there is one texel of four floats per entry. Packed, there are
/// [`COLORS_PER_ENTRY`] texels per entry: each holds the opacities of the entry and the next entry, and an
/// interpolated color in 11, 11 and 10 bits.
pub(crate) fn table_texels(fetch: VoxelFetch, table: &StepTable) -> Vec<u8> {
    if fetch != VoxelFetch::Packed {
        return bytemuck::cast_slice(table.as_slice()).to_vec();
    }
    let mut texels = vec![[0u32; 4]; PACKED_TEXELS];
    for (j, texel) in texels[..(TABLE_LEN - 1) * COLORS_PER_ENTRY + 1].iter_mut().enumerate() {
        // The middle of the table positions that are rounded down to texel j.
        let at = ((j as f32 + 0.5) / COLORS_PER_ENTRY as f32).min(255.0);
        let low = (at as usize).min(TABLE_LEN - 2);
        let f = at - low as f32;
        let channel = |c: usize, top: f32| {
            let v = table[low][c] + f * (table[low + 1][c] - table[low][c]);
            (v * top + 0.5) as u32
        };
        let color = channel(0, 2047.0) | (channel(1, 2047.0) << 11) | (channel(2, 1023.0) << 22);
        *texel = [table[low][3].to_bits(), table[low + 1][3].to_bits(), color, 0];
    }
    bytemuck::cast_slice(&texels).to_vec()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bricks_take_every_cell_once_and_hold_what_its_samples_touch() {
        for (dims, limit, most) in [
            ([10, 10, 10], 16, u64::MAX),
            ([100, 33, 7], 16, u64::MAX),
            ([40, 50, 60], 64, 20_000),
            ([17, 1, 9], 8, 200),
            ([16, 16, 16], 16, 4096),
        ] {
            let (bricks, grid) = cut(dims, limit, most).unwrap();
            assert_eq!(bricks.len(), grid.iter().product::<usize>());
            let mut taken = vec![0u8; dims.iter().product()];
            for b in &bricks {
                assert!(b.dims.iter().all(|&n| n <= limit), "{b:?}");
                assert!(b.dims.iter().map(|&n| n as u64).product::<u64>() <= most, "{b:?}");
                for (a, &n) in dims.iter().enumerate() {
                    assert!(b.origin[a] <= b.low[a].saturating_sub(1));
                    assert!(b.origin[a] + b.dims[a] >= (b.high[a] + 3).min(n));
                    assert!(b.origin[a] + b.dims[a] <= n);
                }
                for z in b.low[2]..=b.high[2] {
                    for y in b.low[1]..=b.high[1] {
                        for x in b.low[0]..=b.high[0] {
                            taken[(z * dims[1] + y) * dims[0] + x] += 1;
                        }
                    }
                }
            }
            assert!(taken.iter().all(|&n| n == 1), "{dims:?}");
        }
        assert_eq!(cut([16, 16, 16], 16, u64::MAX).unwrap().1, [1, 1, 1]);
        assert!(cut([1 << 20, 1, 1], 4096, u64::MAX).is_none());
        assert!(cut([64, 64, 64], 64, 100).is_none());
    }

    #[test]
    fn packed_words_hold_the_square_of_neighbors_block_by_block() {
        let dims = [9, 3, 2];
        let voxels: Vec<u8> = (0..54).collect();
        let shape = packed_shape(dims);
        assert_eq!(shape.extent, [PACKED_ROW as u32, 1, 0]);
        let mut out = vec![7u8; 4 * PACKED_ROW];
        pack_rows(&voxels, dims, 0, &mut out);
        let word = |x: usize, y: usize, z: usize| {
            let i = x / 8 * PACKED_BLOCK + (z * 8 + y) * 8 + x % 8;
            [out[4 * i], out[4 * i + 1], out[4 * i + 2], out[4 * i + 3]]
        };
        assert_eq!(word(0, 0, 0), [0, 1, 9, 10]);
        assert_eq!(word(7, 1, 1), [43, 44, 52, 53], "the neighbor is of the next block");
        assert_eq!(word(8, 0, 0), [8, 8, 17, 17], "clamped at the end of a row");
        assert_eq!(word(8, 2, 1), [53; 4], "clamped at the corner");
        assert!(out[8 * PACKED_BLOCK..].iter().all(|&b| b == 0), "rows are filled up");
        // 17 blocks along each axis: more than one row.
        let shape = packed_shape([129, 130, 136]);
        assert_eq!(shape.extent, [PACKED_ROW as u32, (17u32 * 17 * 17).div_ceil(32), 0]);
    }
}
