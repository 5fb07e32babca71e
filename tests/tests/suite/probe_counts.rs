//! Compares the estimates of the coarse ray probe with the exact counts of the CPU raycaster, on the volumes
//! in `data/`.

use entire_core::scene::{Camera, DEFAULT_FOV_Y_DEGREES, Frame, Shading, Skipping, TransferFunction};
use entire_io::scenes::SceneDistribution;
use entire_io::volume::Volume;
use entire_steer::features::{
    FrameFeatures, PROBE_SIDE, SceneQuantity, Setting, TransferSummary, VolumeSummary,
};
use entire_vk_raycaster::{CpuRaycaster, Renderer};
use std::path::{Path, PathBuf};

/// Upper bound of the median of |estimate / count − 1| over random scenes without single scattering.
const MEDIAN_TOLERANCE: f64 = 0.1;

/// The same bound with single scattering, where one shadow ray per probe ray represents all shadow rays.
const SCATTER_TOLERANCE: f64 = 0.15;

/// Returns the volumes in `data/` and one volume of each folder under it.
fn shipped() -> Vec<PathBuf> {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../data");
    let volumes = |folder: &Path| {
        let entries = std::fs::read_dir(folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
        let mut found: Vec<PathBuf> = entries.map(|e| e.expect("a directory entry").path()).collect();
        found.sort();
        found
    };
    let mut found = Vec::new();
    let is_volume = |p: &PathBuf| p.extension().is_some_and(|e| e == "nrrd");
    for path in volumes(&data) {
        if path.is_dir() {
            // Of an ensemble, takes the last time step of the first member.
            let steps = volumes(&path).into_iter().filter(|p| p.is_dir()).flat_map(|p| volumes(&p));
            let mut steps = steps.filter(is_volume).collect::<Vec<_>>();
            let member = steps.first().and_then(|p| p.parent()).map(PathBuf::from);
            steps.retain(|p| p.parent() == member.as_deref());
            found.extend(steps.pop());
        } else if is_volume(&path) {
            found.push(path);
        }
    }
    assert!(found.len() >= 4, "fewer than four volumes under {}", data.display());
    found
}

#[test]
fn estimated_work_is_the_counted_work() {
    let steps = vec![1.0, 2.0, 4.0];
    let distribution = SceneDistribution { max_size: 72, steps, ..SceneDistribution::default() };
    for (shading, skipping, parallel) in [
        (Shading::None, Skipping::None, false),
        (Shading::Local, Skipping::Blocks, false),
        (Shading::None, Skipping::Distance, false),
        (Shading::Scatter, Skipping::Blocks, false),
        (Shading::LocalScatter, Skipping::Blocks, false),
        (Shading::None, Skipping::None, true),
        (Shading::Local, Skipping::Blocks, true),
        (Shading::None, Skipping::Distance, true),
        (Shading::Scatter, Skipping::Blocks, true),
    ] {
        let mut errors: [Vec<f64>; 4] = Default::default();
        for path in &shipped() {
            let volume = Volume::open(path).expect("a shipped volume");
            let view = volume.view();
            let summary = VolumeSummary::new(&view).expect("a summary");
            let mut renderer = CpuRaycaster::new();
            renderer.set_volume(&view).expect("the volume");
            for index in 0..6 {
                let scene = distribution.draw(5, volume.name(), index);
                let table = TransferFunction::Gaussian(scene.lobes.clone()).to_table().expect("a table");
                renderer.set_transfer(&table).expect("the transfer function");
                let mut camera = Camera::from_arcball(scene.camera).expect("a camera");
                if parallel {
                    // At the volume's center, the parallel camera shows the same height as the perspective
                    // camera.
                    let scale = scene.camera.dz * (0.5 * DEFAULT_FOV_Y_DEGREES.to_radians()).tan();
                    camera = camera.with_parallel_scale(scale).expect("a scale");
                }
                let frame = Frame {
                    shading,
                    skipping,
                    ..Frame::new(camera, scene.width, scene.height)
                        .and_then(|f| Frame { step: scene.step, ..f }.checked())
                        .expect("a frame")
                };
                let counts = renderer.render(&frame).expect("a picture").counts.expect("counts");
                let mut transfer = TransferSummary::new(&summary, &table).expect("a summary");
                let features =
                    FrameFeatures::of(&summary, &mut transfer, &frame, PROBE_SIDE).expect("a frame");
                let of = features.quantities(Setting::from(&frame));
                let samples = of(SceneQuantity::Samples) + of(SceneQuantity::ShadowSamples);
                let shaded = of(SceneQuantity::LocalSamples).max(of(SceneQuantity::ScatterSamples));
                let pairs = [
                    (of(SceneQuantity::Rays), counts.rays),
                    (samples, counts.samples),
                    (of(SceneQuantity::Skips), counts.skips),
                    (shaded, counts.shaded),
                ];
                for (errors, (estimate, count)) in errors.iter_mut().zip(pairs) {
                    // A count of less than half an event per ray is negligible.
                    if count * 2 > counts.rays {
                        errors.push((estimate / count as f64 - 1.0).abs());
                    }
                }
            }
        }
        for (name, errors) in ["rays", "samples", "skips", "shaded"].iter().zip(&mut errors) {
            // Skips of shadow rays are estimated roughly: they cost little compared with the rays' samples.
            let rough = *name == "skips" && shading.scatters();
            if errors.len() >= 6 && !rough {
                // Of an even number of errors, the bound applies to the larger of the two middle ones.
                errors.sort_by(f64::total_cmp);
                let m = errors[errors.len() / 2];
                let tolerance = if shading.scatters() { SCATTER_TOLERANCE } else { MEDIAN_TOLERANCE };
                assert!(
                    m < tolerance,
                    "{shading:?} {skipping:?}, parallel {parallel}: median error of {name} is {m}"
                );
            }
        }
        assert!(errors[1].len() >= 12, "too few scenes with work");
    }
}
