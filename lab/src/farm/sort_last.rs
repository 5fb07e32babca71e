//! Sort-last rendering: a volume that is too large for a node is cut into parts, a group of nodes renders one
//! part each, and the partial images are composited. The time of a frame is that of its slowest part plus
//! compositing.
//!
//! Compositing is radix-k (Peterka et al. 2009; binary swap if all factors are 2) with a last gathering: in a
//! round with factor k a node sends k − 1 messages with (k − 1)/k of its remaining pixels. Its seconds are
//! messages · latency + bytes · seconds per byte, both fitted to measured times or given.

use anyhow::{Result, bail, ensure};
use entire_core::scene::{Arcball, Camera, Frame, Scalars, TransferTable, VolumeOptions, VolumeView};
use entire_steer::features::{
    FrameFeatures, PROBE_SIDE, Setting, SummaryOptions, TransferSummary, VolumeSummary,
};
use entire_steer::predict::{AnalyticModel, Inputs, Measurement, Predictor, UnitCosts};
use entire_vk_raycaster::Renderer;

/// Bytes of a pixel that is sent: four 32-bit floats.
const PIXEL_BYTES: f64 = 16.0;

/// A measured compositing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Composited {
    /// Number of partial images.
    pub parts: usize,
    /// Number of pixels of the image.
    pub pixels: u64,
    /// Measured seconds.
    pub seconds: f64,
}

/// Costs of compositing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Compositing {
    /// Seconds per message.
    pub latency: f64,
    /// Seconds per byte, sent and blended.
    pub per_byte: f64,
}

impl Compositing {
    /// Messages that a node waits for, and bytes that it sends.
    fn amounts(parts: usize, pixels: u64) -> (f64, f64) {
        let whole = pixels as f64 * PIXEL_BYTES;
        let (mut messages, mut bytes, mut share, mut left, mut k) = (0.0, 0.0, whole, parts.max(1), 2);
        while left > 1 {
            while !left.is_multiple_of(k) {
                k += 1;
            }
            let others = (k - 1) as f64;
            messages += others;
            bytes += share * others / k as f64;
            share /= k as f64;
            left /= k;
        }
        // The first node gathers the parts of the others.
        (messages + parts.saturating_sub(1) as f64, bytes + whole - share)
    }

    /// Seconds to composite an image.
    pub fn seconds(&self, parts: usize, pixels: u64) -> f64 {
        let (messages, bytes) = Self::amounts(parts, pixels);
        messages * self.latency + bytes * self.per_byte
    }

    /// Fits both costs to measured times by least squares of the relative errors.
    ///
    /// # Errors
    /// When the times do not determine latency and bytes: at least two different numbers of parts or of
    /// pixels are needed.
    pub fn fit(measured: &[Composited]) -> Result<Self> {
        let (mut aa, mut ab, mut bb, mut a1, mut b1) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for m in measured {
            ensure!(
                m.parts >= 2 && m.seconds.is_finite() && m.seconds > 0.0,
                "a compositing of {} parts took {} s; at least 2 parts and a positive time are needed",
                m.parts,
                m.seconds
            );
            let (a, b) = Self::amounts(m.parts, m.pixels);
            let (a, b) = (a / m.seconds, b / m.seconds);
            aa += a * a;
            ab += a * b;
            bb += b * b;
            a1 += a;
            b1 += b;
        }
        let spread = aa * bb - ab * ab;
        if measured.len() < 2 || spread <= 1e-9 * aa * bb {
            bail!("the measured compositings are alike; vary the number of parts or of pixels");
        }
        let (latency, per_byte) = ((a1 * bb - b1 * ab) / spread, (b1 * aa - a1 * ab) / spread);
        // Neither cost can be negative.
        Ok(match (latency < 0.0, per_byte < 0.0) {
            (true, _) => Self { latency: 0.0, per_byte: b1 / bb },
            (_, true) => Self { latency: a1 / aa, per_byte: 0.0 },
            _ => Self { latency, per_byte },
        })
    }
}

