//! Compares the CPU version of the raycaster with closed forms, and its modes with each other.

mod common;

use common::{
    bytes, camera, constant, field_bytes, field_voxels, frame, medium, opaque, parallel, transparent,
};
use entire_core::scene::{
    Frame, Scalars, Shading, Skipping, TABLE_LEN, TransferTable, VolumeOptions, VolumeView,
};
use entire_vk_raycaster::{CpuRaycaster, Renderer, WorkCounts};

fn twin(view: &VolumeView<'_>, table: &TransferTable) -> CpuRaycaster {
    let mut r = CpuRaycaster::new();
    r.set_volume(view).unwrap();
    r.set_transfer(table).unwrap();
    r
}

/// A renderer of the bytes of [`common::field`].
fn field_twin(dims: [usize; 3], table: &TransferTable) -> CpuRaycaster {
    twin(&bytes(&field_bytes(dims), dims), table)
}

/// A renderer of a cube of `n`³ equal voxels.
fn cube_twin(n: usize, value: u8, table: &TransferTable) -> CpuRaycaster {
    twin(&bytes(&vec![value; n * n * n], [n; 3]), table)
}

/// A volume whose scalars `low` to `high` map to [0, 1].
fn ranged(scalars: Scalars<'_>, dims: [usize; 3], low: f32, high: f32) -> VolumeView<'_> {
    VolumeView::with(scalars, dims, VolumeOptions { range: Some((low, high)), ..VolumeOptions::default() })
        .unwrap()
}

fn largest_difference(a: &[[f32; 4]], b: &[[f32; 4]]) -> f32 {
    a.iter().flatten().zip(b.iter().flatten()).fold(0.0, |m, (a, b)| m.max((a - b).abs()))
}

fn mean_difference(a: &[[f32; 4]], b: &[[f32; 4]]) -> f32 {
    let sum: f32 = a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| (a - b).abs()).sum();
    sum / (4 * a.len()) as f32
}

/// Returns a frame of one ray, which goes along −z through the volume's center.
fn central_ray(dz: f32) -> Frame {
    Frame { skipping: Skipping::None, termination: 1.0, ..Frame::new(camera(0.0, 0.0, dz), 1, 1).unwrap() }
}

#[test]
fn homogeneous_slab_absorbs_by_its_thickness() {
    for n in [1usize, 5, 64] {
        for alpha in [0.001f32, 0.05, 0.5] {
            let r = cube_twin(n, 100, &constant(alpha));
            for step in [0.5, 1.0, 3.0] {
                let (p, counts) = r.render_linear(&Frame { step, ..central_ray(3.0) }).unwrap();
                // Samples lie in the middle of their steps; a last step of less than a half has no sample.
                let taken = (n as f64 / f64::from(step) - 0.5).ceil();
                assert_eq!(counts.samples as f64, taken, "{n} {step}");
                let want = 1.0 - (1.0 - f64::from(alpha)).powf(taken * f64::from(step));
                assert!((f64::from(p[0][3]) - want).abs() < 2e-5, "{n} {alpha} {step}: {} {want}", p[0][3]);
                for (c, tint) in p[0].iter().zip([1.0, 0.5, 0.25]) {
                    assert!((f64::from(*c) - want * tint).abs() < 2e-5);
                }
            }
        }
    }
}

