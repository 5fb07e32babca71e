//! Compares the summaries with plain loops, and checks the probe's invariants.

use super::frame::Work;
use super::*;
use entire_core::ErrorKind;
use entire_core::kernels::Executor;
use entire_core::scene::*;
use proptest::prelude::*;
use std::vec::Vec;

pub(super) fn noise(n: usize, seed: u64) -> Vec<u8> {
    let mut state = seed;
    (0..n)
        .map(|_| {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 56) as u8
        })
        .collect()
}

pub(crate) fn summary(data: &[u8], dims: [usize; 3], cells_per_axis: usize) -> VolumeSummary {
    let view = VolumeView::new(Scalars::U8(data), dims).unwrap();
    VolumeSummary::with_cells(&view, cells_per_axis, Executor::Serial).unwrap()
}

/// Returns the summary of a cube of `edge`³ voxels with repeating values.
pub(crate) fn cube(edge: usize) -> VolumeSummary {
    let data: Vec<u8> = (0..edge.pow(3)).map(|i| (i * 7 % 256) as u8).collect();
    summary(&data, [edge; 3], 48)
}

pub(super) fn table(opacity: impl Fn(usize) -> f32) -> TransferTable {
    TransferTable::new(core::array::from_fn(|i| [0.5, 0.5, 0.5, opacity(i)])).unwrap()
}

/// Returns the table of one Gaussian lobe.
pub(crate) fn lobe_at(center: f32) -> TransferTable {
    let lobe = GaussianLobe { center, width: 0.05, height: 0.2 };
    TransferFunction::Gaussian(std::vec![lobe]).to_table().unwrap()
}

pub(crate) fn frame(rx: f32, ry: f32, dz: f32, size: u32) -> Frame {
    Frame::new(Camera::from_arcball(Arcball { rx, ry, dz }).unwrap(), size, size).unwrap()
}

pub(crate) fn measured(volume: &VolumeSummary, table: &TransferTable, frame: &Frame) -> FrameFeatures {
    let mut transfer = TransferSummary::new(volume, table).unwrap();
    transfer.prepare_distance();
    FrameFeatures::of(volume, &mut transfer, frame, PROBE_SIDE).unwrap()
}

#[test]
fn coarse_cells_judge_emptiness_by_their_blocks() {
    // 128 voxels along x in cells of 64: one bright voxel occupies one of eight blocks.
    let dims = [128, 8, 8];
    let mut data = std::vec![0u8; 128 * 8 * 8];
    data[20] = 255;
    let s = summary(&data, dims, 2);
    assert_eq!((s.cells, s.block), ([2, 1, 1], [8, 8, 8]));
    let t = TransferSummary::new(&s, &table(|i| if i > 100 { 0.5 } else { 0.0 })).unwrap();
    assert!((t.occupied_share - 1.0 / 16.0).abs() < 1e-6, "{}", t.occupied_share);
    assert!(t.is_occupied(0) && !t.is_occupied(1));
}

#[test]
fn uniform_volumes_have_the_tables_extinction() {
    for alpha in [0.001f32, 0.1, 0.9] {
        for unit in [1.0f32, 0.25, 8.0] {
            let data = std::vec![100u8; 16 * 16 * 16];
            let s = summary(&data, [16; 3], 48);
            let table = table(|i| if (90..=110).contains(&i) { alpha } else { 0.0 })
                .with_unit_distance(unit)
                .unwrap();
            let mut t = TransferSummary::new(&s, &table).unwrap();
            let expected = -(1.0 - alpha).ln() / unit;
            let found = t.optics(&s, 7).unwrap().extinction;
            assert!((found / expected - 1.0).abs() < 1e-2, "{alpha} {unit}: {found}");
            assert_eq!((t.occupied_share, t.visible_share), (1.0, 1.0));
        }
    }
}

