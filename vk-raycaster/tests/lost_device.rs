//! Checks that a device that is lost or hangs gives an error, never a panic or an endless wait, and that a
//! new renderer can be opened; and that a slow device gets smaller tiles. The device is a real device whose
//! functions fail from a given call on, or report long times. Without a Vulkan device every test is reported
//! as ignored.

mod common;

use ash::vk;
use common::{frame, medium, set_field};
use entire_core::scene::{Frame, Shading};
use entire_vk_raycaster::{Image, Picture, Region, Renderer, VulkanOptions, VulkanRaycaster};
use libtest_mimic::{Arguments, Failed, Trial};
use std::cell::{Cell, RefCell};
use std::time::Duration;

type Outcome = Result<(), Failed>;

/// Fault of a thread's device, and the number of calls or waits after which it occurs.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Fault {
    Sound,
    /// This many calls succeed; every later call returns `VK_ERROR_DEVICE_LOST`.
    Lost(usize),
    /// This many waits for fences succeed; every later one returns `VK_TIMEOUT`.
    Hangs(usize),
    /// Every dispatch takes [`SLOW_TICKS`] by the device's timestamps.
    Slow,
}

/// Ticks of a slow dispatch: more than half a second, if a tick is longer than 0.06 ns.
const SLOW_TICKS: u64 = 1 << 33;

/// Time limit of a submission in these tests. A wait that the mock lets fail returns at once.
const WAIT: Duration = Duration::from_secs(20);

thread_local! {
    static FAULT: Cell<Fault> = const { Cell::new(Fault::Sound) };
    /// Number of calls that can fail, and how many of these calls wait for fences.
    static CALLS: Cell<(usize, usize)> = const { Cell::new((0, 0)) };
    /// Time limits of the waits for fences, nanoseconds.
    static WAITS: RefCell<Vec<u64>> = const { RefCell::new(Vec::new()) };
    static DESTROYED: Cell<usize> = const { Cell::new(0) };
    /// Number of waits for the queue.
    static IDLED: Cell<usize> = const { Cell::new(0) };
    static DEVICE: RefCell<Option<ash::Device>> = const { RefCell::new(None) };
}

/// Sets the fault and resets the counters.
fn set(fault: Fault) {
    FAULT.set(fault);
    CALLS.set((0, 0));
    DESTROYED.set(0);
    IDLED.set(0);
    WAITS.take();
}

/// The function of the real device that the mock replaces.
macro_rules! own {
    ($name:ident) => {
        DEVICE.with_borrow(|d| d.as_ref().expect("a wrapped device").fp_v1_0().$name)
    };
}

/// Waits until the device behind the mock is idle.
fn settle() {
    let _ = DEVICE.with_borrow(|d| {
        // SAFETY: the device is alive while its renderer is, and only this thread uses its queue.
        d.as_ref().map(|d| unsafe { d.device_wait_idle() })
    });
}

/// Counts a call, and returns the result that replaces the device's result if the fault occurs.
fn fault(waits: bool) -> Option<vk::Result> {
    let (calls, waited) = CALLS.get();
    CALLS.set((calls + 1, waited + usize::from(waits)));
    match FAULT.get() {
        Fault::Lost(after) if calls >= after => {
            // A lost device runs nothing, so the call waits for the real device first.
            settle();
            Some(vk::Result::ERROR_DEVICE_LOST)
        }
        Fault::Hangs(after) if waits && waited >= after => Some(vk::Result::TIMEOUT),
        _ => None,
    }
}

unsafe extern "system" fn wait_for_fences(
    device: vk::Device,
    count: u32,
    fences: *const vk::Fence,
    all: vk::Bool32,
    timeout: u64,
) -> vk::Result {
    WAITS.with_borrow_mut(|w| w.push(timeout));
    // SAFETY: the caller guarantees valid arguments, and the device's own function gets them unchanged.
    fault(true).unwrap_or_else(|| unsafe { own!(wait_for_fences)(device, count, fences, all, timeout) })
}

