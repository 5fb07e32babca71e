//! Loader, instance, device, queue and allocator.

use super::VulkanOptions;
use crate::error::{Error, Result};
use crate::renderer::DeviceLimits;
use ash::vk;
use gpu_allocator::vulkan::{Allocator, AllocatorCreateDesc};
use std::ffi::{CStr, c_char, c_void};
use std::mem::ManuallyDrop;
use std::ops::Deref;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

const VALIDATION_LAYER: &CStr = c"VK_LAYER_KHRONOS_validation";

/// Time limit of a submission on a GPU, after which the device counts as hanging: 30 s. A submission is one
/// tile or one copy of 64 MiB. A working device stays far below the limit: tiles shrink after a tile has
/// taken half a second, and drivers reset a GPU that does not answer for 2 to 10 s.
const LONGEST_WAIT: Duration = Duration::from_secs(30);

/// Time limit of a submission on a software device (llvmpipe, SwiftShader): 30 min. The largest tile takes
/// minutes on such a device, and more on a loaded host; no driver stops it.
const LONGEST_WAIT_SOFTWARE: Duration = Duration::from_secs(30 * 60);

/// Function that returns a device with some Vulkan functions replaced by those of a test.
pub(crate) type WrapDevice<'a> = &'a dyn Fn(ash::Device) -> ash::Device;

/// Seconds from one timestamp to a later one; the counter may have wrapped once in between. The clock is
/// [`DeviceLimits::timestamps`].
pub(crate) fn seconds_between((valid_bits, period): (u32, f64), begin: u64, end: u64) -> f64 {
    let mask = if valid_bits >= 64 { u64::MAX } else { (1 << valid_bits) - 1 };
    let ticks = end.wrapping_sub(begin) & mask;
    ticks as f64 * period * 1e-9
}

/// Messages of the validation layer.
#[derive(Default)]
struct Messages(Mutex<Vec<String>>);

/// An instance; with the messenger of the validation layer if this layer is enabled.
pub(crate) struct Instance {
    pub(crate) functions: ash::Instance,
    debug: Option<(ash::ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    messages: Arc<Messages>,
    /// Keeps the loader's library open.
    pub(crate) entry: ash::Entry,
}

/// An open device. All objects made from the device hold an `Arc` of this value, so the device is freed last.
pub(crate) struct Gpu {
    pub(crate) instance: ManuallyDrop<Instance>,
    pub(crate) device: ash::Device,
    properties: Properties,
    /// Locked while work is submitted to the queue, or the queue presents an image.
    queue: Mutex<vk::Queue>,
    /// Number of threads among which the device splits a dispatch into runs of successive workgroups; 1 if it
    /// is no software device.
    pub(crate) threads: u32,
    /// Time limit of a submission.
    pub(crate) longest_wait: Duration,
    /// True if a call has returned `VK_ERROR_DEVICE_LOST`: nothing runs on the device, and nothing can be
    /// submitted.
    lost: AtomicBool,
    /// True if a submission was still running when its engine was dropped: resources that the device may
    /// still use are never freed.
    abandoned: AtomicBool,
    /// Number of engines whose submission has exceeded its time limit and was not seen to end.
    pub(crate) hanging: AtomicUsize,
    pub(crate) allocator: ManuallyDrop<Mutex<Allocator>>,
}

/// Returns the error of a failed Vulkan call, with the remedy. `device` is the name of the open device, if
/// any.
fn call_failed(call: &str, result: vk::Result, device: Option<&str>) -> Error {
    let remedy = match result {
        vk::Result::ERROR_OUT_OF_DEVICE_MEMORY => {
            "the device's memory is full: use a smaller volume or image, or close other programs that use \
             the device"
        }
        vk::Result::ERROR_OUT_OF_HOST_MEMORY => {
            "the host's memory is full: use a smaller volume or image, or close other programs"
        }
        vk::Result::ERROR_DEVICE_LOST => {
            "the driver lost the device, often because one dispatch ran too long: make a new renderer, \
             with smaller tiles (ENTIRE_TILE) or a coarser step"
        }
        vk::Result::ERROR_INCOMPATIBLE_DRIVER | vk::Result::ERROR_INITIALIZATION_FAILED => {
            "no working Vulkan driver was found: install one (Debian and Ubuntu: mesa-vulkan-drivers, \
             which also has the software device llvmpipe), or render on the CPU"
        }
        vk::Result::ERROR_LAYER_NOT_PRESENT => {
            "install the validation layer (Debian and Ubuntu: vulkan-validationlayers) or switch \
             validation off (ENTIRE_VALIDATION=0)"
        }
        vk::Result::ERROR_EXTENSION_NOT_PRESENT => {
            "the driver cannot show pictures in windows: install one that can (Debian and Ubuntu: \
             mesa-vulkan-drivers), choose another device (ENTIRE_DEVICE), or use a command without a window"
        }
        _ => "update the graphics driver, choose another device (ENTIRE_DEVICE), or render on the CPU",
    };
    let on = device.map(|name| format!(" on {name}")).unwrap_or_default();
    Error::new(format!("{call} failed with {result:?}{on}; {remedy}"))
}

/// Names the Vulkan call of an error.
pub(crate) trait NamedCall<T> {
    fn named(self, call: &str) -> Result<T>;

