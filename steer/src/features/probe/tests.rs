//! Compares packets of rays with single rays, edited summaries with new ones, and parallel rays with closed
//! forms and with a distant perspective camera.

use super::march::{FIELDS, TERMINATED, VISIBLE_LENGTH};
use super::{SHADOW_DIRECTION, SHADOW_STEP, ends_apart};
use crate::features::tests::{frame, measured, noise, summary, table};
use crate::features::*;
use entire_core::kernels::Level;
use entire_core::scene::*;

#[test]
fn packets_of_rays_find_what_single_rays_find_on_every_level() {
    // Cases: cells of one block and of several; cameras outside and inside the volume; tables with few, many
    // and only visible entries.
    let data = noise(64 * 48 * 40, 7);
    for (cells, dims) in [(48, [64, 48, 40]), (3, [64, 48, 40]), (48, [1, 48, 40])] {
        let s = summary(&data[..dims[0] * dims[1] * dims[2]], dims, cells);
        for cut in [255usize, 250, 128, 0] {
            let table = table(|i| if i >= cut { 0.02 + 0.5 * (i as f32 / 255.0) } else { 0.0 });
            let mut transfer = TransferSummary::new(&s, &table).unwrap();
            for (rx, ry, dz) in [(0.0, 0.0, 2.0), (33.0, 71.0, 1.3), (-80.0, 10.0, 0.2), (10.0, 200.0, 9.0)] {
                let lens = Camera::from_arcball(Arcball { rx, ry, dz }).unwrap();
                let parallel = lens.with_parallel_scale(0.3 * dz).unwrap();
                for (camera, shading) in [
                    (lens, Shading::None),
                    (lens, Shading::Scatter),
                    (parallel, Shading::None),
                    (parallel, Shading::Scatter),
                ] {
                    let frame = Frame { shading, ..Frame::new(camera, 320, 200).unwrap() };
                    for side in [1, 4, 11, 24] {
                        let single = Probe::on(None, &s, &mut transfer, &frame, side);
                        for level in Level::available() {
                            let packets = Probe::on(Some(level), &s, &mut transfer, &frame, side);
                            assert_eq!(
                                packets, single,
                                "{dims:?} {cut} {camera:?} {shading:?} {side} {level:?}"
                            );
                        }
                    }
                }
            }
        }
    }
}

#[test]
fn cells_are_classified_alike_by_ranges_and_by_lookup() {
    // Values rise along x, so that every table but the last leaves some of the cells empty.
    let rising = |(i, noise): (usize, &u8)| 90 + (i % 40) as u8 + noise % 3;
    let data: Vec<u8> = noise(40 * 24 * 24, 3).iter().enumerate().map(rising).collect();
    for (cells, single) in [(48, true), (2, false)] {
        let s = summary(&data, [40, 24, 24], cells);
        assert_eq!(s.blocks().is_none(), single);
        // One run of visible entries, several runs, and more runs than are compared one by one.
        for period in [256usize, 64, 16, 2] {
            let table = table(|i| if i % period == period / 2 { 0.3 } else { 0.0 });
            let t = TransferSummary::new(&s, &table).unwrap();
            let shows = |low: u8, high: u8| (low..=high).any(|i| table.is_visible(usize::from(i)));
            let mut shares = 0.0;
            for cell in 0..s.low.len() {
                let share = s.blocks().map_or(f64::from(shows(s.low[cell], s.high[cell])), |blocks| {
                    let of_cell = blocks.first[cell] as usize..blocks.first[cell + 1] as usize;
                    let shown = of_cell.clone().filter(|&b| shows(blocks.low[b], blocks.high[b])).count();
                    shown as f64 / of_cell.len() as f64
                });
                assert_eq!(t.is_occupied(cell), share > 0.0, "{period} {cell}");
                shares += share;
            }
            let mean = shares / s.low.len() as f64;
            assert!(mean > 0.0 && (mean < 1.0) == (period > 2), "{period}: {mean}");
            assert!((f64::from(t.occupied_share) - mean).abs() < 1e-6, "{period}: {mean}");
        }
    }
}

