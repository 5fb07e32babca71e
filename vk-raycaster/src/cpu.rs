//! The CPU version of the ray-casting shader: plain loops that render the same picture and count their work.

#![allow(
    clippy::needless_range_loop,
    reason = "loops over the three axes read several arrays at once, as in the shader"
)]

use crate::blocks::{BlockMap, EMPTY_BIT, SkipMap};
use crate::clock::Stopwatch;
use crate::error::{Error, Result};
use crate::renderer::{FrameTime, Image, Preparation, Rendered, Renderer, WorkCounts};
use crate::setup::{FrameSetup, SHADOW_STEP, SHADOW_TERMINATION, SMALLEST_ADVANCE, check};
use crate::table::{Classifier, StepTable};
use crate::voxels::{BLOCK_EDGE, PreparedVolume, Voxel, with_voxels};
use entire_core::scene::{Frame, Shading, Skipping, TransferTable, VolumeView};
use rayon::prelude::*;

/// The CPU version of the raycaster. It renders the picture that the crate documentation defines, with exact
/// counts, on all threads of the current rayon pool.
#[derive(Default)]
pub struct CpuRaycaster {
    volume: Option<(PreparedVolume, BlockMap)>,
    classifier: Option<Classifier>,
    /// `None` until both volume and transfer function are set.
    skip: Option<SkipMap>,
}

impl CpuRaycaster {
    /// A renderer without volume and transfer function.
    pub fn new() -> Self {
        Self::default()
    }

    /// Renders a frame and returns its premultiplied colors and opacities before they are rounded to 8 bits,
    /// row by row from the top, and the counts of its work.
    ///
    /// # Errors
    /// When volume or transfer function were not set, the frame is invalid ([`Frame::checked`]), or a ray may
    /// take more samples than are counted exactly.
    pub fn render_linear(&self, frame: &Frame) -> Result<(Vec<[f32; 4]>, WorkCounts)> {
        let (Some((volume, _)), Some(classifier), Some(skip)) = (&self.volume, &self.classifier, &self.skip)
        else {
            let missing = if self.volume.is_none() { "volume" } else { "transfer function" };
            return Err(Error::new(format!("nothing to render: no {missing} was set")));
        };
        check(frame, &volume.geometry)?;
        let setup = FrameSetup::new(&volume.geometry, frame);
        let table = classifier.step_table(frame.step);
        let mut pixels = vec![[0.0; 4]; frame.width as usize * frame.height as usize];
        let counts = with_voxels!(&volume.voxels, voxels => {
            let dims = volume.geometry.dims;
            Caster { setup: &setup, table: &table, skip, frame, voxels, dims }.trace_all(&mut pixels)
        });
        Ok((pixels, counts))
    }

    /// Makes the skip map of the current volume and transfer function, if both are set. Stores its times in
    /// `preparation`, as [`SkipMap::new`] does.
    fn update_skip_map(&mut self, preparation: &mut Preparation) {
        if let (Some((_, blocks)), Some(classifier)) = (&self.volume, &self.classifier) {
            self.skip = Some(SkipMap::new(blocks, classifier, preparation));
        }
    }
}

impl Renderer for CpuRaycaster {
    fn device(&self) -> String {
        format!("CPU raycaster, {} threads", rayon::current_num_threads())
    }