    /// Adds the names of the Vulkan call and of its device to an error. The device is marked lost if the call
    /// returns `VK_ERROR_DEVICE_LOST`.
    fn on(self, gpu: &Gpu, call: &str) -> Result<T>;
}

impl<T> NamedCall<T> for ash::prelude::VkResult<T> {
    fn named(self, call: &str) -> Result<T> {
        self.map_err(|r| call_failed(call, r, None))
    }

    fn on(self, gpu: &Gpu, call: &str) -> Result<T> {
        self.map_err(|r| gpu.error(call, r))
    }
}

impl Gpu {
    /// Opens a device. `wrap` may replace its functions.
    pub(crate) fn open(options: &VulkanOptions, wrap: WrapDevice<'_>) -> Result<Self> {
        // SAFETY: the loaded library is the system's Vulkan loader, whose initializers are safe to run.
        let entry = unsafe { ash::Entry::load() }.map_err(|e| {
            Error::new(format!(
                "the Vulkan loader could not be opened ({e}); install it with a driver (Debian and Ubuntu: \
                 libvulkan1 mesa-vulkan-drivers), or render on the CPU"
            ))
        })?;
        let messages = Arc::<Messages>::default();
        let functions = create_instance(&entry, options, &messages)?;
        let mut instance = Instance { functions, debug: None, messages, entry };
        if options.validation {
            let loader = ash::ext::debug_utils::Instance::new(&instance.entry, &instance.functions);
            let info = messenger_info(&instance.messages);
            // SAFETY: the instance was made with VK_EXT_debug_utils, and `messages`, to which `info` points,
            // outlives the messenger.
            let messenger = unsafe { loader.create_debug_utils_messenger(&info, None) }
                .named("vkCreateDebugUtilsMessengerEXT")?;
            instance.debug = Some((loader, messenger));
        }

        let properties = choose_device(&instance.functions, options)?;
        let presents = !options.surface_extensions.is_empty();
        let device = wrap(create_device(&instance.functions, &properties, presents)?);
        let allocator = Allocator::new(&AllocatorCreateDesc {
            instance: instance.functions.clone(),
            device: device.clone(),
            physical_device: properties.physical,
            debug_settings: Default::default(),
            buffer_device_address: false,
            allocation_sizes: Default::default(),
        });
        let allocator = allocator.map_err(|e| {
            // SAFETY: the device was made above, nothing was made from it, and it is not used afterwards.
            unsafe { device.destroy_device(None) };
            Error::new(format!("the device's memory allocator could not start: {e}"))
        })?;
        // SAFETY: the device was made with one queue of this family.
        let queue = unsafe { device.get_device_queue(properties.family, 0) };
        let is_software = properties.is_software;
        Ok(Self {
            instance: ManuallyDrop::new(instance),
            device,
            properties,
            queue: Mutex::new(queue),
            threads: if is_software { software_threads() } else { 1 },
            longest_wait: options.longest_wait.unwrap_or(if is_software {
                LONGEST_WAIT_SOFTWARE
            } else {
                LONGEST_WAIT
            }),
            lost: AtomicBool::new(false),
            abandoned: AtomicBool::new(false),
            hanging: AtomicUsize::new(0),
            allocator: ManuallyDrop::new(Mutex::new(allocator)),
        })
    }