#[test]
fn an_edit_forgets_what_cells_were() {
    let data = noise(24 * 24 * 24, 5);
    let s = summary(&data, [24; 3], 48);
    let (thin, thick) = (table(|_| 0.001), table(|_| 0.6));
    let frame = frame(10.0, 20.0, 1.8, 64);
    let mut edited = TransferSummary::new(&s, &thin).unwrap();
    for table in [&thick, &thin, &thick] {
        edited.update(&s, table).unwrap();
        let level = Some(Level::detect());
        let found = Probe::on(level, &s, &mut edited, &frame, 11);
        let mut fresh = TransferSummary::new(&s, table).unwrap();
        assert_eq!(found, Probe::on(level, &s, &mut fresh, &frame, 11));
    }
}

#[test]
fn rays_from_afar_end_where_cells_are_thinner_than_the_rounding_error() {
    let voxels = std::vec![0u8; 24 * 24 * 24];
    let options = VolumeOptions { spacing: [1e-3, 1.0, 1.0], ..VolumeOptions::default() };
    let view = VolumeView::with(Scalars::U8(&voxels), [24; 3], options).unwrap();
    let s = VolumeSummary::new(&view).unwrap();
    for opacity in [0.0, 0.04] {
        let mut transfer = TransferSummary::new(&s, &table(|_| opacity)).unwrap();
        for ((rx, ry), skipping) in [(20.0, 30.0), (0.0, 90.0)]
            .into_iter()
            .flat_map(|pose| [Skipping::Blocks, Skipping::Distance].map(|skipping| (pose, skipping)))
        {
            let camera = Camera::from_arcball(Arcball { rx, ry, dz: 1e4 }).unwrap();
            let frame = Frame { skipping, ..Frame::new(camera, 640, 480).unwrap() };
            // Rounding carries some of the rays out of the grid.
            for (shading, side) in [(Shading::None, 11), (Shading::Scatter, 11), (Shading::None, 24)] {
                let frame = Frame { shading, ..frame };
                for level in Level::available() {
                    let packets = Probe::on(Some(level), &s, &mut transfer, &frame, side);
                    let single = Probe::on(None, &s, &mut transfer, &frame, side);
                    assert_eq!(packets, single, "{opacity} {rx} {frame:?} {side} {level:?}");
                }
            }
            let features = FrameFeatures::of(&s, &mut transfer, &frame, PROBE_SIDE).unwrap();
            let of = features.quantities(Setting::from(&frame));
            let counts = [SceneQuantity::Samples, SceneQuantity::Skips, SceneQuantity::Runs].map(of);
            assert!(
                counts.iter().all(|n| n.is_finite() && *n >= 0.0),
                "{opacity} {rx} {skipping:?}: {counts:?}"
            );
        }
    }
}

#[test]
fn a_transfer_function_for_other_blocks_casts_no_ray() {
    // The grids of cells are equal; the cells have one, two and four blocks.
    let volumes = [384usize, 768, 1536].map(|n| summary(&std::vec![9u8; 64 * n], [n, 8, 8], 48));
    let frame = frame(10.0, 20.0, 2.0, 64);
    for (i, of) in volumes.iter().enumerate() {
        let mut transfer = TransferSummary::new(of, &table(|_| 0.1)).unwrap();
        for (j, volume) in volumes.iter().enumerate() {
            assert_eq!(volume.cells, [48, 1, 1]);
            let features = FrameFeatures::of(volume, &mut transfer, &frame, PROBE_SIDE).unwrap();
            assert_eq!(features.probe.rays > 0, i == j, "{i} {j}");
        }
    }
}

/// Largest allowed relative difference between the samples estimated by a probe of 24² rays and the closed
/// form, which holds for the mean over all rays.
const CLOSED_FORM_TOLERANCE: f64 = 0.02;

