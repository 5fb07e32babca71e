//! Output of a playback: tables, CSV, JSON, and the HTML report.

use super::contenders::ControllerKind;
use super::metrics::{Metrics, SWITCH_FRAMES};
use super::model::{Sample, Steers};
use super::play::{ActsOn, Playback, Record};
use super::rivals::{StepResponse, response_pairs};
use crate::pictures::BEST_PSNR;
use anyhow::{Context, Result};
use entire_io::dataset::ensure_no_table;
use entire_io::files::{make_folder, write_json, write_whole};
use entire_io::machine::Provenance;
use entire_io::options::DrawSettings;
use entire_report::{Axis, Chart, Mark, Page, Rule, Series, Table, encode_png};
use serde_json::{Value, json};
use std::path::Path;

/// G, the frame time at a ray step divided by that at the reference step: its samples, scene after scene, and
/// its points.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ResponseCurve {
    /// Measured pairs (step ratio, time ratio).
    pub samples: Vec<(f32, f32)>,
    /// Points of the curve.
    pub points: Vec<(f32, f32)>,
}

impl ResponseCurve {
    /// Returns a curve with its samples.
    pub fn new(samples: &[Sample], response: &StepResponse) -> Self {
        Self { samples: response_pairs(samples), points: response.points().collect() }
    }

    /// Returns a chart of the curve and its samples.
    pub fn chart(&self) -> Chart {
        let wide = |p: &(f32, f32)| (f64::from(p.0), f64::from(p.1));
        let samples = self.samples.iter().map(wide).map(|(x, y)| (x, y, String::new())).collect();
        let points = self.points.iter().map(wide).collect();
        Chart::new(
            "G: frame time at a ray step / frame time at the reference step",
            Axis::log("step / reference steps"),
            Axis::log("frame time / frame time at the reference step"),
        )
        .size(900.0, 300.0)
        .series(Series::new("random scenes", Mark::Points(samples)).color(6))
        .series(Series::new("G (median, never rising)", Mark::Line(points)).color(0))
    }
}

#[derive(Clone, Debug)]
pub(crate) struct Story {
    pub(crate) title: String,
    pub(crate) lead: String,
    /// Text that says how the target time was chosen.
    pub(crate) target: String,
    pub(crate) volume: String,
    pub(crate) path: String,
    pub(crate) predictor: Steers,
    /// G, the frame time at a ray step divided by that at the reference step.
    pub(crate) response: ResponseCurve,
    /// Further remarks, a paragraph each.
    pub(crate) remarks: Vec<String>,
    pub(crate) provenance: Provenance,
}

/// Returns the title of a controller, and the index of its color in the palette of [`entire_report`].
fn title_and_color(name: &str) -> (String, usize) {
    let kind = ControllerKind::from_name(name);
    let (title, color) = kind.map_or((name, ControllerKind::OTHER_COLOR), |k| k.title_and_color());
    (title.to_owned(), color)
}

/// Returns the name of the setting that a controller chooses.
fn acts_on(playback: &Playback, controller: usize) -> &'static str {
    let smaller = playback.records[controller].iter().any(|r| r.image_sample_distance > 1.0);
    match playback.acts_on[controller] {
        ActsOn::RayStep if smaller => "ray step and image",
        other => other.name(),
    }
}