    /// Warnings and errors of the validation layer so far.
    pub(crate) fn messages(&self) -> Vec<String> {
        self.instance.messages.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The queue, locked during the lifetime of the guard.
    pub(crate) fn queue(&self) -> MutexGuard<'_, vk::Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the error of a call on the device. The device is marked lost for `VK_ERROR_DEVICE_LOST`.
    pub(crate) fn error(&self, call: &str, result: vk::Result) -> Error {
        if result == vk::Result::ERROR_DEVICE_LOST {
            self.lost.store(true, Ordering::Relaxed);
        }
        call_failed(call, result, Some(&self.name))
    }

    /// Refuses a device that is lost.
    pub(crate) fn check(&self) -> Result<()> {
        if self.is_lost() {
            return Err(Error::new(format!(
                "the device {} was lost in an earlier call and renders nothing more: make a new renderer",
                self.name
            )));
        }
        Ok(())
    }

    /// True if a call has returned `VK_ERROR_DEVICE_LOST`.
    pub(crate) fn is_lost(&self) -> bool {
        self.lost.load(Ordering::Relaxed)
    }

    /// True if a submission was still running when its engine was dropped, so that it may still use the
    /// device's resources.
    pub(crate) fn is_abandoned(&self) -> bool {
        self.abandoned.load(Ordering::Relaxed)
    }

    /// True if a submission has exceeded its time limit and was not seen to end: a wait for the queue, which
    /// has no time limit, might never return. False for a lost device, which uses nothing.
    pub(crate) fn is_hanging(&self) -> bool {
        self.hanging.load(Ordering::Relaxed) > 0 && !self.is_lost()
    }

    /// Marks the device as abandoned: everything made from it is leaked until the process ends.
    pub(crate) fn abandon(&self) {
        self.abandoned.store(true, Ordering::Relaxed);
    }

    /// Returns two flags: true if optimally tiled images of a format can be copied to and sampled, and true
    /// if they can be sampled with a linear filter.
    pub(crate) fn sampling(&self, format: vk::Format) -> (bool, bool) {
        // SAFETY: the physical device was enumerated from this instance.
        let properties =
            unsafe { self.instance.functions.get_physical_device_format_properties(self.physical, format) };
        let found = properties.optimal_tiling_features;
        (
            found.contains(vk::FormatFeatureFlags::SAMPLED_IMAGE | vk::FormatFeatureFlags::TRANSFER_DST),
            found.contains(vk::FormatFeatureFlags::SAMPLED_IMAGE_FILTER_LINEAR),
        )
    }
}

/// Number of threads of the software device llvmpipe: `LP_NUM_THREADS`, which Mesa reads, else one per
/// processor.
fn software_threads() -> u32 {
    /// Largest number of threads that llvmpipe starts.
    const MAX_THREADS: usize = 32;
    let asked = std::env::var("LP_NUM_THREADS").ok().and_then(|n| n.trim().parse::<usize>().ok());
    let all = || std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    asked.unwrap_or_else(all).clamp(1, MAX_THREADS) as u32
}

impl Drop for Gpu {
    fn drop(&mut self) {
        if self.is_abandoned() {
            return;
        }
        // SAFETY: everything made from the device holds an `Arc` of this value and is destroyed. All
        // submissions were waited for, or the device is lost and runs nothing. The calls destroy each object
        // once: allocator, device, and then the instance.
        unsafe {
            ManuallyDrop::drop(&mut self.allocator);
            self.device.destroy_device(None);
            ManuallyDrop::drop(&mut self.instance);
        }
    }
}

impl Drop for Instance {
    fn drop(&mut self) {
        // SAFETY: the device of this instance is destroyed, if it was made. The messenger and the instance
        // are destroyed once; the library is closed after them.
        unsafe {
            if let Some((loader, messenger)) = &self.debug {
                loader.destroy_debug_utils_messenger(*messenger, None);
            }
            self.functions.destroy_instance(None);
        }
    }
}

fn messenger_info(messages: &Arc<Messages>) -> vk::DebugUtilsMessengerCreateInfoEXT<'_> {
    vk::DebugUtilsMessengerCreateInfoEXT::default()
        .message_severity(
            vk::DebugUtilsMessageSeverityFlagsEXT::ERROR | vk::DebugUtilsMessageSeverityFlagsEXT::WARNING,
        )
        .message_type(
            vk::DebugUtilsMessageTypeFlagsEXT::GENERAL
                | vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION
                | vk::DebugUtilsMessageTypeFlagsEXT::PERFORMANCE,
        )
        .pfn_user_callback(Some(on_message))
        .user_data(Arc::as_ptr(messages).cast_mut().cast())
}

unsafe extern "system" fn on_message(
    _severity: vk::DebugUtilsMessageSeverityFlagsEXT,
    _kind: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    user: *mut c_void,
) -> vk::Bool32 {
    // SAFETY: `user` points to the `Messages` given at creation, which outlives the messenger; threads share
    // it and change it only under its lock. `data` and its text are valid during the call.
    unsafe {
        if let (Some(messages), Some(data)) = (user.cast::<Messages>().as_ref(), data.as_ref()) {
            let text = data.message_as_c_str().map(CStr::to_string_lossy).unwrap_or_default();
            messages.0.lock().unwrap_or_else(PoisonError::into_inner).push(text.into_owned());
        }
    }
    vk::FALSE
}

fn create_instance(
    entry: &ash::Entry,
    options: &VulkanOptions,
    messages: &Arc<Messages>,
) -> Result<ash::Instance> {
    let validation = options.validation;
    // SAFETY: the loader's library is loaded, and the query needs nothing else.
    let version = unsafe { entry.try_enumerate_instance_version() }
        .named("vkEnumerateInstanceVersion")?
        .unwrap_or(vk::API_VERSION_1_0);
    if version < vk::API_VERSION_1_1 {
        return Err(Error::new(
            "the Vulkan loader is of version 1.0, at least 1.1 is needed; update it (Debian and Ubuntu: \
             libvulkan1), or render on the CPU",
        ));
    }
    let application = vk::ApplicationInfo::default()
        .application_name(c"entire")
        .engine_name(c"entire-vk-raycaster")
        .api_version(vk::API_VERSION_1_1);
    let layers = if validation { vec![VALIDATION_LAYER.as_ptr()] } else { vec![] };
    let mut extensions: Vec<*const c_char> = options.surface_extensions.iter().map(|e| e.as_ptr()).collect();
    if validation {
        extensions
            .extend([ash::ext::debug_utils::NAME.as_ptr(), ash::ext::validation_features::NAME.as_ptr()]);
    }
    let enabled = [vk::ValidationFeatureEnableEXT::SYNCHRONIZATION_VALIDATION];
    let mut features = vk::ValidationFeaturesEXT::default().enabled_validation_features(&enabled);
    // This messenger also receives the layer's messages about creation and destruction of the instance
    // itself.
    let mut messenger = messenger_info(messages);
    let mut info = vk::InstanceCreateInfo::default()
        .application_info(&application)
        .enabled_layer_names(&layers)
        .enabled_extension_names(&extensions);
    if validation {
        info = info.push_next(&mut features).push_next(&mut messenger);
    }
    // SAFETY: all pointers in `info` live until the call returns.
    unsafe { entry.create_instance(&info, None) }.named("vkCreateInstance")
}

pub(crate) struct Properties {
    pub(crate) physical: vk::PhysicalDevice,
    kind: vk::PhysicalDeviceType,
    pub(crate) family: u32,
    pub(crate) limits: vk::PhysicalDeviceLimits,
    /// True if compute shaders may compute minima and maxima over a subgroup.
    pub(crate) subgroup_arithmetic: bool,
    /// The properties that users of the renderer see.
    pub(crate) reported: DeviceLimits,
}

impl Deref for Gpu {
    type Target = Properties;