#[test]
fn parallel_rays_through_a_box_follow_from_its_volume_and_its_shadow() {
    // The projection of a box along a unit vector d has the area Σ |d_k| · face_k, with the area face_k of
    // the face normal to axis k. The chords of all rays fill the box, so their mean length is volume / area,
    // and the mean number of samples per ray is volume / area / step.
    let data = std::vec![200u8; 48 * 32 * 40];
    for spacing in [[1.0, 1.0, 1.0], [0.5, 2.0, 1.0]] {
        let options = VolumeOptions { spacing, ..VolumeOptions::default() };
        let view = VolumeView::with(Scalars::U8(&data), [48, 32, 40], options).unwrap();
        let s = VolumeSummary::new(&view).unwrap();
        let shape = s.shape();
        let edges = (2.0 * shape.half_extent).to_array().map(f64::from);
        let mut transfer = TransferSummary::new(&s, &table(|_| 1e-4)).unwrap();
        for (rx, ry, dz) in [(0.0, 0.0, 1.5), (0.0, 90.0, 40.0), (90.0, 0.0, 3.0), (30.0, 40.0, 1e4)] {
            // The whole box is visible, at any distance in front of it.
            let scale = 1.1f32;
            let camera = Camera::from_arcball(Arcball { rx, ry, dz }).unwrap();
            let camera = camera.with_parallel_scale(scale).unwrap();
            let frame = Frame { termination: 1.0, ..Frame::new(camera, 300, 240).unwrap() };
            let d = camera.view().row(2).truncate().abs().to_array().map(f64::from);
            let shadow: f64 = (0..3).map(|k| d[k] * edges[(k + 1) % 3] * edges[(k + 2) % 3]).sum();
            let seen = 4.0 * f64::from(scale * scale) * 300.0 / 240.0;
            let features = FrameFeatures::of(&s, &mut transfer, &frame, 24).unwrap();
            let what = format!("{spacing:?} {rx} {ry} {dz}");
            for step in [0.5f32, 2.0] {
                let setting = Setting { step, skipping: Skipping::None, ..Setting::from(&frame) };
                let work = features.work(&setting);
                let rays = shadow / seen * work.pixels;
                assert!((work.rays / rays - 1.0).abs() < 1e-4, "{what}: {} rays, not {rays}", work.rays);
                let volume: f64 = edges.iter().product();
                let along = volume / f64::from(shape.reference_step) / f64::from(step);
                let samples = along / seen * work.pixels;
                let off = (work.samples / samples - 1.0).abs();
                assert!(off < CLOSED_FORM_TOLERANCE, "{what}: {} samples, not {samples}", work.samples);
                let apart = 2.0 * f64::from(scale) / 240.0 / f64::from(shape.reference_step);
                assert!((work.ray_spacing / apart - 1.0).abs() < 1e-5, "{what}: {}", work.ray_spacing);
            }
        }
        // The plane from which the rays start cuts the box in half: half of each chord is left.
        let through = Camera::from_arcball(Arcball { rx: 0.0, ry: 0.0, dz: 1e-3 }).unwrap();
        let through = through.with_parallel_scale(1.1).unwrap();
        let frame = Frame { termination: 1.0, ..Frame::new(through, 300, 240).unwrap() };
        let features = FrameFeatures::of(&s, &mut transfer, &frame, 24).unwrap();
        let half = 0.5 * edges[2] / f64::from(shape.reference_step);
        let chord = features.quantities(Setting::from(&frame))(SceneQuantity::MeanChord);
        assert!((chord / half - 1.0).abs() < 3e-3, "{chord}, not {half}");
        // With the plane behind the box, nothing is visible.
        let behind = glam::Mat4::from_translation(glam::Vec3::new(0.0, 0.0, 2.0));
        let behind = Camera::from_world_view(behind, glam::Vec3::ZERO, 1.0).unwrap();
        let frame = Frame::new(behind.with_parallel_scale(1.1).unwrap(), 300, 240).unwrap();
        let features = FrameFeatures::of(&s, &mut transfer, &frame, 24).unwrap();
        assert_eq!(features.work(&Setting::from(&frame)).rays, 0.0);
    }
}