#[test]
fn bricks_give_the_same_bounds_as_voxels() {
    let dims = [24, 16, 9];
    let data = noise(24 * 16 * 9, 3);
    let s = summary(&data, dims, 48);
    let bounds: Vec<[f32; 2]> =
        s.low.iter().zip(&s.high).map(|(lo, hi)| [lo, hi].map(|&entry| f32::from(entry) / 255.0)).collect();
    let made = |dims, spacing, edge, bounds: &[[f32; 2]]| {
        VolumeSummary::from_bricks(dims, spacing, ScalarType::U8, edge, bounds)
    };
    let b = made(dims, [1.0; 3], [8; 3], &bounds).unwrap();
    let close = |a: &[u8], b: &[u8]| a.len() == b.len() && a.iter().zip(b).all(|(a, b)| a.abs_diff(*b) <= 1);
    assert!(close(&s.low, &b.low) && close(&s.high, &b.high));
    for (dims, spacing, edge, bounds, kind) in [
        (dims, [1.0; 3], [8; 3], &bounds[1..], ErrorKind::SizeMismatch),
        ([0, 1, 1], [1.0; 3], [8; 3], &[], ErrorKind::InvalidArgument),
        (dims, [1.0, 0.0, 1.0], [8; 3], &bounds, ErrorKind::InvalidArgument),
        (dims, [1.0; 3], [0, 8, 8], &bounds, ErrorKind::InvalidArgument),
    ] {
        assert_eq!(made(dims, spacing, edge, bounds).unwrap_err().kind(), kind);
    }
    let nan = made([8; 3], [1.0; 3], [8; 3], &[[f32::NAN, f32::INFINITY]]).unwrap();
    assert_eq!((nan.low[0], nan.high[0]), (0, 255));
    assert!(made([usize::MAX, usize::MAX, 9], [1.0; 3], [1; 3], &[]).is_err());
}

/// Compares a summary with its definitions, voxel by voxel.
fn check_against_definitions(view: &VolumeView<'_>, cells_per_axis: usize) {
    let s = VolumeSummary::with_cells(view, cells_per_axis, Executor::Serial).unwrap();
    let (low, high) = view.range();
    let scale = 255.0 / (high - low);
    let position = |x: usize, y: usize, z: usize| {
        let v = view.value(x, y, z);
        if high > low && scale > 0.0 && scale.is_finite() {
            if v.is_nan() { 0.0 } else { ((v - low) * scale).clamp(0.0, 255.0) }
        } else {
            normalize(view.range(), v) * 255.0
        }
    };
    let dims = s.shape().dims;
    let (cells, edge, block) = (s.cells, s.edge, s.block);
    let what =
        std::format!("{:?} {dims:?} {cells_per_axis} {:?}", view.scalars().scalar_type(), view.range());
    for a in 0..3 {
        assert!(cells[a] <= cells_per_axis && cells[a] == dims[a].div_ceil(edge[a]), "{what}");
    }
    let bounds = |from: [usize; 3], size: [usize; 3]| {
        let (mut lo, mut hi) = (f32::INFINITY, f32::NEG_INFINITY);
        let range = |a: usize| from[a]..(from[a] + size[a] + 1).min(dims[a]);
        for z in range(2) {
            for y in range(1) {
                for x in range(0) {
                    lo = lo.min(position(x, y, z));
                    hi = hi.max(position(x, y, z));
                }
            }
        }
        [lo.floor() as u8, hi.ceil() as u8]
    };
    let mut total = [0u64; 256];
    for i in 0..s.low.len() {
        let c = [i % cells[0], i / cells[0] % cells[1], i / cells[0] / cells[1]];
        let from: [usize; 3] = std::array::from_fn(|a| c[a] * edge[a]);
        assert_eq!([s.low[i], s.high[i]], bounds(from, edge), "{what} {c:?}");
        let mut sorted = Vec::new();
        for z in from[2]..(from[2] + edge[2]).min(dims[2]) {
            for y in from[1]..(from[1] + edge[1]).min(dims[1]) {
                for x in from[0]..(from[0] + edge[0]).min(dims[0]) {
                    sorted.push((position(x, y, z) + 0.5) as u8);
                }
            }
        }
        sorted.sort();
        sorted.iter().for_each(|&e| total[usize::from(e)] += 1);
        for (k, &q) in s.quantiles[i].iter().enumerate() {
            // Bound k is the smallest entry with more than k/QUANTILES of the voxels at or below it; the last
            // bound is the largest entry.
            let rank = (k * sorted.len() / QUANTILES).min(sorted.len() - 1);
            assert_eq!(q, sorted[rank], "{what} {c:?} bound {k}");
        }
        if let Some(blocks) = s.blocks() {
            let own = blocks.first[i] as usize..blocks.first[i + 1] as usize;
            assert!(own.len() == blocks.most || own.len() < blocks.most && !blocks.uniform);
            let mut kept = own.map(|b| [blocks.low[b], blocks.high[b]]);
            let firsts = |a: usize| (from[a]..(from[a] + edge[a]).min(dims[a])).step_by(block[a]);
            for z in firsts(2) {
                for y in firsts(1) {
                    for x in firsts(0) {
                        assert_eq!(kept.next(), Some(bounds([x, y, z], block)), "{what} {c:?}");
                    }
                }
            }
            assert_eq!(kept.next(), None);
        } else {
            assert_eq!(block, edge);
        }
    }
    let voxels = s.voxels();
    assert_eq!(s.histogram, total.map(|t| (t as f64 / voxels) as f32), "{what}");
}

