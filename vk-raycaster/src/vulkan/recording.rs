//! Commands of a submission, as plain data that can be tested without a device. The engine executes them.

use super::picture::Region;
use crate::setup::FrameSetup;
use ash::vk;

/// Pixels along the edge of a workgroup.
pub(crate) const GROUP_EDGE: u32 = 8;

/// Bytes per pixel of the image and of the work counts.
pub(crate) const IMAGE_BYTES: u64 = 4;
pub(crate) const WORK_BYTES: u64 = 16;

/// Images that commands write.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Target {
    /// A brick of the volume.
    Volume(usize),
    SkipMap,
    Table,
}

/// One step of a submission.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Command {
    /// Writes the frame's parameters.
    WriteSetup(Box<FrameSetup>),
    /// Writes the texels of the step table into the table's staging buffer on the device.
    WriteTable(Vec<u8>),
    /// Makes an image ready to be copied to; its contents are lost unless `keep` is true.
    PrepareCopy { target: Target, keep: bool },
    /// Copies slices `first_slice…` of the volume or skip map from the staging buffer.
    CopySlices { target: Target, first_slice: u32, slices: u32 },
    /// Copies the table's staging buffer to its image.
    CopyTable,
    /// Makes a copied image ready to be read by the shader.
    FinishCopy { target: Target },
    /// Makes earlier writes to buffers visible to the copy or shader that follows.
    BufferBarrier(Hazard),
    /// Clears the two timestamps.
    ResetTimestamps,
    /// Writes timestamp 0 (before the work) or 1 (after it).
    Timestamp(u32),
    /// Casts the rays of the tile.
    Dispatch { groups: [u32; 2] },
    /// Copies the image into a rectangle of a picture on the device; the picture's other contents are lost if
    /// `fresh` is true.
    CopyToPicture { image: vk::Image, fresh: bool, tile: Region },
    /// Copies the image, and the work counts if there are any, to the buffer that the host reads.
    ReadBack { image_bytes: u64, work_bytes: u64 },
}

/// Accesses that a buffer barrier separates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Hazard {
    /// A transfer wrote, a transfer reads.
    TransferToTransfer,
    /// A transfer wrote, the shader reads.
    TransferToShader,
    /// The shader wrote, a transfer reads.
    ShaderToTransfer,
    /// A transfer wrote, the host reads.
    TransferToHost,
}

/// Destination of a tile's pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Output {
    /// To the buffer that the host reads.
    Host,
    /// No copy of the pixels: another dispatch continues these rays.
    Device,
    /// To a picture on the device, at the tile's place; see [`Command::CopyToPicture`].
    Picture { image: vk::Image, fresh: bool },
}

/// Cuts an image into tiles of at most `edge` × `edge` pixels, row by row.
pub(crate) fn tiles(width: u32, height: u32, edge: u32) -> Vec<Region> {
    let starts = |side: u32| (0..side).step_by(edge as usize);
    let tile = |x, y| Region { x, y, width: edge.min(width - x), height: edge.min(height - y) };
    starts(height).flat_map(|y| starts(width).map(move |x| tile(x, y))).collect()
}

/// Returns the commands that cast the rays of one tile. `table`: texels to upload, if the ray step or the
/// transfer function changed.
pub(crate) fn record_tile(
    setup: &FrameSetup,
    tile: Region,
    table: Option<Vec<u8>>,
    timestamps: bool,
    counting: bool,
    output: Output,
) -> Vec<Command> {
    let mut setup = *setup;
    (setup.tile_x, setup.tile_y) = (tile.x, tile.y);
    (setup.tile_width, setup.tile_height) = (tile.width, tile.height);
    let mut commands = vec![];
    if timestamps {
        commands.push(Command::ResetTimestamps);
    }
    commands.push(Command::WriteSetup(Box::new(setup)));
    if let Some(table) = table {
        commands.extend([
            Command::WriteTable(table),
            Command::BufferBarrier(Hazard::TransferToTransfer),
            Command::PrepareCopy { target: Target::Table, keep: false },
            Command::CopyTable,
            Command::FinishCopy { target: Target::Table },
        ]);
    }
    commands.push(Command::BufferBarrier(Hazard::TransferToShader));
    if timestamps {
        commands.push(Command::Timestamp(0));
    }
    commands.push(Command::Dispatch {
        groups: [tile.width.div_ceil(GROUP_EDGE), tile.height.div_ceil(GROUP_EDGE)],
    });
    if timestamps {
        commands.push(Command::Timestamp(1));
    }
    commands.push(Command::BufferBarrier(Hazard::ShaderToTransfer));
    if let Output::Picture { image, fresh } = output {
        commands.push(Command::CopyToPicture { image, fresh, tile });
    }
    if output == Output::Host || counting && output != Output::Device {
        commands.extend([
            Command::ReadBack {
                image_bytes: tile.pixels() * IMAGE_BYTES,
                work_bytes: if counting { tile.pixels() * WORK_BYTES } else { 0 },
            },
            Command::BufferBarrier(Hazard::TransferToHost),
        ]);
    }
    commands
}

