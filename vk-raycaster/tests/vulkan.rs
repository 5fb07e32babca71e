//! Compares the Vulkan renderer with its CPU version, under the validation layer if it is installed. Without
//! a Vulkan device every test is reported as ignored.

mod common;

use ash::vk;
use common::{
    bytes, camera, constant, field_bytes, field_voxels, frame, medium, opaque, parallel, set_field,
    transparent,
};
use entire_core::scene::{
    Camera, Frame, Scalars, Shading, Skipping, TransferTable, VolumeOptions, VolumeView,
};
use entire_vk_raycaster::{
    CpuRaycaster, Picture, Region, Rendered, Renderer, VoxelFetch, VulkanOptions, VulkanRaycaster, WorkCounts,
};
use libtest_mimic::{Arguments, Failed, Trial};

/// Upper bound of the difference of a channel between device and CPU version, in units of 1/255.
const MAX_DIFFERENCE: u8 = 2;
/// Upper bound of the mean difference over all channels of an image, in units of 1/255.
const MEAN: f64 = 0.1;

type Outcome = Result<(), Failed>;
type Test = (&'static str, fn() -> Outcome);

fn open(options: VulkanOptions) -> Result<VulkanRaycaster, Failed> {
    let environment = VulkanOptions::from_env()?;
    Ok(VulkanRaycaster::new(VulkanOptions { device: environment.device, ..options })?)
}

/// Opens a renderer, with the validation layer if it is installed.
fn open_validated(
    fetch: Option<VoxelFetch>,
    largest_texture: Option<u32>,
) -> Result<VulkanRaycaster, Failed> {
    let options = |validation| VulkanOptions {
        validation,
        fetch,
        count_work: true,
        largest_texture,
        ..Default::default()
    };
    open(options(true)).or_else(|_| open(options(false)))
}

fn expect_silence(gpu: &VulkanRaycaster) -> Outcome {
    let messages = gpu.shared_device().validation_messages();
    assert!(messages.is_empty(), "validation: {}", messages.join("\n"));
    Ok(())
}

/// Scenes (name, frame, transfer function) with various cameras, sizes and steps; the tests draw each in
/// every mode.
fn scenes() -> Vec<(&'static str, Frame, TransferTable)> {
    let mut all = vec![];
    let mut add = |name, frame: Frame, table| all.push((name, frame, table));
    add("transparent", frame(20.0, 35.0, 3.0, 61, 47), transparent());
    add("medium", frame(-40.0, 120.0, 2.5, 61, 47), medium());
    add("opaque", frame(70.0, -20.0, 3.0, 61, 47), opaque());
    add("axis-aligned", frame(0.0, 0.0, 3.0, 32, 32), medium());
    add("from above", frame(90.0, 0.0, 2.0, 33, 31), medium());
    add("half step", Frame { step: 0.5, ..frame(10.0, 200.0, 2.5, 40, 30) }, medium());
    add("triple step", Frame { step: 3.0, ..frame(10.0, 200.0, 2.5, 40, 30) }, medium());
    add("inside", frame(15.0, 45.0, 0.3, 50, 38), medium());
    add("at the center", frame(0.0, 10.0, 1e-4, 24, 24), transparent());
    add("one pixel", frame(5.0, 5.0, 2.0, 1, 1), medium());
    add("one row", frame(5.0, 5.0, 2.0, 37, 1), medium());
    add("no termination", Frame { termination: 1.0, ..frame(30.0, 30.0, 2.5, 40, 40) }, opaque());
    add("early termination", Frame { termination: 0.5, ..frame(30.0, 30.0, 2.5, 40, 40) }, opaque());
    add("jitter", Frame { jitter: true, ..frame(30.0, 30.0, 2.5, 40, 40) }, medium());
    add("invisible", frame(30.0, 30.0, 2.5, 40, 40), constant(0.0));
    add("solid", frame(30.0, 30.0, 2.5, 40, 40), constant(1.0));
    add("misses", frame(0.0, 0.0, 800.0, 9, 9), medium());
    add("parallel", parallel((25.0, -140.0, 3.0), 1.1, 61, 47), medium());
    add("parallel, opaque, from behind", parallel((-50.0, 160.0, 1.6), 0.9, 47, 61), opaque());
    add("parallel along an axis", parallel((0.0, 90.0, 2.0), 0.8, 32, 32), medium());
    add("parallel from below", parallel((-90.0, 0.0, 5.0), 1.0, 33, 31), opaque());
    add("parallel, the plane in the box", parallel((35.0, 30.0, 0.1), 1.0, 50, 38), medium());
    add("parallel, close", parallel((15.0, 45.0, 2.5), 0.05, 40, 30), transparent());
    add("parallel, far away", parallel((15.0, 45.0, 5e4), 1.2, 40, 30), medium());
    let view = glam::Mat4::from_translation(glam::Vec3::new(0.4, -0.3, 0.0)) * camera(10.0, 70.0, 2.0).view();
    let aside =
        Camera::from_world_view(view, glam::Vec3::ZERO, 1.0).unwrap().with_parallel_scale(0.6).unwrap();
    let aside = Frame { jitter: true, ..Frame::new(aside, 41, 37).unwrap() };
    add("parallel, moved aside", aside, medium());
    all
}

/// The voxels of a test volume in each scalar type.
struct Data {
    dims: [usize; 3],
    bytes: Vec<u8>,
    words: Vec<u16>,
    signed: Vec<i16>,
    floats: Vec<f32>,
}

impl Data {
    fn new(dims: [usize; 3]) -> Self {
        let floats = field_voxels(dims);
        Self {
            dims,
            bytes: field_bytes(dims),
            words: floats.iter().map(|v| (v * 60000.0) as u16 + 1000).collect(),
            signed: floats.iter().map(|v| (v * 4000.0 - 1000.0) as i16).collect(),
            floats,
        }
    }

    fn views(&self) -> Vec<(&'static str, VolumeView<'_>)> {
        let options = VolumeOptions { spacing: [1.0, 1.4, 0.8], ..VolumeOptions::default() };
        [
            ("u8", Scalars::U8(&self.bytes)),
            ("u16", Scalars::U16(&self.words)),
            ("i16", Scalars::I16(&self.signed)),
            ("f32", Scalars::F32(&self.floats)),
        ]
        .map(|(name, s)| (name, VolumeView::with(s, self.dims, options).unwrap()))
        .to_vec()
    }
}

/// Returns the differences between two images in units of 1/255: the largest of any channel, and the mean.
fn difference(a: &[u8], b: &[u8]) -> (u8, f64) {
    assert_eq!(a.len(), b.len());
    let largest = a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0);
    let sum: u64 = a.iter().zip(b).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
    (largest, sum as f64 / a.len() as f64)
}

