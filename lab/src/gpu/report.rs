//! The report of a device's study.

use super::Outcomes;
use super::pictures::Difference;
use entire_io::dataset::{Clock, NoiseFloor, TimedFrame};
use entire_io::machine::Provenance;
use entire_io::metrics::median;
use entire_report::{Axis, Cell, Chart, Mark, Page, Series, Table};
use serde::Deserialize;
use serde_json::Value;

/// The shading modes, from the fastest to the slowest.
pub(crate) const MODES: [&str; 3] = ["none", "local", "scatter"];

/// Results of a run. A result is missing if its step did not run or failed.
pub(crate) struct Found {
    pub(crate) outcomes: Outcomes,
    /// Output of `entire probe --json`.
    pub(crate) probe: Option<Value>,
    pub(crate) pictures: Vec<Difference>,
    /// Tables: kind (`frames`, `large`), mode, frames.
    pub(crate) tables: Vec<(&'static str, &'static str, Vec<TimedFrame>)>,
    /// Evaluations: kind, mode, output of `entire evaluate`.
    pub(crate) evaluations: Vec<(&'static str, &'static str, Value)>,
    pub(crate) switches: Option<Value>,
    pub(crate) clock: Clock,
}

fn number(value: &Value, path: &[&str]) -> Option<f64> {
    path.iter().try_fold(value, |v, key| v.get(key))?.as_f64()
}

/// Noise floor of an evaluation: the median error that perfect predictions would have.
fn floor(evaluation: &Value) -> Option<f64> {
    Some(NoiseFloor::deserialize(evaluation.get("noise_floor")?).ok()?.mdape())
}

fn shown(value: Option<f64>, factor: f64, digits: usize) -> Cell {
    value.map(|v| format!("{:.digits$}", v * factor)).into()
}

impl Found {
    pub(crate) fn steps(&self) -> Table {
        let mut table = Table::headed("step | state | #s | last line of output");
        for o in &self.outcomes.0 {
            let said: String = o.said.chars().take(160).collect();
            table.row(vec![
                o.step.as_str().into(),
                o.state.name().into(),
                format!("{:.1}", o.seconds).into(),
                said.into(),
            ]);
        }
        table
    }

    /// Returns a table of the errors of the machine's models on held-out volumes.
    pub(crate) fn errors(&self) -> Table {
        let mut table = Table::headed(
            "shading | table | #frames | #median error / % | #RMSE/SD | #noise floor / % | \
             #in a session, median error / %",
        );
        for (kind, mode, found) in &self.evaluations {
            let one = &found["predictors"][0];
            let session = found["in_session"].as_object().and_then(|o| o.values().next());
            table.row(vec![
                (*mode).into(),
                (*kind).into(),
                shown(number(one, &["metrics", "frames"]), 1.0, 0),
                shown(number(one, &["metrics", "mdape"]), 100.0, 1),
                shown(number(one, &["metrics", "rmse_over_sd"]), 1.0, 3),
                shown(floor(found), 100.0, 1),
                shown(session.and_then(|s| number(s, &["mdape"])), 100.0, 1),
            ]);
        }
        table
    }

    /// Returns a table of median milliseconds by shading mode, kind of table and image size.
    pub(crate) fn times(&self) -> Table {
        const EDGES: [u64; 4] = [0, 128 * 128, 512 * 512, u64::MAX];
        let mut table = Table::headed(
            "shading | table | #voxels of the largest volume | #below 128² pixels / ms | #128² to 512² | \
             #512² and more",
        );
        for (kind, mode, frames) in &self.tables {
            let most =
                frames.iter().map(|f| f.scene.dims.iter().map(|d| u64::from(*d)).product::<u64>()).max();
            let mut row = vec![(*mode).into(), (*kind).into(), most.map(|m| m.to_string()).into()];
            for edge in EDGES.windows(2) {
                let inside = |f: &&TimedFrame| (edge[0]..edge[1]).contains(&f.scene.pixels());
                let mut seconds: Vec<f64> =
                    frames.iter().filter(inside).filter_map(|f| f.seconds(self.clock)).collect();
                row.push(shown(median(&mut seconds), 1e3, 3));
            }
            table.row(row);
        }
        table
    }

