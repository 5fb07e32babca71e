//! Tests that the calls of a render loop never allocate: otherwise the test's allocator aborts the process.

use assert_no_alloc::{AllocDisabler, assert_no_alloc};
use entire_core::model::{GroupKind, ModelFile};
use entire_core::nn::{DenseParts, Dtype, PredNetParts, Target};
use entire_core::scene::{Arcball, Camera, Frame, Scalars, Shading, Skipping, TransferTable, VolumeView};
use entire_steer::control::{ObserveFlags, Session};
use entire_steer::features::{Setting, VolumeSummary};
use entire_steer::predict::{AnalyticModel, InputLayout, Predictor, load};

#[global_allocator]
static ALLOCATOR: AllocDisabler = AllocDisabler;

fn network() -> Box<dyn Predictor + Send> {
    let dense = |inputs: usize, outputs: usize| DenseParts {
        inputs,
        outputs,
        weight: (0..inputs * outputs).map(|i| 0.01 * (i % 7) as f32 - 0.03).collect(),
        bias: vec![-0.1; outputs],
        dtype: Dtype::F32,
    };
    let parts = PredNetParts {
        layers: vec![dense(7, 32), dense(32, 32), dense(32, 1)],
        input: None,
        output: None,
        target: Target::LogSeconds,
    };
    let features =
        ["log_samples", "log_pixels", "occupied_share"].map(|name| name.parse().expect("a feature"));
    let groups = [GroupKind::Camera, GroupKind::StepSize, GroupKind::SceneFeatures];
    let mut file = ModelFile::default();
    InputLayout::new(&groups, features.to_vec(), 0, 0)
        .and_then(|layout| layout.store(&parts, &mut file))
        .expect("a network that fits");
    load(&file.to_model().expect("a model")).expect("known inputs")
}

#[test]
fn plan_choose_predict_and_observe_never_allocate() {
    let voxels: Vec<u8> = (0..64 * 64 * 64u64).map(|i| (i * i / 977) as u8).collect();
    let view = VolumeView::new(Scalars::U8(&voxels), [64; 3]).expect("a volume");
    let volume = VolumeSummary::new(&view).expect("a summary");
    let tables = [0.0f32, 0.02, 0.9].map(|a| {
        TransferTable::new(core::array::from_fn(|i| [0.5, 0.5, 0.5, a * i as f32 / 255.0])).expect("a table")
    });
    let predictors: [Box<dyn Predictor + Send>; 2] = [Box::new(AnalyticModel::default()), network()];
    for predictor in predictors {
        let mut session = Session::new(predictor, Default::default()).expect("valid options");
        session.set_volume(volume.clone(), None);
        session.set_transfer(&tables[0], None).expect("a volume is set");
        #[cfg(feature = "calibrate")]
        session.record(None, 50).expect("a recording");
        for i in 0..200usize {
            let camera = Camera::from_arcball(Arcball { rx: 10.0, ry: i as f32, dz: 1.5 }).expect("a camera");
            let frame = Frame {
                shading: [Shading::None, Shading::Local, Shading::Scatter][i / 20 % 3],
                skipping: [Skipping::None, Skipping::Blocks, Skipping::Distance][i / 7 % 3],
                ..Frame::new(camera, 64 + i as u32 % 3, 64).expect("a frame")
            };
            let settings = [1.0, 2.0, 4.0].map(|step| Setting { step, ..Setting::from(&frame) });
            assert_no_alloc(|| {
                if i % 10 == 0 {
                    session.set_transfer(&tables[i / 10 % 3], None).expect("a volume is set");
                }
                let prediction = session.predict(&frame).expect("a prediction");
                assert!(prediction.seconds > 0.0);
                let plan = if i % 2 == 0 {
                    session.plan(&frame, 0.02).expect("a plan")
                } else {
                    session.choose(&frame, &settings, 0.02).expect("a choice").1
                };
                // The first observation is invalid, the second is accepted, and the third repeats the second.
                for (seconds, accepted) in [(f32::NAN, false), (0.01, true), (0.01, false)] {
                    let verdict = session.observe(plan.id, seconds, ObserveFlags::default());
                    assert!(verdict.is_ok() == accepted);
                }
            });
        }
        #[cfg(feature = "calibrate")]
        assert_eq!(session.recorded(), Some(50));
    }
}
