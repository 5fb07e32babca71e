//! Tests that call the entry points as C does: raw pointers in, codes out. They are small enough for Miri,
//! which detects what C tests cannot: an access outside of a pointer's provenance, a race, a leak.

use crate::frame::{ENTIRE_SHADING_NONE, ENTIRE_SKIPPING_BLOCKS, entire_frame_init, entire_setting};
use crate::model::*;
use crate::result::entire_result::{self, *};
use crate::session::*;
use crate::transfer::*;
use crate::volume::*;
use std::mem::{MaybeUninit, size_of};
use std::path::Path;
use std::ptr::{null, null_mut};

/// Bytes of the small model that the C tests use.
fn toy() -> Vec<u8> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/golden/toy_model/toy.safetensors");
    std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

fn ok(result: entire_result) {
    assert_eq!(result, ENTIRE_OK);
}

/// The value that a call writes into its last argument.
fn made<T>(call: impl FnOnce(*mut *mut T) -> entire_result) -> *mut T {
    let mut out = null_mut();
    ok(call(&raw mut out));
    assert!(!out.is_null());
    out
}

/// A struct filled by its `_init`.
fn init<T>(call: unsafe extern "C" fn(*mut T, usize) -> entire_result) -> T {
    let mut value = MaybeUninit::uninit();
    // SAFETY: `value` has room for the struct, and the call writes the whole struct.
    unsafe {
        ok(call(value.as_mut_ptr(), size_of::<T>()));
        value.assume_init()
    }
}

fn volume(voxels: &[u8], ownership: entire_voxels_ownership) -> *mut entire_volume {
    let mut desc = init(entire_volume_desc_init);
    desc.scalar_type = ENTIRE_SCALAR_U8;
    desc.ownership = ownership;
    desc.voxels = voxels.as_ptr().cast();
    desc.voxel_count = voxels.len();
    desc.dims = [5, 7, 11];
    // SAFETY: `voxels` has the stated number of voxels. Where they are borrowed, they outlive the volume.
    made(|out| unsafe { entire_volume_new(&raw const desc, out) })
}

fn transfer_function() -> *mut entire_transfer_function {
    let lobe = entire_gaussian_lobe { center: 0.5, width: 0.05, height: 0.3 };
    // SAFETY: `lobe` is one lobe, as stated.
    made(|out| unsafe { entire_transfer_function_from_lobes(&raw const lobe, 1, out) })
}

/// Returns a session that has a volume and a transfer function. Both handles are freed before the return.
///
/// # Safety
/// `model` is NULL or live.
unsafe fn session_of(
    model: *const entire_model,
    voxels: &[u8],
    ownership: entire_voxels_ownership,
) -> *mut entire_session {
    let (volume, transfer) = (volume(voxels, ownership), transfer_function());
    // SAFETY: `model` is NULL or live as the caller guarantees, the other handles are live, and the output
    // has room for a handle.
    unsafe {
        let session = made(|out| entire_session_new(model, null(), out));
        ok(entire_session_set_volume(session, volume));
        ok(entire_session_set_transfer_function(session, transfer));
        entire_volume_free(volume);
        entire_transfer_function_free(transfer);
        session
    }
}

const SETTING: entire_setting = entire_setting {
    step: 1.0,
    width: 32,
    height: 32,
    shading: ENTIRE_SHADING_NONE,
    skipping: ENTIRE_SKIPPING_BLOCKS,
};
const SETTINGS: [entire_setting; 2] =
    [SETTING, entire_setting { step: 4.0, width: 16, height: 16, ..SETTING }];

