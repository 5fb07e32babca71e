//! A render loop that holds a frame budget from its first frames on, without any model file: the session
//! starts from default costs and learns from the times it observes.
//!
//! ```text
//! cargo run --release -p entire-examples --bin steered_loop
//! ```

use entire_core::scene::{
    Arcball, Camera, Frame, GaussianLobe, Scalars, Skipping, TransferFunction, VolumeOptions, VolumeView,
};
use entire_steer::control::ObserveFlags;
use entire_steer::control::{Session, StepLimits};
use entire_steer::features::VolumeSummary;
use entire_vk_raycaster::{CpuRaycaster, Renderer};
use std::error::Error;

const DIMS: [usize; 3] = [96, 80, 64];
const FRAMES: usize = 60;
/// The frame at which the transfer function changes abruptly.
const SWITCH: usize = 30;

fn main() -> Result<(), Box<dyn Error>> {
    let voxels = nested_shells();
    let volume = VolumeView::with(
        Scalars::U8(&voxels),
        DIMS,
        VolumeOptions { spacing: [1.0, 1.0, 1.5], ..VolumeOptions::default() },
    )?;
    let thin = TransferFunction::Gaussian(vec![GaussianLobe { center: 0.5, width: 0.05, height: 0.01 }]);
    let dense = TransferFunction::Gaussian(vec![GaussianLobe { center: 0.8, width: 0.01, height: 0.9 }]);

    let mut renderer = CpuRaycaster::new();
    renderer.set_volume(&volume)?;
    let mut session = Session::default();
    session.set_volume(VolumeSummary::new(&volume)?, None);
    session.set_limits(StepLimits { finest: 0.5, coarsest: 8.0 })?;

    // The budget is two thirds of the time of the first view at the reference step.
    renderer.set_transfer(&thin.to_table()?)?;
    renderer.render(&frame_at(0)?)?;
    let target = renderer.render(&frame_at(0)?)?.time.seconds() * 0.66;
    println!("budget {:.1} ms\n", target * 1e3);
    println!("frame  step  predicted ms  measured ms  reason");

    let mut over = 0;
    for i in 0..FRAMES {
        if i == 0 || i == SWITCH {
            let table = if i < SWITCH { thin.to_table()? } else { dense.to_table()? };
            renderer.set_transfer(&table)?;
            session.set_transfer(&table, None)?;
        }
        let frame = frame_at(i)?;
        let plan = session.plan(&frame, target as f32)?;
        let seconds = renderer.render(&Frame { step: plan.step, ..frame })?.time.seconds();
        session.observe(plan.id, seconds as f32, ObserveFlags::default())?;
        over += usize::from(seconds > 1.25 * target);
        println!(
            "{i:5}  {:4.2}  {:12.2}  {:11.2}  {}",
            plan.step,
            plan.seconds * 1e3,
            seconds * 1e3,
            plan.reason
        );
    }
    println!("\n{over} of {FRAMES} frames took more than 1.25 times the budget");
    Ok(())
}

/// Returns frame `i` of a slow orbit, at the reference step. The caller replaces this step by the plan's.
fn frame_at(i: usize) -> Result<Frame, entire_core::Error> {
    let camera = Camera::from_arcball(Arcball { rx: 20.0, ry: 3.0 * i as f32, dz: 2.4 })?;
    Ok(Frame { skipping: Skipping::Blocks, ..Frame::new(camera, 160, 120)? })
}

/// Returns the voxels of shells around the center; values rise towards the center.
fn nested_shells() -> Vec<u8> {
    let [nx, ny, nz] = DIMS;
    let mut voxels = Vec::with_capacity(nx * ny * nz);
    let unit = |i: usize, n: usize| 2.0 * (i as f32 + 0.5) / n as f32 - 1.0;
    for z in 0..nz {
        for y in 0..ny {
            for x in 0..nx {
                let r = (unit(x, nx).powi(2) + unit(y, ny).powi(2) + unit(z, nz).powi(2)).sqrt();
                let ripple = 0.5 + 0.5 * (24.0 * r).cos();
                voxels.push((255.0 * ((1.0 - r).max(0.0) * (0.4 + 0.6 * ripple))) as u8);
            }
        }
    }
    voxels
}