#[test]
fn every_type_range_and_layout_is_summarized_as_defined() {
    for (dims, per_axis) in [
        ([17, 9, 8], 48),
        ([1, 1, 1], 48),
        ([40, 3, 70], 48),
        ([40, 3, 70], 2),
        ([100, 1, 33], 4),
        ([33, 40, 25], 2),
        ([8, 16, 24], 48),
        ([129, 5, 2], 1),
    ] {
        let n: usize = dims.iter().product();
        let bytes = noise(n, 11);
        let words: Vec<u16> = noise(2 * n, 12).chunks(2).map(|b| u16::from_le_bytes([b[0], b[1]])).collect();
        let signed: Vec<i16> = words.iter().map(|&w| (w ^ 0x8000) as i16).collect();
        let mut numbers: Vec<f32> = words.iter().map(|&w| f32::from(w) * 1e-3 - 20.0).collect();
        for (i, wild) in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -0.0].into_iter().enumerate() {
            numbers[i * 37 % n] = wild;
        }
        let views = [
            (Scalars::U8(&bytes), [(0.0, 255.0), (13.0, 200.0), (-7.5, 999.0), (40.0, 40.0), (30.0, 31.0)]),
            (
                Scalars::U16(&words),
                [(0.0, 65535.0), (1000.0, 1255.0), (5.0, 5.0), (-1e30, 1e38), (0.0, 1e-40)],
            ),
            (
                Scalars::I16(&signed),
                [(-32768.0, 32767.0), (-1.0, 1.0), (0.0, 255.0), (3.0, 3.0), (-9.0, 9e3)],
            ),
            (
                Scalars::F32(&numbers),
                [(-20.0, 45.0), (0.0, 1.0), (f32::MIN, f32::MAX), (1.0, 1.0), (0.0, 3e-41)],
            ),
        ];
        for (scalars, ranges) in views {
            for (low, high) in ranges {
                let options = VolumeOptions { range: Some((low, high)), ..VolumeOptions::default() };
                check_against_definitions(&VolumeView::with(scalars, dims, options).unwrap(), per_axis);
            }
        }
        // The same voxels with x as the slowest axis.
        let [x, y, z] = dims;
        let options = VolumeOptions { strides: Some([x * y, x, 1]), ..VolumeOptions::default() };
        let view = VolumeView::with(Scalars::U8(&bytes), [z, y, x], options).unwrap();
        check_against_definitions(&view, per_axis);
    }
}