/// One render loop: plans, choices, observations, a saved state.
///
/// # Safety
/// `model` is NULL or live.
unsafe fn render(model: *const entire_model, voxels: &[u8], frames: usize) {
    let mut frame = init(entire_frame_init);
    (frame.width, frame.height) = (32, 32);
    // SAFETY: every handle below is live and used by this thread alone, and every output has room for its
    // result.
    unsafe {
        let session = session_of(model, voxels, ENTIRE_VOXELS_BORROW);
        for i in 0..frames {
            frame.arcball[1] = 40.0 * i as f32;
            let mut plan: entire_plan = crate::abi::ByValue::defaults();
            let mut index = 99;
            if i % 3 == 2 {
                let (settings, count) = (SETTINGS.as_ptr(), SETTINGS.len());
                let (chosen, out) = (&raw mut index, &raw mut plan);
                ok(entire_session_choose(session, &raw const frame, settings, count, 0.02, chosen, out));
                assert!(index < 2);
            } else {
                ok(entire_session_plan(session, &raw const frame, 0.02, &raw mut plan));
            }
            assert!(plan.id != 0 && plan.step >= 1.0);
            let mut verdict = 99;
            ok(entire_session_observe(session, plan.id, 0.01 + 0.02 / plan.step, 0, &raw mut verdict));
            assert_eq!(
                entire_session_observe(session, plan.id, 0.01, 0, null_mut()),
                ENTIRE_REJECTED_OBSERVATION
            );
        }
        let mut prediction: entire_prediction = crate::abi::ByValue::defaults();
        ok(entire_session_predict(session, &raw const frame, &raw mut prediction));
        assert!(prediction.seconds > 0.0);
        let mut count = 0;
        ok(entire_session_save_state(session, null_mut(), 0, &raw mut count));
        let mut state = vec![0u8; count];
        ok(entire_session_save_state(session, state.as_mut_ptr(), count, &raw mut count));
        ok(entire_session_load_state(session, state.as_ptr(), count));
        assert_ne!(entire_session_load_state(session, state.as_ptr(), count - 1), ENTIRE_OK);
        ok(entire_session_withdraw(session, 1));
        ok(entire_session_reset(session));
        entire_session_free(session);
    }
}

#[test]
fn a_session_follows_a_volume_from_step_to_step() {
    let mut voxels: Vec<u8> = (0..5 * 7 * 11).map(|i| (i * 37 % 256) as u8).collect();
    let (borrowed, transfer) = (volume(&voxels, ENTIRE_VOXELS_BORROW), transfer_function());
    let mut desc = init(entire_volume_desc_init);
    (desc.scalar_type, desc.ownership) = (ENTIRE_SCALAR_U8, ENTIRE_VOXELS_BORROW);
    (desc.voxel_count, desc.dims) = (voxels.len(), [5, 7, 11]);
    let (first, size) = ([0, 0, 2usize], [5, 7, 1usize]);
    let mut frame = init(entire_frame_init);
    (frame.width, frame.height) = (32, 32);
    // SAFETY: every handle below is live and used by this thread alone, and every output has room for its
    // result. After the borrowed voxels were changed, they are passed to the library again.
    unsafe {
        let session = made(|out| entire_session_new(null(), null(), out));
        ok(entire_session_set_volume(session, borrowed));
        ok(entire_session_set_transfer_function(session, transfer));
        for step in 0..3 {
            voxels[70..105].fill(100 + 50 * step);
            desc.voxels = voxels.as_ptr().cast();
            if step == 0 {
                ok(entire_volume_update(borrowed, &raw const desc));
            } else {
                ok(entire_volume_update_box(borrowed, &raw const desc, first.as_ptr(), size.as_ptr()));
            }
            ok(entire_session_set_time_step(session, borrowed));
            let mut found: entire_prediction = crate::abi::ByValue::defaults();
            ok(entire_session_predict(session, &raw const frame, &raw mut found));
            let given = session_of(null(), &voxels, ENTIRE_VOXELS_COPY);
            let mut wanted: entire_prediction = crate::abi::ByValue::defaults();
            ok(entire_session_predict(given, &raw const frame, &raw mut wanted));
            assert_eq!(found.seconds, wanted.seconds);
            entire_session_free(given);
        }
        entire_session_free(session);
        entire_transfer_function_free(transfer);
        entire_volume_free(borrowed);
    }
}