/// The Vulkan renderer and the CPU version.
struct Both {
    gpu: VulkanRaycaster,
    twin: CpuRaycaster,
}

impl Both {
    fn new(gpu: VulkanRaycaster) -> Self {
        Self { gpu, twin: CpuRaycaster::new() }
    }

    fn set_volume(&mut self, view: &VolumeView<'_>) -> Outcome {
        self.gpu.set_volume(view)?;
        self.twin.set_volume(view)?;
        Ok(())
    }

    fn set_transfer(&mut self, table: &TransferTable) -> Outcome {
        self.gpu.set_transfer(table)?;
        self.twin.set_transfer(table)?;
        Ok(())
    }

    /// Draws a frame on the device and on the CPU version. Panics if a channel differs by more than
    /// [`MAX_DIFFERENCE`], or if the mean difference over all channels exceeds `mean`; both are in units of
    /// 1/255.
    fn draw(&mut self, name: &str, frame: &Frame, mean: f64) -> Result<(Rendered, Rendered), Failed> {
        let (a, b) = (self.gpu.render(frame)?, self.twin.render(frame)?);
        let (largest, off) = difference(&a.image.rgba, &b.image.rgba);
        let alike = largest <= MAX_DIFFERENCE && off <= mean;
        assert!(alike, "{name}: differs by up to {largest}/255, mean {off:.3}/255");
        Ok((a, b))
    }
}

/// Compares device and CPU version in all scenes and modes, with one source of voxels in the shader.
fn compare(fetch: VoxelFetch, bytes_only: bool) -> Outcome {
    let mut both = Both::new(open_validated(Some(fetch), None)?);
    let exact = fetch != VoxelFetch::Sampler && both.gpu.is_software();
    let data = Data::new([37, 53, 29]);
    for (kind, view) in data.views().into_iter().take(if bytes_only { 1 } else { 4 }) {
        both.set_volume(&view)?;
        // Bytes are tested with all scenes, the other types with the first three.
        for scene in scenes().into_iter().take(if kind == "u8" { usize::MAX } else { 3 }) {
            compare_modes(&mut both, kind, &scene, &Shading::ALL, |name, a, b| {
                assert!(!exact || a == b, "{name}: device {a:?}, CPU version {b:?}");
                check_counts(name, a.expect("counts"), b.expect("counts"));
            })?;
        }
    }
    expect_silence(&both.gpu)
}

