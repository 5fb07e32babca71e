//! How a volume's voxels become texels.

use super::VoxelFetch;
use super::gpu::Gpu;
use super::resources::Shape;
use crate::renderer::{Error, Result};
use crate::table::StepTable;
use crate::voxels::{PreparedVolume, Voxels};
use ash::vk;
use entire_core::scene::TABLE_LEN;
use rayon::prelude::*;

/// Colors per table entry in a packed table.
const COLORS_PER_ENTRY: usize = 16;

/// Texels per row of a packed table.
const PACKED_ROW: usize = 4096;

/// Format and meaning of the texels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Plan {
    pub(crate) fetch: VoxelFetch,
    pub(crate) format: vk::Format,
    /// Voxel value that the shader reads as 1.
    pub(crate) unit: f32,
}

/// Refuses volumes that no 3-D texture of the device holds, before any work.
pub(crate) fn check_size(gpu: &Gpu, dims: [usize; 3]) -> Result<()> {
    let limit = gpu.limits.max_image_dimension3_d as usize;
    if dims.iter().any(|&n| n > limit) {
        return Err(Error::new(format!(
            "the volume has {} x {} x {} voxels, {} takes at most {limit} along each axis; crop or downsample it, or render on the CPU",
            dims[0], dims[1], dims[2], gpu.name
        )));
    }
    Ok(())
}

/// Chooses how the shader fetches voxels: as wished, else what is fastest on the device.
pub(crate) fn plan(gpu: &Gpu, volume: &PreparedVolume, wish: Option<VoxelFetch>) -> Result<Plan> {
    let (plain, unit) = match &volume.voxels {
        Voxels::U8(_) => (vk::Format::R8_UNORM, 255.0),
        Voxels::U16(_) => (vk::Format::R16_UNORM, 65535.0),
        Voxels::F32(_) => (vk::Format::R32_SFLOAT, 1.0),
    };
    let (can_sample, can_filter) = gpu.sampling(plain);
    let is_bytes = matches!(volume.voxels, Voxels::U8(_));
    let packed_bytes = volume.geometry.dims.iter().map(|&n| n as u64).product::<u64>() * 4;
    let fetch = wish.unwrap_or(match (gpu.is_cpu, is_bytes, can_filter) {
        (true, true, _) if packed_bytes <= gpu.max_allocation => VoxelFetch::Packed,
        (true, ..) => VoxelFetch::Texels,
        (_, _, true) => VoxelFetch::Sampler,
        _ => VoxelFetch::Texels,
    });
    match fetch {
        VoxelFetch::Packed if !is_bytes => Err(Error::new(
            "packed voxel fetch takes bytes only; choose the sampler or texels, or leave the choice open",
        )),
        // Software samplers interpolate 8-bit textures in 8 bits; in 16 they keep the fractions.
        VoxelFetch::Sampler if is_bytes && gpu.is_cpu && gpu.sampling(vk::Format::R16_UNORM).1 => {
            Ok(Plan { fetch, format: vk::Format::R16_UNORM, unit: 255.0 })
        }
        VoxelFetch::Packed => Ok(Plan { fetch, format: vk::Format::R32_UINT, unit: 1.0 }),
        VoxelFetch::Sampler if !can_filter => Err(Error::new(format!(
            "{} has no linear filter for {plain:?}; choose texels, or leave the choice open",
            gpu.name
        ))),
        _ if !can_sample => Err(Error::new(format!(
            "{} cannot sample {plain:?} textures; convert the volume to bytes, or render on the CPU",
            gpu.name
        ))),
        _ => Ok(Plan { fetch, format: plain, unit }),
    }
}