/// Returns the table of the controllers' metrics, with the best value of each column marked.
pub(crate) fn table(playback: &Playback, metrics: &[Metrics]) -> Table {
    let mut table = Table::headed(
        "controller | acts on | #> 1.1 T / % | #> 1.25 T / % | #|t-T|/T / % | #at switches / % | #calm / % | \
         #p95 / ms | #worst / ms | #recovery / frames | #PSNR / dB | #step",
    );
    type Figure = fn(&Metrics) -> f64;
    // The figures and their factors; missing figures are NaN.
    let figures: [(Figure, f64); 9] = [
        (|m| m.missed_by_10_percent, 100.0),
        (|m| m.missed_by_25_percent, 100.0),
        (|m| m.mean_error, 100.0),
        (|m| m.mean_error_at_switches.unwrap_or(f64::NAN), 100.0),
        (|m| m.mean_error_in_calm.unwrap_or(f64::NAN), 100.0),
        (|m| m.p95_seconds, 1e3),
        (|m| m.worst_seconds, 1e3),
        (|m| m.recovery_frames.iter().sum::<usize>() as f64 / m.recovery_frames.len() as f64, 1.0),
        (|m| m.mean_psnr, 1.0),
    ];
    for (controller, (name, m)) in playback.names.iter().zip(metrics).enumerate() {
        let mut row = vec![title_and_color(name).0.into(), acts_on(playback, controller).into()];
        row.extend(figures.iter().map(|(value, factor)| {
            let value = value(m) * factor;
            value.is_finite().then(|| format!("{value:.1}")).into()
        }));
        row.push(format!("{:.2}", m.mean_step).into());
        table.row(row);
    }
    for (column, (value, _)) in (2..).zip(figures) {
        // For PSNR, the highest value is the best; for every other figure, the lowest.
        table.mark_best(column, &metrics.iter().map(value).collect::<Vec<_>>(), column != 10);
    }
    table
}

/// Returns a picture's step and image sample distance, as text.
fn setting(r: &Record) -> String {
    match r.image_sample_distance {
        1.0 => format!("step {:.2}", r.step),
        distance => format!("step {:.2}, {distance:.2} pixels between rays", r.step),
    }
}

fn table_caption() -> String {
    format!(
        "T is the target, t is the time of a frame. A switch is a frame at which the camera or the transfer \
         function changes abruptly, or at which another volume or image size begins. The best value of each \
         column is bold. \"> 1.1 T\" and \"> 1.25 T\" are the shares of frames that took longer than 1.1 T \
         and 1.25 T. \"|t-T|/T\" is the mean of |t - T| / T over all frames. \"At switches\" is this mean \
         over the first {SWITCH_FRAMES} frames from each switch on. \"Calm\" is this mean over all other \
         frames, without the first {SWITCH_FRAMES} of the path. \"p95\" and \"worst\" are the 95th \
         percentile and the maximum of the frame times. \"Recovery\" is the number of frames from a switch \
         until two frames in a row are on target, averaged over the switches; it is 0 if the frame of the \
         switch and the next one are on target. A frame is on target if t is within 25 % of T, or shorter at \
         the finest step, or longer at the coarsest step. \"PSNR\" compares each picture with the picture at \
         the reference step, after smaller images were enlarged to full size; equal pictures count as \
         {BEST_PSNR:.0} dB. \"Step\" is the mean ray step. For rules that change the image resolution and \
         keep the reference step, it is the mean number of pixels of the full image per drawn pixel."
    )
}

fn write_csv(path: &Path, playback: &Playback) -> Result<()> {
    let mut out = csv::Writer::from_writer(Vec::new());
    let columns = "frame,controller,switch,target_s,predicted_s,upper_s,seconds,seconds_device,seconds_wall,\
                   seconds_cpu,step_ref,psnr_db,reference_seconds,out_of_range,reason,image_sample_distance,\
                   width_px,height_px,volume";
    out.write_record(columns.split(','))?;
    let known = |v: f64| if v.is_nan() { String::new() } else { v.to_string() };
    let clock = |v: Option<f64>| v.map_or(String::new(), |v| v.to_string());
    for frame in 0..playback.references.len() {
        for (name, records) in playback.names.iter().zip(&playback.records) {
            let r = &records[frame];
            out.write_record([
                frame.to_string(),
                name.clone(),
                u8::from(playback.switches.binary_search(&frame).is_ok()).to_string(),
                playback.target.to_string(),
                known(f64::from(r.predicted)),
                known(f64::from(r.upper)),
                r.seconds.to_string(),
                clock(r.measured.device),
                clock(r.measured.wall),
                clock(r.measured.cpu),
                r.step.to_string(),
                r.psnr.min(BEST_PSNR).to_string(),
                playback.references[frame].seconds.to_string(),
                known(f64::from(r.out_of_range)),
                r.reason.to_string(),
                r.image_sample_distance.to_string(),
                playback.sizes[frame].0.to_string(),
                playback.sizes[frame].1.to_string(),
                playback.volumes[frame].to_string(),
            ])?;
        }
    }
    write_whole(path, &out.into_inner()?)
}