#[test]
fn parallel_rays_take_the_samples_of_their_chords() {
    // Along an axis, every ray crosses the whole box: it takes n / step samples at any distance. The rays
    // fill the pixels that the box's face covers.
    let (n, alpha) = (32usize, 0.05f32);
    let r = cube_twin(n, 100, &constant(alpha));
    let half = 1.0 / 3f32.sqrt();
    for (rx, ry) in [(0.0, 0.0), (0.0, 180.0), (0.0, -90.0), (90.0, 0.0)] {
        for dz in [0.7, 3.0, 1e5] {
            for (scale, step) in [(2.0 * half, 0.5f32), (4.0 * half, 2.0)] {
                let base = parallel((rx, ry, dz), scale, 64, 64);
                let f = Frame { skipping: Skipping::None, termination: 1.0, step, ..base };
                let (p, counts) = r.render_linear(&f).unwrap();
                let rays = (64.0 * half / scale).powi(2) as u64;
                assert_eq!(counts.rays, rays, "{rx} {ry} {dz} {scale}");
                let taken = (n as f64 / f64::from(step) - 0.5).ceil();
                assert_eq!(counts.samples as f64, rays as f64 * taken, "{rx} {ry} {dz} {scale}");
                let want = 1.0 - (1.0 - f64::from(alpha)).powf(taken * f64::from(step));
                let seen = p.iter().filter(|p| p[3] > 0.0);
                assert!(seen.clone().all(|p| (f64::from(p[3]) - want).abs() < 2e-5));
                assert_eq!(seen.count() as u64, rays);
            }
        }
        // The plane where the rays start cuts the box in the middle, so only half of the samples remain.
        let f = Frame { skipping: Skipping::None, ..parallel((rx, ry, 1e-6), 2.0 * half, 64, 64) };
        let (_, counts) = r.render_linear(&Frame { termination: 1.0, ..f }).unwrap();
        assert_eq!(counts.samples, counts.rays * n as u64 / 2, "{rx} {ry}");
    }
    // In any direction, all chords together fill the box: samples = volume · pixels / (seen area · step).
    for (rx, ry) in [(30.0, 40.0), (-55.0, 200.0)] {
        let f = parallel((rx, ry, 4.0), 1.1, 400, 300);
        let f = Frame { skipping: Skipping::None, termination: 1.0, step: 0.5, ..f };
        let (_, counts) = r.render_linear(&f).unwrap();
        let volume = 8.0 * f64::from(half).powi(3);
        let step = 0.5 * 2.0 * f64::from(half) / n as f64;
        let want = volume * 400.0 * 300.0 / (4.0 * 1.1 * 1.1 * 400.0 / 300.0 * step);
        // A ray takes as many samples as its chord has steps, rounded to a whole number.
        assert!((counts.samples as f64 / want - 1.0).abs() < 2e-3, "{} {want}", counts.samples);
    }
}

#[test]
fn parallel_rays_draw_the_limit_of_a_narrow_lens_far_away() {
    let r = field_twin([40, 32, 36], &medium());
    for shading in Shading::ALL {
        let p = parallel((25.0, 40.0, 500.0), 0.9, 60, 48);
        let p = Frame { shading, ..p };
        let (straight, counts) = r.render_linear(&p).unwrap();
        let mut last = f32::INFINITY;
        for distance in [5.0f32, 50.0, 500.0] {
            let fov = 2.0 * (0.9 / distance).atan().to_degrees();
            let lens = camera(25.0, 40.0, distance).with_fov_y_degrees(fov).unwrap();
            let (seen, near) = r.render_linear(&Frame { camera: lens, ..p }).unwrap();
            let off = mean_difference(&seen, &straight);
            assert!(off < 0.25 * last, "{shading:?} {distance}: {off} after {last}");
            last = off;
            if distance == 500.0 {
                assert!((near.samples as f64 / counts.samples as f64 - 1.0).abs() < 5e-3);
            }
        }
        assert!(last < 0.25 / 255.0, "{shading:?}: {last}");
    }
}

#[test]
fn unit_distance_scales_the_optical_depth() {
    let table = constant(0.4).with_unit_distance(8.0).unwrap();
    let (p, _) = cube_twin(32, 7, &table).render_linear(&central_ray(3.0)).unwrap();
    assert!((p[0][3] - (1.0 - 0.6f32.powf(4.0))).abs() < 1e-5, "{}", p[0][3]);
}

