//! Scenes of the frame server.

use entire_core::scene::{ControlPoint, TransferFunction, TransferTable};

/// Returns the hash of a lattice point, a number in [0, 1).
fn lattice(x: i32, y: i32, z: i32) -> f32 {
    let mut h = (x as u32).wrapping_mul(0x8da6_b343)
        ^ (y as u32).wrapping_mul(0xd816_3841)
        ^ (z as u32).wrapping_mul(0xcb1a_b31f);
    h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
    ((h ^ (h >> 15)) >> 8) as f32 / 16_777_216.0
}

fn value_noise(p: [f32; 3]) -> f32 {
    let cell = p.map(|v| v.floor() as i32);
    let f = [0, 1, 2].map(|a| {
        let t = p[a] - cell[a] as f32;
        t * t * (3.0 - 2.0 * t)
    });
    let mix = |a: f32, b: f32, t: f32| a + t * (b - a);
    let at = |x: i32, y: i32, z: i32| lattice(cell[0] + x, cell[1] + y, cell[2] + z);
    let row = |y, z| mix(at(0, y, z), at(1, y, z), f[0]);
    mix(mix(row(0, 0), row(1, 0), f[1]), mix(row(0, 1), row(1, 1), f[1]), f[2])
}

/// Five octaves of value noise with a radial fall-off: a dense volume.
pub(crate) fn noise(n: usize) -> Vec<u8> {
    let mut out = Vec::with_capacity(n * n * n);
    for z in 0..n {
        for y in 0..n {
            for x in 0..n {
                let p = [x, y, z].map(|i| (i as f32 + 0.5) / n as f32);
                let mut sum = 0.0;
                for octave in 0..5 {
                    let scale = (4 << octave) as f32;
                    sum += value_noise(p.map(|v| v * scale)) / (1 << octave) as f32;
                }
                let r = p.iter().map(|v| (2.0 * v - 1.0).powi(2)).sum::<f32>().sqrt();
                let v = (sum / 1.9375 - 0.25 - 0.35 * (r - 0.6).max(0.0)) * 1.7;
                out.push((v.clamp(0.0, 1.0) * 255.0) as u8);
            }
        }
    }
    out
}

/// A few thin tubes in empty space, as vessels in an angiogram.
pub(crate) fn vessels(n: usize) -> Vec<u8> {
    let mut out = vec![0u8; n * n * n];
    for tube in 0..6 {
        let phase = tube as f32 * 1.7;
        for i in 0..8 * n {
            let t = i as f32 / (8 * n) as f32;
            let c = [
                0.5 + 0.38 * (6.0 * t + phase).sin() * (0.3 + 0.7 * t),
                0.5 + 0.38 * (5.0 * t + 2.0 * phase).cos() * (0.3 + 0.7 * t),
                0.08 + 0.84 * t,
            ];
            let radius = n as f32 * 0.008 + 1.0;
            let low = c.map(|c| ((c * n as f32 - radius - 1.0).max(0.0)) as usize);
            let high = c.map(|c| ((c * n as f32 + radius + 1.0) as usize).min(n - 1));
            for z in low[2]..=high[2] {
                for y in low[1]..=high[1] {
                    for x in low[0]..=high[0] {
                        let d = [x, y, z]
                            .iter()
                            .zip(c)
                            .map(|(&i, c)| (i as f32 + 0.5 - c * n as f32).powi(2))
                            .sum::<f32>()
                            .sqrt();
                        let v = ((radius + 0.5 - d).clamp(0.0, 1.0) * 220.0) as u8;
                        let o = &mut out[(z * n + y) * n + x];
                        *o = (*o).max(v);
                    }
                }
            }
        }
    }
    out
}

/// Returns the transfer function of this name: `transparent` (no ray terminates), `medium`, `opaque`, or
/// `scan` (contrast-filled vessels).
pub(crate) fn transfer(name: &str) -> Option<TransferTable> {
    let list: &[(f32, [f32; 3], f32)] = match name {
        "transparent" => {
            &[(0.0, [0.1, 0.2, 0.6], 0.0), (0.02, [0.1, 0.3, 0.7], 0.0), (1.0, [1.0, 0.8, 0.3], 0.01)]
        }
        "medium" => {
            &[(0.0, [0.1, 0.2, 0.6], 0.0), (0.02, [0.1, 0.3, 0.7], 0.0), (1.0, [1.0, 0.8, 0.3], 0.08)]
        }
        "opaque" => &[
            (0.0, [0.1, 0.2, 0.6], 0.0),
            (0.15, [0.1, 0.5, 0.7], 0.0),
            (0.3, [0.8, 0.5, 0.3], 0.5),
            (1.0, [1.0, 0.9, 0.6], 0.9),
        ],
        // Shows only bright vessels.
        "scan" => &[
            (0.0, [0.5, 0.1, 0.1], 0.0),
            (0.3, [0.7, 0.2, 0.1], 0.0),
            (0.6, [0.9, 0.5, 0.3], 0.3),
            (1.0, [1.0, 0.9, 0.8], 0.8),
        ],
        _ => return None,
    };
    let points =
        list.iter().map(|&(position, color, opacity)| ControlPoint { position, color, opacity }).collect();
    TransferFunction::Points(points).to_table().ok()
}