/// Largest allowed relative difference between a quantity of parallel rays and the same quantity of a
/// perspective camera 1000 radii away.
const LIMIT_TOLERANCE: f64 = 0.01;

/// Tolerance in place of [`LIMIT_TOLERANCE`] for quantities that count samples along shadow rays. A ray's
/// shadow ray starts at a point selected by comparing a random number with shares of lengths. If a share is
/// close to that number, the two cameras may select different points, whose shadow rays differ much in
/// length. This happens to some of the 121 rays and causes nearly all of the difference, at most 3.2 %.
const SHADOW_LIMIT_TOLERANCE: f64 = 0.04;

/// Tolerance in place of [`LIMIT_TOLERANCE`] for lookups in the skip map, which differ between shadow rays
/// even more than samples do.
const SEGMENTS_LIMIT_TOLERANCE: f64 = 0.05;

/// Tolerance in place of [`LIMIT_TOLERANCE`] for the ray with the most samples or lookups along shadow rays.
/// It is a single ray, and its shadow ray may start at different points for the two cameras.
const LONGEST_LIMIT_TOLERANCE: f64 = 0.25;

#[test]
fn parallel_rays_are_the_limit_of_a_narrow_lens_far_away() {
    let data: Vec<u8> = (0..64 * 48 * 40).map(|i| ((i % 64) * 2 + i / 3072) as u8).collect();
    let s = summary(&data, [64, 48, 40], 48);
    let table = table(|i| if i > 60 { 0.01 } else { 0.0 });
    for (rx, ry) in [(3.0, 2.0), (25.0, 130.0), (-70.0, 10.0)] {
        for scale in [0.4f32, 1.2] {
            let far = Camera::from_arcball(Arcball { rx, ry, dz: 1000.0 }).unwrap();
            let lens = far.with_fov_y_degrees(2.0 * (scale / 1000.0).atan().to_degrees()).unwrap();
            let parallel = far.with_parallel_scale(scale).unwrap();
            for shading in Shading::ALL {
                let [one, other] = [lens, parallel].map(|camera| {
                    let frame = Frame { shading, ..Frame::new(camera, 200, 150).unwrap() };
                    (Setting::from(&frame), measured(&s, &table, &frame))
                });
                for q in SceneQuantity::ALL {
                    let [a, b] = [&one, &other].map(|(setting, features)| features.quantities(*setting)(q));
                    let shadows = matches!(
                        q,
                        SceneQuantity::ShadowSamples
                            | SceneQuantity::ShadowPerPixel
                            | SceneQuantity::LaneShadowSamples
                            | SceneQuantity::FarShadowSamples
                            | SceneQuantity::EstimatedSeconds
                    );
                    let segments = matches!(
                        q,
                        SceneQuantity::Segments | SceneQuantity::FarSegments | SceneQuantity::SegmentsPerRay
                    );
                    let longest = matches!(
                        q,
                        SceneQuantity::LongestSegments
                            | SceneQuantity::FarLongestSegments
                            | SceneQuantity::LongestShadowSamples
                            | SceneQuantity::FarLongestShadowSamples
                    );
                    let tolerance = if longest && shading.scatters() {
                        LONGEST_LIMIT_TOLERANCE
                    } else if segments && shading.scatters() {
                        SEGMENTS_LIMIT_TOLERANCE
                    } else if shadows && shading.scatters() {
                        SHADOW_LIMIT_TOLERANCE
                    } else {
                        LIMIT_TOLERANCE
                    };
                    let apart = (a - b).abs();
                    assert!(apart <= tolerance * a.abs().max(1e-3), "{q} {rx} {ry} {scale}: {a}, {b}");
                }
            }
        }
    }
}