#[test]
fn non_finite_voxels_are_counted_and_harmless() {
    let mut data = std::vec![0.5f32; 9 * 9 * 9];
    data[0] = f32::NAN;
    data[100] = f32::INFINITY;
    data[728] = -1.0;
    let view = VolumeView::new(Scalars::F32(&data), [9; 3]).unwrap();
    let s = VolumeSummary::new(&view).unwrap();
    assert!((s.non_finite_share() - 2.0 / 729.0).abs() < 1e-7);
    let w = measured(&s, &table(|_| 0.1), &frame(0.0, 0.0, 2.0, 64))
        .work(&Setting::from(&frame(0.0, 0.0, 2.0, 64)));
    assert!(w.samples.is_finite() && w.samples > 0.0);
}

#[test]
fn a_transparent_table_leaves_only_jumps_and_an_opaque_one_the_first_sample() {
    let data = noise(64 * 64 * 64, 9);
    let s = summary(&data, [64; 3], 48);
    let f = frame(10.0, 20.0, 2.0, 256);
    let clear = measured(&s, &table(|_| 0.0), &f);
    let w = clear.work(&Setting::from(&f));
    assert_eq!((w.samples, w.shaded), (0.0, 0.0));
    assert!(w.rays > 0.0 && w.skips > 4.0 * w.rays && w.skips < 30.0 * w.rays, "{w:?}");
    let mapped = Frame { skipping: Skipping::Distance, ..f };
    let far = measured(&s, &table(|_| 0.0), &mapped).work(&Setting::from(&mapped));
    assert!(far.skips < 1.5 * far.rays, "one jump leaves an empty volume: {far:?}");
    let solid = measured(&s, &table(|_| 1.0), &f).work(&Setting::from(&f));
    assert!(solid.samples < 1.2 * solid.rays && solid.samples > 0.5 * solid.rays, "{solid:?}");
    let never = Frame { termination: 1.0, ..f };
    let whole = measured(&s, &table(|_| 1.0), &never);
    let length = f64::from(whole.probe.mean_chord);
    let w = whole.work(&Setting::from(&never));
    assert!(
        (w.samples / w.rays / length - 1.0).abs() < 1e-3,
        "without termination every sample is taken: {w:?} {length}"
    );
}

#[test]
fn the_longest_ray_is_no_shorter_than_the_mean_ray_and_does_not_grow_with_the_image() {
    let data = noise(32 * 32 * 32, 9);
    let s = summary(&data, [32; 3], 48);
    let t = table(|i| if i > 200 { 0.02 } else { 0.0 });
    let quantity = |features: &FrameFeatures, setting: Setting, q| features.quantities(setting)(q);
    for shading in Shading::ALL {
        let frame = Frame { shading, ..frame(20.0, 30.0, 2.5, 100) };
        let features = measured(&s, &t, &frame);
        let small = Setting::from(&frame);
        let large = Setting { width: 400, height: 400, ..small };
        for (longest, sum) in [
            (SceneQuantity::LongestSamples, SceneQuantity::Samples),
            (SceneQuantity::LongestSegments, SceneQuantity::Segments),
            (SceneQuantity::LongestShadowSamples, SceneQuantity::ShadowSamples),
        ] {
            let rays = quantity(&features, small, SceneQuantity::Rays);
            let (most, mean) = (quantity(&features, small, longest), quantity(&features, small, sum) / rays);
            assert!(most >= mean, "{longest} {shading}: {most}, {mean} on average");
            assert_eq!(most, quantity(&features, large, longest), "{longest} {shading}");
        }
    }
    // No sample of this box is skipped, so the longest ray is at least an edge and at most the diagonal.
    let (s, t) = (summary(&[200; 4096], [16; 3], 48), table(|_| 1.0e-4));
    let frame = frame(0.0, 0.0, 3.0, 64);
    let most = quantity(&measured(&s, &t, &frame), Setting::from(&frame), SceneQuantity::LongestSamples);
    assert!((15.5..28.0).contains(&most), "{most}");
}

