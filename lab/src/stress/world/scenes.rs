//! The scripts of the scenes of real geometry: volumes, cameras, transfer functions, image sizes.

use super::super::{Limits, Noise};
use anyhow::Result;
use entire_core::scene::{Arcball, GaussianLobe, Scalars, VolumeOptions, VolumeView};

#[derive(Clone)]
pub(super) struct Block {
    pub(super) dims: [usize; 3],
    pub(super) spacing: [f32; 3],
    pub(super) voxels: Vec<f32>,
}

impl Block {
    pub(super) fn new(dims: [usize; 3], f: impl Fn([f32; 3]) -> f32) -> Self {
        let mut voxels = Vec::with_capacity(dims.iter().product());
        for z in 0..dims[2] {
            for y in 0..dims[1] {
                for x in 0..dims[0] {
                    let at = |i: usize, n: usize| (i as f32 + 0.5) / n as f32 * 2.0 - 1.0;
                    voxels.push(f([at(x, dims[0]), at(y, dims[1]), at(z, dims[2])]));
                }
            }
        }
        Self { dims, spacing: [1.0; 3], voxels }
    }

    pub(super) fn ball(n: usize, wave: f32) -> Self {
        Self::new([n; 3], |p| {
            let r = (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt();
            (1.0 - r + wave * (9.0 * p[0]).sin() * (7.0 * p[1]).cos()).clamp(0.0, 1.0)
        })
    }

    pub(super) fn noise(n: usize, seed: u64) -> Self {
        let mut source = Noise::new(seed);
        let mut block = Self::new([n; 3], |_| 0.0);
        block.voxels.iter_mut().for_each(|v| *v = source.uniform() as f32);
        block
    }

    pub(super) fn view(&self) -> Result<VolumeView<'_>> {
        Ok(VolumeView::with(
            Scalars::F32(&self.voxels),
            self.dims,
            VolumeOptions { spacing: self.spacing, ..VolumeOptions::default() },
        )?)
    }
}

pub(super) fn lobes(center: f32, width: f32, height: f32) -> Vec<GaussianLobe> {
    vec![GaussianLobe { center, width, height }]
}

pub(super) fn shell() -> Vec<GaussianLobe> {
    lobes(0.5, 0.01, 0.4)
}

pub(super) fn haze() -> Vec<GaussianLobe> {
    lobes(0.5, 0.5, 0.004)
}

#[derive(Clone)]
pub(super) struct Shot {
    pub(super) volume: usize,
    pub(super) lobes: Vec<GaussianLobe>,
    pub(super) camera: Arcball,
    pub(super) size: (u32, u32),
    /// Size at which the CPU version draws. Its counts of work are scaled to `size`, which may be too large
    /// to draw.
    pub(super) drawn: (u32, u32),
    /// Factor on the seconds, from effects that no predictor models.
    pub(super) speed: f64,
    pub(super) camera_cut: bool,
}

impl Shot {
    pub(super) fn plain(i: usize) -> Self {
        Self {
            volume: 0,
            lobes: shell(),
            camera: Arcball { rx: 20.0, ry: 5.0 * i as f32, dz: 2.2 },
            size: (48, 48),
            drawn: (48, 48),
            speed: 1.0,
            camera_cut: false,
        }
    }
}

pub(super) struct World {
    pub(super) blocks: Vec<Block>,
    pub(super) shot: Box<dyn Fn(usize) -> Shot>,
    pub(super) frames: usize,
    /// Target divided by the median frame time at the finest step.
    pub(super) share: f64,
    pub(super) limits: Limits,
}

fn world(blocks: Vec<Block>, limits: Limits, shot: impl Fn(usize) -> Shot + 'static) -> World {
    World { blocks, shot: Box::new(shot), frames: 60, share: 0.5, limits }
}