#[test]
fn linear_ramp_integrates_to_its_closed_form() {
    // Slice z holds 4·z, and the extinction rises linearly over the table: the optical depth is the sum of
    // the samples' extinctions.
    let n = 64;
    let data: Vec<u8> = (0..n).flat_map(|z| vec![(4 * z) as u8; n * n]).collect();
    let mut rgba = [[1.0, 1.0, 1.0, 0.0]; TABLE_LEN];
    for (i, e) in rgba.iter_mut().enumerate() {
        // Extinction 0.1·i/255 per reference step.
        e[3] = 1.0 - (-0.1 * i as f32 / 255.0).exp();
    }
    let r = twin(&bytes(&data, [n; 3]), &TransferTable::new(rgba).unwrap());
    let (p, _) = r.render_linear(&central_ray(3.0)).unwrap();
    // Samples lie at voxel centers, so the sum over z = 0…63 of 0.1·4z/255 is exact.
    let tau: f64 = (0..n).map(|z| 0.1 * 4.0 * z as f64 / 255.0).sum();
    assert!((f64::from(p[0][3]) - (1.0 - (-tau).exp())).abs() < 1e-4, "{} {tau}", p[0][3]);
}

#[test]
fn shells_composite_front_to_back() {
    // Red in front of green: the front shell hides the back one by its opacity.
    let n = 32usize;
    let data: Vec<u8> = (0..n)
        .flat_map(|z| {
            let shell = match z {
                20..24 => 200,
                8..12 => 100,
                _ => 0,
            };
            vec![shell; n * n]
        })
        .collect();
    let mut rgba = [[0.0; 4]; TABLE_LEN];
    for (i, e) in rgba.iter_mut().enumerate() {
        *e = match i {
            95..=105 => [0.0, 1.0, 0.0, 0.3],
            195..=205 => [1.0, 0.0, 0.0, 0.2],
            _ => [0.0; 4],
        };
    }
    let table = TransferTable::new(rgba).unwrap();
    let front = 1.0 - 0.8f32.powi(4);
    let back = (1.0 - front) * (1.0 - 0.7f32.powi(4));
    for skipping in [Skipping::None, Skipping::Blocks, Skipping::Distance] {
        let r = twin(&bytes(&data, [n; 3]), &table);
        let (p, _) = r.render_linear(&Frame { skipping, ..central_ray(3.0) }).unwrap();
        assert!((p[0][0] - front).abs() < 1e-5 && (p[0][1] - back).abs() < 1e-5, "{:?}", p[0]);
        assert!((p[0][3] - front - back).abs() < 1e-5);
        let behind = Frame { skipping, ..Frame::new(camera(0.0, 180.0, 3.0), 1, 1).unwrap() };
        let (p, _) = r.render_linear(&behind).unwrap();
        assert!((p[0][1] - (1.0 - 0.7f32.powi(4))).abs() < 1e-5, "from behind green is in front");
    }
}

#[test]
fn halving_the_step_converges() {
    let dims = [40, 32, 36];
    let data = field_voxels(dims);
    let r = twin(&ranged(Scalars::F32(&data), dims, 0.0, 1.0), &medium());
    let image = |step: f32| {
        let f = Frame { step, termination: 1.0, ..frame(25.0, 40.0, 3.0, 40, 30) };
        r.render_linear(&f).unwrap().0
    };
    let reference = image(1.0 / 32.0);
    let errors = [4.0, 2.0, 1.0, 0.5, 0.25].map(|step| mean_difference(&image(step), &reference));
    for pair in errors.windows(2) {
        assert!(pair[1] < 0.7 * pair[0], "{errors:?}");
    }
    assert!(errors[4] < 0.1 / 255.0, "{errors:?}");
}