#[test]
fn distances_match_a_search_over_all_cells() {
    let dims = [56, 40, 48];
    let mut data = std::vec![0u8; 56 * 40 * 48];
    for (i, v) in noise(6, 2).into_iter().enumerate() {
        data[(usize::from(v) * 397 + i * 7919) % (56 * 40 * 48)] = 255;
    }
    let s = summary(&data, dims, 48);
    let mut t = TransferSummary::new(&s, &table(|i| if i == 255 { 1.0 } else { 0.0 })).unwrap();
    t.prepare_distance();
    let [nx, ny, nz] = s.cells;
    let cells: Vec<[usize; 3]> = (0..nx * ny * nz).map(|i| [i % nx, i / nx % ny, i / nx / ny]).collect();
    let found = t.distance().unwrap();
    for (i, a) in cells.iter().enumerate() {
        let nearest = cells
            .iter()
            .filter(|[x, y, z]| t.is_occupied(x + nx * (y + ny * z)))
            .map(|b| (0..3).map(|k| a[k].abs_diff(b[k])).max().unwrap())
            .min()
            .unwrap();
        assert_eq!(usize::from(found[i]), nearest, "{a:?}");
    }
}

#[test]
fn thin_flat_and_tiny_volumes_give_finite_features() {
    for dims in [[1, 1, 1], [200, 1, 1], [1, 64, 64], [2, 300, 2]] {
        let data = noise(dims.iter().product(), 4);
        let options = VolumeOptions { spacing: [1.0, 10.0, 0.1], ..VolumeOptions::default() };
        let view = VolumeView::with(Scalars::U8(&data), dims, options).unwrap();
        let s = VolumeSummary::new(&view).unwrap();
        for (rx, ry, dz) in [(0.0, 0.0, 2.0), (90.0, 0.0, 1.1), (30.0, 45.0, 0.01), (0.0, 90.0, 50.0)] {
            for size in [1, 33] {
                let lens = Frame { shading: Shading::Scatter, ..frame(rx, ry, dz, size) };
                let parallel = Frame { camera: lens.camera.with_parallel_scale(dz).unwrap(), ..lens };
                for f in [lens, parallel] {
                    let features = measured(&s, &table(|i| i as f32 / 255.0), &f);
                    let quantity = features.quantities(Setting::from(&f));
                    for q in SceneQuantity::ALL {
                        let value = quantity(q);
                        let what = format!("{q} is {value} for {dims:?} {:?} {size}", f.camera);
                        assert!((value as f32).is_finite() && q.log(value).is_finite(), "{what}");
                    }
                }
            }
        }
    }
}

