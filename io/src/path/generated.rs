//! Paths that are generated from a volume's value distribution.

use super::{CameraPose, Keyframe, MAX_FRAMES, PATH_FORMAT, PathFile, Transfer};
use anyhow::{Result, ensure};
use entire_core::scene::{DEFAULT_FOV_Y_DEGREES, GaussianLobe, VolumeView, normalize};

/// Paths that are generated for a volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Generated {
    /// An orbit with three abrupt transfer-function switches.
    Switches,
    /// One turn around the volume with one transfer function, without abrupt changes.
    Orbit,
    /// A slow orbit while the lobes are dragged to lower values and back.
    Drag,
    /// A flight from far away into the volume and out again.
    FlyIn,
    /// Two switches of the camera and one of the transfer function.
    Cuts,
}

entire_core::names! { Generated:
    Switches "switches",
    Orbit "orbit",
    Drag "drag",
    FlyIn "fly-in",
    Cuts "cuts",
}

impl Generated {
    /// Returns the path, `frames` long, with transfer functions set by the volume's value distribution. Every
    /// transfer function has three lobes.
    ///
    /// # Errors
    /// When `frames` is outside 8 to [`MAX_FRAMES`].
    pub fn path(self, volume: &VolumeView<'_>, frames: u32) -> Result<PathFile> {
        ensure!(
            (8..=MAX_FRAMES).contains(&frames),
            "a generated path has 8 to {MAX_FRAMES} frames, not {frames}"
        );
        let values = Values::of(volume);
        let share = |p: u32| (u64::from(frames) * u64::from(p) / 100).min(u64::from(frames) - 1) as u32;
        let camera =
            |rx_deg, ry_deg, dz_radii| Some(CameraPose { rx_deg, ry_deg, dz_radii, parallel_scale: None });
        let key = |p: u32, camera, transfer: Option<Transfer>, switch| Keyframe {
            frame: share(p),
            camera,
            transfer,
            switch,
        };
        // Surfaces at the upper half of the values: rays end early.
        let shell = values.lobes([(0.7, 0.004, 0.1), (0.85, 0.004, 0.15), (0.97, 0.01, 0.3)]);
        // A thin haze over everything: no ray ends early.
        let haze = values.lobes([(0.2, 0.01, 0.002), (0.5, 0.01, 0.003), (0.9, 0.005, 0.01)]);
        // Only the highest values: most blocks are skipped.
        let core = values.lobes([(0.985, 0.0008, 0.3), (0.993, 0.0008, 0.6), (0.999, 0.0015, 0.9)]);
        // A translucent layer around a denser layer.
        let layers = values.lobes([(0.35, 0.002, 0.02), (0.65, 0.002, 0.03), (0.95, 0.003, 0.3)]);
        let keyframes = match self {
            Self::Switches => vec![
                key(0, camera(15.0, 0.0, 2.2), Some(shell), false),
                key(25, None, Some(haze), true),
                key(40, camera(30.0, 90.0, 1.7), None, false),
                key(50, None, Some(core), true),
                key(70, camera(5.0, 170.0, 2.0), None, false),
                key(75, None, Some(layers), true),
                key(100, camera(20.0, 260.0, 2.4), None, false),
            ],
            Self::Orbit => vec![
                key(0, camera(20.0, 0.0, 2.0), Some(layers), false),
                key(100, camera(20.0, 360.0, 2.0), None, false),
            ],
            Self::Drag => vec![
                key(0, camera(10.0, 0.0, 2.0), Some(core), false),
                key(50, None, Some(haze), false),
                key(100, camera(30.0, 120.0, 2.0), Some(shell), false),
            ],
            Self::FlyIn => vec![
                key(0, camera(20.0, 0.0, 4.0), Some(layers), false),
                key(60, camera(10.0, 60.0, 0.7), None, false),
                key(100, camera(25.0, 90.0, 3.0), None, false),
            ],
            Self::Cuts => vec![
                key(0, camera(10.0, 0.0, 3.5), Some(layers), false),
                key(25, camera(40.0, 120.0, 1.3), None, true),
                key(50, None, Some(shell), true),
                key(75, camera(5.0, 250.0, 2.5), None, true),
                key(100, camera(5.0, 300.0, 2.2), None, false),
            ],
        };
        Ok(PathFile {
            format: PATH_FORMAT.into(),
            name: self.name().into(),
            frames,
            fov_y_deg: DEFAULT_FOV_Y_DEGREES,
            keyframes,
        })
    }
}

/// The value distribution of a volume without its background.
struct Values {
    sorted: Vec<f32>,
}

impl Values {
    /// Returns the distribution in about 100 000 evenly spread voxels. Voxels in the lowest 4 % of the range
    /// count as background and are left out if more than 0.5 % of the voxels lie above this threshold.
    fn of(volume: &VolumeView<'_>) -> Self {
        let [nx, ny, nz] = volume.shape().dims;
        let stride = (volume.shape().voxels / 100_000).max(1);
        // An odd stride visits every column of rows whose length is a power of two.
        let stride = if stride.is_multiple_of(2) { stride + 1 } else { stride };
        let mut all: Vec<f32> = (0..volume.shape().voxels)
            .step_by(stride as usize)
            .map(|i| {
                let (x, rest) = (i as usize % nx, i as usize / nx);
                normalize(volume.range(), volume.value(x, rest % ny, (rest / ny).min(nz - 1)))
            })
            .filter(|v| v.is_finite())
            .collect();
        all.sort_by(f32::total_cmp);
        let above = all.partition_point(|v| *v <= 0.04);
        let sorted = if all.len() - above > all.len() / 200 { all.split_off(above) } else { all };
        Self { sorted }
    }

    fn quantile(&self, p: f64) -> f32 {
        match self.sorted.len() {
            0 => 0.5,
            n => self.sorted[((p * (n - 1) as f64).round() as usize).min(n - 1)],
        }
    }

    fn lobes(&self, lobes: [(f64, f32, f32); 3]) -> Transfer {
        Transfer::Lobes(
            lobes.map(|(p, width, height)| GaussianLobe { center: self.quantile(p), width, height }).to_vec(),
        )
    }
}
