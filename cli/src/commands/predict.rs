//! `entire predict`: predict seconds for rows of model inputs.

use crate::calibrate::place::machine_file;
use anyhow::{Context, Result, bail, ensure};
use entire_core::model::Model;
use entire_core::nn::PredNet;
use entire_core::scene::Shading;
use entire_io::files::{digits, note, open_model, read_decompressed};
use entire_io::options::shade_parser;
use entire_steer::predict::{PREDICTED_SECONDS, check_predictions};
use std::io::Read;
use std::path::{Path, PathBuf};

/// Predict frame times, in seconds, from a table of model inputs.
///
/// The table has one row per frame and no header. Its columns are the model's inputs, in the model's order,
/// separated by commas. Inputs are used as given. In contrast, sessions and `entire evaluate` clamp them to
/// the range of the training frames, if the model states this range. Prints one line per row: seconds, at
/// least 1e-6, with 9 significant digits. If any row is invalid, nothing is printed. If the model states the
/// clock of its seconds, a note on standard error names the clock.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire predict --model model.safetensors --inputs inputs.csv
  my-renderer --log-inputs | entire predict --model model.safetensors --inputs -

The columns are the inputs that the model file lists in its metadata, under the
key entire.inputs. If a row has another number of columns, the error names the
input groups and their sizes. To predict the frames of timing tables, use
`entire evaluate`.")]
pub(crate) struct Options {
    /// Model file of a predictor; default: this machine's model for --shade (`entire calibrate` makes it).
    #[arg(long, value_name = "M.safetensors")]
    pub(crate) model: Option<PathBuf>,
    /// Shading mode of the machine's model, if --model is not given.
    #[arg(long, value_parser = shade_parser(), default_value = "none", conflicts_with = "model")]
    pub(crate) shade: Shading,
    /// Table of inputs: CSV without a header line, one row per frame; `-` for standard input.
    #[arg(long, value_name = "X.csv")]
    pub(crate) inputs: PathBuf,
}

pub(crate) fn run(options: &Options) -> Result<()> {
    let path = match &options.model {
        Some(path) => path.clone(),
        None => machine_file(options.shade)?,
    };
    let model = open_model(&path)?;
    let Some(parts) = model.prednet.as_ref() else {
        bail!("{}: has no PredNet (prednet.0.weight); give a model that predicts", path.display());
    };
    let net = PredNet::new(parts).with_context(|| format!("{}", path.display()))?;
    let seconds = if options.inputs == Path::new("-") {
        predict(&net, &model, std::io::stdin().lock()).context("standard input")
    } else {
        let shown = options.inputs.display();
        let table = read_decompressed(&options.inputs).with_context(|| format!("cannot read {shown}"))?;
        predict(&net, &model, &table[..]).with_context(|| format!("{shown}"))
    }?;
    if let Some(clock) = entire_io::clock::of(&model) {
        note(&format!("{} predicts {} seconds", path.display(), clock.name()));
    }
    print!("{}", seconds.into_iter().map(|value| digits(value) + "\n").collect::<String>());
    Ok(())
}

fn predict(net: &PredNet, model: &Model, table: impl Read) -> Result<Vec<f32>> {
    let mut reader =
        csv::ReaderBuilder::new().has_headers(false).flexible(true).trim(csv::Trim::All).from_reader(table);
    let mut scratch = net.scratch(1)?;
    let mut inputs = Vec::with_capacity(net.inputs());
    let mut seconds = Vec::new();
    let mut record = csv::ByteRecord::new();
    loop {
        let row = seconds.len() + 1;
        if !reader.read_byte_record(&mut record).with_context(|| format!("row {row}"))? {
            break;
        }
        ensure!(
            record.len() == net.inputs(),
            "row {row} has {} column{}, the model takes {}: {}",
            record.len(),
            if record.len() == 1 { "" } else { "s" },
            net.inputs(),
            model.inputs.iter().map(|g| format!("{} {}", g.name, g.size)).collect::<Vec<_>>().join(", ")
        );
        inputs.clear();
        for (column, field) in record.iter().enumerate() {
            let text = String::from_utf8_lossy(field);
            let Ok(value) = text.parse::<f32>() else {
                bail!(
                    "row {row}, column {}: {text:?} is not a number{}",
                    column + 1,
                    if row == 1 { " (a header line is not accepted)" } else { "" }
                );
            };
            ensure!(
                value.is_finite(),
                "row {row}, column {}: {text:?} is not finite; accepted are numbers within ±3.4e38",
                column + 1
            );
            inputs.push(value);
        }
        let value = net.predict(&inputs, &mut scratch);
        ensure!(
            value.is_finite(),
            "row {row}: the model predicts {value} seconds, since the inputs are far from the model's \
             training data; check the units of the inputs"
        );
        seconds.push(value);
    }
    if seconds.is_empty() {
        bail!("holds no row; one row per frame is expected, {} columns each", net.inputs());
    }
    let outside = check_predictions(&mut seconds)?;
    if outside > 0 {
        note(&format!(
            "{outside} of {} predictions were outside of {:e} to {:e} seconds \
             and are printed as the nearer limit",
            seconds.len(),
            PREDICTED_SECONDS.start(),
            PREDICTED_SECONDS.end()
        ));
    }
    Ok(seconds)
}