/// A part of a volume: a box of voxels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Part {
    from: [usize; 3],
    to: [usize; 3],
}

/// Cuts a volume into boxes of about equal size, each across its longest edge. Neighbors share a layer of voxels.
///
/// # Errors
/// When it has too few voxels.
pub fn cut(dims: [usize; 3], parts: usize) -> Result<Vec<Part>> {
    let mut out = vec![Part { from: [0; 3], to: dims.map(|n| n.saturating_sub(1)) }];
    while out.len() < parts {
        let cells = |p: &Part| (0..3).map(|a| p.to[a] - p.from[a]).product::<usize>();
        let index = (0..out.len()).max_by_key(|i| (cells(&out[*i]), usize::MAX - i)).unwrap_or(0);
        let edge = |a: usize| out[index].to[a] - out[index].from[a];
        let (length, axis) = (0..3).map(|a| (edge(a), a)).max().unwrap_or((0, 0));
        ensure!(length >= 8, "a volume of {dims:?} voxels cannot be cut into {parts} parts");
        let middle = out[index].from[axis] + length / 2;
        let mut other = out[index];
        out[index].to[axis] = middle;
        other.from[axis] = middle;
        out.push(other);
    }
    Ok(out)
}

/// The elements from an index on, and the number of bytes of one element.
fn behind(scalars: Scalars<'_>, at: usize) -> Result<(Scalars<'_>, u64)> {
    Ok(match scalars {
        Scalars::U8(v) => (Scalars::U8(&v[at..]), 1),
        Scalars::U16(v) => (Scalars::U16(&v[at..]), 2),
        Scalars::I16(v) => (Scalars::I16(&v[at..]), 2),
        Scalars::F32(v) => (Scalars::F32(&v[at..]), 4),
    })
}

impl Part {
    /// The voxels of this part, and their number of bytes.
    fn view<'a>(&self, whole: &VolumeView<'a>) -> Result<(VolumeView<'a>, u64)> {
        let dims = [0, 1, 2].map(|a| self.to[a] - self.from[a] + 1);
        let first = self.from.iter().zip(whole.strides()).map(|(from, stride)| from * stride).sum();
        let (scalars, bytes) = behind(whole.scalars(), first)?;
        let options = VolumeOptions {
            strides: Some(whole.strides()),
            spacing: whole.shape().spacing.to_array(),
            range: Some(whole.range()),
        };
        let view = VolumeView::with(scalars, dims, options)?;
        Ok((view, bytes * view.shape().voxels))
    }

    /// The camera that shows this part as the camera of the whole volume does.
    fn camera(
        &self,
        whole: &VolumeView<'_>,
        view: &VolumeView<'_>,
        camera: &Camera,
        fov: f32,
    ) -> Result<Camera> {
        let (whole, own) = (whole.shape(), view.shape());
        let mut corner = whole.spacing;
        corner.x *= self.from[0] as f32;
        corner.y *= self.from[1] as f32;
        corner.z *= self.from[2] as f32;
        let center =
            (corner + own.half_extent * own.bounding_radius) / whole.bounding_radius - whole.half_extent;
        let radius = own.bounding_radius / whole.bounding_radius;
        Ok(Camera::from_world_view(camera.view(), center, radius)?.with_fov_y_degrees(fov)?)
    }
}

/// Scene of the frames.
pub struct Scene<'a> {
    /// The volume.
    pub volume: VolumeView<'a>,
    /// The transfer function.
    pub table: TransferTable,
    /// The views.
    pub poses: Vec<Arcball>,
    /// Width and height of the images, pixels.
    pub size: [u32; 2],
}

/// Vertical field of view of all frames, degrees.
const FOV: f32 = 45.0;