#[test]
fn voxels_that_are_no_numbers_are_counted_in_a_scan() {
    const COUNT: usize = 5 * 7 * 11;
    let share = |volume: *const entire_volume| {
        let mut info: entire_volume_info = crate::abi::ByValue::defaults();
        // SAFETY: the volume is live, and `info` has room for the struct.
        ok(unsafe { entire_volume_describe(volume, &raw mut info) });
        info.non_finite_share
    };
    let of = |broken: usize| (broken as f64 / COUNT as f64) as f32;
    let mut voxels: Vec<f64> = (0..COUNT).map(|i| (i * 37 % 256) as f64).collect();
    // The last one is infinite as a 32-bit float.
    (voxels[3], voxels[90], voxels[200]) = (f64::NAN, f64::NEG_INFINITY, 1e300);
    let mut desc = init(entire_volume_desc_init);
    (desc.scalar_type, desc.voxels) = (ENTIRE_SCALAR_F64, voxels.as_ptr().cast());
    (desc.voxel_count, desc.dims) = (COUNT, [5, 7, 11]);
    let bounds = [0.0, 1.0f32];
    let mut bricks = init(entire_brick_desc_init);
    (bricks.scalar_type, bricks.dims, bricks.brick_edge) = (ENTIRE_SCALAR_F32, [8; 3], [8; 3]);
    (bricks.bounds, bricks.brick_count) = (bounds.as_ptr(), 1);
    // SAFETY: every handle below is live, every array has the stated length, and every output has room for
    // its result. After the voxels were changed, they are passed to the library again.
    unsafe {
        let floats = made(|out| entire_volume_new(&raw const desc, out));
        assert!(share(floats).is_nan());
        let session = made(|out| entire_session_new(null(), null(), out));
        ok(entire_session_set_volume(session, floats));
        assert_eq!(share(floats), of(3));
        for broken in [2, 1] {
            voxels[[90, 200][broken - 1]] = 7.0;
            desc.voxels = voxels.as_ptr().cast();
            ok(entire_volume_update(floats, &raw const desc));
            assert_eq!(share(floats), of(broken));
        }
        let bytes = volume(&[7; COUNT], ENTIRE_VOXELS_COPY);
        ok(entire_session_set_volume(session, bytes));
        assert_eq!(share(bytes), 0.0);
        let of_bricks = made(|out| entire_volume_from_bricks(&raw const bricks, out));
        assert!(share(of_bricks).is_nan());
        entire_session_free(session);
        for volume in [floats, bytes, of_bricks] {
            entire_volume_free(volume);
        }
    }
}

#[test]
fn a_session_makes_a_model_of_what_it_observes() {
    let voxels: Vec<u8> = (0..5 * 7 * 11).map(|i| (i * 37 % 256) as u8).collect();
    let mut frame = init(entire_frame_init);
    // SAFETY: every handle below is live and used by this thread alone, and every output has room for its
    // result.
    unsafe {
        let session = session_of(null(), &voxels, ENTIRE_VOXELS_COPY);
        let mut model = null_mut();
        assert_eq!(entire_session_calibrate(session, &raw mut model, null_mut()), ENTIRE_NOT_READY);
        assert!(model.is_null());
        ok(entire_session_record(session, null(), 10));
        for i in 0..13 {
            (frame.width, frame.height) = (16 + 8 * i, 16);
            let mut plan: entire_plan = crate::abi::ByValue::defaults();
            ok(entire_session_plan(session, &raw const frame, 0.02, &raw mut plan));
            ok(entire_session_observe(session, plan.id, 1e-3 * (1 + i) as f32, 0, null_mut()));
        }
        ok(entire_session_record_picture(session, 1, 1.0, 1.0, 0.1, 0.0));
        let mut q = [9f32; 4];
        let [a, b, c, d] = &mut q;
        ok(entire_session_quality(session, a, b, c, d));
        assert_eq!(q, [0.0; 4]);
        let mut count = 0;
        ok(entire_session_recorded_count(session, &raw mut count));
        assert_eq!(count, 10);
        let mut report: entire_calibration_report = crate::abi::ByValue::defaults();
        let model = made(|out| entire_session_calibrate(session, out, &raw mut report));
        assert_eq!((report.frames, report.held_out), (10, ENTIRE_HELD_OUT_NOTHING));
        ok(entire_session_set_model(session, model));
        ok(entire_session_record(session, model, 8));
        entire_model_free(model);
        entire_session_free(session);
    }
}