/// Draws a scene on the device and on the CPU version, in some shading modes and every skipping mode. Passes
/// the name of the mode, the device's counts and the CPU version's counts to `check`.
fn compare_modes(
    both: &mut Both,
    kind: &str,
    (scene, frame, table): &(&str, Frame, TransferTable),
    shadings: &[Shading],
    check: impl Fn(&str, Option<WorkCounts>, Option<WorkCounts>),
) -> Outcome {
    both.set_transfer(table)?;
    for &shading in shadings {
        for skipping in Skipping::ALL {
            let name = format!("{kind}, {scene}, {shading}, {skipping}");
            let (a, b) = both.draw(&name, &Frame { shading, skipping, ..*frame }, MEAN)?;
            check(&name, a.counts, b.counts);
        }
    }
    Ok(())
}

/// Checks that the counts of device and CPU version are close. They may differ in a few samples: those at the
/// borders of the box and of blocks, and some that are barely visible.
fn check_counts(name: &str, device: WorkCounts, twin: WorkCounts) {
    let close = |a: u64, b: u64, share: f64| a.abs_diff(b) as f64 <= 4.0 + share * b as f64;
    assert!(
        close(device.rays, twin.rays, 0.01)
            && close(device.samples, twin.samples, 0.02)
            && close(device.shaded, twin.shaded, 0.05),
        "{name}: device {device:?}, CPU version {twin:?}"
    );
}

fn odd_volumes() -> Outcome {
    let mut both = Both::new(open_validated(None, None)?);
    for dims in [[1, 1, 1], [16, 9, 1], [1, 17, 3], [2, 2, 2], [8, 8, 8], [65, 3, 2]] {
        let data = Data::new(dims);
        for (kind, view) in data.views() {
            both.set_volume(&view)?;
            for table in [medium(), constant(0.3)] {
                both.set_transfer(&table)?;
                for shading in Shading::ALL {
                    let f = Frame { shading, step: 0.3, ..frame(33.0, 20.0, 2.0, 31, 17) };
                    both.draw(&format!("{kind} {dims:?} {shading}"), &f, MEAN)?;
                }
            }
        }
    }
    expect_silence(&both.gpu)
}

fn homogeneous_slab() -> Outcome {
    let mut gpu = open(VulkanOptions::default())?;
    let data = vec![100u8; 32 * 32 * 32];
    gpu.set_volume(&bytes(&data, [32; 3]))?;
    for alpha in [0.001f32, 0.02, 0.3] {
        gpu.set_transfer(&constant(alpha))?;
        for step in [0.5, 1.0, 2.0] {
            let f = Frame { step, termination: 1.0, ..frame(0.0, 0.0, 3.0, 1, 1) };
            let found = gpu.render(&f)?.image.rgba[3];
            let want = (1.0 - (1.0 - f64::from(alpha)).powi(32)) * 255.0;
            let near = (f64::from(found) - want).abs() <= 1.0;
            assert!(near, "opacity {alpha}, step {step}: {found} for {want}");
        }
    }
    Ok(())
}

fn skipping_changes_nothing() -> Outcome {
    let mut gpu = open_validated(None, None)?;
    let dims = [45, 37, 61];
    let data = field_bytes(dims);
    gpu.set_volume(&bytes(&data, dims))?;
    for table in [transparent(), medium(), opaque()] {
        gpu.set_transfer(&table)?;
        let f = frame(25.0, -50.0, 2.5, 64, 48);
        let [none, blocks, distance] = Skipping::ALL.map(|s| gpu.render(&Frame { skipping: s, ..f }));
        let (none, blocks, distance) = (none?, blocks?, distance?);
        assert!(none.image == blocks.image && none.image == distance.image, "the pictures differ");
        let (n, b, d) = (none.counts.unwrap(), blocks.counts.unwrap(), distance.counts.unwrap());
        let less = b.samples < n.samples && d.samples == b.samples && d.skips <= b.skips;
        assert!(less, "{n:?} {b:?} {d:?}");
    }
    expect_silence(&gpu)
}

