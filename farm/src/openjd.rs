//! Export as an OpenJD job template (Open Job Description, `jobtemplate-2023-09`) with one task per bundle,
//! for farms that read such templates. After such a farm has run, `entire farm --resume` adds the rendered
//! images to the database.

use super::engine::{Bundle, Places, utf8};
use super::job::Job;
use super::planner::Planner;
use anyhow::{Context, Result, ensure};
use entire_io::files::write_json;
use serde_json::json;
use std::path::Path;

/// Maximum number of characters of a job's name in OpenJD. Longer names are cut.
const NAME: usize = 128;

/// Cuts tasks into bundles of about equal expected seconds, each of one volume. Within a volume, the longest
/// tasks come first. A bundle of several tasks is expected to take at most two thirds of `limit`, the time
/// limit of a bundle in seconds.
pub fn cut(planner: &Planner, tasks: &[u32], bundles: usize, limit: Option<f64>) -> Vec<Vec<u32>> {
    let shape = planner.learner().shape();
    let mut sorted = tasks.to_vec();
    sorted.sort_by(|a, b| {
        let of = |t: &u32| shape.volume(*t as usize);
        of(a).cmp(&of(b)).then(planner.expected(*b).total_cmp(&planner.expected(*a)))
    });
    let total: f64 = tasks.iter().map(|t| planner.expected(*t)).sum();
    let target = (total / bundles.max(1) as f64).min(limit.map_or(f64::INFINITY, |limit| 0.5 * limit));
    let mut out: Vec<Vec<u32>> = Vec::new();
    let (mut sum, mut volume) = (f64::INFINITY, usize::MAX);
    for task in sorted {
        let seconds = planner.expected(task);
        // A new bundle begins at another volume, or if the time of the current bundle is closer to `target`
        // without this task than with it.
        if sum + 0.5 * seconds > target || shape.volume(task as usize) != volume {
            out.push(Vec::new());
            (sum, volume) = (0.0, shape.volume(task as usize));
        }
        sum += seconds;
        if let Some(last) = out.last_mut() {
            last.push(task);
        }
    }
    out
}

/// Writes the bundles' descriptions into the state folder, and the template to `file`.
///
/// # Errors
/// When there is no bundle, or a file cannot be written.
pub fn export(job: &Job, places: &Places, bundles: &[Bundle], run: u64, file: &Path) -> Result<()> {
    ensure!(
        !bundles.is_empty(),
        "there is nothing to export: all tasks are done, or were given up; --resume --retry-quarantined exports \
         those that were given up"
    );
    for bundle in bundles {
        places.write_order(bundle, run)?;
    }
    let first = bundles.iter().map(|b| b.number).min().unwrap_or(0);
    let last = bundles.iter().map(|b| b.number).max().unwrap_or(0);
    let longest = bundles.iter().map(|b| b.upper_s).fold(1.0, f64::max).ceil() as u64;
    // OpenJD accepts a default path only below the template's folder; otherwise the submitter gives the path.
    let folder = file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let folder = std::fs::canonicalize(folder)
        .with_context(|| format!("cannot find the folder {}", folder.display()))?;
    let mut state = json!({
        "name": "State", "type": "PATH", "objectType": "DIRECTORY", "dataFlow": "INOUT",
        "description": "State folder of the image database, the same path on every host.",
    });
    if let Ok(below) = std::fs::canonicalize(&places.state)?.strip_prefix(&folder) {
        state["default"] = utf8(below.as_os_str())?.into();
    }
    let command = places.command("{{Param.State}}", "{{Task.Param.Bundle}}")?;
    let (program, arguments) = command.split_first().context("no program")?;
    let template = json!({
        "specificationVersion": "jobtemplate-2023-09",
        "name": job.name.chars().take(NAME).collect::<String>(),
        "parameterDefinitions": [
            state,
            {
                "name": "Entire", "type": "STRING", "description": "The program `entire`.",
                "default": program,
            },
        ],
        "steps": [{
            "name": "Render",
            "parameterSpace": {
                "taskParameterDefinitions": [
                    { "name": "Bundle", "type": "INT", "range": format!("{first}-{last}") },
                ],
            },
            "script": { "actions": { "onRun": {
                "command": "{{Param.Entire}}",
                "args": arguments,
                "timeout": longest,
            } } },
        }],
    });
    write_json(file, &template)
}
