//! Model cards: the Markdown page beside a model file.

use crate::table::Table;
use entire_io::metrics::Metrics;

/// Contents of a model card. Texts are Markdown.
#[derive(Clone, Debug, Default)]
pub struct Card {
    /// Name of the model file without its ending.
    pub name: String,
    /// Kind of the model, without a full stop.
    pub what: String,
    /// Storage format of the weights.
    pub dtype: String,
    /// Shading mode of the training frames; `None` if there are several.
    pub shading: Option<String>,
    /// Paragraphs before the commands, and the commands that adapt the model to another machine.
    pub adapt: (Vec<String>, Vec<String>),
    /// Groups of inputs, with their sizes.
    pub inputs: Vec<(String, usize)>,
    /// Names of the scene features, in order.
    pub scene_features: Vec<String>,
    /// Rays along each side of the probe.
    pub probe_side: usize,
    /// Items of the list of training data.
    pub data: Vec<String>,
    /// Paragraphs after that list.
    pub volumes: Vec<String>,
    /// Paragraphs about the split into training and test data.
    pub split: Vec<String>,
    /// Result of the training, without a full stop.
    pub outcome: String,
    /// Name of the clock of the training frames.
    pub clock: String,
    /// Settings of the training.
    pub settings: String,
    /// Paragraphs after the settings.
    pub training: Vec<String>,
    /// Errors on each part of the data.
    pub figures: Vec<CardFigures>,
    /// Paragraphs after the table of errors.
    pub notes: Vec<String>,
    /// Further limits of the model.
    pub limits: String,
}

/// One row of a card's table of errors.
#[derive(Clone, Debug)]
pub struct CardFigures {
    /// Name of the part of the data.
    pub part: String,
    /// Errors on its frames.
    pub metrics: Metrics,
    /// RMSE/SD and median error in percent, with intervals where they are known.
    pub with_intervals: [String; 2],
    /// Shares of all frames and of the slowest tenth below the upper bound.
    pub below_bound: Option<[f64; 2]>,
    /// Median error of a perfect predictor, due to the noise of the measured times.
    pub noise: Option<f64>,
}

impl CardFigures {
    fn cells(&self) -> Vec<crate::Cell> {
        let m = &self.metrics;
        let percent = |share: f64| format!("{:.1}", 100.0 * share);
        let [over_sd, median] = self.with_intervals.clone();
        let [all, slowest] = [0, 1].map(|i| self.below_bound.map(|shares| percent(shares[i])).into());
        vec![
            self.part.clone().into(),
            m.frames.to_string().into(),
            format!("{:.3}", 1.0e3 * m.rmse).into(),
            over_sd.into(),
            median.into(),
            percent(m.p95).into(),
            format!("{:.4}", m.r2_log).into(),
            all,
            slowest,
            self.noise.map(percent).into(),
        ]
    }
}

impl Card {
    /// Returns the card as Markdown: headings, paragraphs, lists and a table, separated by blank lines.
    pub fn to_markdown(&self) -> String {
        let list = |items: Vec<String>| items.iter().map(|i| format!("- {i}")).collect::<Vec<_>>().join("\n");
        let shading = self.shading.as_ref().map_or(String::new(), |s| format!(" with shading `{s}`"));
        let (paragraphs, commands) = &self.adapt;
        let mut md = vec![
            format!("# {}", self.name),
            format!(
                "{}; weights stored as {}. Predicts the seconds of one frame{shading} before it is drawn.",
                self.what, self.dtype
            ),
            "## Use".into(),
        ];
        md.extend_from_slice(paragraphs);
        md.push(format!("```\n{}\n```", commands.join("\n")));
        md.push("## Inputs".into());
        let numbers = |size: usize| if size == 1 { "1 number".into() } else { format!("{size} numbers") };
        md.push(list(
            self.inputs.iter().map(|(name, size)| format!("`{name}`, {}", numbers(*size))).collect(),
        ));
        if !self.scene_features.is_empty() {
            md.push(format!(
                "Scene features, in order: {}. Rays along each side of the probe: {}.",
                self.scene_features.join(", "),
                self.probe_side
            ));
        }
        md.extend(["## Data".into(), list(self.data.clone())]);
        md.extend_from_slice(&self.volumes);
        md.push("## Splits".into());
        md.extend_from_slice(&self.split);
        md.extend([
            "## Training".into(),
            format!("{}. Clock: {}; a frame's time is the median of its repeats.", self.outcome, self.clock),
            format!("```json\n{}\n```", self.settings),
        ]);
        md.extend_from_slice(&self.training);
        let mut figures = Table::headed(
            "frames of | #number | #RMSE, ms | #RMSE/SD | #median error, % | #p95, % | #R² in log | \
             #below the upper bound, % | #… slowest tenth | #median noise, %",
        );
        for row in &self.figures {
            figures.row(row.cells());
        }
        md.extend(["## Figures".into(), figures.to_markdown().trim_end().into()]);
        md.extend_from_slice(&self.notes);
        md.extend([
            "## Limits".into(),
            format!(
                "The times are those of one renderer on one machine. On another machine, driver or renderer, \
                 adapt the model first. The out-of-range score is above 0 if an input lies outside the range \
                 of the training data. {}",
                self.limits
            ),
        ]);
        md.join("\n\n") + "\n"
    }
}