#[test]
fn skipping_changes_nothing_but_the_work() {
    let dims = [37, 41, 53];
    let data = field_bytes(dims);
    let spacing = VolumeOptions { spacing: [1.0, 1.5, 0.7], ..VolumeOptions::default() };
    let view = VolumeView::with(Scalars::U8(&data), dims, spacing).unwrap();
    for table in [transparent(), medium(), opaque(), constant(0.0)] {
        let r = twin(&view, &table);
        for shading in Shading::ALL {
            for step in [0.5, 1.0, 3.0] {
                for base in [
                    frame(20.0, -35.0, 3.0, 33, 21),
                    frame(20.0, -35.0, 0.4, 33, 21),
                    parallel((20.0, -35.0, 3.0), 0.9, 33, 21),
                    parallel((0.0, 90.0, 0.2), 0.5, 33, 21),
                ] {
                    let base = Frame { shading, step, ..base };
                    let [none, blocks, distance] = [Skipping::None, Skipping::Blocks, Skipping::Distance]
                        .map(|s| r.render_linear(&Frame { skipping: s, ..base }).unwrap());
                    assert_eq!(none.0, blocks.0);
                    assert_eq!(none.0, distance.0);
                    assert!(none.1.skips == 0 && none.1.rays == blocks.1.rays);
                    assert_eq!(none.1.shaded, blocks.1.shaded);
                    assert!(blocks.1.samples < none.1.samples, "{:?} {:?}", blocks.1, none.1);
                    assert!(distance.1.samples == blocks.1.samples && distance.1.skips <= blocks.1.skips);
                }
            }
        }
    }
}

#[test]
fn distance_map_takes_fewer_jumps_through_sparse_volumes() {
    let n = 96usize;
    let mut data = vec![0u8; n * n * n];
    for z in 44..52 {
        for y in 44..52 {
            data[(z * n + y) * n + 44..][..8].fill(255);
        }
    }
    let r = twin(&bytes(&data, [n; 3]), &opaque());
    let f = frame(10.0, 20.0, 3.0, 40, 40);
    let (_, blocks) = r.render_linear(&f).unwrap();
    let (_, distance) = r.render_linear(&Frame { skipping: Skipping::Distance, ..f }).unwrap();
    assert!(distance.skips * 2 < blocks.skips, "{distance:?} {blocks:?}");
    assert_eq!(distance.samples, blocks.samples);
}

#[test]
fn early_termination_saves_samples_and_little_light() {
    let r = field_twin([48; 3], &opaque());
    let f = frame(0.0, 30.0, 3.0, 64, 64);
    let (stopped, few) = r.render_linear(&f).unwrap();
    let (full, many) = r.render_linear(&Frame { termination: 1.0, ..f }).unwrap();
    assert!(few.samples < many.samples);
    assert!(largest_difference(&stopped, &full) <= 0.0101);
}

#[test]
fn transparent_tables_give_black_and_opaque_ones_stop_at_the_first_sample() {
    let r = cube_twin(20, 50, &constant(0.0));
    let f = frame(10.0, 10.0, 3.0, 16, 16);
    let (p, counts) = r.render_linear(&f).unwrap();
    assert!(p.iter().all(|p| *p == [0.0; 4]));
    assert!(counts.samples == 0 && counts.skips >= counts.rays && counts.rays > 0);
    let (_, counts) = r.render_linear(&Frame { skipping: Skipping::None, ..f }).unwrap();
    assert!(counts.samples > 10 * counts.rays / 2);

    let r = cube_twin(20, 50, &constant(1.0));
    let (p, counts) = r.render_linear(&f).unwrap();
    // Grazing rays may hit the box with less than half a step inside it.
    assert!(counts.samples <= counts.rays && counts.samples + 3 >= counts.rays);
    assert_eq!(p.iter().filter(|p| p[3] == 1.0).count() as u64, counts.samples);
}

#[test]
fn camera_inside_sees_only_what_lies_ahead() {
    let n = 32usize;
    // The camera is at z = 16. Behind it, from z = 18 on, everything is bright; ahead of it lies a dim
    // medium.
    let data: Vec<u8> = (0..n).flat_map(|z| vec![if z >= 18 { 255 } else { 50 }; n * n]).collect();
    let mut rgba = [[0.0, 0.0, 1.0, 0.05]; TABLE_LEN];
    for e in &mut rgba[200..] {
        *e = [1.0, 0.0, 0.0, 1.0];
    }
    let r = twin(&bytes(&data, [n; 3]), &TransferTable::new(rgba).unwrap());
    let (p, counts) = r.render_linear(&frame(0.0, 0.0, 1e-6, 8, 8)).unwrap();
    assert_eq!(counts.rays, 64);
    assert!(p.iter().all(|p| p[0] == 0.0 && p[2] > 0.4));
}