/// Returns the script of a scene; `None` if the scene is not in this file.
pub(super) fn scene(number: usize) -> Option<World> {
    let strict = |missed, run| Limits { missed, run, quality: 0.6, inside: 0.9 };
    let loose = |missed| Limits { quality: 0.5, ..Limits::missed(missed) };
    let ball = || vec![Block::ball(32, 0.05)];
    Some(match number {
        3 => world(ball(), strict(0.10, 3), |i| Shot {
            camera: Arcball { rx: 10.0, ry: 2.0 * i as f32, dz: (2.4 - 0.045 * i as f32).max(0.02) },
            ..Shot::plain(i)
        }),
        4 => world(ball(), strict(0.10, 3), |i| Shot {
            // The camera moves in to a single block, then out to a few pixels.
            camera: Arcball {
                rx: 10.0,
                ry: 30.0,
                dz: if i < 30 { 2.0 * 0.9f32.powi(i as i32) } else { 0.1 * 1.2f32.powi(i as i32 - 30) },
            },
            ..Shot::plain(i)
        }),
        5 => world(ball(), loose(0.10), |i| Shot {
            lobes: if i / 15 % 2 == 1 { lobes(0.5, 0.01, 0.0) } else { shell() },
            ..Shot::plain(i)
        }),
        6 => world(ball(), strict(0.10, 2), |i| Shot {
            lobes: if i / 15 % 2 == 1 { lobes(0.5, 100.0, 1.0) } else { haze() },
            ..Shot::plain(i)
        }),
        7 => world(ball(), strict(0.10, 2), |i| Shot {
            lobes: if i / 12 % 2 == 1 { haze() } else { shell() },
            ..Shot::plain(i)
        }),
        8 => world(vec![Block::noise(32, 5)], strict(0.10, 3), |i| Shot {
            lobes: if i / 15 % 2 == 1 { lobes(0.9, 0.01, 0.3) } else { lobes(0.5, 0.05, 0.02) },
            ..Shot::plain(i)
        }),
        9 => {
            let constant = Block::new([24; 3], |_| 0.7);
            let two = Block::new([24; 3], |p| if p[0] + p[1] > 0.3 { 1.0 } else { 0.0 });
            let mut single = Block::new([24; 3], |_| 0.0);
            single.voxels[24 * 24 * 12 + 24 * 12 + 12] = 1.0;
            world(vec![constant, two, single], loose(0.10), |i| Shot {
                volume: i / 20,
                lobes: [haze(), lobes(0.9, 0.05, 0.3), lobes(1.0, 0.1, 0.5)][i / 7 % 3].clone(),
                ..Shot::plain(i)
            })
        }
        10 => {
            let mut holes = Block::ball(24, 0.0);
            holes.voxels.iter_mut().step_by(7).for_each(|v| *v = f32::NAN);
            holes.voxels.iter_mut().step_by(11).for_each(|v| *v = f32::INFINITY);
            let mut none = Block::ball(24, 0.0);
            none.voxels.fill(f32::NAN);
            let mut signed = Block::ball(24, 0.0);
            signed.voxels.iter_mut().for_each(|v| *v *= -3000.0);
            let mut squeezed = Block::ball(24, 0.0);
            squeezed.voxels.iter_mut().for_each(|v| *v *= 600.0);
            squeezed.voxels[0] = 65_535.0;
            world(vec![holes, none, signed, squeezed], loose(0.10), |i| Shot {
                volume: i / 15,
                lobes: [haze(), shell()][i / 5 % 2].clone(),
                ..Shot::plain(i)
            })
        }
        11 => {
            let wave = |p: [f32; 3]| 0.5 + 0.5 * (6.0 * p[0]).sin() * (5.0 * p[1]).cos();
            let mut flat = Block::new([48, 48, 4], wave);
            flat.spacing = [1.0, 1.0, 10.0];
            let slice = Block::new([40, 40, 1], wave);
            let needle = Block::new([256, 4, 4], wave);
            let flat = world(vec![flat, slice, needle], loose(0.10), |i| Shot {
                volume: i / 20,
                camera: Arcball { rx: 30.0, ry: 3.0 * i as f32, dz: 1.8 },
                lobes: lobes(0.6, 0.05, 0.1),
                ..Shot::plain(i)
            });
            // These volumes need few samples, so a coarser step saves little.
            World { share: 1.1, ..flat }
        }
        12 => world(ball(), loose(0.15), |i| {
            let size = [(32, 32), (8192, 8192), (3, 900), (1920, 80), (64, 64), (4096, 2160)][i / 10];
            let shrink = (f64::from(size.0.max(size.1)) / 64.0).max(1.0);
            let side = |n: u32| ((f64::from(n) / shrink).round() as u32).max(1);
            Shot { size, drawn: (side(size.0), side(size.1)), ..Shot::plain(i) }
        }),
        13 => world(ball(), strict(0.10, 2), |i| {
            let n = [48, 96, 24, 64][i / 15];
            Shot { size: (n, n), drawn: (n, n), ..Shot::plain(i) }
        }),
        14 => {
            let balls = (0..6).map(|k| Block::ball(28, 0.04 + 0.03 * k as f32)).collect();
            world(balls, strict(0.10, 3), |i| Shot { volume: i % 6, ..Shot::plain(i) })
        }
        15 => {
            // Integer labels, which change abruptly from voxel to voxel.
            let labels = Block::new([32; 3], |p| {
                ((p[0] * 3.0).floor() + 3.0 * (p[1] * 3.0).floor() + 5.0 * (p[2] * 2.0).floor())
                    .rem_euclid(7.0)
            });
            let layers =
                Block::new([32; 3], |p| ((40.0 * p[2] + 6.0 * (4.0 * p[0]).sin()).sin() * 0.5 + 0.5).powi(6));
            world(vec![labels, Block::noise(32, 9), layers], strict(0.12, 3), |i| Shot {
                volume: i / 20,
                lobes: [lobes(0.5, 0.02, 0.2), haze()][i / 10 % 2].clone(),
                speed: 2.0,
                ..Shot::plain(i)
            })
        }
        _ => return None,
    })
}