/// Writes the texels of whole slices from `first` on.
pub(crate) fn fill_slices(volume: &PreparedVolume, plan: &Plan, first: usize, out: &mut [u8]) {
    let [nx, ny, _] = volume.geometry.dims;
    match &volume.voxels {
        Voxels::U8(v) if plan.fetch == VoxelFetch::Packed => pack_slices(v, [nx, ny], first, out),
        Voxels::U8(v) if plan.format == vk::Format::R16_UNORM => {
            for (o, v) in out.chunks_exact_mut(2).zip(&v[first * nx * ny..]) {
                o.copy_from_slice(&(u16::from(*v) * 257).to_ne_bytes());
            }
        }
        Voxels::U8(v) => copy(v, first * nx * ny, out),
        Voxels::U16(v) => copy(v, first * nx * ny, out),
        Voxels::F32(v) => copy(v, first * nx * ny, out),
    }
}

fn copy<T: bytemuck::NoUninit>(voxels: &[T], start: usize, out: &mut [u8]) {
    let count = out.len() / size_of::<T>();
    out.copy_from_slice(bytemuck::cast_slice(&voxels[start..start + count]));
}

/// Each word holds a voxel and its neighbors at x + 1, y + 1 and both, clamped to the edge, lowest byte first.
fn pack_slices(voxels: &[u8], [nx, ny]: [usize; 2], first: usize, out: &mut [u8]) {
    out.par_chunks_mut(nx * 4).enumerate().for_each(|(row, out)| {
        let (y, z) = (row % ny, first + row / ny);
        let line = |y: usize| &voxels[(z * ny + y) * nx..][..nx];
        let (near, far) = (line(y), line((y + 1).min(ny - 1)));
        for (x, word) in out.chunks_exact_mut(4).enumerate() {
            let next = (x + 1).min(nx - 1);
            word.copy_from_slice(&[near[x], near[next], far[x], far[next]]);
        }
    });
}

/// The table's image.
pub(crate) fn table_shape(fetch: VoxelFetch) -> Shape {
    match fetch {
        VoxelFetch::Packed => {
            Shape { extent: [PACKED_ROW as u32, 2, 1], format: vk::Format::R32_UINT, storage: true }
        }
        _ => {
            let format = vk::Format::R32G32B32A32_SFLOAT;
            Shape { extent: [TABLE_LEN as u32, 1, 1], format, storage: false }
        }
    }
}

/// The skip map's image.
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

/// The table's texels: four floats per entry; or, packed, one row of opacities and one row of finely interpolated
/// colors in 11, 11 and 10 bits.
pub(crate) fn table_texels(fetch: VoxelFetch, table: &StepTable) -> Vec<u8> {
    if fetch != VoxelFetch::Packed {
        return bytemuck::cast_slice(table.as_slice()).to_vec();
    }
    let mut words = vec![0u32; 2 * PACKED_ROW];
    for (word, entry) in words.iter_mut().zip(table) {
        *word = entry[3].to_bits();
    }
    for (j, word) in words[PACKED_ROW..][..(TABLE_LEN - 1) * COLORS_PER_ENTRY + 1].iter_mut().enumerate() {
        // The middle of the positions that round down to j.
        let at = ((j as f32 + 0.5) / COLORS_PER_ENTRY as f32).min(255.0);
        let low = (at as usize).min(TABLE_LEN - 2);
        let f = at - low as f32;
        let channel = |c: usize, top: f32| {
            let v = table[low][c] + f * (table[low + 1][c] - table[low][c]);
            (v * top + 0.5) as u32
        };
        *word = channel(0, 2047.0) | (channel(1, 2047.0) << 11) | (channel(2, 1023.0) << 22);
    }
    bytemuck::cast_slice(&words).to_vec()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packed_words_hold_the_square_of_neighbors() {
        let voxels: Vec<u8> = (0..24).collect();
        let mut out = [0u8; 12 * 4];
        pack_slices(&voxels, [4, 3], 1, &mut out);
        assert_eq!(out[..4], [12, 13, 16, 17]);
        assert_eq!(out[3 * 4..4 * 4], [15, 15, 19, 19], "clamped at the end of a row");
        assert_eq!(out[11 * 4..], [23, 23, 23, 23], "clamped at the corner");
        let mut one = [0u8; 4];
        pack_slices(&[9], [1, 1], 0, &mut one);
        assert_eq!(one, [9; 4]);
    }
}