    fn backend(&self) -> &'static str {
        "cpu"
    }

    fn set_volume(&mut self, volume: &VolumeView<'_>) -> Result<Preparation> {
        let all = Stopwatch::start();
        let mut preparation = Preparation::default();
        let volume = PreparedVolume::new(volume);
        preparation.upload = Some(all.wall());
        let watch = Stopwatch::start();
        let blocks = BlockMap::new(&volume);
        preparation.block_map = Some(watch.wall());
        self.volume = Some((volume, blocks));
        self.update_skip_map(&mut preparation);
        preparation.wall = all.wall();
        Ok(preparation)
    }

    fn set_transfer(&mut self, table: &TransferTable) -> Result<Preparation> {
        let all = Stopwatch::start();
        let mut preparation = Preparation::default();
        self.classifier = Some(Classifier::new(table));
        self.update_skip_map(&mut preparation);
        preparation.wall = all.wall();
        Ok(preparation)
    }

    fn render(&mut self, frame: &Frame) -> Result<Rendered> {
        let watch = Stopwatch::start();
        let (pixels, counts) = self.render_linear(frame)?;
        let rgba = pixels.iter().flat_map(|p| p.map(to_byte)).collect();
        let time = FrameTime { device: None, wall: watch.wall(), cpu: watch.cpu() };
        let image = Image { width: frame.width, height: frame.height, rgba };
        Ok(Rendered { image, time, counts: Some(counts) })
    }
}

/// A color channel in 8 bits, rounded.
fn to_byte(v: f32) -> u8 {
    (v.min(1.0) * 255.0 + 0.5) as u8
}

/// A ray: sample k = 0 … count − 1 lies at `first + k * advance` in voxel coordinates. `direction` is a unit
/// vector in scene space, and `inverse` has the reciprocals of `advance`.
struct Ray {
    direction: [f32; 3],
    first: [f32; 3],
    advance: [f32; 3],
    inverse: [f32; 3],
    count: f32,
}

/// Data that the rays of one frame read.
struct Caster<'a, V> {
    setup: &'a FrameSetup,
    table: &'a StepTable,
    skip: &'a SkipMap,
    frame: &'a Frame,
    voxels: &'a [V],
    dims: [usize; 3],
}