#[test]
fn rays_that_miss_cost_nothing() {
    let r = cube_twin(2, 255, &constant(1.0));
    let (p, counts) = r.render_linear(&frame(0.0, 0.0, 1000.0, 4, 4)).unwrap();
    assert_eq!(counts, WorkCounts::default());
    assert!(p.iter().all(|p| *p == [0.0; 4]));
}

#[test]
fn thin_and_constant_volumes_render() {
    for dims in [[1, 1, 1], [16, 16, 1], [1, 16, 16], [16, 1, 16], [16, 1, 1], [2, 1, 3]] {
        let count = dims[0] * dims[1] * dims[2];
        let words = vec![1234u16; count];
        let floats = vec![f32::NAN; count];
        let ramp: Vec<u8> = (0..count).map(|i| (i * 255 / count.max(2)) as u8).collect();
        for view in [
            VolumeView::new(Scalars::U16(&words), dims).unwrap(),
            VolumeView::new(Scalars::F32(&floats), dims).unwrap(),
            bytes(&ramp, dims),
        ] {
            let r = twin(&view, &constant(0.5));
            for shading in Shading::ALL {
                let f = Frame { shading, step: 0.25, ..frame(33.0, 20.0, 3.0, 31, 17) };
                let (p, counts) = r.render_linear(&f).unwrap();
                assert!(counts.samples > 0, "{dims:?}");
                assert!(p.iter().flatten().all(|v| (0.0..=1.0).contains(v)));
                if shading == Shading::None {
                    // The table has one color, and premultiplied channels keep the ratios of its channels.
                    assert!(p.iter().all(|p| (p[0] - 2.0 * p[1]).abs() < 1e-6 && (p[0] - p[3]).abs() < 1e-6));
                }
            }
        }
    }
}

#[test]
fn scalar_types_agree() {
    let dims = [20, 24, 28];
    let floats = field_voxels(dims);
    let bytes8: Vec<u8> = floats.iter().map(|v| (v * 255.0).round() as u8).collect();
    let exact: Vec<f32> = bytes8.iter().map(|&b| f32::from(b)).collect();
    let words: Vec<u16> = bytes8.iter().map(|&b| u16::from(b) * 100 + 7).collect();
    let signed: Vec<i16> = bytes8.iter().map(|&b| i16::from(b) * 64 - 9000).collect();
    let render =
        |view: VolumeView<'_>| twin(&view, &medium()).render_linear(&frame(15.0, 70.0, 2.5, 48, 36)).unwrap();
    let a = render(bytes(&bytes8, dims));
    for view in [
        ranged(Scalars::F32(&exact), dims, 0.0, 255.0),
        ranged(Scalars::U16(&words), dims, 7.0, 25507.0),
        ranged(Scalars::I16(&signed), dims, -9000.0, 7320.0),
    ] {
        let b = render(view);
        assert!(largest_difference(&a.0, &b.0) < 1e-3);
    }
}

#[test]
fn lighting_dims_edges_and_scattering_casts_shadows() {
    let r = field_twin([48; 3], &opaque());
    let f = frame(0.0, 20.0, 3.0, 48, 48);
    let sum = |s| {
        let (p, c) = r.render_linear(&Frame { shading: s, ..f }).unwrap();
        (p.iter().map(|p| f64::from(p[0])).sum::<f64>(), p.iter().map(|p| f64::from(p[3])).sum::<f64>(), c)
    };
    let (plain, alpha, none) = sum(Shading::None);
    let (local, alpha_local, lit) = sum(Shading::Local);
    let (scatter, alpha_scatter, shadowed) = sum(Shading::Scatter);
    let (both, alpha_both, lit_and_shadowed) = sum(Shading::LocalScatter);
    assert!(alpha == alpha_local && alpha == alpha_scatter && alpha == alpha_both);
    assert!(local < plain && scatter < plain && scatter > 0.2 * plain);
    // Shadows attenuate the lit color, but never to less than a quarter.
    assert!(both < local && both < scatter && both > 0.2 * local);
    assert_eq!(lit_and_shadowed, shadowed);
    assert!(none.shaded == 0 && lit.shaded > 0 && lit.shaded == shadowed.shaded);
    assert!(lit.samples == none.samples && shadowed.samples > none.samples + shadowed.shaded / 2);
}