    /// Returns a table that compares each controller's frame times with the target.
    pub(crate) fn held(&self) -> Table {
        let mut table =
            Table::headed("controller | #> 1.1 T / % | #> 1.25 T / % | #|t-T|/T / % | #PSNR / dB");
        let controllers = self.switches.as_ref().and_then(|s| s["controllers"].as_object());
        for (name, c) in controllers.into_iter().flatten() {
            table.row(vec![
                name.as_str().into(),
                shown(number(c, &["missed_by_10_percent"]), 100.0, 1),
                shown(number(c, &["missed_by_25_percent"]), 100.0, 1),
                shown(number(c, &["mean_error"]), 100.0, 1),
                shown(number(c, &["mean_psnr"]), 1.0, 1),
            ]);
        }
        table
    }

    /// Number of steps that failed, were skipped or are unfinished.
    pub(crate) fn missing(&self) -> usize {
        self.outcomes.0.iter().filter(|o| !o.state.is_over()).count()
    }

    /// Largest difference of any picture from the CPU version's, on a scale of 0 to 255; `None` if none was
    /// drawn.
    pub(crate) fn worst_picture(&self) -> Option<u8> {
        self.pictures.iter().map(|d| d.largest).max()
    }

    pub(crate) fn page(&self, device: String) -> Page {
        let mut page = Page::new(
            "Study of a device",
            "Pictures compared with the CPU version, the device's rates, frame times in three shading modes, \
             models calibrated to the device, and frames held at a target across switches of the transfer \
             function.",
        );
        page.table(&self.steps(), "Steps. A step that ran out of time counts with its partial results.");
        page.heading("Pictures");
        let mut worst = Table::headed(
            "volume | shading | #camera | #largest difference | #mean difference | equal sample counts",
        );
        for d in &self.pictures {
            worst.row(vec![
                d.volume.as_str().into(),
                d.shading.as_str().into(),
                d.camera.to_string().into(),
                d.largest.to_string().into(),
                format!("{:.4}", d.mean).into(),
                d.same_samples.map(|s| if s { "yes" } else { "no" }).into(),
            ]);
        }
        page.table(
            &worst,
            "Differences of single channels between device and CPU version, on a scale of 0 to 255; a \
             difference of at most 2 is accepted.",
        );
        if let Some(probe) = &self.probe {
            page.heading("The device");
            let mut numbers = Table::headed("quantity | value");
            for group in ["limits", "timestamps", "numbers"] {
                for (name, value) in probe[group].as_object().into_iter().flatten() {
                    numbers.row(vec![name.as_str().into(), value.to_string().trim_matches('"').into()]);
                }
            }
            page.table(&numbers, "The values are those that `entire probe` prints.");
        }
        page.heading("Frame times");
        page.table(&self.times(), "Median milliseconds of frames that no calibration rendered.");
        let mut chart = Chart::new("Frame times by image size", Axis::log("pixels"), Axis::log("seconds"))
            .size(900.0, 420.0);
        for (kind, mode, frames) in &self.tables {
            let points = frames
                .iter()
                .filter_map(|f| {
                    let seconds = f.seconds(self.clock)?;
                    (seconds > 0.0).then(|| (f.scene.pixels() as f64, seconds, String::new()))
                })
                .collect();
            chart = chart.series(Series::new(format!("{mode}, {kind}"), Mark::Points(points)));
        }
        page.chart(&chart, "Every frame of the tables.");
        page.heading("Predictions");
        page.table(
            &self.errors(),
            "Errors of the models that `entire calibrate` made on this machine, on volumes that the calibration \
             did not render. The noise floor is the median error of perfect predictions: repeats of a frame \
             differ. In a session every frame is predicted, then observed.",
        );
        if self.switches.is_some() {
            page.heading("Frames held");
            page.table(
                &self.held(),
                "An orbit with three abrupt switches of the transfer function; T is the target.",
            );
        }
        let missing = self.missing();
        if missing > 0 {
            page.paragraph(&format!(
                "{missing} steps are missing: see the first table, and logs/ beside this page."
            ));
        }
        page.facts(Provenance::of(device).facts());
        page
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn the_noise_floor_is_that_of_the_median_of_repeats() {
        let noise = json!({ "log_sd": 0.04, "log_sd_of_median": 0.02, "median_relative_deviation": 0.5,
            "warm_up": 0.0, "drift": null, "frames": 9 });
        let found = floor(&json!({ "noise_floor": noise })).unwrap();
        assert!((found - 0.6745 * 0.02).abs() < 1e-12, "{found}");
        assert_eq!(floor(&json!({ "noise_floor": null })), None);
    }
}
