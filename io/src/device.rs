//! Choice of the renderer by a command.

use crate::files::note;
use anyhow::{Context, Result};
use clap::ValueEnum;
use entire_vk_raycaster::{CpuRaycaster, Renderer, VulkanOptions, VulkanRaycaster};

/// Choice of the renderer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Device {
    /// Vulkan where there is a device, else the CPU version of the raycaster.
    #[default]
    Auto,
    /// The Vulkan raycaster.
    Vulkan,
    /// The CPU version of the raycaster: same pictures, with sample counts.
    Cpu,
}

/// True where a processor renders: frame times are then those of the host.
pub fn is_software(renderer: &dyn Renderer) -> bool {
    renderer.backend() == "cpu" || is_software_device(&renderer.device())
}

/// True for the name of a Vulkan device that is the processor.
pub fn is_software_device(name: &str) -> bool {
    let name = name.to_ascii_lowercase();
    ["llvmpipe", "lavapipe", "swiftshader"].iter().any(|s| name.contains(s))
}

/// Opens a renderer; the environment chooses among Vulkan devices (see [`VulkanOptions::from_env`]). A note
/// on standard error says when the CPU version is used instead.
///
/// # Errors
/// When Vulkan or one of its devices was requested and there is none; names the way to get a driver. For a
/// variable of the environment that cannot be read.
pub fn open(device: Device) -> Result<Box<dyn Renderer>> {
    if device == Device::Cpu {
        return Ok(Box::new(CpuRaycaster::new()));
    }
    // What the environment asks for is not replaced by something else.
    let options = VulkanOptions::from_env()?;
    let named = options.device.is_some();
    match VulkanRaycaster::new(options) {
        Ok(renderer) => Ok(Box::new(renderer)),
        Err(error) if device == Device::Auto && !named => {
            note(&format!("{error}; the CPU version renders instead"));
            Ok(Box::new(CpuRaycaster::new()))
        }
        Err(error) => Err(error).context("cannot open a Vulkan device (--device cpu needs none)"),
    }
}
