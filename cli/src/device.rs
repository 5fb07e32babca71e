//! Which renderer a command uses.

use anyhow::Result;
use clap::ValueEnum;
use entire_vk_raycaster::{CpuRaycaster, Renderer};

/// What renders.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Device {
    /// Vulkan where there is a device, else the CPU twin.
    #[default]
    Auto,
    /// The Vulkan raycaster.
    Vulkan,
    /// The CPU twin: same pictures, and it counts its samples.
    Cpu,
}

/// Opens a renderer. Falling back to the CPU twin is said on standard error.
///
/// # Errors
/// When Vulkan was asked for and there is none; says how to get a driver.
pub fn open(device: Device) -> Result<Box<dyn Renderer>> {
    match device {
        Device::Cpu => Ok(Box::new(CpuRaycaster::new())),
        Device::Vulkan | Device::Auto => {
            let missing = "the Vulkan raycaster is not part of this build";
            anyhow::ensure!(device == Device::Auto, "{missing}; use --device cpu");
            eprintln!("note: {missing}: the CPU twin renders");
            Ok(Box::new(CpuRaycaster::new()))
        }
    }
}
