//! Compares the coarse ray probe's estimated work with the counts of the CPU version of the reference
//! raycaster.
//!
//! ```text
//! cargo run --release -p entire-tests --example probe_accuracy -- [--frames N] [--max-size N] VOLUME…
//! ```
//!
//! Draws random scenes as `entire collect` does (seed 1), for every volume with steps 1, 2 and 4, and prints
//! for each shading mode the median and 90th percentile of |estimate / count − 1| and the median of estimate
//! / count, over the frames in which the counted work is not negligible. With `WORST` in the environment it
//! also prints, for each volume, the frame whose samples were estimated worst.

use entire_core::scene::{Camera, Frame, Shading, Skipping, TransferFunction};
use entire_io::scenes::SceneDistribution;
use entire_io::volume::Volume;
use entire_steer::features::{FrameFeatures, SceneQuantity, Setting, TransferSummary, VolumeSummary};
use entire_vk_raycaster::{CpuRaycaster, Renderer};

fn main() {
    let mut frames = 24;
    let mut max_size = 160;
    let mut volumes = Vec::new();
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        let mut number = || args.next().and_then(|v| v.parse().ok()).expect("a number");
        match arg.as_str() {
            "--frames" => frames = number(),
            "--max-size" => max_size = number(),
            _ => volumes.push(arg),
        }
    }
    assert!(!volumes.is_empty(), "give at least one volume file");
    let distribution = SceneDistribution {
        min_size: 32.min(max_size as u32),
        max_size: max_size as u32,
        steps: vec![1.0, 2.0, 4.0],
        ..SceneDistribution::default()
    };
    let names = ["rays", "samples", "skips", "shaded"];
    for (shading, skipping) in [
        (Shading::None, Skipping::None),
        (Shading::None, Skipping::Blocks),
        (Shading::None, Skipping::Distance),
        (Shading::Local, Skipping::Blocks),
        (Shading::Scatter, Skipping::Blocks),
    ] {
        let mut ratios: [Vec<f64>; 4] = Default::default();
        for path in &volumes {
            let volume = Volume::open(path).unwrap_or_else(|e| panic!("{e:#}"));
            let view = volume.view();
            let summary = VolumeSummary::new(&view).expect("a summary");
            let mut renderer = CpuRaycaster::new();
            renderer.set_volume(&view).expect("the volume");
            let mut worst = (0.0, String::new());
            for index in 0..frames {
                let scene = distribution.draw(1, path, index as u64);
                let table = TransferFunction::Gaussian(scene.lobes.clone()).to_table().expect("a table");
                renderer.set_transfer(&table).expect("the transfer function");
                let frame = Frame {
                    shading,
                    skipping,
                    ..Frame::new(
                        Camera::from_arcball(scene.camera).expect("a camera"),
                        scene.width,
                        scene.height,
                    )
                    .and_then(|f| Frame { step: scene.step, ..f }.checked())
                    .expect("a frame")
                };
                let counts = renderer.render(&frame).expect("a picture").counts.expect("counts");
                let mut transfer = TransferSummary::new(&summary, &table).expect("a summary");
                transfer.prepare_distance();
                let mut features = FrameFeatures::default();
                features.measure(&summary, &mut transfer, &frame).expect("a frame");
                let of = features.quantities(Setting::from(&frame));
                let terminated = of(SceneQuantity::TerminatedShare);
                let occupied = of(SceneQuantity::OccupiedShare);
                let samples = of(SceneQuantity::Samples) + of(SceneQuantity::ShadowSamples);
                let shaded = of(SceneQuantity::LocalSamples) + of(SceneQuantity::ScatterSamples);
                // The CPU version counts shadow samples with the primary ones.
                let pairs = [
                    (of(SceneQuantity::Rays), counts.rays as f64),
                    (samples, counts.samples as f64),
                    (of(SceneQuantity::Skips), counts.skips as f64),
                    (shaded, counts.shaded as f64),
                ];
                for (k, (estimate, count)) in pairs.into_iter().enumerate() {
                    // A count of less than a tenth of an event per ray is negligible.
                    if count > 0.1 * counts.rays as f64 {
                        ratios[k].push(estimate / count);
                        let off = (estimate / count).ln().abs();
                        if k == 1 && off > worst.0 {
                            worst = (
                                off,
                                format!(
                                    "frame {index} estimate {estimate:.0} count {count:.0} rays {} \
                                     terminated {:.2} occupied {:.3} step {} {:?}",
                                    counts.rays, terminated, occupied, scene.step, scene.lobes
                                ),
                            );
                        }
                    }
                }
            }
            if std::env::var_os("WORST").is_some() {
                println!("  {path}: x{:.2} {}", f64::exp(worst.0), worst.1);
            }
        }
        println!("{shading} / {skipping}");
        for (name, ratios) in names.iter().zip(&mut ratios) {
            if ratios.is_empty() {
                continue;
            }
            ratios.sort_by(f64::total_cmp);
            let mut errors: Vec<f64> = ratios.iter().map(|r| (r - 1.0).abs()).collect();
            errors.sort_by(f64::total_cmp);
            let at = |v: &[f64], q: f64| v[((v.len() - 1) as f64 * q) as usize];
            println!(
                "  {name:8} n {:4}  median error {:5.1} %  p90 {:5.1} %  bias {:+5.1} %",
                ratios.len(),
                100.0 * at(&errors, 0.5),
                100.0 * at(&errors, 0.9),
                100.0 * (at(ratios, 0.5) - 1.0)
            );
        }
    }
}