fn summary(story: &Story, draw: &DrawSettings, playback: &Playback, metrics: &[Metrics]) -> Value {
    let controllers: serde_json::Map<String, Value> =
        playback.names.iter().cloned().zip(metrics.iter().map(|m| json!(m))).collect();
    json!({
        "target_s": playback.target,
        "target": story.target,
        "frames": playback.references.len(),
        "switches": playback.switches,
        "volume": story.volume,
        "path": story.path,
        "image": draw,
        "steps_allowed": [playback.limits.finest, playback.limits.coarsest],
        "predictor": story.predictor,
        "step_response": story.response.points,
        "controllers": controllers,
        "provenance": story.provenance,
    })
}

/// Returns a controller's errors around the switches: (frames since the switch, mean of |frame time − target|
/// / target over the switches, in %), from `before` frames before a switch to `after` frames after it.
fn around_switches(playback: &Playback, controller: usize, before: usize, after: usize) -> Vec<(f64, f64)> {
    let played = playback.played(controller);
    (0..=before + after)
        .filter_map(|offset| {
            let errors: Vec<f64> = playback
                .switches
                .iter()
                .filter_map(|s| (s + offset).checked_sub(before).and_then(|i| played.get(i)))
                .map(|p| p.error().abs())
                .collect();
            let n = errors.len() as f64;
            (!errors.is_empty())
                .then(|| (offset as f64 - before as f64, 100.0 * errors.iter().sum::<f64>() / n))
        })
        .collect()
}

fn with_switches(mut chart: Chart, switches: &[usize]) -> Chart {
    for (i, s) in switches.iter().enumerate() {
        let text = if switches.len() <= 8 { format!("switch {}", i + 1) } else { String::new() };
        chart = chart.rule(Rule::Vertical(*s as f64, text));
    }
    chart
}

/// Returns the indices of the controllers that charts and pictures show. Three rules convert recent frame
/// times by G, and their curves would hide each other: if OLP was played, the other two are left out.
fn shown(names: &[String]) -> Vec<usize> {
    use ControllerKind::{LargerOfTwo, Last, Olp};
    let is = |name: &String, kinds: &[ControllerKind]| kinds.iter().any(|k| k.name() == name);
    let olp = names.iter().any(|name| is(name, &[Olp]));
    (0..names.len()).filter(|c| !olp || !is(&names[*c], &[Last, LargerOfTwo])).collect()
}

fn per_controller(mut chart: Chart, playback: &Playback, mark: impl Fn(usize) -> Mark) -> Chart {
    for c in shown(&playback.names) {
        let (title, color) = title_and_color(&playback.names[c]);
        chart = chart.series(Series::new(title, mark(c)).color(color));
    }
    chart
}

