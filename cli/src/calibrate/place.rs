//! Location of the machine's model: the user's data folder, one file per shading mode.

use crate::collection::{Job, ensure_utf8};
use anyhow::{Context, Result};
use entire_core::model::{Key, Model, ModelFile};
use entire_core::scene::Shading;
use entire_io::clock::{ClockChoice, waited_for};
use entire_io::dataset::Clock;
use entire_io::files::{note, read_model_file};
use entire_io::identity::{self, Identity, is_volume};
use entire_io::options::names_software;
use entire_vk_raycaster::Renderer;
use serde::Deserialize as _;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The user's data folder: `XDG_DATA_HOME` where it is an absolute path; else `LOCALAPPDATA` on Windows and
/// `.local/share` in the home folder elsewhere. `None` where none of them is known. `libentire` looks in the
/// same place (`entire_model_open_machine`).
fn data_folder() -> Option<PathBuf> {
    let absolute = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|p| p.is_absolute());
    absolute("XDG_DATA_HOME").or_else(|| {
        if cfg!(windows) {
            absolute("LOCALAPPDATA")
        } else {
            std::env::home_dir().filter(|p| p.is_absolute()).map(|home| home.join(".local/share"))
        }
    })
}

/// The shading mode of the frames to which a model was fitted; `None` if its file does not state one.
pub(crate) fn shading_of(model: &Model) -> Option<Shading> {
    let stated = model.metadata.get(Key::Provenance.name())?;
    let origin: serde_json::Value = serde_json::from_str(stated).ok()?;
    origin["shading"].as_str()?.parse().ok()
}

/// True if a model with these metadata was calibrated on the volume; `None` if the metadata lack the hashes
/// of the model's volumes, as in shipped models, in networks, and in models that a session made.
///
/// # Errors
/// When the volume's files cannot be read.
pub(crate) fn calibrated_on(metadata: &BTreeMap<String, String>, volume: &Path) -> Result<Option<bool>> {
    let stated = metadata.get(Key::Provenance.name()).and_then(|text| serde_json::from_str(text).ok());
    let files =
        stated.map(|origin: serde_json::Value| Vec::<Identity>::deserialize(&origin["calibration"]["files"]));
    match files {
        Some(Ok(files)) if !files.is_empty() => {
            Ok(Some(identity::contained(&identity::of_volume(volume)?, &files)))
        }
        _ => Ok(None),
    }
}

/// The file of the machine's model for a shading mode.
pub(crate) fn file_of(shading: Shading) -> Option<PathBuf> {
    Some(data_folder()?.join("entire").join(format!("machine-{shading}.safetensors")))
}

/// The machine's model for a shading mode, with its file and its clock; `None` where `entire calibrate` was
/// not run.
pub(crate) fn machine_model(shading: Shading) -> Result<Option<(PathBuf, ModelFile, Option<Clock>)>> {
    let Some(path) = file_of(shading).filter(|p| p.is_file()) else { return Ok(None) };
    let (file, model) = read_model_file(&path).with_context(|| {
        format!(
            "the machine's model is damaged; remove {}, or make it again with `entire calibrate --shade \
             {shading}`",
            path.display()
        )
    })?;
    let clock = entire_io::clock::of(&model);
    Ok(Some((path, file, clock)))
}

/// Returns the reason for ignoring the machine's model: it was calibrated on a GPU and a renderer in software
/// draws, or the reverse. `None` if both are of one kind, or if the model names no renderer. `backend` and
/// `device` name the renderer.
pub(crate) fn of_another_kind(path: &Path, file: &ModelFile, backend: &str, device: &str) -> Option<String> {
    let of = |key: Key| file.metadata.get(key.name()).map_or("", String::as_str);
    let (renderer, made_on) = (of(Key::Renderer), of(Key::Device));
    let differs =
        !renderer.is_empty() && names_software(renderer, made_on) != names_software(backend, device);
    differs.then(|| {
        format!(
            "{} is ignored: it was calibrated on {made_on}, but frames are drawn by {device}",
            path.display()
        )
    })
}

/// Returns the machine's model for a shading mode, with its name, and the clock of frame times: `asked`; for
/// `auto`, the clock that this model states, else that of the renderer. The model is ignored, with a note, if
/// it states no clock or another clock than the requested one. It is also ignored if it was calibrated on a
/// GPU and a renderer in software draws, or the reverse.
pub(crate) fn machine_model_for(
    shading: Shading,
    asked: ClockChoice,
    renderer: &dyn Renderer,
) -> Result<(Option<(String, ModelFile)>, Clock)> {
    let without = Ok((None, waited_for(asked, renderer)));
    let Some((path, file, stated)) = machine_model(shading)? else { return without };
    if let Some(why) = of_another_kind(&path, &file, renderer.backend(), &renderer.device()) {
        note(&format!(
            "{why}; `entire calibrate --shade {shading}` with the same --device makes a model of this \
             device, which replaces the present model unless --out names another file"
        ));
        return without;
    }
    let Some(clock) = stated.filter(|c| asked.is_none_or(|a| a == *c)) else {
        note(&format!("{} {}", path.display(), ignored(shading, stated, asked)));
        return without;
    };
    Ok((Some((format!("{}, of this machine", path.display()), file)), clock))
}