/// Returns the commands that copy some slices of a volume or skip map from the staging buffer.
pub(crate) fn record_slices(target: Target, depth: u32, first_slice: u32, slices: u32) -> Vec<Command> {
    let mut commands = vec![Command::PrepareCopy { target, keep: first_slice > 0 }];
    commands.push(Command::CopySlices { target, first_slice, slices });
    // The shader may read the image only once all of it is copied; until then it stays a copy destination.
    if first_slice + slices == depth {
        commands.push(Command::FinishCopy { target });
    }
    commands
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::Zeroable;

    #[test]
    fn tiles_cover_every_pixel_once() {
        for (w, h, edge) in [(1, 1, 8), (100, 7, 32), (64, 64, 64), (65, 129, 64), (8192, 8192, 1024)] {
            let tiles = tiles(w, h, edge);
            let area: u64 = tiles.iter().map(Region::pixels).sum();
            assert_eq!(area, u64::from(w) * u64::from(h));
            assert!(
                tiles
                    .iter()
                    .all(|t| t.width <= edge && t.height <= edge && t.x % edge == 0 && t.y % edge == 0)
            );
            assert!(tiles.iter().all(|t| t.x + t.width <= w && t.y + t.height <= h));
        }
    }

    fn position(commands: &[Command], find: impl Fn(&Command) -> bool) -> usize {
        commands.iter().position(find).unwrap_or_else(|| panic!("missing in {commands:?}"))
    }

    #[test]
    fn a_tile_writes_before_it_casts_and_reads_back_after() {
        let tile = Region { x: 16, y: 32, width: 33, height: 9 };
        let table = vec![0; 64];
        let c = record_tile(&FrameSetup::zeroed(), tile, Some(table), true, true, Output::Host);
        let write =
            position(&c, |c| matches!(c, Command::WriteSetup(s) if s.tile_x == 16 && s.tile_height == 9));
        let copied = position(&c, |c| *c == Command::FinishCopy { target: Target::Table });
        let ready = position(&c, |c| *c == Command::BufferBarrier(Hazard::TransferToShader));
        let begin = position(&c, |c| *c == Command::Timestamp(0));
        let cast = position(&c, |c| *c == Command::Dispatch { groups: [5, 2] });
        let end = position(&c, |c| *c == Command::Timestamp(1));
        let wait = position(&c, |c| *c == Command::BufferBarrier(Hazard::ShaderToTransfer));
        let read =
            position(&c, |c| *c == Command::ReadBack { image_bytes: 33 * 9 * 4, work_bytes: 33 * 9 * 16 });
        let host = position(&c, |c| *c == Command::BufferBarrier(Hazard::TransferToHost));
        assert_eq!(c[0], Command::ResetTimestamps);
        assert!(write < copied && copied < ready && ready < begin && begin < cast && cast < end);
        assert!(end < wait && wait < read && read < host && host == c.len() - 1);
    }

    #[test]
    fn without_clock_table_and_counts_nothing_is_recorded_for_them() {
        let tile = Region { x: 0, y: 0, width: 8, height: 8 };
        let c = record_tile(&FrameSetup::zeroed(), tile, None, false, false, Output::Host);
        assert!(
            !c.iter()
                .any(|c| matches!(c, Command::Timestamp(_) | Command::ResetTimestamps | Command::CopyTable))
        );
        assert!(c.contains(&Command::ReadBack { image_bytes: 256, work_bytes: 0 }));
    }

    #[test]
    fn a_picture_on_the_device_is_copied_to_and_not_read_back() {
        let tile = Region { x: 8, y: 16, width: 8, height: 4 };
        let output = Output::Picture { image: vk::Image::null(), fresh: true };
        let c = record_tile(&FrameSetup::zeroed(), tile, None, true, false, output);
        let cast = position(&c, |c| matches!(c, Command::Dispatch { .. }));
        let wait = position(&c, |c| *c == Command::BufferBarrier(Hazard::ShaderToTransfer));
        let copy = Command::CopyToPicture { image: vk::Image::null(), fresh: true, tile };
        assert!(cast < wait && wait < position(&c, |c| *c == copy));
        assert!(!c.iter().any(|c| matches!(c, Command::ReadBack { .. })));
        // Work counts are read back nevertheless.
        let c = record_tile(&FrameSetup::zeroed(), tile, None, true, true, output);
        assert!(c.contains(&Command::ReadBack { image_bytes: 128, work_bytes: 512 }));
    }

    #[test]
    fn rays_that_another_dispatch_continues_are_not_read_back() {
        let tile = Region { x: 0, y: 0, width: 8, height: 8 };
        for counting in [false, true] {
            let c = record_tile(&FrameSetup::zeroed(), tile, None, true, counting, Output::Device);
            assert!(!c.iter().any(|c| matches!(c, Command::ReadBack { .. })), "{c:?}");
        }
    }

    #[test]
    fn only_a_whole_image_becomes_readable() {
        let finishes = |c: &[Command]| c.contains(&Command::FinishCopy { target: Target::Volume(0) });
        let first = record_slices(Target::Volume(0), 10, 0, 6);
        let last = record_slices(Target::Volume(0), 10, 6, 4);
        assert!(!finishes(&first) && finishes(&last));
        assert!(first.contains(&Command::PrepareCopy { target: Target::Volume(0), keep: false }));
        assert!(last.contains(&Command::PrepareCopy { target: Target::Volume(0), keep: true }));
    }
}