unsafe extern "system" fn get_query_pool_results(
    device: vk::Device,
    pool: vk::QueryPool,
    first: u32,
    count: u32,
    size: usize,
    out: *mut std::ffi::c_void,
    stride: vk::DeviceSize,
    flags: vk::QueryResultFlags,
) -> vk::Result {
    let result = fault(false).unwrap_or_else(|| {
        // SAFETY: the caller guarantees valid arguments, and the device's own function gets them unchanged.
        unsafe { own!(get_query_pool_results)(device, pool, first, count, size, out, stride, flags) }
    });
    if FAULT.get() == Fault::Slow && result == vk::Result::SUCCESS {
        let ticks = out.cast::<u64>();
        assert!(count == 2 && size == 16, "two timestamps of 64 bits are read");
        // SAFETY: the caller guarantees that `out` holds the `size` bytes that the assertion has checked.
        unsafe { ticks.add(1).write_unaligned(ticks.read_unaligned().wrapping_add(SLOW_TICKS)) };
    }
    result
}

unsafe extern "system" fn device_wait_idle(_: vk::Device) -> vk::Result {
    // This wait has no time limit, so no renderer may use it.
    vk::Result::ERROR_UNKNOWN
}

unsafe extern "system" fn queue_wait_idle(queue: vk::Queue) -> vk::Result {
    IDLED.set(IDLED.get() + 1);
    // SAFETY: the caller guarantees a valid queue, and the device's own function gets it unchanged.
    unsafe { own!(queue_wait_idle)(queue) }
}

unsafe extern "system" fn destroy_device(device: vk::Device, host: *const vk::AllocationCallbacks<'_>) {
    DESTROYED.set(DESTROYED.get() + 1);
    // SAFETY: the caller guarantees valid arguments, and the device's own function gets them unchanged.
    unsafe { own!(destroy_device)(device, host) };
}

macro_rules! faulty {
    ($($name:ident($($argument:ident: $kind:ty),*);)*) => {
        $(
            unsafe extern "system" fn $name($($argument: $kind),*) -> vk::Result {
                // SAFETY: the caller guarantees valid arguments, and the device's own function gets them
                // unchanged.
                fault(false).unwrap_or_else(|| unsafe { own!($name)($($argument),*) })
            }
        )*

        /// Replaces the device's functions by those above.
        fn wrap(device: ash::Device) -> ash::Device {
            let mut functions = device.fp_v1_0().clone();
            $(functions.$name = $name;)*
            functions.wait_for_fences = wait_for_fences;
            functions.get_query_pool_results = get_query_pool_results;
            functions.device_wait_idle = device_wait_idle;
            functions.queue_wait_idle = queue_wait_idle;
            functions.destroy_device = destroy_device;
            let (f1, f2, f3) = (device.fp_v1_1().clone(), device.fp_v1_2().clone(), device.fp_v1_3().clone());
            let wrapped = ash::Device::from_parts_1_3(device.handle(), functions, f1, f2, f3);
            DEVICE.set(Some(device));
            wrapped
        }
    };
}

type Host<'a> = *const vk::AllocationCallbacks<'a>;