/// Checks the number of shadow samples of eight rays that march in lockstep against a closed formula. A ray
/// whose own sample is transparent waits while another of the eight shades. Adjacent rays shade at the same
/// time and do not wait. Rays far apart have independent samples.
#[test]
fn rays_far_apart_wait_while_any_of_eight_shades() {
    let dims = [64, 64, 64];
    for (least, apart) in [(0usize, false), (192, true), (240, true)] {
        let s = summary(&noise(64 * 64 * 64, 7), dims, 4);
        let frame = Frame { shading: Shading::Scatter, ..frame(20.0, 30.0, 2.0, 64) };
        let features = measured(&s, &table(|i| if i >= least { 1.0e-4 } else { 0.0 }), &frame);
        let p = &features.probe;
        let (shown, busy) = (p.visible / p.occupied, p.busy / p.occupied);
        // Every cell holds thousands of voxels of the same noise, so all cells have nearly the same visible
        // share.
        let expected = 1.0 - (1.0 - shown).powi(8);
        assert!((busy - expected).abs() < 0.01, "{least}: {shown}, {busy} of {expected}");
        let independent = f64::from(busy / shown);
        assert_eq!(independent > 1.05, apart, "{independent}");
        for size in [1 << 20, 64, 1] {
            let setting = Setting { width: size, height: size, ..Setting::from(&frame) };
            let work = features.work(&setting);
            let square = work.ray_spacing * work.ray_spacing;
            let value = |q| features.quantity_of(q, &setting, &work);
            let [lanes, spread] =
                [SceneQuantity::LaneShadowSamples, SceneQuantity::FarShadowSamples].map(value);
            let waiting = 1.0 + 4.0 * (independent - 1.0) * work.ray_spacing / (work.ray_spacing + 8.0);
            assert!((lanes / work.shadow_samples - waiting).abs() < 1e-5 * waiting, "{size}: {waiting}");
            assert!(size < 1 << 20 || (waiting - 1.0).abs() < 0.02, "{waiting}");
            // Samples along a shadow ray are two steps of the primary ray apart.
            let apart = 2.0 * f64::from(setting.step);
            let new = 3.0 * apart / (apart + 2.0);
            let parted = work.shadow_samples * (1.0 + 4.0 * (independent - 1.0) * 0.5);
            let far = new * aside(&frame) * parted * work.uncached * square / (square + 64.0);
            assert!((spread - far).abs() < 1e-5 * far, "{size}: {spread} of {far}");
            assert_eq!(value(SceneQuantity::FarLocalSamples), 0.0);
        }
        for (step, new) in [(0.5f32, 0.6), (1.0, 1.0), (4.0, 2.0)] {
            let local = Setting { shading: Shading::Local, step, ..Setting::from(&frame) };
            let work = features.work(&local);
            let square = work.ray_spacing * work.ray_spacing;
            let spread = features.quantity_of(SceneQuantity::FarLocalSamples, &local, &work);
            let far = new * work.uncached * square / (square + 64.0);
            assert!((spread / work.shaded - far).abs() < 1e-6, "{step}: {spread}");
        }
    }
}

/// Sine of the angle between the central ray and the shadow rays.
fn aside(frame: &Frame) -> f64 {
    let (_, [forward, ..]) = frame.camera.ray_basis(frame.width, frame.height);
    f64::from(forward.angle_between(glam::Vec3::from_array(SHADOW_DIRECTION))).sin()
}