#[test]
fn names_round_trip_and_unknown_ones_are_refused() {
    for q in SceneQuantity::ALL {
        for feature in [false, true].map(|log| SceneFeature { quantity: q, log }) {
            assert_eq!(std::format!("{feature}").parse::<SceneFeature>().unwrap(), feature);
        }
    }
    let e = "log_mood".parse::<SceneFeature>().unwrap_err();
    assert!(e.kind() == ErrorKind::Unsupported && e.to_string().contains("lane_samples"));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    /// A coarser step or fewer pixels never increase the work; every count is finite and not negative. Only
    /// work that waits for memory may be more with fewer pixels.
    #[test]
    fn work_never_grows_with_the_step_nor_shrinks_with_the_image(
        rx in -89.0f32..89.0, ry in -180.0f32..180.0, dz in 0.05f32..6.0,
        center in 0.0f32..1.0, width in 1e-4f32..0.1, height in 0.001f32..1.0,
        seed in 0u64..8, shading in 0usize..4, skipping in 0usize..3,
    ) {
        let mut data = noise(40 * 33 * 21, seed);
        if seed % 2 == 0 {
            data.iter_mut().enumerate().for_each(|(i, v)| *v = (i / 200) as u8);
        }
        let s = summary(&data, [40, 33, 21], 48);
        let tf = TransferFunction::Gaussian(std::vec![GaussianLobe { center, width, height }]).to_table().unwrap();
        let f = Frame { shading: Shading::ALL[shading], skipping: Skipping::ALL[skipping], ..frame(rx, ry, dz, 100) };
        let features = measured(&s, &tf, &f);
        let counts = |w: Work| [w.pixels, w.rays, w.samples, w.skips, w.lane_samples, w.shaded, w.shadow_samples, w.lane_shadow_samples, w.parted_shadow_samples * w.unshared_shading];
        let mut last: Option<[f64; 9]> = None;
        for i in 0..40 {
            let step = 0.25 * 1.15f32.powi(i);
            let now = counts(features.work(&Setting { step, ..Setting::from(&f) }));
            for (k, v) in now.iter().enumerate() {
                prop_assert!(v.is_finite() && *v >= 0.0);
                if let Some(last) = last {
                    prop_assert!(*v <= last[k] * (1.0 + 1e-6), "count {} rose from {} to {} at step {}", k, last[k], v, step);
                }
            }
            last = Some(now);
        }
        let mut last = [0.0f64; 9];
        for size in [1, 2, 3, 10, 50, 100, 333, 1000, 4000] {
            let now = counts(features.work(&Setting { width: size, height: size, ..Setting::from(&f) }));
            for (k, v) in now.iter().enumerate() {
                prop_assert!(*v >= last[k] * (1.0 - 1e-6), "count {} fell at size {}", k, size);
            }
            last = now;
        }
        let work = |step: f32, size: u32| {
            features.cost_work(&Setting { step, width: size, height: size, ..Setting::from(&f) })
        };
        for (k, q) in COST_QUANTITIES.iter().enumerate() {
            for size in [2, 10, 100, 1000] {
                let settings = [(1.0, size), (2.0, size), (1.0, size / 2)];
                let [all, coarser, smaller] = settings.map(|(step, size)| work(step, size)[k + 1]);
                let (name, most) = (q.name(), all * (1.0 + 1e-6));
                prop_assert!(coarser <= most, "{name} rose with the step at size {size}");
                prop_assert!(q.is_far() || smaller <= most, "{name} fell at size {size}");
            }
        }
    }
}

/// The values of 40³ voxels of a ball, which fall from 1 at the center to 0.02.
fn ball() -> impl Iterator<Item = f32> {
    (0..40 * 40 * 40).map(|i| {
        let r = [i % 40, i / 40 % 40, i / 1600].map(|c| (c as f32 - 19.5) / 20.0);
        (1.0 - r.iter().map(|c| c * c).sum::<f32>()).max(0.02)
    })
}

#[test]
fn what_needs_no_probe_is_known_without_one() {
    let bytes: Vec<u8> = ball().map(|v| (255.0 * v) as u8).collect();
    let volume = summary(&bytes, [40; 3], 48);
    let table = table(|i| if i > 100 { 0.3 } else { 0.0 });
    let mut transfer = TransferSummary::new(&volume, &table).unwrap();
    transfer.prepare_distance();
    let mut of = |side: usize, shading: Shading| {
        let frame = Frame { shading, ..frame(20.0, 30.0, 1.7, 200) };
        let features = FrameFeatures::of(&volume, &mut transfer, &frame, side).unwrap();
        SceneQuantity::ALL.map(features.quantities(Setting::from(&frame)))
    };
    let mut both = |side| [of(side, Shading::Local), of(side, Shading::Scatter)].concat();
    let (without, with) = (both(0), both(PROBE_SIDE));
    for (k, q) in SceneQuantity::ALL.iter().enumerate() {
        let at = [k, k + SceneQuantity::ALL.len()];
        let same = at.iter().all(|&i| without[i] == with[i]);
        assert_eq!(same, !q.needs_probe(), "{}", q.name());
    }
    let mut of = |side| of(side, Shading::None);
    // The estimates of coarser probes must lie near that of the finest probe, within a tolerance that falls
    // with the number of rays. A side above the maximum must give the result of the maximum.
    let samples = SceneQuantity::ALL.iter().position(|q| *q == SceneQuantity::Samples).unwrap();
    let finest = of(MAX_PROBE_SIDE)[samples];
    for (side, tolerance) in [(4, 0.25), (7, 0.12), (8, 0.12), (11, 0.08), (12, 0.08), (13, 0.08)] {
        let found = of(side)[samples];
        assert!((found / finest - 1.0).abs() < tolerance, "{side}: {found}, {finest}");
    }
    assert_eq!(of(MAX_PROBE_SIDE + 9), of(MAX_PROBE_SIDE));
    assert_eq!(FrameFeatures::default().probe_side, PROBE_SIDE);
}

