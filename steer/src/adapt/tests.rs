use super::correction::Corrected;
use super::*;
use crate::numeric::Noise;
use crate::predict::{CostTerms, Source, TERMS};
use alloc::vec::Vec;
use entire_core::ErrorKind;

fn scene(noise: &mut Noise) -> [f64; TERMS] {
    let mut parts = [0.0; TERMS];
    parts[0] = 2e-4;
    for (i, scale) in [(1, 1e-3), (2, 3e-3), (3, 2e-3), (4, 2e-2), (5, 2e-2)] {
        parts[i] = scale * (3.0 * (noise.uniform() - 0.5)).exp();
    }
    parts
}

fn terms(parts: &[f64; TERMS]) -> CostTerms {
    CostTerms { parts: parts.map(|p| p as f32), out_of_range: 0.0, source: Source::Analytic }
}

#[test]
fn sixty_frames_bring_an_unknown_machine_within_ten_percent() {
    for seed in 0..20 {
        let mut noise = Noise(100 + seed);
        // Each unit cost has an error: a factor of its own (up to 4.5) times a common factor (up to 20).
        let common = (6.0 * (noise.uniform() - 0.5)).exp();
        let factors: [f64; TERMS] = core::array::from_fn(|_| common * (3.0 * (noise.uniform() - 0.5)).exp());
        let mut correction = Correction::new(Prior::Unknown, CorrectionConstants::default());
        let mut errors = Vec::new();
        for i in 0..200 {
            let parts = scene(&mut noise);
            let clean: f64 = parts.iter().zip(factors).map(|(p, f)| p * f).sum();
            correction.advance(1.0);
            let predicted = correction.apply(&terms(&parts)).seconds;
            if i >= 60 {
                errors.push((predicted / clean - 1.0).abs());
            }
            let seconds = clean * (0.05 * (noise.uniform() + noise.uniform() - 1.0)).exp();
            correction.observe(&terms(&parts), seconds, Standing::First, 1.0, f64::NAN);
        }
        errors.sort_by(f64::total_cmp);
        assert!(errors[errors.len() / 2] < 0.1, "seed {seed}: {}", errors[errors.len() / 2]);
    }
}

#[test]
fn a_jump_of_the_machine_is_followed_within_twenty_frames_both_ways() {
    let mut noise = Noise(3);
    let mut correction = Correction::new(Prior::Fitted { log_sd: 0.1 }, CorrectionConstants::default());
    for block in 0..6 {
        let speed = if block % 2 == 0 { 1.0 } else { 3.0 };
        for i in 0..100 {
            let parts = scene(&mut noise);
            let clean = speed * parts.iter().sum::<f64>();
            correction.advance(0.0);
            let error = (correction.apply(&terms(&parts)).seconds / clean).ln();
            if i >= 20 {
                assert!(error.abs() < 0.15, "block {block} frame {i}: {error}");
            }
            let seconds = clean * (1.0 + 0.05 * (noise.uniform() - 0.5));
            correction.observe(&terms(&parts), seconds, Standing::Same, 1.0, f64::NAN);
        }
    }
}

#[test]
fn single_spikes_barely_move_it() {
    let mut noise = Noise(8);
    let mut correction = Correction::new(Prior::Fitted { log_sd: 0.1 }, CorrectionConstants::default());
    for i in 0..300 {
        let parts = scene(&mut noise);
        let clean: f64 = parts.iter().sum();
        correction.advance(0.0);
        let error = (correction.apply(&terms(&parts)).seconds / clean).ln();
        assert!(i < 20 || error.abs() < 0.12, "frame {i}: {error}");
        let spike = if i % 25 == 24 { 50.0 } else { 1.0 };
        let seconds = clean * spike * (1.0 + 0.04 * (noise.uniform() - 0.5));
        correction.observe(&terms(&parts), seconds, Standing::Same, 1.0, f64::NAN);
    }
}

