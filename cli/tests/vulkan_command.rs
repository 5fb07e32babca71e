//! `entire render` and `entire probe` on Vulkan. Without a Vulkan device, the tests are reported as ignored.

mod support;

use entire_vk_raycaster::{Renderer, VulkanOptions, VulkanRaycaster};
use libtest_mimic::{Arguments, Failed, Trial};
use support::*;

const RENDER: &str = "render ball.nrrd --camera 20,35,2.5 --tf 0.3,0.02,0.4,0.9,0.01,0.8 --out out.png";

/// Checks the same frame on Vulkan and on the CPU version: pictures and numbers of samples agree.
fn agrees_with_the_twin() -> Result<(), Failed> {
    let folder = workshop();
    let at = folder.path();
    let mut seen = Vec::new();
    for device in ["vulkan", "cpu"] {
        let line = format!("{RENDER} --size 40x30 --shade local --repeats 2 --json --device {device}");
        let json: serde_json::Value = serde_json::from_str(&succeeds(at, &words(&line)))?;
        assert_eq!(json["backend"], device);
        assert_eq!(json["seconds"].as_array().map(Vec::len), Some(2));
        seen.push((json["samples"].as_u64().ok_or("samples are not counted")?, picture(&at.join("out.png"))));
    }
    let [(vulkan_samples, vulkan), (twin_samples, twin)] = &seen[..] else { unreachable!() };
    assert!(vulkan_samples.abs_diff(*twin_samples) * 100 <= *twin_samples, "{vulkan_samples} {twin_samples}");
    let apart = vulkan.2.iter().zip(&twin.2).map(|(a, b)| u64::from(a.abs_diff(*b))).sum::<u64>();
    assert!(apart <= vulkan.2.len() as u64, "{apart} over {} numbers", vulkan.2.len());
    assert!(twin.2.iter().any(|&v| v > 50));
    Ok(())
}

/// Checks the probe's comparison with the CPU version, and the values that only a device has.
fn probe_describes_the_device() -> Result<(), Failed> {
    let folder = workshop();
    let json: serde_json::Value = serde_json::from_str(&probed(folder.path(), "vulkan", true))?;
    assert_eq!(json["backend"], "vulkan");
    assert!(json["limits"]["max_image_3d"].as_u64() >= Some(256));
    assert!(json["agreement"]["counts"]["samples"].as_u64() > Some(1000));
    let timed = json["limits"]["timestamp_period_ns"].as_f64().is_some();
    assert_eq!(json["clock"], if timed { "device" } else { "wall" });
    assert_eq!(json["timestamps"].is_object(), timed);
    assert!(json["numbers"].as_object().is_some_and(|n| n.values().all(|v| v.as_f64() > Some(0.0))));
    Ok(())
}

/// Checks a device that exceeds its time limit: one line, status 1, and the process ends while the device
/// works.
fn a_hanging_device_ends_in_one_line() -> Result<(), Failed> {
    let folder = workshop();
    let line = format!("{RENDER} --size 1024x1024 --shade scatter --step 0.05 --device vulkan");
    let device = VulkanRaycaster::new(VulkanOptions::from_env()?)?;
    let name = device.limits().ok_or("a device has limits")?.name;
    let parts = ["counts as hanging", "ENTIRE_DEVICE_WAIT", "ENTIRE_TILE", &name];
    refuses_in(folder.path(), &[("ENTIRE_DEVICE_WAIT", "0.001")], &words(&line), &parts);
    assert!(!folder.path().join("out.png").exists());
    Ok(())
}

fn main() {
    let arguments = Arguments::from_args();
    let missing = VulkanRaycaster::new(VulkanOptions::default()).err();
    if let Some(error) = &missing {
        eprintln!("No Vulkan device, these tests are ignored: {error}");
    }
    type Test = fn() -> Result<(), Failed>;
    let tests: [(&str, Test); 3] = [
        ("a_hanging_device_ends_in_one_line", a_hanging_device_ends_in_one_line),
        ("agrees_with_the_twin", agrees_with_the_twin),
        ("probe_describes_the_device", probe_describes_the_device),
    ];
    let trials = tests.map(|(name, run)| Trial::test(name, run).with_ignored_flag(missing.is_some())).into();
    libtest_mimic::run(&arguments, trials).exit();
}