#[test]
fn quantities_depend_on_the_step_where_the_table_says_so() {
    // A volume of bytes, and one of negative and positive integers, each with a mostly opaque and a mostly
    // transparent transfer function, seen from outside and inside.
    let bytes: Vec<u8> = ball().map(|v| (255.0 * v) as u8).collect();
    let shorts: Vec<i16> = ball().map(|v| (3000.0 * v) as i16 - 1000).collect();
    let volumes = [Scalars::U8(&bytes), Scalars::I16(&shorts)]
        .map(|scalars| VolumeSummary::new(&VolumeView::new(scalars, [40; 3]).unwrap()).unwrap());
    let tables = [100, 0].map(|first| table(|i| if i > first { 0.3 } else { 0.0 }));
    let mut changed = std::vec![false; SceneQuantity::ALL.len()];
    for (volume, table) in volumes.iter().zip(&tables).chain(volumes.iter().zip(tables.iter().rev())) {
        for dz in [0.4, 1.7] {
            for shading in Shading::ALL {
                for skipping in [Skipping::None, Skipping::Blocks, Skipping::Distance] {
                    let frame = Frame { shading, skipping, ..frame(20.0, 30.0, dz, 200) };
                    let of = |frame: &Frame, step: f32| {
                        let features = measured(volume, table, frame);
                        let setting = Setting { step, ..Setting::from(frame) };
                        SceneQuantity::ALL.map(features.quantities(setting)).map(f64::to_bits)
                    };
                    let at_one = of(&frame, 1.0);
                    let at_three = of(&frame, 3.0);
                    // Quantities depend on the step of the setting, not on the step of the measured frame.
                    assert_eq!(at_three, of(&Frame { step: 2.0, ..frame }, 3.0));
                    for (changed, (a, b)) in changed.iter_mut().zip(at_one.iter().zip(&at_three)) {
                        *changed |= a != b;
                    }
                }
            }
        }
    }
    for (quantity, changed) in SceneQuantity::ALL.iter().zip(changed) {
        assert_eq!(changed, quantity.depends_on_step(), "{}", quantity.name());
    }
}

#[test]
fn stored_values_are_remapped_unless_they_index_a_table_as_they_stand() {
    let dims = [20, 9, 10];
    let n = dims.iter().product::<usize>();
    let of = |scalars: Scalars<'_>| {
        // The result must depend on the stored values only, not on the range that maps them to the table.
        let options = VolumeOptions { range: Some((3.0, 90.0)), ..VolumeOptions::default() };
        let view = VolumeView::with(scalars, dims, options).unwrap();
        VolumeSummary::new(&view).unwrap().remapped
    };
    let with = |low: f32, high: f32| -> Vec<f32> {
        (0..n).map(|i| if i == 777 { low } else { low + (high - low) * (i % 5) as f32 / 4.0 }).collect()
    };
    for (low, high, remapped) in
        [(0.0, 255.0, false), (1.0, 255.0, true), (0.0, 7.0, false), (0.0, 0.0, false)]
    {
        let bytes: Vec<u8> = with(low, high).iter().map(|&v| v as u8).collect();
        assert_eq!(of(Scalars::U8(&bytes)), remapped, "bytes from {low} to {high}");
    }
    for (low, high, remapped) in
        [(0.0, 32767.0, false), (0.0, 32768.0, true), (0.0, 65535.0, true), (1.0, 900.0, true)]
    {
        let words: Vec<u16> = with(low, high).iter().map(|&v| v as u16).collect();
        assert_eq!(of(Scalars::U16(&words)), remapped, "words from {low} to {high}");
    }
    for (low, high, remapped) in [(0.0, 900.0, false), (-1024.0, 900.0, true), (5.0, 900.0, true)] {
        let words: Vec<i16> = with(low, high).iter().map(|&v| v as i16).collect();
        assert_eq!(of(Scalars::I16(&words)), remapped, "signed words from {low} to {high}");
    }
    assert!(of(Scalars::F32(&with(0.0, 255.0))));
    for (low, kind, remapped) in
        [(0.0, ScalarType::U8, false), (0.1, ScalarType::U8, true), (0.0, ScalarType::F32, true)]
    {
        let bounds = [[0.5, 1.0], [low, 0.7]];
        let bricks = VolumeSummary::from_bricks([16, 8, 8], [1.0; 3], kind, [8; 3], &bounds).unwrap();
        assert_eq!(bricks.remapped, remapped, "bricks of {kind:?} from {low}");
    }
    // All samples of a volume whose integers must be remapped count as remapped samples.
    let bytes: Vec<u8> = with(9.0, 250.0).iter().map(|&v| v as u8).collect();
    let f = frame(20.0, 30.0, 2.0, 50);
    let features = measured(&summary(&bytes, dims, 48), &table(|_| 0.5), &f);
    let quantity = features.quantities(Setting::from(&f));
    assert_eq!(quantity(SceneQuantity::RemappedSamples), quantity(SceneQuantity::Samples));
}

