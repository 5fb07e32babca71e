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
    /// The CPU version of the raycaster, which draws the same pictures and counts their samples.
    Cpu,
}

/// True if the renderer runs on the CPU: the CPU raycaster, or a Vulkan driver in software.
pub fn is_software(renderer: &dyn Renderer) -> bool {
    names_software(renderer.backend(), &renderer.device())
}

/// True if a renderer with this backend and this device runs on the CPU (see [`is_software`]).
pub fn names_software(backend: &str, device: &str) -> bool {
    let device = device.to_ascii_lowercase();
    backend == "cpu" || ["llvmpipe", "lavapipe", "swiftshader"].iter().any(|s| device.contains(s))
}

/// Opens a renderer; the environment chooses among Vulkan devices (see [`VulkanOptions::from_env`]). If
/// [`Device::Auto`] finds no Vulkan device, the CPU version is opened, and a note on standard error says so.
///
/// # Errors
/// When Vulkan or one of its devices was requested and there is none; the error says how to get a driver.
/// When an environment variable has an invalid value.
pub fn open(device: Device) -> Result<Box<dyn Renderer>> {
    if device == Device::Cpu {
        return Ok(Box::new(CpuRaycaster::new()));
    }
    // If the environment names a device, the CPU version does not replace it.
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
