//! What features, predictions and plans cost, on one core: the median and the 99th percentile of many calls.
//!
//! ```text
//! cargo bench -p entire-core --bench predict
//! ```

use entire_core::scene::{
    Arcball, Camera, Frame, GaussianLobe, Scalars, Shading, Skipping, TransferFunction, TransferTable,
    VolumeView,
};
use entire_steer::control::ObserveFlags;
use entire_steer::control::Session;
use entire_steer::features::{
    Changes, FrameFeatures, Setting, SummaryOptions, TransferSummary, VolumeSummary,
};
use entire_steer::predict::{AnalyticModel, Inputs, Predictor};
use std::hint::black_box;
use std::time::Instant;

fn report(name: &str, calls: usize, mut call: impl FnMut(usize)) {
    for i in 0..calls / 10 + 1 {
        call(i);
    }
    let mut times: Vec<f64> = (0..calls)
        .map(|i| {
            let start = Instant::now();
            call(i);
            start.elapsed().as_secs_f64()
        })
        .collect();
    times.sort_by(f64::total_cmp);
    println!("{name:58} {:10.2} us   p99 {:10.2} us", 1e6 * times[calls / 2], 1e6 * times[calls * 99 / 100]);
}

fn blobs(n: usize) -> Vec<u8> {
    let mut out = Vec::with_capacity(n * n * n);
    for z in 0..n {
        for y in 0..n {
            for x in 0..n {
                let [a, b, c] = [x, y, z].map(|i| (i as f32 + 0.5) / n as f32);
                let v = (9.0 * a).sin() * (11.0 * b).sin() * (7.0 * c).sin();
                out.push((127.5 + 127.5 * v) as u8);
            }
        }
    }
    out
}

fn table(center: f32, height: f32) -> TransferTable {
    let lobe = GaussianLobe { center, width: 0.004, height };
    TransferFunction::Gaussian(vec![lobe]).to_table().expect("a table")
}

fn frame(i: usize) -> Frame {
    let pose = Arcball { rx: 20.0, ry: i as f32, dz: 1.6 };
    Frame::new(Camera::from_arcball(pose).expect("a camera"), 1024, 768).expect("a frame")
}

fn main() {
    for n in [128, 256] {
        let data = blobs(n);
        let view = VolumeView::new(Scalars::U8(&data), [n; 3]).expect("a volume");
        println!("volume {n}^3");
        report("volume summary, once per volume", 5, |_| {
            black_box(VolumeSummary::new(&view, SummaryOptions::default()).expect("a summary"));
        });
        let volume = VolumeSummary::new(&view, SummaryOptions::default()).expect("a summary");
        let tables = [table(0.9, 0.02), table(0.5, 0.02), table(0.7, 0.9)];
        for (name, t) in ["sparse", "thin everywhere", "opaque"].iter().zip(&tables) {
            let mut transfer = TransferSummary::new(&volume, t).expect("a summary");
            report(&format!("{name}: transfer summary, once per edit"), 200, |_| {
                transfer.update(&volume, black_box(t)).expect("a summary")
            });
            let mut features = FrameFeatures::default();
            report(&format!("{name}: frame features (probe), once per frame"), 2000, |i| {
                features.measure(&volume, &mut transfer, black_box(&frame(i))).expect("a frame");
            });
            report(&format!("{name}: frame features with scattering"), 2000, |i| {
                features
                    .measure(
                        &volume,
                        &mut transfer,
                        black_box(&Frame { shading: Shading::Scatter, ..frame(i) }),
                    )
                    .expect("a frame");
            });
            report(&format!("{name}: distance map, once per edit where used"), 50, |_| {
                transfer.update(&volume, t).expect("a summary");
                transfer.prepare_distance();
            });
            report(&format!("{name}: frame features with distance map"), 2000, |i| {
                features
                    .measure(
                        &volume,
                        &mut transfer,
                        black_box(&Frame { skipping: Skipping::Distance, ..frame(i) }),
                    )
                    .expect("a frame");
            });
            let mut model = AnalyticModel::default();
            let setting = Setting::from(&frame(0));
            let inputs = Inputs {
                features: &features,
                setting,
                changes: Changes::default(),
                camera: frame(0).camera.to_arcball(),
                volume_features: None,
                lobes: None,
            };
            report(&format!("{name}: 100 further steps evaluated"), 1000, |i| {
                for k in 0..100 {
                    let s = Setting { step: 1.0 + 0.1 * k as f32 + 1e-4 * i as f32, ..setting };
                    black_box(model.terms(&Inputs { setting: s, ..inputs }).expect("a prediction"));
                }
            });
        }
        let mut session = Session::untrained();
        session.set_volume(volume, None);
        session.set_transfer(&tables[1], None).expect("a volume is set");
        report("session: plan and observe", 2000, |i| {
            let plan = session.plan(&frame(i), 0.02).expect("a plan");
            black_box(
                session.observe(plan.id, 0.019 + 1e-5 * (i % 7) as f32, ObserveFlags::default()).is_ok(),
            );
        });
    }
}