#[test]
fn a_saved_state_is_bound_to_the_renderer_and_the_clock() {
    let options = init(entire_session_options_init);
    let session_on = |renderer: &std::ffi::CStr, clock: &std::ffi::CStr| {
        // SAFETY: the output has room for a handle, the session is live, and the texts are C strings.
        unsafe {
            let session = made(|out| entire_session_new(null(), &raw const options, out));
            ok(entire_session_set_timing_source(session, renderer.as_ptr(), clock.as_ptr()));
            session
        }
    };
    let taken = |session: *mut entire_session, state: &[u8]| {
        // SAFETY: the session is live and is freed only here, and `state` has the stated number of bytes.
        unsafe {
            let code = entire_session_load_state(session, state.as_ptr(), state.len());
            entire_session_free(session);
            code
        }
    };
    let mut state = vec![0u8; 4096];
    // SAFETY: every handle below is live, every array has the stated length, and every output has room for
    // its result.
    unsafe {
        let session = session_on(c"a mapper", c"wall");
        let mut count = 0;
        ok(entire_session_save_state(session, state.as_mut_ptr(), state.len(), &raw mut count));
        state.truncate(count);
        let long = std::ffi::CString::new(vec![b'x'; 257]).unwrap();
        let name = c"x".as_ptr();
        for (renderer, clock) in [(long.as_ptr(), name), (name, long.as_ptr()), (c"\xff".as_ptr(), name)] {
            assert_eq!(entire_session_set_timing_source(session, renderer, clock), ENTIRE_INVALID_ARGUMENT);
        }
        assert_eq!(entire_session_set_timing_source(session, null(), name), ENTIRE_NULL_ARGUMENT);
        assert_eq!(entire_session_set_timing_source(session, name, null()), ENTIRE_NULL_ARGUMENT);
        let (mut model, mut own) = (ENTIRE_CLOCK_CPU, ENTIRE_CLOCK_CPU);
        ok(entire_session_clocks(session, &raw mut model, &raw mut own));
        assert_eq!((model, own), (ENTIRE_CLOCK_UNSTATED, ENTIRE_CLOCK_WALL));
        // The refused calls above have changed nothing.
        assert_eq!(taken(session, &state), ENTIRE_OK);
    }
    assert_eq!(taken(session_on(c"a mapper", c"wall"), &state), ENTIRE_OK);
    assert_eq!(taken(session_on(c"another mapper", c"wall"), &state), ENTIRE_UNSUPPORTED);
    assert_eq!(taken(session_on(c"a mapper", c"cpu"), &state), ENTIRE_UNSUPPORTED);
    assert_eq!(taken(session_on(c"", c""), &state), ENTIRE_UNSUPPORTED);
    state[20] ^= 1;
    assert_eq!(taken(session_on(c"a mapper", c"wall"), &state), ENTIRE_INVALID_ARGUMENT);
}

/// A model with the same answer for every frame: exp(`log_seconds`).
fn constant_model(log_seconds: f32) -> Vec<u8> {
    use entire_core::model::{InputGroup, ModelFile};
    use entire_core::nn::{DenseParts, Dtype, PredNetParts, Target};
    let layer = DenseParts {
        inputs: 3,
        outputs: 1,
        weight: vec![0.0; 3],
        bias: vec![log_seconds],
        dtype: Dtype::F32,
    };
    let parts = PredNetParts { layers: vec![layer], input: None, output: None, target: Target::LogSeconds };
    let mut file = ModelFile::default();
    file.set_prednet(&parts, &[InputGroup { name: "camera".into(), size: 3 }]).unwrap();
    file.to_bytes().unwrap()
}