/// Largest allowed difference between a share of crossed voxel borders, computed from nine rays, and the
/// share that is counted over all rays of an image.
const ALONG_TOLERANCE: f64 = 0.06;

#[test]
fn shares_of_borders_are_those_that_rays_count() {
    let (dims, spacing) = ([40usize, 24, 30], [1.0f32, 2.0, 0.5]);
    let data = noise(dims.iter().product(), 9);
    let options = VolumeOptions { spacing, ..VolumeOptions::default() };
    let view = VolumeView::with(Scalars::U8(&data), dims, options).unwrap();
    let s = VolumeSummary::new(&view).unwrap();
    let half = s.shape().half_extent;
    let voxel = [0, 1, 2].map(|a| 2.0 * half[a] / dims[a] as f32);
    for (rx, ry, dz) in
        [(0.0, 0.0, 2.5), (0.0, 90.0, 2.5), (90.0, 0.0, 2.5), (30.0, 40.0, 1.4), (-60.0, 10.0, 4.0)]
    {
        let f = frame(rx, ry, dz, 60);
        let mut shares = [0.0f64; 3];
        let mut rays = 0;
        for (x, y) in (0..60).flat_map(|y| (0..60).map(move |x| (x, y))) {
            let (o, d) = footprint::ray(&f.camera, [x, y], [60, 60]);
            let (a, b) = ((-half - o) / d, (half - o) / d);
            let (near, far) = (a.min(b).max_element().max(0.0), a.max(b).min_element());
            if near >= far {
                continue;
            }
            // Number of voxel borders normal to each axis between the ray's entry into the box and its exit.
            let planes = [0, 1, 2].map(|k| {
                let index = |t: f32| f64::from((o[k] + t * d[k] + half[k]) / voxel[k]).floor();
                (index(far) - index(near)).abs()
            });
            let sum: f64 = planes.iter().sum();
            if sum > 0.0 {
                rays += 1;
                shares.iter_mut().zip(planes).for_each(|(share, p)| *share += p / sum);
            }
        }
        let features = measured(&s, &table(|_| 0.1), &f);
        let axes = [SceneQuantity::FarX, SceneQuantity::FarY, SceneQuantity::FarZ];
        let far = axes.map(features.quantities(Setting::from(&f)));
        let all: f64 = far.iter().sum();
        // The three shares sum to 1, so the error of y can be the sum of the errors of x and z.
        for (axis, tolerance) in
            [ALONG_TOLERANCE, 2.0 * ALONG_TOLERANCE, ALONG_TOLERANCE].into_iter().enumerate()
        {
            let (found, counted) = (far[axis] / all, shares[axis] / f64::from(rays));
            assert!(
                (found - counted).abs() < tolerance,
                "{} at {rx} {ry} {dz}: {found}, counted {counted}",
                axes[axis].name()
            );
        }
    }
}