    fn deref(&self) -> &Properties {
        &self.properties
    }
}

impl Deref for Properties {
    type Target = DeviceLimits;

    fn deref(&self) -> &DeviceLimits {
        &self.reported
    }
}

/// Returns the device that the options name, otherwise the first device of the best kind.
fn choose_device(instance: &ash::Instance, options: &VulkanOptions) -> Result<Properties> {
    let wanted = options.device.as_deref();
    let presents = !options.surface_extensions.is_empty();
    // SAFETY: the instance is alive.
    let all = unsafe { instance.enumerate_physical_devices() }.named("vkEnumeratePhysicalDevices")?;
    let mut usable: Vec<(usize, Properties)> = all
        .iter()
        .enumerate()
        .filter_map(|(i, &physical)| Some((i, describe_device(instance, physical, presents)?)))
        .collect();
    let names = usable.iter().map(|(i, d)| format!("{i}: {}", d.name)).collect::<Vec<_>>().join(", ");
    if usable.is_empty() {
        return Err(Error::new(
            "no Vulkan 1.1 device with a compute queue was found; install a driver (Debian and Ubuntu: \
             mesa-vulkan-drivers, which also has the software device llvmpipe), or render on the CPU",
        ));
    }
    let position = match wanted {
        None => (0..usable.len()).min_by_key(|&p| rank(usable[p].1.kind)),
        Some(wanted) => {
            let lower = wanted.to_lowercase();
            let index = wanted.parse::<usize>().ok();
            usable
                .iter()
                .position(|(i, _)| Some(*i) == index)
                // A number below 64 counts as an index only: as text, it would match version numbers in
                // names.
                .or_else(|| match index {
                    Some(0..64) => None,
                    _ => usable.iter().position(|(_, d)| d.name.to_lowercase().contains(&lower)),
                })
        }
    };
    match position {
        Some(p) => Ok(usable.swap_remove(p).1),
        None => Err(Error::new(format!(
            "no Vulkan device has {:?} as its index or in its name; there are: {names}",
            wanted.unwrap_or_default()
        ))),
    }
}

fn rank(kind: vk::PhysicalDeviceType) -> u32 {
    match kind {
        vk::PhysicalDeviceType::DISCRETE_GPU => 0,
        vk::PhysicalDeviceType::INTEGRATED_GPU => 1,
        vk::PhysicalDeviceType::VIRTUAL_GPU => 2,
        vk::PhysicalDeviceType::CPU => 3,
        _ => 4,
    }
}

/// Returns the properties of a device, or `None` if it cannot run compute shaders under Vulkan 1.1 or, if
/// `presents` is true, cannot draw.
fn describe_device(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    presents: bool,
) -> Option<Properties> {
    // SAFETY: `physical` was enumerated from `instance`.
    let (core, families) = unsafe {
        (
            instance.get_physical_device_properties(physical),
            instance.get_physical_device_queue_family_properties(physical),
        )
    };
    let version = core.api_version;
    if version < vk::API_VERSION_1_1 {
        return None;
    }
    let needed =
        if presents { vk::QueueFlags::COMPUTE | vk::QueueFlags::GRAPHICS } else { vk::QueueFlags::COMPUTE };
    let family = families.iter().position(|f| f.queue_flags.contains(needed))?;
    let mut maintenance = vk::PhysicalDeviceMaintenance3Properties::default();
    let mut driver = vk::PhysicalDeviceDriverProperties::default();
    let mut subgroup = vk::PhysicalDeviceSubgroupProperties::default();
    let mut properties =
        vk::PhysicalDeviceProperties2::default().push_next(&mut maintenance).push_next(&mut subgroup);
    let has_driver_properties = version >= vk::API_VERSION_1_2;
    if has_driver_properties {
        properties = properties.push_next(&mut driver);
    }
    // SAFETY: `physical` was enumerated from `instance`. The chained structures are part of the device's
    // Vulkan version.
    unsafe { instance.get_physical_device_properties2(physical, &mut properties) };
    // SAFETY: `physical` was enumerated from `instance`.
    let memory = unsafe { instance.get_physical_device_memory_properties(physical) };
    let heaps = memory.memory_heaps_as_slice();
    let heaps: Vec<_> =
        heaps.iter().filter(|h| h.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL)).collect();
    let limits = core.limits;
    let valid_bits = families[family].timestamp_valid_bits;
    let period = f64::from(limits.timestamp_period);
    let text = |c: Option<&CStr>| c.map(|c| c.to_string_lossy().into_owned()).unwrap_or_default();
    let driver = if has_driver_properties {
        let (name, info) =
            (text(driver.driver_name_as_c_str().ok()), text(driver.driver_info_as_c_str().ok()));
        format!("{name} {info}").trim().to_owned()
    } else {
        format!("driver version {:#x}", core.driver_version)
    };
    Some(Properties {
        physical,
        kind: core.device_type,
        family: u32::try_from(family).ok()?,
        limits,
        subgroup_arithmetic: subgroup.supported_stages.contains(vk::ShaderStageFlags::COMPUTE)
            && subgroup.supported_operations.contains(vk::SubgroupFeatureFlags::ARITHMETIC),
        reported: DeviceLimits {
            name: text(core.device_name_as_c_str().ok()),
            driver,
            api_version: format!("{}.{}.{}", version >> 22 & 0x7f, version >> 12 & 0x3ff, version & 0xfff),
            is_software: core.device_type == vk::PhysicalDeviceType::CPU,
            max_image_3d: limits.max_image_dimension3_d,
            max_storage_buffer: u64::from(limits.max_storage_buffer_range),
            max_allocation: maintenance.max_memory_allocation_size,
            memory: heaps.iter().map(|h| h.size).max().unwrap_or(0),
            subgroup_size: subgroup.subgroup_size,
            timestamps: (valid_bits > 0 && period > 0.0).then_some((valid_bits, period)),
        },
    })
}

