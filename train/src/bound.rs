//! Upper bounds of frame times: computed from residuals, read from model files, and evaluated.

use entire_core::model::{Key, Model};
use entire_io::metrics::{BoundMetrics, usable};
use entire_steer::predict::{UPPER_LEVEL, UpperBound};

/// Returns ln(measured / predicted) of every frame. Each prediction is first made [`usable`].
pub fn log_residuals(predicted: &[f64], measured: &[f64]) -> Vec<f64> {
    predicted.iter().zip(measured).map(|(&p, t)| (t / usable(p)).ln()).collect()
}

/// Computes the upper bound from predictions of held-out frames, to which no weight was fitted.
pub fn from_predictions(predicted: &[f64], measured: &[f64]) -> UpperBound {
    UpperBound::from_groups(log_residuals(predicted, measured).into_iter().map(|r| (r, ())))
}

/// Computes the upper bound as [`from_predictions`] does, but every group (ensemble member) has the same
/// weight, however many frames it has. The bound is for frames of groups that are not among `groups`.
pub fn from_groups(predicted: &[f64], measured: &[f64], groups: &[String]) -> UpperBound {
    UpperBound::from_groups(log_residuals(predicted, measured).into_iter().zip(groups))
}

/// Coverage and quantile loss of an upper bound; `None` without frames.
pub fn judge(upper: &UpperBound, predicted: &[f64], measured: &[f64]) -> Option<BoundMetrics> {
    let bounds: Vec<f64> = predicted.iter().map(|p| f64::from(upper.upper(usable(*p) as f32))).collect();
    BoundMetrics::new(&bounds, measured, UPPER_LEVEL)
}

/// The upper bound that a model file contains; `None` if it contains none.
pub fn of(model: &Model) -> Option<UpperBound> {
    let stored: serde_json::Value =
        serde_json::from_str(model.metadata.get(Key::Calibration.name())?).ok()?;
    Some(UpperBound { log_factor: stored.get("log_factor")?.as_f64()? as f32 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use entire_core::model::ModelFile;
    use entire_io::metrics::SHORTEST_PREDICTION;

    #[test]
    fn a_bound_holds_for_its_share_of_the_frames_that_gave_it() {
        let predicted = vec![2.0; 399];
        let measured: Vec<f64> = (1..=399).map(|i| 2.0 + f64::from(i) * 1e-3).collect();
        let upper = from_predictions(&predicted, &measured);
        // The bound is the 380th of 399 residuals: ceil(400 · 0.95) = 380.
        assert!((f64::from(upper.factor()) - 2.380 / 2.0).abs() < 1e-6, "{}", upper.factor());
        let held = judge(&upper, &predicted, &measured).unwrap();
        assert!((held.coverage - 0.95).abs() < 0.004, "{}", held.coverage);
        assert_eq!(held.slowest_coverage, 1.0 - 19.0 / 40.0);
        assert!(judge(&upper, &[], &[]).is_none());
    }

    #[test]
    fn groups_count_alike_in_a_bound() {
        let measured: Vec<f64> = (1..=399).map(|i| 1.0 + f64::from(i) * 1e-3).collect();
        let predicted = vec![1.0; 399];
        let one = vec!["a".to_owned(); 399];
        assert_eq!(from_groups(&predicted, &measured, &one), from_predictions(&predicted, &measured));
        // The 39 slow frames form a group with half of the total weight, so the bound is the 90 % quantile of
        // this group and not the 95 % quantile of all frames.
        let two: Vec<String> = (1..=399).map(|i| if i > 360 { "slow" } else { "quick" }.to_owned()).collect();
        let upper = from_groups(&predicted, &measured, &two);
        assert!((f64::from(upper.factor()) - 1.396).abs() < 1.5e-3, "{}", upper.factor());
        let few = from_groups(&predicted[..3], &measured[..3], &two[..3]);
        assert!((few.factor() - 1.003).abs() < 1e-6, "{}", few.factor());
        assert!(from_groups(&[], &[], &[]).log_factor.is_nan());
    }

    #[test]
    fn a_bound_survives_the_file_beside_what_else_stands_there() {
        let mut file = ModelFile::default();
        file.metadata.insert(Key::Calibration.into(), r#"{"range":[1,2]}"#.into());
        UpperBound { log_factor: 0.25 }.store(&mut file).unwrap();
        let text = file.metadata.get(Key::Calibration.name()).unwrap().clone();
        assert!(text.contains("range") && text.contains("0.25"), "{text}");
        UpperBound::default().store(&mut file).unwrap();
        assert_eq!(file.metadata.get(Key::Calibration.name()), Some(&text));
        file.metadata.insert(Key::Calibration.into(), "{".into());
        assert!(UpperBound { log_factor: 0.1 }.store(&mut file).is_err());
    }

    #[test]
    fn what_is_no_prediction_counts_as_the_shortest() {
        let r = log_residuals(&[0.0, f64::NAN, -1.0, 1.0], &[1.0; 4]);
        assert!(r[..3].iter().all(|r| (r - (1.0 / SHORTEST_PREDICTION).ln()).abs() < 1e-12));
        assert_eq!(r[3], 0.0);
    }
}