fn page(story: &Story, draw: &DrawSettings, playback: &Playback, metrics: &[Metrics]) -> Result<Page> {
    let frames = playback.references.len();
    let numbered = |c: usize, f: &dyn Fn(&Record) -> f64| -> Vec<(f64, f64)> {
        playback.records[c].iter().enumerate().map(|(i, r)| (i as f64, f(r))).collect()
    };
    let over_frames = |title: &str, y: Axis, height: f64| {
        let chart = Chart::new(title, Axis::linear("frame"), y).size(900.0, height);
        with_switches(chart, &playback.switches)
    };
    let mut page = Page::new(story.title.clone(), &story.lead);
    page.table(&table(playback, metrics), &table_caption());

    let target = playback.target * 1e3;
    let band = playback.references.iter().map(|r| r.seconds * 1e3).enumerate();
    let band = band.map(|(i, time)| (i as f64, target.min(time), time)).collect();
    let target = vec![(0.0, target), (frames as f64 - 1.0, target)];
    let chart = over_frames("Frame time", Axis::log("frame time / ms"), 380.0)
        .series(Series::new("target", Mark::Line(target)).color(10))
        .series(Series::new("time at the reference step", Mark::Band(band)).color(6));
    let chart = per_controller(chart, playback, |c| Mark::Line(numbered(c, &|r| r.seconds * 1e3)));
    let left_out = if shown(&playback.names).len() < playback.names.len() {
        " Three rules convert recent frame times to the reference step by G, the frame time as a function of \
         the step. Of these rules, charts and pictures show OLP only."
    } else {
        ""
    };
    page.chart(
        &chart,
        &format!(
            "Measured time of every frame under the controllers of the legend.{left_out} The shaded area \
             reaches from the target to the frame's time at the reference step. All controllers draw the \
             same frame before the next frame begins; their order rotates from frame to frame."
        ),
    );

    if !playback.switches.is_empty() {
        let chart = Chart::new(
            "Error around switches",
            Axis::linear("frames since the switch"),
            Axis::linear("mean |t - target| / target / %").from(0.0),
        )
        .size(900.0, 300.0)
        .rule(Rule::Vertical(0.0, "switch".into()));
        let chart = per_controller(chart, playback, |c| Mark::Line(around_switches(playback, c, 3, 10)));
        page.chart(
            &chart,
            "Mean over the switches (abrupt changes of camera, transfer function, volume or image size). \
             Reactive controllers notice a switch one frame late. Predicting controllers plan the switch's \
             frame.",
        );
    }

    let chart = over_frames("Ray step", Axis::log("step / reference steps"), 300.0);
    let chart = per_controller(chart, playback, |c| Mark::Steps(numbered(c, &|r| f64::from(r.step))));
    page.chart(
        &chart,
        "Ray step of each controller: at a coarser step, frames are faster and pictures less exact. \
         Controllers that act on image resolution keep the reference step.",
    );

    if playback.records.iter().flatten().any(|r| r.image_sample_distance != 1.0) {
        let y = Axis::linear("distance / pixels").from(0.0);
        let chart = per_controller(over_frames("Image sample distance", y, 220.0), playback, |c| {
            Mark::Steps(numbered(c, &|r| f64::from(r.image_sample_distance)))
        });
        page.chart(
            &chart,
            "Distance between rays along each side of the image, for each controller. Two kinds of \
             controllers change this distance: those that act on image resolution, and entire's controller \
             if it may coarsen the image.",
        );
    }

    let chart = over_frames("Picture quality", Axis::linear("PSNR / dB"), 300.0);
    let chart = per_controller(chart, playback, |c| Mark::Line(numbered(c, &|r| r.psnr.min(60.0))));
    page.chart(&chart, "Similarity to the picture at the reference step; values over 60 dB are drawn at 60.");

    page.heading("Predictions");
    page.paragraph(&format!("{}.", story.predictor.sentence()));
    let predicting: Vec<usize> = (0..playback.names.len())
        .filter(|c| matches!(playback.names[*c].as_str(), "algorithm1" | "hybrid"))
        .collect();
    if !predicting.is_empty() {
        let chart = Chart::new("Prediction", Axis::linear("frame"), Axis::log("predicted / measured"))
            .size(900.0, 300.0)
            .rule(Rule::Horizontal(1.0, "exact".into()));
        let mut chart = with_switches(chart, &playback.switches);
        for c in predicting {
            let (title, color) = title_and_color(&playback.names[c]);
            let ratio = |r: &Record| f64::from(r.predicted) / r.seconds;
            chart = chart.series(Series::new(title, Mark::Line(numbered(c, &ratio))).color(color));
        }
        page.chart(
            &chart,
            "Predicted time of each frame divided by its measured time. Algorithm 1 uses the uncorrected \
             prediction; entire's controller corrects the prediction by the times of earlier frames, and \
             aims below the target where the upper bound of the time would exceed the target.",
        );
    }
    if !story.response.points.is_empty() {
        page.chart(
            &story.response.chart(),
            "Algorithm 1 and the controllers that convert recent frame times, such as OLP, use this one \
             curve for all scenes. The scatter of the scenes about the curve is an error of these \
             controllers; entire's controller predicts each scene's own curve.",
        );
    }

    if playback.references.iter().any(|r| r.image.is_some()) {
        page.heading("Pictures");
    }
    for (frame, reference) in playback.references.iter().enumerate() {
        let Some(image) = &reference.image else { continue };
        let what = match playback.switches.binary_search(&frame) {
            Ok(i) => format!("Frame {frame}, the first after switch {}:", i + 1),
            Err(_) => format!("Frame {frame} of {frames}:"),
        };
        page.paragraph(&what);
        let mut pictures =
            vec![(encode_png(image)?, format!("reference step, {:.1} ms", reference.seconds * 1e3))];
        for c in shown(&playback.names) {
            let (name, r) = (&playback.names[c], &playback.records[c][frame]);
            if let Some(image) = &r.image {
                let likeness = if r.psnr >= BEST_PSNR { "equal".into() } else { format!("{:.1} dB", r.psnr) };
                pictures.push((
                    encode_png(image)?,
                    format!(
                        "{}: {}, {:.1} ms, {likeness}",
                        title_and_color(name).0,
                        setting(r),
                        r.seconds * 1e3
                    ),
                ));
            }
        }
        page.pictures(pictures.iter().map(|(png, caption)| (png.as_slice(), caption.clone())));
    }

    page.heading("Where the numbers come from");
    for remark in &story.remarks {
        page.paragraph(remark);
    }
    let mut facts = vec![
        ("Volume", story.volume.clone()),
        ("Path", story.path.clone()),
        ("Target", story.target.clone()),
        (
            "Frames",
            format!(
                "{} x {} pixels, shading {}, skipping {}, rays end at opacity {}, steps {} to {}, clock: {}",
                draw.width,
                draw.height,
                draw.shading,
                draw.skipping,
                draw.termination,
                playback.limits.finest,
                playback.limits.coarsest,
                draw.clock.name()
            ),
        ),
    ];
    facts.extend(story.provenance.facts());
    page.facts(facts);
    Ok(page)
}