fn create_device(instance: &ash::Instance, chosen: &Properties, presents: bool) -> Result<ash::Device> {
    let priorities = [1.0];
    let queues = [vk::DeviceQueueCreateInfo::default()
        .queue_family_index(chosen.family)
        .queue_priorities(&priorities)];
    let extensions = if presents { vec![ash::khr::swapchain::NAME.as_ptr()] } else { vec![] };
    let info =
        vk::DeviceCreateInfo::default().queue_create_infos(&queues).enabled_extension_names(&extensions);
    // SAFETY: the queue family exists and has at least one queue; all pointers in `info` live until the call
    // returns.
    unsafe { instance.create_device(chosen.physical, &info, None) }.named("vkCreateDevice")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timestamps_are_masked_and_scaled() {
        let clock = (36, 52.08);
        assert!((seconds_between(clock, 1000, 3000) - 2000.0 * 52.08e-9).abs() < 1e-15);
        // The counter wrapped, and the bits above the valid ones are garbage.
        let begin = (0xabc << 36) | ((1 << 36) - 10);
        let end = (0xdef << 36) | 5;
        assert!((seconds_between(clock, begin, end) - 15.0 * 52.08e-9).abs() < 1e-15);
        assert_eq!(seconds_between((64, 1.0), u64::MAX, 9), 10e-9);
    }

    #[test]
    fn errors_name_the_call_the_result_and_the_remedy() {
        let text = call_failed("vkQueueSubmit", vk::Result::ERROR_DEVICE_LOST, Some("a GPU")).to_string();
        assert!(
            text.contains("vkQueueSubmit")
                && text.contains("ERROR_DEVICE_LOST on a GPU")
                && text.contains("ENTIRE_TILE")
        );
        let text = call_failed("vkCreateInstance", vk::Result::ERROR_LAYER_NOT_PRESENT, None).to_string();
        assert!(text.contains("vulkan-validationlayers"));
    }

    #[test]
    fn real_devices_come_first() {
        use vk::PhysicalDeviceType as T;
        let order = [T::DISCRETE_GPU, T::INTEGRATED_GPU, T::VIRTUAL_GPU, T::CPU, T::OTHER];
        assert!(order.windows(2).all(|w| rank(w[0]) < rank(w[1])));
    }
}