/// Measured and predicted seconds of every view and part; the analytic model that predicts was fitted to the
/// first views.
#[derive(Clone, Debug, PartialEq)]
pub struct Parts {
    /// Measured seconds, by view and part.
    pub measured: Vec<Vec<f64>>,
    /// Predicted seconds, by view and part.
    pub predicted: Vec<Vec<f64>>,
    /// Bytes of the largest part.
    pub bytes: u64,
    /// Number of views that the model was fitted to; they come first.
    pub fitted: usize,
    /// Number of samples of each view, all parts together; 0 if the renderer does not count them.
    pub samples: Vec<u64>,
}

/// Renders every view of a volume in parts, one after another, and predicts their times.
///
/// # Errors
/// When the renderer fails or the volume is too small.
pub fn measure(
    scene: &Scene<'_>,
    parts: usize,
    fitted: usize,
    repeats: usize,
    renderer: &mut dyn Renderer,
    termination: f32,
) -> Result<Parts> {
    let views = scene.poses.len();
    ensure!(fitted < views, "{fitted} of {views} views are to be fitted to; none is left to predict");
    let mut out = Parts {
        measured: vec![Vec::new(); views],
        predicted: vec![Vec::new(); views],
        bytes: 0,
        fitted,
        samples: vec![0; views],
    };
    let mut seen = Vec::new();
    for part in cut(scene.volume.shape().dims, parts)? {
        let (view, bytes) = part.view(&scene.volume)?;
        out.bytes = out.bytes.max(bytes);
        let summary = VolumeSummary::new(&view, SummaryOptions::default())?;
        let mut transfer = TransferSummary::new(&summary, &scene.table)?;
        let mut features = FrameFeatures::with_probe_side(PROBE_SIDE);
        renderer.set_volume(&view)?;
        renderer.set_transfer(&scene.table)?;
        for (index, pose) in scene.poses.iter().enumerate() {
            let whole = Camera::from_arcball(*pose)?.with_fov_y_degrees(FOV)?;
            let camera = part.camera(&scene.volume, &view, &whole, FOV)?;
            let frame = Frame { termination, ..Frame::new(camera, scene.size[0], scene.size[1])? };
            let (mut least, mut samples) = (f64::INFINITY, 0);
            for _ in 0..repeats.max(1) {
                let rendered = renderer.render(&frame)?;
                least = least.min(rendered.time.cpu.unwrap_or(rendered.time.wall));
                samples = rendered.counts.map_or(0, |c| c.samples);
            }
            out.samples[index] += samples;
            features.measure(&summary, &mut transfer, &frame)?;
            out.measured[index].push(least);
            seen.push((index, features.clone(), Setting::from(&frame), camera.to_arcball(), least));
        }
    }
    let mut model = AnalyticModel::default();
    let known: Vec<Measurement> =
        seen.iter().filter(|s| s.0 < fitted).map(|s| Measurement::new(&s.1, &s.2, s.4)).collect();
    model.fit(&UnitCosts::SOFTWARE, &known)?;
    for (index, features, setting, camera, _) in &seen {
        let predicted = model.predict(&Inputs {
            features,
            setting: *setting,
            changes: entire_steer::features::Changes::default(),
            camera: *camera,
            volume_features: None,
            lobes: None,
        })?;
        out.predicted[*index].push(f64::from(predicted.seconds));
    }
    Ok(out)
}

impl Parts {
    /// Predicted and measured seconds of the frames that the model was not fitted to: those of the slowest part
    /// plus compositing.
    pub fn frames(&self, compositing: &Compositing, pixels: u64) -> (Vec<f64>, Vec<f64>) {
        let of = |times: &[Vec<f64>]| -> Vec<f64> {
            times[self.fitted..]
                .iter()
                .map(|t| t.iter().copied().fold(0.0, f64::max) + compositing.seconds(t.len(), pixels))
                .collect()
        };
        (of(&self.predicted), of(&self.measured))
    }