/// Compares volumes that are larger than a texture: the texture limit is lowered so far that the test volume
/// is cut into bricks.
fn bricks_match_the_twin(fetch: VoxelFetch) -> Outcome {
    let mut both = Both::new(open_validated(Some(fetch), Some(21))?);
    let exact = fetch != VoxelFetch::Sampler && both.gpu.is_software();
    let data = Data::new([37, 53, 29]);
    for (kind, view) in data.views().into_iter().take(2) {
        both.set_volume(&view)?;
        for scene in scenes() {
            compare_modes(&mut both, kind, &scene, &[Shading::None, Shading::Local], |name, a, b| {
                assert!(!exact || a == b, "{name}: device {a:?}, CPU version {b:?}");
            })?;
        }
    }
    for shading in [Shading::Scatter, Shading::LocalScatter] {
        let scatter = both.gpu.render(&Frame { shading, ..frame(0.0, 0.0, 3.0, 8, 8) });
        assert!(scatter.is_err_and(|e| e.to_string().contains("one texture")), "{shading}");
    }
    // A smaller volume takes one texture again, and supports scattering.
    let small = Data::new([20, 21, 8]);
    let (_, view) = small.views()[0];
    both.set_volume(&view)?;
    both.set_transfer(&medium())?;
    let f = Frame { shading: Shading::Scatter, ..frame(10.0, 30.0, 2.5, 30, 20) };
    both.draw("after bricks", &f, f64::INFINITY)?;
    expect_silence(&both.gpu)
}

/// Checks that regions have the pixels of the whole frame, and that drawing into a picture on the device
/// causes no validation message.
fn regions_are_parts_of_the_whole() -> Outcome {
    let mut gpu = open_validated(None, None)?;
    set_field(&mut gpu, [40; 3], &medium())?;
    let f = Frame { jitter: true, shading: Shading::Local, ..frame(25.0, 70.0, 2.2, 75, 61) };
    let whole = gpu.render(&f)?;
    let mut picture = Picture::new(&gpu.shared_device(), 80, 64)?;
    assert!(picture.is_fresh(), "a new picture");
    let mut samples = 0;
    for (x, y, width, height) in [(0, 0, 75, 20), (0, 20, 33, 41), (33, 20, 42, 41)] {
        let region = Region { x, y, width, height };
        let part = gpu.render_region(&f, region)?;
        samples += part.counts.unwrap_or_default().samples;
        for row in 0..height {
            let bytes = |from: u32, width: u32| {
                let start = 4 * from as usize;
                start..start + 4 * width as usize
            };
            let found = &part.image.rgba[bytes(row * width, width)];
            let same = found == &whole.image.rgba[bytes((y + row) * 75 + x, width)];
            assert!(same, "row {row} of {region:?}");
        }
        assert!(gpu.render_to(&f, region, &mut picture)?.wall > 0.0 && !picture.is_fresh());
    }
    assert_eq!(samples, whole.counts.unwrap_or_default().samples);
    let beyond = Region { x: 70, y: 0, width: 6, height: 1 };
    assert!(gpu.render_region(&f, beyond).is_err() && gpu.render_to(&f, beyond, &mut picture).is_err());
    let large = frame(25.0, 70.0, 2.2, 90, 61);
    assert!(gpu.render_to(&large, Region::whole(&large), &mut picture).is_err());
    expect_silence(&gpu)
}

/// Checks that several raycasters of one device, each in a thread, draw the same pictures as one raycaster
/// alone.
fn raycasters_share_a_device() -> Outcome {
    let gpu = open_validated(None, None)?;
    let device = gpu.shared_device();
    let draw = |table: &TransferTable| -> entire_vk_raycaster::Result<Vec<_>> {
        let mut own = VulkanRaycaster::on_device(&device, VulkanOptions::default())?;
        set_field(&mut own, [40; 3], table)?;
        (0..6u8).map(|i| Ok(own.render(&frame(10.0, 30.0 * f32::from(i), 2.5, 60, 50))?.image)).collect()
    };
    let tables = [medium(), opaque()];
    let alone = [draw(&tables[0])?, draw(&tables[1])?];
    let together = std::thread::scope(|s| {
        let threads = tables.each_ref().map(|t| s.spawn(|| draw(t)));
        threads.map(|t| t.join().expect("a thread that draws"))
    });
    for (found, wanted) in together.into_iter().zip(alone) {
        assert!(found? == wanted, "the pictures differ from those of one raycaster alone");
    }
    expect_silence(&gpu)
}

