//! Saved states of a session: mutations with valid checksums, and invariants of accepted states.

use crate::mutate::{Step, number, put, random};
use entire_core::scene::{Arcball, Camera, Frame, GaussianLobe, Scalars, TransferFunction, VolumeView};
use entire_steer::control::ObserveFlags;
use entire_steer::control::Session;
use entire_steer::features::VolumeSummary;
use std::cell::RefCell;

/// Size of the checksum at the end of a state, bytes.
const SEAL: usize = 4;

/// Number of frames that are steered after a state was loaded.
const FRAMES: usize = 12;

/// Target frame time, seconds.
const TARGET: f32 = 0.02;

fn frame(turn: f32) -> Frame {
    let camera = Camera::from_arcball(Arcball { rx: 10.0, ry: turn, dz: 2.0 }).expect("a camera");
    Frame::new(camera, 64, 48).expect("a frame")
}

fn session() -> Session {
    let voxels: Vec<u8> = (0..8 * 8 * 8u32).map(|i| (i * i / 97 % 251) as u8).collect();
    let view = VolumeView::new(Scalars::U8(&voxels), [8; 3]).expect("a volume");
    let mut session = Session::default();
    session.set_volume(VolumeSummary::new(&view).expect("a summary"), None);
    let lobe = GaussianLobe { center: 0.5, width: 0.1, height: 0.4 };
    let table = TransferFunction::Gaussian(vec![lobe]).to_table().expect("a table");
    session.set_transfer(&table, None).expect("a transfer function");
    session
}

/// The state of a new session.
pub fn fresh() -> Vec<u8> {
    session().save_state()
}

/// The state of a session after some frames.
pub fn learned() -> Vec<u8> {
    let mut session = session();
    for i in 0..40 {
        let plan = session.plan(&frame(3.0 * (i % 20) as f32), TARGET).expect("a plan");
        session.observe(plan.id, 0.05 / plan.step, ObserveFlags::default()).expect("an observation");
    }
    session.save_state()
}

/// Appends the checksum of all bytes before it.
pub fn seal(bytes: &mut Vec<u8>) {
    bytes.extend_from_slice(&crc32fast::hash(bytes).to_le_bytes());
}

/// Changes some numbers of a state, or mutates its bytes with the fuzzer's function `step`, and updates the
/// checksum. Returns the new number of bytes, at most `room`.
pub fn mutate(data: &mut [u8], size: usize, room: usize, seed: u32, step: Step) -> usize {
    let mut random = random(seed);
    let mut body = data[..size.saturating_sub(SEAL)].to_vec();
    // A learned state replaces every state without a number after its first 32 bytes, and one in 200 of all
    // other states.
    if body.len() < 40 || random.below(200) == 0 {
        body = learned();
        body.truncate(body.len() - SEAL);
    }
    match random.below(4) {
        0 => {
            let (length, most) = (body.len(), room.saturating_sub(SEAL).max(body.len()));
            body.resize(most, 0);
            let length = step(&mut body, length, most);
            body.truncate(length);
        }
        // The first 32 bytes are two tags, the model's checksum and two empty names; 8-byte numbers follow.
        _ => {
            for _ in 0..1 + random.below(4) {
                let at = 32 + 8 * random.below((body.len() - 32) / 8);
                let own = f64::from_le_bytes(body[at..at + 8].try_into().expect("eight bytes"));
                let number = number(&mut random, own);
                body[at..at + 8].copy_from_slice(&number.to_le_bytes());
            }
        }
    }
    seal(&mut body);
    put(data, &body, room)
}

thread_local! {
    static SESSION: RefCell<(Session, Vec<u8>)> = RefCell::new({
        let session = session();
        let fresh = session.save_state();
        (session, fresh)
    });
}

/// Checks that a refused state changes nothing, and that an accepted state can be saved and loaded again,
/// gives plans with a finite step and a finite expected time, and lets the session continue to learn.
pub fn check_state(input: &[u8]) {
    SESSION.with_borrow_mut(|(session, fresh)| {
        session.load_state(fresh).expect("the state of a new session");
        if let Err(error) = session.load_state(input) {
            assert!(!error.to_string().is_empty());
            assert_eq!(&session.save_state(), fresh, "a refused state has changed the session");
            return;
        }
        let taken = session.save_state();
        session.load_state(&taken).expect("a saved state can be loaded");
        assert_eq!(session.save_state(), taken);
        for i in 0..FRAMES {
            let plan = session.plan(&frame(5.0 * i as f32), TARGET).expect("a plan");
            assert!(plan.step.is_finite() && plan.step >= 1.0, "{plan:?}");
            assert!(plan.seconds.is_finite() && plan.seconds > 0.0, "{plan:?}");
            assert!(plan.upper.is_nan() || plan.upper >= plan.seconds, "{plan:?}");
            session.observe(plan.id, 0.05 / plan.step, ObserveFlags::default()).expect("an observation");
        }
        let saved = session.save_state();
        session.load_state(&saved).expect("a session's own state");
    });
}
