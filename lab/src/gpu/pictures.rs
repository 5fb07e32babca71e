//! Pictures of a device beside those of the CPU version.

use anyhow::{Context, Result};
use entire_core::scene::{Arcball, Camera, Frame, GaussianLobe, Shading, Skipping, TransferFunction};
use entire_io::files::write_whole;
use entire_io::options::{Device, open_renderer};
use entire_io::volume::{Reading, open_volume};
use entire_report::encode_png;
use entire_vk_raycaster::{CpuRaycaster, Renderer};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Cameras of the pictures: rotations rx and ry, degrees; distance, radii. The last is inside the volume.
const CAMERAS: [(f32, f32, f32); 4] =
    [(0.0, 0.0, 2.5), (25.0, 40.0, 1.6), (-60.0, 130.0, 3.0), (10.0, -75.0, 0.4)];

/// Difference between a picture of the device and the picture of the CPU version.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Difference {
    pub(crate) volume: String,
    pub(crate) shading: String,
    pub(crate) camera: usize,
    /// Largest difference of a channel, on a scale of 0 to 255.
    pub(crate) largest: u8,
    /// Mean difference of the channels, on a scale of 0 to 255.
    pub(crate) mean: f64,
    /// True if device and CPU version took equally many samples; `None` if one of them does not count them.
    pub(crate) same_samples: Option<bool>,
}

/// Draws every volume in every shading mode from every camera on the device and on the CPU version. Writes
/// the device's pictures into `folder`, and returns the differences.
pub(crate) fn compare(
    device: Device,
    volumes: &[PathBuf],
    side: u32,
    folder: &Path,
) -> Result<Vec<Difference>> {
    let mut renderer = open_renderer(device)?;
    let mut twin = CpuRaycaster::new();
    renderer.count_work(true);
    let table = TransferFunction::Gaussian(vec![
        GaussianLobe { center: 0.35, width: 0.004, height: 0.05 },
        GaussianLobe { center: 0.75, width: 0.01, height: 0.4 },
    ])
    .to_table()?;
    let mut found = Vec::new();
    for path in volumes {
        let volume = open_volume(path, &Reading::default())?;
        renderer.set_volume(&volume.view()).with_context(|| path.display().to_string())?;
        twin.set_volume(&volume.view())?;
        renderer.set_transfer(&table)?;
        twin.set_transfer(&table)?;
        let name =
            path.components().rev().take(3).map(|c| c.as_os_str().to_string_lossy()).collect::<Vec<_>>();
        let name = name.into_iter().rev().collect::<Vec<_>>().join("/");
        for shading in Shading::ALL {
            for (camera, (rx, ry, dz)) in CAMERAS.into_iter().enumerate() {
                let view = Camera::from_arcball(Arcball { rx, ry, dz })?;
                let frame = Frame { shading, skipping: Skipping::Blocks, ..Frame::new(view, side, side)? };
                let (drawn, expected) = (renderer.render(&frame)?, twin.render(&frame)?);
                let pairs = || drawn.image.rgba.iter().zip(&expected.image.rgba).map(|(a, b)| a.abs_diff(*b));
                let file = format!("{}-{shading}-{camera}.png", name.replace('/', "-"));
                write_whole(&folder.join(file), &encode_png(&drawn.image)?)?;
                found.push(Difference {
                    volume: name.clone(),
                    shading: shading.to_string(),
                    camera,
                    largest: pairs().max().unwrap_or(0),
                    mean: pairs().map(f64::from).sum::<f64>() / drawn.image.rgba.len() as f64,
                    same_samples: drawn.counts.zip(expected.counts).map(|(a, b)| a.samples == b.samples),
                });
            }
        }
    }
    Ok(found)
}