#[test]
fn shadow_of_a_slab_has_its_closed_form() {
    // A homogeneous medium: the shadow of a sample follows from the length of its shadow ray.
    let n = 16usize;
    let alpha = 0.02f32;
    let r = cube_twin(n, 9, &constant(alpha));
    let f = Frame { shading: Shading::Scatter, ..central_ray(3.0) };
    let (p, counts) = r.render_linear(&f).unwrap();
    // The sum over the samples, each with its own shadow length, in float64.
    let light = entire_vk_raycaster::LIGHT_DIRECTION.map(f64::from);
    let norm = light.iter().map(|l| l * l).sum::<f64>().sqrt();
    let (mut color, mut opacity, mut shadow_samples) = (0.0, 0.0, 0u64);
    for k in 0..n {
        let at = [8.0, 8.0, 15.5 - k as f64];
        let exit = (0..3)
            .map(|a| (16.0 - at[a]) / (light[a] / norm * f64::from(entire_vk_raycaster::SHADOW_STEP)))
            .fold(f64::INFINITY, f64::min);
        let m = exit.ceil() - 1.0;
        shadow_samples += m as u64;
        let t = (1.0 - f64::from(alpha)).powf(m * 2.0);
        let weight = (1.0 - opacity) * f64::from(alpha);
        color += weight * (0.25 + 0.75 * t);
        opacity += weight;
    }
    assert!((f64::from(p[0][0]) - color).abs() < 1e-4, "{} {color}", p[0][0]);
    assert_eq!(counts.samples, n as u64 + shadow_samples);
    // Local lighting leaves the color as it is if the gradient is zero.
    let both = Frame { shading: Shading::LocalScatter, ..f };
    assert_eq!(r.render_linear(&both).unwrap(), (p, counts));
}

#[test]
fn jitter_moves_samples_within_a_step() {
    let r = field_twin([40; 3], &medium());
    let f = frame(5.0, 15.0, 3.0, 40, 40);
    let (plain, _) = r.render_linear(&f).unwrap();
    let (a, _) = r.render_linear(&Frame { jitter: true, ..f }).unwrap();
    let (b, _) = r.render_linear(&Frame { jitter: true, ..f }).unwrap();
    assert!(a == b && a != plain);
    assert!(largest_difference(&a, &plain) < 0.1);
}

#[test]
fn missing_scene_parts_are_named() {
    let data = [1u8; 8];
    let f = frame(0.0, 0.0, 3.0, 4, 4);
    let mut r = CpuRaycaster::new();
    assert!(r.render(&f).unwrap_err().to_string().contains("no volume"));
    r.set_volume(&bytes(&data, [2; 3])).unwrap();
    assert!(r.render(&f).unwrap_err().to_string().contains("no transfer function"));
    r.set_transfer(&medium()).unwrap();
    let rendered = r.render(&f).unwrap();
    assert_eq!((rendered.image.rgba.len(), rendered.time.device), (64, None));
    assert!(rendered.time.wall > 0.0 && rendered.counts.is_some());
}

#[test]
fn preparation_times_are_told_apart() {
    let data = vec![1u8; 64 * 64 * 64];
    let mut r = CpuRaycaster::new();
    let p = r.set_volume(&bytes(&data, [64; 3])).unwrap();
    assert!(p.upload.is_some() && p.block_map.is_some() && p.occupancy.is_none());
    let p = r.set_transfer(&medium()).unwrap();
    assert!(p.upload.is_none() && p.occupancy.is_some() && p.distance_map.is_some());
    assert!(p.wall >= p.occupancy.unwrap() + p.distance_map.unwrap());
}