faulty! {
    queue_submit(q: vk::Queue, n: u32, s: *const vk::SubmitInfo<'_>, f: vk::Fence);
    reset_fences(d: vk::Device, n: u32, f: *const vk::Fence);
    create_fence(d: vk::Device, i: *const vk::FenceCreateInfo<'_>, a: Host<'_>, out: *mut vk::Fence);
    create_buffer(d: vk::Device, i: *const vk::BufferCreateInfo<'_>, a: Host<'_>, out: *mut vk::Buffer);
    bind_buffer_memory(d: vk::Device, b: vk::Buffer, m: vk::DeviceMemory, at: vk::DeviceSize);
    create_image(d: vk::Device, i: *const vk::ImageCreateInfo<'_>, a: Host<'_>, out: *mut vk::Image);
    bind_image_memory(d: vk::Device, b: vk::Image, m: vk::DeviceMemory, at: vk::DeviceSize);
    create_image_view(d: vk::Device, i: *const vk::ImageViewCreateInfo<'_>, a: Host<'_>, out: *mut vk::ImageView);
    allocate_memory(d: vk::Device, i: *const vk::MemoryAllocateInfo<'_>, a: Host<'_>, out: *mut vk::DeviceMemory);
    create_sampler(d: vk::Device, i: *const vk::SamplerCreateInfo<'_>, a: Host<'_>, out: *mut vk::Sampler);
    create_query_pool(d: vk::Device, i: *const vk::QueryPoolCreateInfo<'_>, a: Host<'_>, out: *mut vk::QueryPool);
    create_descriptor_pool(
        d: vk::Device, i: *const vk::DescriptorPoolCreateInfo<'_>, a: Host<'_>, out: *mut vk::DescriptorPool
    );
    create_descriptor_set_layout(
        d: vk::Device, i: *const vk::DescriptorSetLayoutCreateInfo<'_>, a: Host<'_>,
        out: *mut vk::DescriptorSetLayout
    );
    allocate_descriptor_sets(
        d: vk::Device, i: *const vk::DescriptorSetAllocateInfo<'_>, out: *mut vk::DescriptorSet
    );
    create_pipeline_layout(
        d: vk::Device, i: *const vk::PipelineLayoutCreateInfo<'_>, a: Host<'_>, out: *mut vk::PipelineLayout
    );
    create_shader_module(
        d: vk::Device, i: *const vk::ShaderModuleCreateInfo<'_>, a: Host<'_>, out: *mut vk::ShaderModule
    );
    create_compute_pipelines(
        d: vk::Device, c: vk::PipelineCache, n: u32, i: *const vk::ComputePipelineCreateInfo<'_>, a: Host<'_>,
        out: *mut vk::Pipeline
    );
    create_command_pool(
        d: vk::Device, i: *const vk::CommandPoolCreateInfo<'_>, a: Host<'_>, out: *mut vk::CommandPool
    );
    allocate_command_buffers(
        d: vk::Device, i: *const vk::CommandBufferAllocateInfo<'_>, out: *mut vk::CommandBuffer
    );
    reset_command_pool(d: vk::Device, p: vk::CommandPool, flags: vk::CommandPoolResetFlags);
    begin_command_buffer(c: vk::CommandBuffer, i: *const vk::CommandBufferBeginInfo<'_>);
    end_command_buffer(c: vk::CommandBuffer);
}

fn options() -> Result<VulkanOptions, Failed> {
    Ok(VulkanOptions { longest_wait: Some(WAIT), ..VulkanOptions::from_env()? })
}

fn open_with(options: VulkanOptions) -> entire_vk_raycaster::Result<VulkanRaycaster> {
    // SAFETY: each function of `wrap` passes its arguments to the device's own function or returns an error.
    unsafe { VulkanRaycaster::with_device_functions(options, &wrap) }
}

fn open() -> Result<VulkanRaycaster, Failed> {
    Ok(open_with(options()?)?)
}

fn small_frame() -> Frame {
    frame(20.0, 35.0, 2.5, 19, 13)
}

/// Sets volume and transfer function of a renderer, and draws a frame twice. Returns the picture.
fn use_it(gpu: &mut VulkanRaycaster) -> entire_vk_raycaster::Result<Image> {
    set_field(gpu, [9, 8, 7], &medium())?;
    let [first, second] = [gpu.render(&small_frame())?, gpu.render(&small_frame())?];
    assert_eq!(first.image, second.image);
    Ok(second.image)
}

/// Returns the numbers of calls and waits of a device without faults, and its picture.
fn sound() -> Result<(usize, usize, Image), Failed> {
    set(Fault::Sound);
    let mut gpu = open()?;
    let image = use_it(&mut gpu)?;
    let (calls, waits) = CALLS.get();
    drop(gpu);
    assert_eq!(DESTROYED.get(), 1, "an idle device is freed");
    Ok((calls, waits, image))
}

fn new_renderer_draws(image: &Image) -> Outcome {
    set(Fault::Sound);
    assert_eq!(&use_it(&mut open()?)?, image, "a new renderer draws the same");
    Ok(())
}

/// In each repeat, the device is lost one call later, beginning with the first call that opens the device.
/// Checks the errors, and that the device is freed.
fn a_device_lost_in_any_call_is_an_error_that_names_it() -> Outcome {
    let (calls, _, image) = sound()?;
    assert!(calls > 50, "{calls} calls");
    for after in 0..calls {
        set(Fault::Lost(after));
        let mut gpu = match open_with(options()?) {
            Ok(gpu) => gpu,
            Err(error) => {
                assert!(error.to_string().contains("ERROR_DEVICE_LOST"), "call {after}: {error}");
                assert_eq!(DESTROYED.get(), 1, "call {after}");
                continue;
            }
        };
        let name = gpu.limits().expect("a device").name;
        let error = use_it(&mut gpu).expect_err("the device is lost").to_string();
        assert!(error.contains("ERROR_DEVICE_LOST") && error.contains(&name), "call {after}: {error}");
        // Later calls fail, too, and name the remedy.
        for error in
            [gpu.render(&small_frame()).err(), gpu.set_transfer(&medium()).err(), use_it(&mut gpu).err()]
        {
            let error = error.expect("the device is still lost").to_string();
            let told = error.contains("make a new renderer") || error.contains("nothing to render");
            assert!(told, "call {after}: {error}");
        }
        drop(gpu);
        assert_eq!(DESTROYED.get(), 1, "call {after}: a lost device is freed");
    }
    new_renderer_draws(&image)
}

/// In each repeat, the device hangs one wait later, beginning with the first wait. Checks that the device
/// is then only polled and never freed.
fn a_hanging_device_is_waited_for_once_and_left_alone() -> Outcome {
    let (_, waits, image) = sound()?;
    assert!(waits >= 4, "{waits} waits");
    for after in 0..waits {
        set(Fault::Hangs(after));
        let mut gpu = open()?;
        let name = gpu.limits().expect("a device").name;
        let hangs = |error: Option<entire_vk_raycaster::Error>| {
            let error = error.expect("the device hangs").to_string();
            let said = ["within 20 s", "ENTIRE_TILE", "ENTIRE_DEVICE_WAIT", &name];
            assert!(said.iter().all(|part| error.contains(part)), "wait {after}: {error}");
        };
        hangs(use_it(&mut gpu).err());
        hangs(gpu.set_transfer(&medium()).err());
        drop(gpu);
        let allowed = WAITS.take();
        let long = allowed.iter().filter(|&&ns| ns > 0).count();
        assert!(allowed.iter().all(|&ns| ns == 0 || u128::from(ns) == WAIT.as_nanos()), "{allowed:?}");
        assert_eq!(long, after + 1, "after the first timeout the device is only polled: {allowed:?}");
        assert_eq!(DESTROYED.get(), 0, "what a hanging device may still use stays");
    }
    new_renderer_draws(&image)
}

/// Checks that dropping a picture waits for the queue of a working device, but not for the queue of a hanging
/// device: a wait for a queue has no time limit.
fn a_picture_of_a_hanging_device_is_left_alone() -> Outcome {
    for (fault, waits) in [(Fault::Sound, 1), (Fault::Hangs(0), 0)] {
        set(Fault::Sound);
        let mut gpu = open()?;
        set_field(&mut gpu, [9, 8, 7], &medium())?;
        let mut picture = Picture::new(&gpu.shared_device(), 19, 13)?;
        set(fault);
        let drawn = gpu.render_to(&small_frame(), Region::whole(&small_frame()), &mut picture);
        assert_eq!(drawn.is_ok(), fault == Fault::Sound);
        drop(picture);
        assert_eq!(IDLED.get(), waits, "{fault:?}");
        settle();
    }
    Ok(())
}

fn a_device_that_answers_again_renders_again() -> Outcome {
    let (_, waits, image) = sound()?;
    set(Fault::Hangs(waits - 1));
    let mut gpu = open()?;
    use_it(&mut gpu).expect_err("the last frame hangs");
    settle();
    set(Fault::Sound);
    assert_eq!(gpu.render(&small_frame())?.image, image);
    assert_eq!(use_it(&mut gpu)?, image);
    drop(gpu);
    assert_eq!(DESTROYED.get(), 1);
    Ok(())
}

/// Checks, without the mock, that a frame that exceeds the time limit is given up while the device works on
/// it.
fn a_frame_that_takes_too_long_is_given_up_while_it_runs() -> Outcome {
    let options = VulkanOptions { longest_wait: Some(Duration::from_nanos(1)), ..VulkanOptions::from_env()? };
    let mut gpu = VulkanRaycaster::new(options)?;
    // A small copy may finish before it is waited for; the frame does not.
    let large =
        Frame { step: 0.25, shading: Shading::Scatter, ..frame(20.0, 35.0, 2.5, 512, 512) }.checked()?;
    let error = set_field(&mut gpu, [48; 3], &medium())
        .and_then(|()| gpu.render(&large))
        .expect_err("nothing is done within a nanosecond");
    assert!(error.to_string().contains("counts as hanging"), "{error}");
    drop(gpu);
    let mut fresh = VulkanRaycaster::new(VulkanOptions::from_env()?)?;
    use_it(&mut fresh)?;
    Ok(())
}

/// Checks that slow dispatches halve the tile edge once per frame, not once per tile, down to 64 pixels. The
/// first dispatch of a shader does not count, since the driver compiles the shader in it.
fn slow_frames_halve_the_tiles_once_each() -> Outcome {
    set(Fault::Slow);
    let mut gpu = open_with(VulkanOptions { tile: Some(256), ..options()? })?;
    set_field(&mut gpu, [9, 8, 7], &medium())?;
    let wide = frame(20.0, 35.0, 2.5, 1024, 4);
    gpu.render(&small_frame())?;
    for edge in [256, 128, 64, 64] {
        WAITS.take();
        gpu.render(&wide)?;
        // The renderer waits once for each tile.
        assert_eq!(WAITS.take().len(), 1024 / edge, "{edge}");
    }
    Ok(())
}

fn main() {
    let arguments = Arguments::from_args();
    let device = VulkanRaycaster::new(VulkanOptions::from_env().unwrap_or_default());
    let none = device.is_err();
    if let Err(error) = &device {
        eprintln!("No Vulkan device, these tests are ignored: {error}");
    }
    let timed = device.as_ref().is_ok_and(VulkanRaycaster::has_timestamps);
    drop(device);
    /// Trials named as their functions; each is ignored if the value after its name is true.
    macro_rules! trials {
        ($($name:ident: $ignored:expr),* $(,)?) => {
            vec![$(Trial::test(stringify!($name), $name).with_ignored_flag($ignored)),*]
        };
    }
    let trials = trials![
        a_device_lost_in_any_call_is_an_error_that_names_it: none,
        a_hanging_device_is_waited_for_once_and_left_alone: none,
        a_picture_of_a_hanging_device_is_left_alone: none,
        a_device_that_answers_again_renders_again: none,
        a_frame_that_takes_too_long_is_given_up_while_it_runs: none,
        slow_frames_halve_the_tiles_once_each: !timed,
    ];
    libtest_mimic::run(&arguments, trials).exit();
}