/// Checks that frames with and without counts have the same bits. Frames without counts may use a shader
/// variant in which the rays of a subgroup skip together.
fn counting_changes_no_picture() -> Outcome {
    let mut gpu = open_validated(Some(VoxelFetch::Packed), None)?;
    let data = Data::new([37, 53, 29]);
    let (_, view) = data.views()[0];
    gpu.set_volume(&view)?;
    let compare = |gpu: &mut VulkanRaycaster, name: &str, frame: &Frame| -> Outcome {
        let [counted, timed] = [true, false].map(|count| {
            gpu.count_work(count);
            gpu.render(frame)
        });
        let (counted, timed) = (counted?, timed?);
        let off = difference(&counted.image.rgba, &timed.image.rgba);
        assert!(counted.image == timed.image && timed.counts.is_none(), "{name}: {off:?}");
        Ok(())
    };
    for (name, frame, table) in scenes() {
        gpu.set_transfer(&table)?;
        for shading in Shading::ALL {
            for skipping in Skipping::ALL {
                let name = format!("{name}, {shading}, {skipping}");
                compare(&mut gpu, &name, &Frame { shading, skipping, ..frame })?;
            }
        }
    }
    // On a software device, these rays are cast in several dispatches.
    let frame = Frame { step: 1.0 / 64.0, shading: Shading::Scatter, ..frame(20.0, 30.0, 2.5, 19, 14) };
    gpu.set_transfer(&transparent().with_unit_distance(16.0).unwrap())?;
    for skipping in Skipping::ALL {
        compare(&mut gpu, &format!("windows, {skipping}"), &Frame { skipping, ..frame })?;
    }
    expect_silence(&gpu)
}

/// Compares rays that need more loop iterations than a software device allows in one dispatch.
fn long_rays_are_cast_in_windows() -> Outcome {
    let mut both = Both::new(open_validated(None, None)?);
    let data = field_bytes([64; 3]);
    both.set_volume(&bytes(&data, [64; 3]))?;
    both.set_transfer(&transparent().with_unit_distance(4.0).unwrap())?;
    for skipping in Skipping::ALL {
        let f = Frame { step: 0.125, shading: Shading::Scatter, ..frame(20.0, 30.0, 2.5, 5, 4) };
        let (a, b) = both.draw(skipping.name(), &Frame { skipping, ..f }, f64::INFINITY)?;
        if both.gpu.is_software() {
            assert_eq!(a.counts, b.counts, "{skipping}");
        }
    }
    expect_silence(&both.gpu)
}

fn tiles_join_without_seams() -> Outcome {
    let f = Frame { jitter: true, ..frame(10.0, 60.0, 2.0, 150, 91) };
    let mut images = vec![];
    for tile in [None, Some(64), Some(24)] {
        let mut gpu = open(VulkanOptions { tile, validation: false, ..Default::default() })?;
        set_field(&mut gpu, [40; 3], &medium())?;
        images.push(gpu.render(&f)?.image);
    }
    assert!(images.windows(2).all(|w| w[0] == w[1]), "tiled images differ");
    Ok(())
}

fn times_are_plausible() -> Outcome {
    let mut gpu = open(VulkanOptions::default())?;
    let data = field_bytes([64; 3]);
    let p = gpu.set_volume(&bytes(&data, [64; 3]))?;
    let told = p.upload.is_some() && p.block_map.is_some() && p.occupancy.is_none() && p.wall > 0.0;
    assert!(told, "{p:?}");
    let p = gpu.set_transfer(&medium())?;
    assert!(p.occupancy.is_some() && p.distance_map.is_some(), "{p:?}");
    let r = gpu.render(&frame(10.0, 20.0, 2.5, 256, 256))?;
    assert!(r.counts.is_none(), "counts that were not requested");
    assert_eq!(r.time.device.is_some(), gpu.has_timestamps());
    assert!(r.time.device.is_none_or(|t| t > 0.0 && t <= r.time.wall), "{:?}", r.time);
    Ok(())
}

fn volume_and_table_may_change_between_frames() -> Outcome {
    let mut both = Both::new(open_validated(None, None)?);
    let f = frame(20.0, 30.0, 2.5, 40, 40);
    assert!(both.gpu.render(&f).is_err_and(|e| e.to_string().contains("no volume")));
    for (dims, table) in [([20; 3], medium()), ([20; 3], opaque()), ([31, 9, 14], transparent())] {
        let data = field_bytes(dims);
        both.set_volume(&bytes(&data, dims))?;
        both.set_transfer(&table)?;
        for step in [1.0, 2.0, 1.0] {
            both.draw(&format!("{dims:?} step {step}"), &Frame { step, ..f }, f64::INFINITY)?;
        }
    }
    expect_silence(&both.gpu)
}