#[test]
fn a_plan_that_is_refused_uses_no_id() {
    let voxels = [7u8; 5 * 7 * 11];
    // The prediction at the reference step is 9e8 s, which is accepted. At the finest step it is a multiple
    // of that, which is refused.
    let bytes = constant_model(9e8f32.ln());
    // SAFETY: every handle below is live, every array has the stated length, and every output has room for
    // its result.
    unsafe {
        let model = made(|out| entire_model_from_bytes(bytes.as_ptr(), bytes.len(), out));
        let session = session_of(model, &voxels, ENTIRE_VOXELS_COPY);
        entire_model_free(model);
        let mut frame = init(entire_frame_init);
        (frame.width, frame.height) = (32, 32);
        let mut plan: entire_plan = crate::abi::ByValue::defaults();
        let finest = entire_setting { step: 1.0 / 64.0, ..SETTING };
        let mut index = 99;
        ok(entire_session_set_limits(session, finest.step, finest.step));
        for _ in 0..3 {
            let code = entire_session_plan(session, &raw const frame, 0.02, &raw mut plan);
            assert_eq!((code, plan.id), (ENTIRE_INVALID_MODEL, 0));
            let (index, plan) = (&raw mut index, &raw mut plan);
            let code =
                entire_session_choose(session, &raw const frame, &raw const finest, 1, 0.02, index, plan);
            assert_eq!((code, (*plan).id, *index), (ENTIRE_INVALID_MODEL, 0, 99));
        }
        ok(entire_session_set_limits(session, 1.0, 1.0));
        ok(entire_session_plan(session, &raw const frame, 0.02, &raw mut plan));
        assert_eq!(plan.id, 1);
        ok(entire_session_observe(session, plan.id, 0.01, 0, null_mut()));
        entire_session_free(session);
    }
}

#[test]
fn a_model_is_described_and_predicts() {
    let bytes = toy();
    // SAFETY: every handle below is live, every array has the stated length, and every output has room for
    // its result.
    unsafe {
        let model = made(|out| entire_model_from_bytes(bytes.as_ptr(), bytes.len(), out));
        let mut info: entire_model_info = crate::abi::ByValue::defaults();
        ok(entire_model_describe(model, &raw mut info));
        let mut group: entire_input_group = crate::abi::ByValue::defaults();
        ok(entire_model_input_group(model, 1, &raw mut group));
        assert_eq!(std::ffi::CStr::from_ptr(group.name), c"camera");
        assert!(!entire_model_metadata(model, c"entire.device".as_ptr()).is_null());
        assert!(entire_model_scene_feature(model, 0).is_null());
        let inputs = vec![0.25f32; 2 * info.input_count];
        let (mut one, mut both) = (0.0, [0.0; 2]);
        ok(entire_model_predict(model, inputs.as_ptr(), info.input_count, &raw mut one));
        ok(entire_model_predict_batch(model, inputs.as_ptr(), 2, info.input_count, both.as_mut_ptr()));
        assert!(one > 0.0 && (both[0] / one - 1.0).abs() < 1e-5);
        assert_eq!(entire_model_predict(model, inputs.as_ptr(), 3, &raw mut one), ENTIRE_SIZE_MISMATCH);
        let (mut features, mut count) = ([0.0f32; 2], 0);
        let voxels: Vec<u8> = (0..385).map(|i| (i * 37 % 256) as u8).collect();
        let volume = volume(&voxels, ENTIRE_VOXELS_COPY);
        ok(entire_model_encode(model, volume, features.as_mut_ptr(), 2, &raw mut count));
        ok(entire_volume_set_features(volume, features.as_ptr(), 2));
        let mut about: entire_volume_info = crate::abi::ByValue::defaults();
        ok(entire_volume_describe(volume, &raw mut about));
        assert_eq!((count, about.feature_count, about.dims), (2, 2, [5, 7, 11]));
        entire_volume_free(volume);
        entire_model_free(model);
    }
}