impl<V: Voxel> Caster<'_, V> {
    fn trace_all(&self, pixels: &mut [[f32; 4]]) -> WorkCounts {
        let width = self.frame.width as usize;
        pixels
            .par_chunks_mut(width)
            .enumerate()
            .map(|(y, row)| {
                let mut counts = WorkCounts::default();
                for (x, pixel) in row.iter_mut().enumerate() {
                    *pixel = self.trace(x as u32, y as u32, &mut counts);
                }
                counts
            })
            .reduce(WorkCounts::default, |a, b| WorkCounts {
                rays: a.rays + b.rays,
                samples: a.samples + b.samples,
                skips: a.skips + b.skips,
                shaded: a.shaded + b.shaded,
            })
    }

    /// The ray through a pixel, if it meets the box.
    fn ray(&self, x: u32, y: u32) -> Option<Ray> {
        let s = self.setup;
        let u = (x as f32 + 0.5) * s.pixel_width - 1.0;
        let v = 1.0 - (y as f32 + 0.5) * s.pixel_height;
        let eye = [0, 1, 2].map(|a| s.eye[a] + u * s.origin_right[a] + v * s.origin_up[a]);
        let d = [0, 1, 2].map(|a| s.forward[a] + u * s.right[a] + v * s.up[a]);
        let length = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
        let direction = d.map(|d| d / length);
        let advance = [0, 1, 2].map(|a| {
            let d = direction[a] * s.advance[a];
            if d.abs() < SMALLEST_ADVANCE { SMALLEST_ADVANCE } else { d }
        });
        let inverse = advance.map(|d| 1.0 / d);
        let (mut enter, mut exit) = (0.0f32, f32::INFINITY);
        for a in 0..3 {
            let near = (0.0 - eye[a]) * inverse[a];
            let far = (s.dims[a] - eye[a]) * inverse[a];
            enter = enter.max(near.min(far));
            exit = exit.min(near.max(far));
        }
        if exit <= enter {
            return None;
        }
        let offset = if s.jitter != 0 { jitter(x, y) } else { 0.5 };
        let start = enter + offset;
        let first = [0, 1, 2].map(|a| eye[a] + start * advance[a]);
        Some(Ray { direction, first, advance, inverse, count: (exit - start).ceil() })
    }

    fn trace(&self, x: u32, y: u32, counts: &mut WorkCounts) -> [f32; 4] {
        let Some(ray) = self.ray(x, y) else { return [0.0; 4] };
        counts.rays += 1;
        let mut sum = [0.0f32; 4];
        let mut k = 0.0;
        while k < ray.count {
            let (empty, end) = self.segment(&ray.first, &ray.advance, &ray.inverse, k, ray.count);
            if empty {
                counts.skips += 1;
                k = end;
                continue;
            }
            while k < end {
                let p = [0, 1, 2].map(|a| ray.first[a] + k * ray.advance[a]);
                counts.samples += 1;
                let [r, g, b, alpha] = self.classify(self.position(&p));
                if alpha > 0.0 {
                    let mut color = [r, g, b];
                    if self.frame.shading.is_lit() {
                        color = self.light(&p, &ray.direction, color);
                    }
                    if self.frame.shading.scatters() {
                        color = self.scatter(&p, color, counts);
                    }
                    counts.shaded += u64::from(self.frame.shading != Shading::None);
                    let weight = (1.0 - sum[3]) * alpha;
                    for c in 0..3 {
                        sum[c] += weight * color[c];
                    }
                    sum[3] += weight;
                    if sum[3] >= self.setup.termination {
                        return sum;
                    }
                }
                k += 1.0;
            }
        }
        sum
    }

    /// Finds the run of samples from `k` on that are all skipped or all taken. Returns true if they are
    /// skipped, and the number of the first sample after the run.
    fn segment(
        &self,
        first: &[f32; 3],
        advance: &[f32; 3],
        inverse: &[f32; 3],
        k: f32,
        count: f32,
    ) -> (bool, f32) {
        if self.frame.skipping == Skipping::None {
            return (false, count);
        }
        let edge = self.setup.block_edge;
        let mut block = [0usize; 3];
        for a in 0..3 {
            let cell = (first[a] + k * advance[a] - 0.5).clamp(0.0, self.setup.dims[a] - 1.0).floor();
            block[a] = cell as usize / BLOCK_EDGE;
        }
        let entry = self.skip.bytes[(block[2] * self.skip.dims[1] + block[1]) * self.skip.dims[0] + block[0]];
        let empty = entry & EMPTY_BIT != 0;
        let distance = if empty && self.frame.skipping == Skipping::Blocks { 1 } else { entry & !EMPTY_BIT };
        let mut exit = f32::INFINITY;
        for a in 0..3 {
            // The face through which the ray leaves the cube of blocks around this block.
            let face = if advance[a] > 0.0 {
                (block[a] as f32 + f32::from(distance)) * edge + 0.5
            } else {
                (block[a] as f32 - f32::from(distance) + 1.0) * edge + 0.5
            };
            exit = exit.min((face - first[a]) * inverse[a]);
        }
        (empty, (exit - 1e-3).ceil().max(k + 1.0).min(count))
    }

    /// The table position (0…255) of the volume at `p`.
    #[inline(always)]
    fn position(&self, p: &[f32; 3]) -> f32 {
        let mut low = [0usize; 3];
        let mut high = [0usize; 3];
        let mut f = [0.0f32; 3];
        for a in 0..3 {
            let q = (p[a] - 0.5).max(0.0).min(self.setup.dims[a] - 1.0);
            let cell = q.floor();
            f[a] = q - cell;
            low[a] = cell as usize;
            high[a] = (low[a] + 1).min(self.dims[a] - 1);
        }
        let at =
            |x: usize, y: usize, z: usize| self.voxels[(z * self.dims[1] + y) * self.dims[0] + x].to_f32();
        let row = |y: usize, z: usize| {
            let (a, b) = (at(low[0], y, z), at(high[0], y, z));
            a + f[0] * (b - a)
        };
        let slice = |z: usize| {
            let (a, b) = (row(low[1], z), row(high[1], z));
            a + f[1] * (b - a)
        };
        let (a, b) = (slice(low[2]), slice(high[2]));
        let value = a + f[2] * (b - a);
        (value * self.setup.scale + self.setup.bias).clamp(0.0, 255.0)
    }

    /// Color and opacity at a table position.
    #[inline(always)]
    fn classify(&self, position: f32) -> [f32; 4] {
        let i = position.min(254.0).floor();
        let f = position - i;
        let (a, b) = (&self.table[i as usize], &self.table[i as usize + 1]);
        [0, 1, 2, 3].map(|c| a[c] + f * (b[c] - a[c]))
    }

    /// Returns `color` with Blinn–Phong lighting by a headlight, which shines along the ray.
    fn light(&self, p: &[f32; 3], view: &[f32; 3], color: [f32; 3]) -> [f32; 3] {
        let gradient = [0, 1, 2].map(|a| {
            let (mut before, mut after) = (*p, *p);
            before[a] -= 1.0;
            after[a] += 1.0;
            (self.position(&after) - self.position(&before)) * self.setup.gradient_scale[a]
        });
        let [x, y, z] = gradient;
        let square = x * x + y * y + z * z;
        if square < 1e-6 {
            return color;
        }
        let cosine = ((x * view[0] + y * view[1] + z * view[2]).abs() / square.sqrt()).min(1.0);
        let diffuse = 0.3 + 0.7 * cosine;
        let c2 = cosine * cosine;
        let c4 = c2 * c2;
        let c8 = c4 * c4;
        let c16 = c8 * c8;
        let specular = 0.2 * (c16 * c16);
        color.map(|c| (c * diffuse + specular).min(1.0))
    }

    /// Returns `color` after single scattering: a shadow ray towards the light attenuates it.
    fn scatter(&self, p: &[f32; 3], color: [f32; 3], counts: &mut WorkCounts) -> [f32; 3] {
        let s = self.setup;
        let mut exit = f32::INFINITY;
        for a in 0..3 {
            let face = if s.light[a] > 0.0 { s.dims[a] } else { 0.0 };
            exit = exit.min((face - p[a]) * s.light_inverse[a]);
        }
        let count = exit.ceil();
        let mut transmittance = 1.0f32;
        let mut k = 1.0;
        'ray: while k < count {
            let (empty, end) = self.segment(p, &s.light, &s.light_inverse, k, count);
            if empty {
                counts.skips += 1;
                k = end;
                continue;
            }
            while k < end {
                let q = [0, 1, 2].map(|a| p[a] + k * s.light[a]);
                counts.samples += 1;
                let clear = 1.0 - self.classify(self.position(&q))[3];
                for _ in 0..SHADOW_STEP {
                    transmittance *= clear;
                }
                if transmittance < SHADOW_TERMINATION {
                    break 'ray;
                }
                k += 1.0;
            }
        }
        let lit = 0.25 + 0.75 * transmittance;
        color.map(|c| c * lit)
    }
}

/// Returns a hash of the pixel: a multiple of 2⁻²⁴ in [0, 1).
fn jitter(x: u32, y: u32) -> f32 {
    let mut h = x.wrapping_mul(0x9e37_79b1) ^ y.wrapping_mul(0x85eb_ca77);
    h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
    h ^= h >> 15;
    (h >> 8) as f32 * (1.0 / 16_777_216.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn jitter_is_spread_over_the_unit_interval() {
        let values: Vec<f32> = (0..64 * 64).map(|i| jitter(i % 64, i / 64)).collect();
        assert!(values.iter().all(|v| (0.0..1.0).contains(v)));
        let mean = values.iter().sum::<f32>() / values.len() as f32;
        assert!((mean - 0.5).abs() < 0.02, "{mean}");
        let neighbors: f32 = values.windows(2).map(|w| (w[0] - w[1]).abs()).sum::<f32>() / 4095.0;
        assert!((neighbors - 1.0 / 3.0).abs() < 0.03, "{neighbors}");
    }

    #[test]
    fn bytes_are_rounded_and_saturate() {
        assert_eq!([0.0, 0.5, 1.0, 1.0000001, 0.001].map(to_byte), [0, 128, 255, 255, 0]);
    }
}