fn oversized_volumes_are_refused_with_size_and_limit() -> Outcome {
    let mut gpu = open(VulkanOptions::default())?;
    // All strides are 0, so one byte stands for every voxel of a huge volume.
    let data = [1u8];
    let broadcast = VolumeOptions { strides: Some([0, 0, 0]), ..VolumeOptions::default() };
    let view = VolumeView::with(Scalars::U8(&data), [1 << 20, 1, 1], broadcast).unwrap();
    let error = gpu.set_volume(&view).expect_err("too many voxels").to_string();
    assert!(error.contains("1048576 x 1 x 1") && error.contains("at most"), "{error}");
    Ok(())
}

/// Checks that a message of the validation layer reaches the tests: a fence with an unknown flag must cause a
/// message.
fn validation_layer_was_heard() -> Outcome {
    let gpu = open(VulkanOptions { validation: true, ..Default::default() })?;
    expect_silence(&gpu)?;
    let shared = gpu.shared_device();
    let unknown = vk::FenceCreateInfo::default().flags(vk::FenceCreateFlags::from_raw(1 << 20));
    // SAFETY: the device is alive, and no work uses the fence. The flag is the error that the layer must
    // find; drivers ignore unknown flags.
    unsafe {
        let fence = shared.device().create_fence(&unknown, None)?;
        shared.device().destroy_fence(fence, None);
    }
    let messages = shared.validation_messages();
    assert!(messages.iter().any(|m| m.contains("vkCreateFence")), "{messages:?}");
    Ok(())
}

fn main() {
    let arguments = Arguments::from_args();
    let device = open(VulkanOptions::default());
    if let Err(e) = &device {
        eprintln!("No Vulkan device, these tests are ignored: {}", e.message().unwrap_or_default());
    }
    let none = device.is_err();
    drop(device);
    let validation = open(VulkanOptions { validation: true, ..Default::default() }).is_ok();
    let tests: Vec<Test> = vec![
        ("texels_match_the_twin", || compare(VoxelFetch::Texels, false)),
        ("sampler_matches_the_twin", || compare(VoxelFetch::Sampler, false)),
        ("packed_fetch_matches_the_twin", || compare(VoxelFetch::Packed, true)),
        ("odd_volumes_match_the_twin", odd_volumes),
        ("homogeneous_slab_absorbs_by_its_thickness", homogeneous_slab),
        ("skipping_changes_nothing_but_the_work", skipping_changes_nothing),
        ("bricks_of_texels_match_the_twin", || bricks_match_the_twin(VoxelFetch::Texels)),
        ("bricks_of_a_sampler_match_the_twin", || bricks_match_the_twin(VoxelFetch::Sampler)),
        ("regions_are_parts_of_the_whole", regions_are_parts_of_the_whole),
        ("raycasters_share_a_device", raycasters_share_a_device),
        ("counting_changes_no_picture", counting_changes_no_picture),
        ("long_rays_are_cast_in_windows", long_rays_are_cast_in_windows),
        ("tiles_join_without_seams", tiles_join_without_seams),
        ("times_are_plausible", times_are_plausible),
        ("volume_and_table_may_change_between_frames", volume_and_table_may_change_between_frames),
        ("oversized_volumes_are_refused", oversized_volumes_are_refused_with_size_and_limit),
        ("unknown_devices_are_refused_with_the_choice", || {
            let unknown = VulkanOptions { device: Some("no such".into()), ..Default::default() };
            let error = VulkanRaycaster::new(unknown).err().expect("no such device").to_string();
            assert!(error.contains("there are: 0: "), "{error}");
            Ok(())
        }),
    ];
    let mut trials: Vec<Trial> =
        tests.into_iter().map(|(name, run)| Trial::test(name, run).with_ignored_flag(none)).collect();
    // If the validation layer is missing, this test is reported as ignored, and the others run without it.
    trials.push(
        Trial::test("validation_layer_was_heard", validation_layer_was_heard)
            .with_ignored_flag(none || !validation),
    );
    libtest_mimic::run(&arguments, trials).exit();
}