#[cfg(unix)]
#[test]
fn a_save_writes_through_no_link() {
    let folder = std::env::temp_dir().join(format!("entire-save-{}", std::process::id()));
    let at = |name: &str| folder.join(name).to_str().unwrap().to_owned();
    std::fs::create_dir(&folder).unwrap();
    std::fs::write(at("other"), "kept").unwrap();
    for number in 0..4 {
        let link = at(&format!("model.{}.{number}.part", std::process::id()));
        std::os::unix::fs::symlink(at("other"), link).unwrap();
    }
    let (bytes, path) = (toy(), std::ffi::CString::new(at("model")).unwrap());
    // SAFETY: `bytes` has the stated number of bytes, and the model is live.
    unsafe {
        let model = made(|out| entire_model_from_bytes(bytes.as_ptr(), bytes.len(), out));
        ok(entire_model_save(model, path.as_ptr()));
        entire_model_free(model);
    }
    assert!(std::fs::read(at("model")).unwrap() == bytes);
    // Besides the model, its folder contains only the files from before the save.
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 6);
    std::os::unix::fs::symlink(at("other"), at("link")).unwrap();
    let (_, name) = create_first(["other", "link", "free"].into_iter().map(at)).unwrap();
    assert_eq!(name, at("free"));
    let taken = create_first(["other", "link"].into_iter().map(at)).unwrap_err();
    assert_eq!(taken.kind(), std::io::ErrorKind::AlreadyExists);
    assert_eq!(std::fs::read(at("other")).unwrap(), b"kept");
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn threads_share_a_model_and_have_sessions_of_their_own() {
    struct Shared(*mut entire_model);
    // SAFETY: a model is immutable, so several threads may call its functions at once.
    unsafe impl Sync for Shared {}
    let bytes = toy();
    // SAFETY: `bytes` has the stated number of bytes.
    let model = Shared(made(|out| unsafe { entire_model_from_bytes(bytes.as_ptr(), bytes.len(), out) }));
    let voxels: Vec<u8> = (0..385).map(|i| (i * 37 % 256) as u8).collect();
    let frames = if cfg!(miri) { 2 } else { 40 };
    std::thread::scope(|scope| {
        for thread in 0..if cfg!(miri) { 2 } else { 8 } {
            let (model, voxels) = (&model, &voxels);
            scope.spawn(move || {
                let with = if thread == 1 { null() } else { model.0.cast_const() };
                // SAFETY: the model is live: it is freed only after all threads have ended.
                unsafe { render(with, voxels, frames) };
                let inputs = [0.25f32; 11];
                for _ in 0..if cfg!(miri) { 3 } else { 200 } {
                    let mut seconds = 0.0;
                    // SAFETY: `inputs` has the 11 stated numbers, and `seconds` has room for one number.
                    ok(unsafe { entire_model_predict(model.0, inputs.as_ptr(), 11, &raw mut seconds) });
                }
            });
        }
    });
    // SAFETY: all threads have ended, so nothing uses the model.
    unsafe { entire_model_free(model.0) };
}

#[test]
fn transfer_functions_of_every_kind_are_made_and_read() {
    let opacity = [
        entire_opacity_node { position: 0.0, opacity: 0.0, midpoint: 0.5, sharpness: 0.0 },
        entire_opacity_node { position: 1.0, opacity: 0.8, midpoint: 0.3, sharpness: 0.2 },
    ];
    let rgba = [0.0f32, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7];
    let mut table = vec![0.0f32; 4 * ENTIRE_TABLE_ENTRIES];
    // SAFETY: every array has the stated length, and every handle below is live.
    unsafe {
        let of_nodes =
            made(|out| entire_transfer_function_from_nodes(opacity.as_ptr(), 2, null(), 0, 0.0, 1.0, 1, out));
        let of_table = made(|out| entire_transfer_function_from_table(rgba.as_ptr(), 2, out));
        for function in [of_nodes, of_table] {
            ok(entire_transfer_function_set_unit_distance(function, 2.0, ENTIRE_UNIT_WORLD));
            ok(entire_transfer_function_table(function, table.as_mut_ptr(), table.len()));
            assert_eq!(entire_transfer_function_table(function, table.as_mut_ptr(), 3), ENTIRE_SIZE_MISMATCH);
            entire_transfer_function_free(function);
        }
    }
    assert!((table[3] - 0.3).abs() < 1e-6);
}