/// Files that [`write`] writes: every frame, the summary and the report.
pub(crate) const FILES: [&str; 3] = ["frames.csv", "summary.json", "report.html"];

/// Makes the folder of a report if it does not exist. Fails if the report would replace a timing table in it.
pub(crate) fn make_report_folder(folder: &Path) -> Result<()> {
    make_folder(folder)?;
    ensure_no_table(&folder.join(FILES[0])).context("--out")
}

/// Writes the [`FILES`] into a folder, which is made if it does not exist. Returns the metrics of the
/// controllers.
pub(crate) fn write(
    folder: &Path,
    story: &Story,
    draw: &DrawSettings,
    playback: &Playback,
) -> Result<Vec<Metrics>> {
    make_folder(folder)?;
    let metrics = playback.metrics();
    let [frames, figures, html] = FILES.map(|name| folder.join(name));
    write_csv(&frames, playback)?;
    write_json(&figures, &summary(story, draw, playback, &metrics))?;
    page(story, draw, playback, &metrics)?.write(&html)?;
    Ok(metrics)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_the_rules_on_recent_frames_charts_show_olp_if_it_was_played() {
        let shown_of = |kinds: &[ControllerKind]| {
            let names: Vec<String> = kinds.iter().map(|k| k.name().to_owned()).collect();
            shown(&names).into_iter().map(|c| kinds[c]).collect::<Vec<_>>()
        };
        use ControllerKind::{Algorithm1, Fixed, Hybrid, LargerOfTwo, Last, Olp, Pid};
        assert_eq!(shown_of(&ControllerKind::DEFAULT_SET), [Fixed, Olp, Pid, Algorithm1, Hybrid]);
        assert_eq!(shown_of(&[LargerOfTwo, Last, Hybrid]), [LargerOfTwo, Last, Hybrid]);
    }
}