    /// Measured seconds of the slowest part over the mean of all parts, averaged over the views.
    pub fn imbalance(&self) -> f64 {
        let of = |t: &Vec<f64>| {
            t.iter().copied().fold(0.0, f64::max) * t.len() as f64 / t.iter().sum::<f64>().max(1e-12)
        };
        self.measured.iter().map(of).sum::<f64>() / self.measured.len().max(1) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use entire_core::scene::{GaussianLobe, TransferFunction};
    use entire_vk_raycaster::CpuRaycaster;

    #[test]
    fn compositing_is_counted_and_found_again() {
        // Binary swap of 4: halves, then quarters, then three messages to the first.
        let (messages, bytes) = Compositing::amounts(4, 1000);
        assert_eq!((messages, bytes), (5.0, 16_000.0 * (0.5 + 0.25 + 0.75)));
        assert_eq!(Compositing::amounts(1, 1000), (0.0, 0.0));
        // Radix 3: two messages, then two to the first.
        assert_eq!(Compositing::amounts(3, 900).0, 4.0);
        let law = Compositing { latency: 3e-5, per_byte: 1.2e-9 };
        let measured: Vec<Composited> = [(2, 65_536), (4, 65_536), (4, 1_000_000), (2, 1_000_000)]
            .map(|(parts, pixels)| Composited { parts, pixels, seconds: law.seconds(parts, pixels) })
            .into();
        let found = Compositing::fit(&measured).unwrap();
        assert!((found.latency / law.latency - 1.0).abs() < 1e-6);
        assert!((found.per_byte / law.per_byte - 1.0).abs() < 1e-6);
        assert!(Compositing::fit(&measured[..1]).is_err());
        assert!(Compositing::fit(&[measured[0], measured[0]]).is_err());
    }

    #[test]
    fn boxes_cover_the_volume_once() {
        for parts in [1, 2, 3, 4, 8, 12] {
            let boxes = cut([33, 65, 41], parts).unwrap();
            assert_eq!(boxes.len(), parts);
            let cells: usize =
                boxes.iter().map(|p| (0..3).map(|a| p.to[a] - p.from[a]).product::<usize>()).sum();
            assert_eq!(cells, 32 * 64 * 40);
        }
        assert!(cut([4, 4, 4], 8).is_err());
    }

    #[test]
    fn parts_take_the_samples_of_the_whole_and_are_predicted() {
        let side = 48;
        let voxels: Vec<u8> = (0..side * side * side)
            .map(|i| {
                let at = [i % side, i / side % side, i / side / side].map(|v| v as f32 / side as f32 - 0.4);
                (255.0 * (-8.0 * at.iter().map(|v| v * v).sum::<f32>()).exp()) as u8
            })
            .collect();
        let volume = VolumeView::new(Scalars::U8(&voxels), [side, side, side]).unwrap();
        let lobes = vec![GaussianLobe { center: 0.6, width: 0.05, height: 0.05 }];
        let scene = Scene {
            volume,
            table: TransferFunction::Gaussian(lobes).to_table().unwrap(),
            poses: (0..6).map(|i| Arcball { rx: 10.0 * i as f32, ry: 55.0 * i as f32, dz: 2.5 }).collect(),
            size: [48, 48],
        };
        let mut renderer = CpuRaycaster::new();
        let whole = measure(&scene, 1, 3, 1, &mut renderer, 1.0).unwrap();
        let parts = measure(&scene, 4, 3, 1, &mut renderer, 1.0).unwrap();
        for (a, b) in whole.samples.iter().zip(&parts.samples) {
            // Blocks of empty space differ between the parts, and each part starts its own rays.
            let ratio = *b as f64 / *a as f64;
            assert!((0.9..1.15).contains(&ratio), "{a} {b}");
        }
        assert!(parts.bytes < whole.bytes / 3);
        assert!(parts.predicted.iter().flatten().all(|t| *t > 0.0));
        let compositing = Compositing { latency: 1.0, per_byte: 0.0 };
        let (predicted, measured) = parts.frames(&compositing, 48 * 48);
        assert_eq!((predicted.len(), measured.len()), (3, 3));
        assert!(measured.iter().all(|t| *t > 5.0) && parts.imbalance() >= 1.0);
    }
}