/// Expected times of frames of a still scene, divided by the first of them. Before these frames, 40 noisy
/// frames are observed. Then frame i takes `factors[i]` times the first expected time.
fn expected_after(factors: &[f64]) -> Vec<f64> {
    let mut noise = Noise(5);
    let mut correction = Correction::new(Prior::Fitted { log_sd: 0.1 }, CorrectionConstants::default());
    let terms = CostTerms::whole(0.01, 0.0, Source::Analytic);
    for i in 0..40 {
        correction.advance(if i == 0 { 1.0 } else { 0.0 });
        let standing = if i == 0 { Standing::First } else { Standing::Same };
        correction.observe(&terms, 0.01 * (1.0 + 0.2 * (noise.uniform() - 0.5)), standing, 1.0, f64::NAN);
    }
    let usual = correction.apply(&terms).seconds;
    let mut expected = Vec::new();
    for factor in factors {
        correction.advance(0.0);
        expected.push(correction.apply(&terms).seconds / usual);
        correction.observe(&terms, usual * factor, Standing::Same, 1.0, f64::NAN);
    }
    expected
}

#[test]
fn a_stall_leaves_no_trace_after_one_usual_frame() {
    let expected = expected_after(&[2.0, 1.0, 1.0, 1.0]);
    assert!(expected[1] > 1.03, "{expected:?}");
    assert!(expected[2..].iter().all(|t| (t - 1.0).abs() < 1.0e-3), "{expected:?}");
}

#[test]
fn a_load_leaves_no_trace_after_its_end() {
    let expected = expected_after(&[2.5, 2.5, 2.5, 2.5, 1.0, 1.0, 1.0]);
    assert!(expected[2..5].iter().all(|t| (t - 2.5).abs() < 1.0e-3), "{expected:?}");
    assert!(expected[5..].iter().all(|t| (t - 1.0).abs() < 1.0e-3), "{expected:?}");
}

#[test]
fn a_change_of_the_scene_that_begins_like_a_stall_is_kept() {
    // The first changed frame is a stall; the others are closer to it than to the frames before the change.
    let expected = expected_after(&[1.3; 12]);
    assert!(expected[1] > 1.03 && expected.is_sorted(), "{expected:?}");
    assert!((expected[11] - 1.3).abs() < 0.02, "{expected:?}");
}

#[test]
fn values_that_are_no_times_change_nothing() {
    let mut correction = Correction::new(Prior::Unknown, CorrectionConstants::default());
    let before = correction.clone();
    let good = CostTerms::whole(0.01, 0.0, Source::Analytic);
    for seconds in [f64::NAN, f64::INFINITY, 0.0, -1.0] {
        assert!(correction.observe(&good, seconds, Standing::Same, 1.0, f64::NAN).is_nan());
    }
    let nan = CostTerms { parts: [f32::NAN; TERMS], ..good };
    let none = CostTerms { parts: [0.0; TERMS], ..good };
    for terms in [nan, none] {
        assert!(correction.observe(&terms, 0.01, Standing::Same, 1.0, f64::NAN).is_nan());
    }
    assert_eq!(correction, before);
    assert!(check_seconds(f32::MIN_POSITIVE).is_ok());
    assert_eq!(
        check_seconds(crate::predict::LONGEST_FRAME * 1.1).unwrap_err().kind(),
        ErrorKind::RejectedObservation
    );
}

#[test]
fn extreme_times_keep_the_state_in_bounds() {
    let mut correction = Correction::new(Prior::Unknown, CorrectionConstants::default());
    let mut noise = Noise(1);
    for i in 0..20_000 {
        let parts = scene(&mut noise);
        let seconds = if i / 50 % 2 == 0 { 1e-30 } else { 1e4 };
        correction.advance((i % 3) as f64 / 2.0);
        correction.observe(
            &terms(&parts),
            seconds,
            [Standing::First, Standing::Same, Standing::Past][i % 3],
            if i % 5 == 0 { 0.01 } else { 1.0 },
            f64::NAN,
        );
        let Corrected { seconds: t, sd, .. } = correction.apply(&terms(&parts));
        assert!(t.is_finite() && t > 0.0 && sd.is_finite() && sd > 0.0, "{i}: {t} {sd}");
    }
}
