//! The shipped models, for the shading modes `none`, `local` and `scatter`. They are built into the program,
//! so that it needs no model files.

use anyhow::Result;
use entire_core::model::ModelFile;
use entire_core::scene::Shading;
use entire_steer::predict::{AnalyticModel, UnitCosts};

/// A name, and the bytes of `models/NAME-selected.safetensors`.
macro_rules! selected {
    ($name:literal) => {
        ($name, include_bytes!(concat!("../models/", $name, "-selected.safetensors")).as_slice())
    };
}

/// Names and bytes of a mode's models: the selected one, then those that were fitted to further types of
/// machine. Empty for a mode without shipped models.
fn files(shading: Shading) -> Vec<(&'static str, &'static [u8])> {
    match shading {
        Shading::None => vec![selected!("unshaded"), selected!("unshaded-epyc"), selected!("unshaded-xeon")],
        Shading::Local => vec![selected!("local"), selected!("local-xeon")],
        Shading::Scatter => vec![selected!("scatter"), selected!("scatter-xeon")],
        _ => Vec::new(),
    }
}

fn read((name, bytes): (&str, &[u8])) -> Result<(String, ModelFile)> {
    Ok((format!("the shipped model {name}"), ModelFile::from_bytes(bytes)?))
}

/// The shipped models of a shading mode with their names; the first is the selected one.
pub(crate) fn shipped_models(shading: Shading) -> Result<Vec<(String, ModelFile)>> {
    files(shading).into_iter().map(read).collect()
}

/// The priors of a calibration, with their names. `typical` are the typical costs of the calibrated renderer.
/// For a GPU there are no priors, so that the calibration starts from the typical costs. For every other
/// renderer, the priors are the shipped models of the shading mode, which were fitted to software renderers.
pub(crate) fn shipped_priors(shading: Shading, typical: &UnitCosts) -> Result<Vec<(String, ModelFile)>> {
    if *typical == UnitCosts::GPU { Ok(Vec::new()) } else { shipped_models(shading) }
}

/// The shipped model that was selected for a shading mode, with its name. For a mode without shipped models,
/// a model of the typical unit costs of software renderers.
pub(crate) fn shipped_model(shading: Shading) -> Result<(String, ModelFile)> {
    match files(shading).into_iter().next() {
        Some(selected) => read(selected),
        None => {
            let typical = AnalyticModel::default().to_model_file()?;
            Ok((format!("typical unit costs, shading {shading}"), typical))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;
    use std::path::Path;

    #[test]
    fn every_selected_model_is_built_in() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models");
        let mut there = BTreeMap::new();
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_str().unwrap();
            if let Some(name) = name.strip_suffix("-selected.safetensors") {
                there.insert(name.to_owned(), std::fs::read(&path).unwrap());
            }
        }
        let built: BTreeMap<String, Vec<u8>> = Shading::ALL
            .into_iter()
            .flat_map(files)
            .map(|(name, bytes)| (name.to_owned(), bytes.to_vec()))
            .collect();
        assert!(there == built, "models/ has {:?}, the program {:?}", there.keys(), built.keys());
    }

    #[test]
    fn every_mode_has_a_model_that_predicts() {
        for shading in Shading::ALL {
            let selected = shipped_model(shading).unwrap();
            for (name, file) in shipped_models(shading).unwrap().into_iter().chain([selected]) {
                let loaded = entire_steer::predict::load(&file.to_model().unwrap());
                assert!(loaded.is_ok(), "{name}: {}", loaded.err().unwrap());
            }
        }
    }
}