/// Returns the reason why the machine's model is ignored, and the remedy.
fn ignored(shading: Shading, stated: Option<Clock>, asked: ClockChoice) -> String {
    let asked = asked.map(Clock::name);
    let remedy = asked.map_or(String::new(), |name| format!(" --clock {name}"));
    match (stated, asked) {
        (Some(stated), Some(asked)) => format!(
            "is ignored: it predicts {} time, but frames are timed by the clock {asked} (`entire calibrate \
             --shade {shading}{remedy}` makes a model of that clock)",
            stated.name()
        ),
        _ => format!(
            "is ignored: it states no clock (`entire calibrate --shade {shading}{remedy}` makes a model that \
             states its clock)"
        ),
    }
}

/// Returns the file of the machine's model for a shading mode.
///
/// # Errors
/// When there is no such model; the message names the command that makes one.
pub fn machine_file(shading: Shading) -> Result<PathBuf> {
    file_of(shading).filter(|p| p.is_file()).with_context(|| {
        let shading: &str = shading.into();
        format!(
            "this machine has no model for shading {shading}; make one with `entire calibrate --shade \
             {shading}`, or name a model with --model"
        )
    })
}

/// Default folder of volumes, in the project's root.
pub(crate) const DATA_FOLDER: &str = "data";

/// Ensemble members that the shipped models were trained on.
pub const TRAINING_MEMBERS: [&str; 2] = ["m01", "m02"];

/// Returns every volume ([`is_volume`]) below a folder, sorted by name; other files are ignored. Of an
/// ensemble, only the training members ([`TRAINING_MEMBERS`]) are returned, so that the other members remain
/// unseen test data.
///
/// # Errors
/// When a folder cannot be read.
pub fn volumes_in(folder: &Path) -> Result<Vec<PathBuf>> {
    volumes_of(folder, |member| member.is_none_or(|m| TRAINING_MEMBERS.contains(&m)))
}

/// Returns the volumes below a folder that [`volumes_in`] leaves out, sorted by name: those of held-out
/// ensemble members.
///
/// # Errors
/// When a folder cannot be read.
pub fn held_out_in(folder: &Path) -> Result<Vec<PathBuf>> {
    volumes_of(folder, |member| member.is_some_and(|m| !TRAINING_MEMBERS.contains(&m)))
}

/// Returns the volumes below a folder that `wanted` accepts, sorted by name. `wanted` gets the volume's
/// ensemble member, or `None` for a volume outside any ensemble. Volumes with paths that tables cannot hold
/// are left out, with a note.
fn volumes_of(folder: &Path, wanted: impl Fn(Option<&str>) -> bool) -> Result<Vec<PathBuf>> {
    let mut out = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder)? {
            let path = entry?.path();
            if path.is_dir() {
                folders.push(path);
            } else if is_volume(&path) {
                if let Err(error) = ensure_utf8(&path) {
                    note(&format!("{error}; the volume is left out"));
                    continue;
                }
                let member = Job::from_path(&path).member;
                if wanted(Some(member.as_str()).filter(|m| !m.is_empty())) {
                    out.push(path);
                }
            }
        }
    }
    out.sort();
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_model_that_is_ignored_can_be_made_again_by_the_command_in_the_note() {
        let said = ignored(Shading::None, Some(Clock::Cpu), Some(Clock::Wall));
        assert!(said.contains("predicts cpu time") && said.contains("--shade none --clock wall`"), "{said}");
        for (asked, command) in [
            (None, "`entire calibrate --shade local`"),
            (Some(Clock::Wall), "`entire calibrate --shade local --clock wall`"),
        ] {
            let said = ignored(Shading::Local, None, asked);
            assert!(said.contains("states no clock") && said.contains(command), "{said}");
        }
    }

    #[test]
    fn a_volume_is_calibrated_with_or_held_out() {
        let data = tempfile::tempdir().unwrap();
        let paths =
            ["e/m01/t0001.nrrd", "e/m03/t0001.nrrd", "e/m03/t0002.nii", "e/m03/t0003.csv", "scan.nrrd"]
                .map(|name| data.path().join(name));
        for path in &paths {
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "").unwrap();
        }
        // A volume with a path that is not UTF-8 is left out.
        #[cfg(target_os = "linux")]
        {
            use std::os::unix::ffi::OsStrExt;
            let name = std::ffi::OsStr::from_bytes(b"v\xe9.nrrd");
            std::fs::write(data.path().join(name), "").unwrap();
        }
        let [seen, first, second, _, scan] = paths;
        assert_eq!(volumes_in(data.path()).unwrap(), [seen, scan]);
        assert_eq!(held_out_in(data.path()).unwrap(), [first, second]);
    }

    #[test]
    fn volumes_of_every_format_are_found_and_other_files_are_not() {
        let data = tempfile::tempdir().unwrap();
        let description = r#"{"size": [2, 2, 2], "type": "uint8"}"#;
        let wanted = ["a.nii.gz", "b.NRRD", "c.mhd", "d.vti", "raw.json"];
        for (name, text) in wanted.map(|name| (name, description)).into_iter().chain([
            ("raw.raw", "12345678"),
            ("gone.json", description),
            ("t.manifest.json", r#"{"format": "entire-timings-1"}"#),
            ("t.csv", ""),
            ("c.zraw", ""),
        ]) {
            std::fs::write(data.path().join(name), text).unwrap();
        }
        assert_eq!(volumes_in(data.path()).unwrap(), wanted.map(|name| data.path().join(name)));
    }
}