/// An opaque volume ends each shadow ray at its first sample, unless the ray starts closer to the border than
/// one shadow step. In a transparent volume, a shadow ray ends on average half a shadow step before the
/// border.
#[test]
fn shadow_rays_take_the_sample_at_which_they_end() {
    let s = summary(&noise(64 * 64 * 64, 7), [64, 64, 64], 4);
    let frame = Frame { shading: Shading::Scatter, termination: 1.0, ..frame(20.0, 30.0, 2.0, 64) };
    for (extinction, ended) in [(1.0e-4, 0.0), (0.5, 1.0)] {
        let features = measured(&s, &table(|_| extinction), &frame);
        let (p, work) = (&features.probe, features.work(&Setting::from(&frame)));
        let share = f64::from(p.shadow_ended / p.visible);
        assert!((share - ended).abs() < 0.1, "{extinction}: {share}");
        let per_ray = work.shadow_samples / work.shaded;
        let length = f64::from(p.shadow / p.visible / SHADOW_STEP);
        assert!(
            (per_ray - length - (share - 0.5)).abs() < 1e-3,
            "{extinction}: {per_ray}, {length}, {share}"
        );
    }
}

/// Checks the distance of ends on two by two rays. Three of them terminate early, so two pairs of neighbors
/// count.
#[test]
fn only_rays_that_terminate_early_end_apart() {
    let mut room = [[0.0f32; 4]; FIELDS];
    room[VISIBLE_LENGTH] = [1.0, 3.0, 5.0, 100.0];
    room[TERMINATED] = [1.0, 1.0, 1.0, 0.0];
    let rays = room.each_mut().map(|field| field.as_mut_slice());
    let (distance, length) = (20.0 + 4.0, 2.0 + 3.0);
    assert_eq!(ends_apart(&[10.0, 30.0, 6.0, 900.0], &rays, 2), distance / (distance + length));
    assert_eq!(ends_apart(&[10.0, 10.0, 10.0, 900.0], &rays, 2), 0.0);
    rays[TERMINATED].fill(0.0);
    assert_eq!(ends_apart(&[10.0, 30.0, 6.0, 900.0], &rays, 2), 0.0);
}

/// Compares the share of unshared reads that wait for memory with its definition, in each shading mode. A
/// frame touches at most the voxels of the volume. The share never falls for a larger image or a finer step.
#[test]
fn a_frame_that_touches_more_voxels_waits_for_more_reads() {
    let n = 64 * 64 * 64;
    let s = summary(&noise(n, 3), [64, 64, 64], 8);
    let table = table(|i| if i >= 128 { 2.0e-3 } else { 0.0 });
    for shading in Shading::ALL {
        let frame = Frame { shading, ..frame(10.0, 50.0, 2.0, 256) };
        let features = measured(&s, &table, &frame);
        let share = |size: u32, step: f32| {
            let setting = Setting { width: size, height: size, step, ..Setting::from(&frame) };
            let work = features.work(&setting);
            let value = |q| features.quantity_of(q, &setting, &work);
            let square = work.ray_spacing * work.ray_spacing;
            let new = 3.0 * f64::from(step) / (f64::from(step) + 2.0);
            let near = square / (square + 4.0);
            let shading =
                (value(SceneQuantity::LocalSamples) + work.parted_shadow_samples) * square / (square + 64.0);
            let touched = 1.0 / (1.0 / n as f64 + 1.0 / (64.0 * (work.samples * near + shading)));
            let expected = touched * touched / (touched * touched + 4.0e6 * 4.0e6);
            assert!((work.uncached - expected).abs() < 1e-9 * expected, "{} of {expected}", work.uncached);
            let far = value(SceneQuantity::FarSamples);
            assert!((far - new * work.lane_samples * near * expected).abs() < 1e-6 * far, "{far}");
            work.uncached
        };
        let most = (n * n) as f64 / ((n * n) as f64 + 4.0e6 * 4.0e6);
        assert!(share(2, 1.0) < 0.9 * most);
        assert!(share(4096, 0.1) > 0.9 * most);
        for sizes in [[2, 8], [8, 64], [64, 512], [512, 4096]] {
            assert!(share(sizes[0], 1.0) < share(sizes[1], 1.0), "{sizes:?}");
        }
        assert!(share(64, 2.0) < share(64, 0.5));
    }
}
