//! `entire_model`: a model file, read once and shared by all its users.

use crate::abi::{
    ByValue, by_value, check_output, check_pointer, slice, slice_mut, text, write, write_struct,
};
use crate::frame::entire_shading;
use crate::guard::{Outcome, entry, freeing, making, reading};
use crate::handle::{Held, borrow, handle};
use crate::limits::{ENTIRE_MAX_MODEL_BYTES, at_most};
use crate::pool::Pool;
use crate::reserve;
use crate::result::entire_result::{self, *};
use crate::result::{Failure, frame_time, refuse};
use crate::volume::{Volume, entire_volume};
use entire_core::kernels::{Executor, Level};
use entire_core::memory::{collected, room, try_vec};
use entire_core::model::{GroupKind, Model, ModelFile};
use entire_core::nn::{EncodeScratch, PredNet, PredScratch, Target, VolumeNet};
use entire_steer::predict::{Predictor, load_with};
use std::collections::BTreeMap;
use std::ffi::{CString, c_char};
use std::fs::File;
use std::hash::{BuildHasher, RandomState};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

/// Maximum number of temporary file names that a save tries.
const SAVE_NAMES: u32 = 16;

/// Output quantity of a prediction network: one of the `ENTIRE_TARGET_*` numbers.
pub type entire_target = u32;
/// The model has no prediction network.
pub const ENTIRE_TARGET_NONE: entire_target = 0;
/// Seconds.
pub const ENTIRE_TARGET_SECONDS: entire_target = 1;
/// The natural logarithm of seconds. Predictions are nevertheless returned in seconds.
pub const ENTIRE_TARGET_LOG_SECONDS: entire_target = 2;

/// Description of a model. Set struct_size before the call.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_model_info {
    /// sizeof(entire_model_info).
    pub struct_size: usize,
    /// Number of inputs of entire_model_predict; 0 where the file has no prediction network.
    pub input_count: usize,
    /// Number of groups of these inputs (entire_model_input_group).
    pub group_count: usize,
    /// Number of scene features that the model names (entire_model_scene_feature).
    pub scene_feature_count: usize,
    /// Number of features that entire_model_encode writes; 0 if the file has no volume encoder.
    pub feature_count: usize,
    /// Voxels along each axis of the encoder's input; 0 where the file has no volume encoder.
    pub encoder_edge: usize,
    /// One of ENTIRE_TARGET_*.
    pub target: entire_target,
    /// Must be ignored.
    pub reserved: u32,
}

by_value!(entire_model_info {
    input_count: 0,
    group_count: 0,
    scene_feature_count: 0,
    feature_count: 0,
    encoder_edge: 0,
    target: ENTIRE_TARGET_NONE,
    reserved: 0,
});

/// A named group of consecutive inputs of a model. Set struct_size before the call.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct entire_input_group {
    /// sizeof(entire_input_group).
    pub struct_size: usize,
    /// Name of the group, such as "camera"; valid as long as the model.
    pub name: *const c_char,
    /// Index of the group's first value among the model's inputs.
    pub offset: usize,
    /// Number of values in the group.
    pub size: usize,
}

by_value!(entire_input_group { name: std::ptr::null(), offset: 0, size: 0 });

/// Maximum number of rows of a batch that are computed at once.
const ROWS_AT_ONCE: usize = 192;

/// A model file in memory. Immutable: any number of threads and sessions may use one model at the same time.
pub struct entire_model(Held<Loaded>);

pub(crate) struct Loaded {
    model: Model,
    /// Contents of the model file.
    bytes: Vec<u8>,
    prednet: Option<(Arc<PredNet>, Pool<PredScratch>)>,
    /// Working memory for predictions of several rows.
    rows: Pool<PredScratch>,
    volumenet: Option<(VolumeNet, Pool<EncodeScratch>)>,
    groups: Vec<CString>,
    scene_features: Vec<CString>,
    metadata: BTreeMap<String, CString>,
}

handle!(entire_model, Loaded);

/// A further reference to a model, for a session to keep. No call changes a model.
///
/// # Safety
/// `model` is a live handle of this library.
pub(crate) unsafe fn share(model: *const entire_model) -> Arc<entire_model> {
    // SAFETY: `give` made the pointer by `Arc::into_raw`, and its owner still holds it, so the count is at
    // least one. The count is raised before the new `Arc` takes its share.
    unsafe {
        Arc::increment_strong_count(model);
        Arc::from_raw(model)
    }
}

impl Loaded {
    fn new(model: Model, bytes: &[u8]) -> Result<Self, Failure> {
        let prednet = match &model.prednet {
            Some(parts) => {
                let net = PredNet::new(parts)?;
                let scratch = Pool::filled(|| net.scratch(1))?;
                Some((Arc::new(net), scratch))
            }
            None => None,
        };
        let volumenet =
            model.volumenet.as_ref().map(VolumeNet::new).transpose()?.map(|net| (net, Pool::lazy()));
        Ok(Self {
            rows: Pool::lazy(),
            volumenet,
            groups: model.inputs.iter().map(|g| kept_text(&g.name)).collect::<Result<_, _>>()?,
            scene_features: model.scene_features.iter().map(|t| kept_text(t)).collect::<Result<_, _>>()?,
            metadata: model
                .metadata
                .iter()
                .map(|(key, value)| Ok((key.clone(), kept_text(value)?)))
                .collect::<Result<_, Failure>>()?,
            prednet,
            bytes: collected(bytes.iter().copied())?,
            model,
        })
    }

    /// The model as a file that can be modified.
    pub(crate) fn file(&self) -> Result<ModelFile, Failure> {
        Ok(ModelFile::from_bytes(&self.bytes)?)
    }

    pub(crate) fn predictor(&self) -> Result<Box<dyn Predictor + Send>, Failure> {
        let (net, _) = self.prednet()?;
        Ok(load_with(net, &self.model)?)
    }

    /// The volume features for the model's predictions: the volume's precomputed ones, else the encoder's;
    /// `None` if the model takes none.
    pub(crate) fn features_of(&self, volume: &Volume) -> Result<Option<Vec<f32>>, Failure> {
        let Some(size) = self.model.input_size(GroupKind::VolumeFeatures) else { return Ok(None) };
        if let Some(ready) = &volume.features {
            if ready.len() != size {
                refuse!(
                    ENTIRE_SIZE_MISMATCH,
                    "the volume has {} precomputed features, but the model takes {size}; encode the volume \
                     with this model",
                    ready.len()
                );
            }
            return Ok(Some(collected(ready.iter().copied())?));
        }
        let mut features = try_vec(size, 0.0)?;
        self.encode(volume, &mut features)?;
        Ok(Some(features))
    }

    fn encode(&self, volume: &Volume, features: &mut [f32]) -> Outcome {
        let (net, pool) = self.volumenet()?;
        let view = volume.view()?;
        let scratch = || Ok::<_, Failure>(net.scratch());
        pool.with(scratch, |scratch| net.encode(view, scratch, Executor::Serial, features))??;
        Ok(())
    }

    fn volumenet(&self) -> Result<&(VolumeNet, Pool<EncodeScratch>), Failure> {
        self.volumenet.as_ref().ok_or_else(|| {
            Failure::new(
                ENTIRE_UNSUPPORTED,
                "the model has no volume encoder; use a file with volumenet.* tensors, \
                 or pass precomputed features to entire_volume_set_features",
            )
        })
    }

    fn prednet(&self) -> Result<&(Arc<PredNet>, Pool<PredScratch>), Failure> {
        self.prednet.as_ref().ok_or_else(|| {
            Failure::new(
                ENTIRE_UNSUPPORTED,
                "the model has no prediction network; use a file with prednet.* tensors",
            )
        })
    }
}

/// Returns a text of the model for C, or the failure if there is no memory for it. A NUL inside becomes the
/// replacement character.
fn kept_text(text: &str) -> Result<CString, Failure> {
    if text.contains('\0') {
        return kept_text(&text.replace('\0', "\u{fffd}"));
    }
    let mut bytes = room(text.len() + 1)?;
    bytes.extend_from_slice(text.as_bytes());
    bytes.push(0);
    Ok(CString::from_vec_with_nul(bytes).unwrap_or_default())
}

/// The instruction set that evaluates models, and its name, determined at the first call.
fn level() -> &'static (Level, CString) {
    static FOUND: OnceLock<(Level, CString)> = OnceLock::new();
    FOUND.get_or_init(|| {
        let level = Level::detect();
        (level, CString::new(level.to_string()).unwrap_or_default())
    })
}

/// The instruction set that evaluates models on this CPU: "scalar", "avx2" or "avx512", followed by its
/// extensions, such as "avx512+vnni". The environment variable ENTIRE_LEVEL selects a lower instruction set;
/// the variable is read only once. The text is static.
#[unsafe(no_mangle)]
pub extern "C" fn entire_simd_level() -> *const c_char {
    level().1.as_ptr()
}

/// Reads a model file.
///
/// Fails with ENTIRE_IO (the file cannot be read), ENTIRE_INVALID_MODEL, ENTIRE_INVALID_TENSOR,
/// ENTIRE_SIZE_MISMATCH (a file over ENTIRE_MAX_MODEL_BYTES), ENTIRE_INVALID_ARGUMENT (a path that is not
/// UTF-8), ENTIRE_OUT_OF_MEMORY, ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_model_open(
    path: *const c_char,
    model: *mut *mut entire_model,
) -> entire_result {
    entry!(making(model, "model (output)", || {
        let path = text(path, "path")?;
        load(&read(Path::new(path), "check the path of the model file")?, path)
    }))
}

/// Reads the model of this machine for a shading mode, which `entire calibrate` stored in the user's data
/// folder: entire/machine-none.safetensors, machine-local.safetensors, machine-scatter.safetensors or
/// machine-local-scatter.safetensors below XDG_DATA_HOME, else below LOCALAPPDATA on Windows and
/// ~/.local/share elsewhere. Its metadata key entire.clock says whether it predicts cpu, wall or device
/// seconds.
///
/// Fails with ENTIRE_IO (this machine was not calibrated for the mode; the error text names the command),
/// ENTIRE_INVALID_ARGUMENT (an unknown shading), and with the same results as entire_model_open for an
/// unsuitable file.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_model_open_machine(
    shading: entire_shading,
    model: *mut *mut entire_model,
) -> entire_result {
    entry!(making(model, "model (output)", || {
        let mode = crate::frame::shading(shading)?;
        let Some(folder) = data_folder() else {
            refuse!(ENTIRE_IO, "no home folder was found to look for the machine's model; set XDG_DATA_HOME");
        };
        let path = folder.join("entire").join(format!("machine-{mode}.safetensors"));
        let bytes = read(&path, &format!("make it with `entire calibrate --shade {mode}`"))?;
        load(&bytes, &path.to_string_lossy())
    }))
}

/// The user's data folder, as `entire calibrate` finds it.
#[allow(
    deprecated,
    reason = "compilers before 1.87 warn about home_dir() because of a bug on Windows that is fixed"
)]
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

/// The bytes of a model file. The error text ends with `remedy` if the file cannot be read.
fn read(path: &Path, remedy: &str) -> Result<Vec<u8>, Failure> {
    let shown = path.display();
    let io = |why: String| Failure::new(ENTIRE_IO, format!("{shown}: {why}; {remedy}"));
    let found = std::fs::metadata(path).map_err(|e| io(e.to_string()))?;
    if !found.is_file() {
        return Err(io("not a regular file".into()));
    }
    let length = usize::try_from(found.len()).unwrap_or(usize::MAX);
    at_most("the model file's size in bytes", length, ENTIRE_MAX_MODEL_BYTES, "ENTIRE_MAX_MODEL_BYTES")
        .map_err(|e| e.within(&shown))?;
    std::fs::read(path).map_err(|e| match e.kind() {
        ErrorKind::OutOfMemory => Failure::new(
            ENTIRE_OUT_OF_MEMORY,
            format!("{shown}: there is no memory for the file's {length} bytes; free some memory"),
        ),
        _ => io(e.to_string()),
    })
}

/// Reads a model from the bytes of a model file; the bytes may be freed when the call returns.
///
/// Fails with ENTIRE_INVALID_MODEL, ENTIRE_INVALID_TENSOR, ENTIRE_SIZE_MISMATCH (over
/// ENTIRE_MAX_MODEL_BYTES), ENTIRE_OUT_OF_MEMORY, ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_model_from_bytes(
    bytes: *const u8,
    byte_count: usize,
    model: *mut *mut entire_model,
) -> entire_result {
    entry!(making(model, "model (output)", || {
        at_most("byte_count", byte_count, ENTIRE_MAX_MODEL_BYTES, "ENTIRE_MAX_MODEL_BYTES")?;
        load(slice(bytes, byte_count, "bytes")?, "model in memory")
    }))
}

/// Reads a model from the bytes of a file. `name` is the model's name in messages.
pub(crate) fn load(bytes: &[u8], name: &str) -> Result<Loaded, Failure> {
    let model = Model::from_bytes(bytes).map_err(|e| Failure::from(e).within(name))?;
    Loaded::new(model, bytes)
}

/// Writes the model to a file, for entire_model_open in a later run and for the command `entire`. The file is
/// written under a temporary name and renamed, so that `path` never names an incomplete file.
///
/// Fails with ENTIRE_IO (the file cannot be written), ENTIRE_INVALID_ARGUMENT (a path that is not UTF-8),
/// ENTIRE_OUT_OF_MEMORY, ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_model_save(model: *const entire_model, path: *const c_char) -> entire_result {
    entry!(reading(model, |loaded| {
        reserve::check()?;
        let path = text(path, "path")?;
        let io = |e: std::io::Error| {
            Failure::new(ENTIRE_IO, format!("{path}: {e}; name a file in a folder that can be written"))
        };
        // Threads, processes and machines that save to the same path write different temporary files.
        let random = || RandomState::new().hash_one(0);
        let names = (0..SAVE_NAMES).map(|_| format!("{path}.{:016x}.part", random()));
        let (mut file, beside) = create_first(names).map_err(io)?;
        let written = file.write_all(&loaded.bytes).and_then(|()| file.sync_all());
        drop(file);
        written.and_then(|()| std::fs::rename(&beside, path)).map_err(|e| {
            // A partial file is useless; a failure to remove it is ignored.
            let _ = std::fs::remove_file(&beside);
            io(e)
        })
    }))
}

/// Creates a file under the first name that is free, and returns the file and its name. A link counts as a
/// taken name.
pub(crate) fn create_first(names: impl Iterator<Item = String>) -> std::io::Result<(File, String)> {
    let mut taken = std::io::Error::from(ErrorKind::AlreadyExists);
    for name in names {
        match File::options().write(true).create_new(true).open(&name) {
            Err(e) if e.kind() == ErrorKind::AlreadyExists => taken = e,
            opened => return opened.map(|file| (file, name)),
        }
    }
    Err(taken)
}

/// Reads the properties of a model; set info->struct_size first.
///
/// Fails with ENTIRE_NULL_ARGUMENT, ENTIRE_STRUCT_SIZE.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_model_describe(
    model: *const entire_model,
    info: *mut entire_model_info,
) -> entire_result {
    entry!(reading(model, |loaded| {
        check_output(info)?;
        let model = &loaded.model;
        let out = entire_model_info {
            input_count: loaded.prednet.as_ref().map_or(0, |(net, _)| net.inputs()),
            group_count: model.inputs.len(),
            feature_count: loaded.volumenet.as_ref().map_or(0, |(net, _)| net.feature_len()),
            encoder_edge: model.volumenet.as_ref().map_or(0, |parts| parts.input),
            scene_feature_count: model.scene_features.len(),
            target: match model.prednet.as_ref().map(|net| net.target) {
                None => ENTIRE_TARGET_NONE,
                Some(Target::Seconds) => ENTIRE_TARGET_SECONDS,
                Some(Target::LogSeconds) => ENTIRE_TARGET_LOG_SECONDS,
            },
            ..ByValue::defaults()
        };
        write_struct(info, &out)
    }))
}

/// Reads the name, size and place of the model's input group `index`; set group->struct_size first.
///
/// Fails with ENTIRE_INVALID_ARGUMENT (no such group), ENTIRE_NULL_ARGUMENT, ENTIRE_STRUCT_SIZE.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_model_input_group(
    model: *const entire_model,
    index: usize,
    group: *mut entire_input_group,
) -> entire_result {
    entry!(reading(model, |loaded| {
        check_output(group)?;
        let groups = &loaded.model.inputs;
        let (Some(found), Some(name)) = (groups.get(index), loaded.groups.get(index)) else {
            refuse!(
                ENTIRE_INVALID_ARGUMENT,
                "input group {index} does not exist; the model has {} (numbered from 0)",
                groups.len()
            );
        };
        let out = entire_input_group {
            name: name.as_ptr(),
            offset: groups[..index].iter().map(|g| g.size).sum(),
            size: found.size,
            ..ByValue::defaults()
        };
        write_struct(group, &out)
    }))
}

/// The name of the model's scene feature `index`, NULL if there is no such feature. Valid as long as the
/// model.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_model_scene_feature(
    model: *const entire_model,
    index: usize,
) -> *const c_char {
    let mut found = std::ptr::null();
    entry!(reading(model, |loaded| {
        found = loaded.scene_features.get(index).map_or(std::ptr::null(), |name| name.as_ptr());
        Ok(())
    }));
    found
}

/// A metadata value of the model file, such as "entire.renderer", "entire.device", "entire.step_reference" or
/// "entire.provenance"; NULL if the file lacks the key. Valid as long as the model.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_model_metadata(
    model: *const entire_model,
    key: *const c_char,
) -> *const c_char {
    let mut found = std::ptr::null();
    entry!(reading(model, |loaded| {
        let key = text(key, "key")?;
        found = loaded.metadata.get(key).map_or(std::ptr::null(), |value| value.as_ptr());
        Ok(())
    }));
    found
}

/// Encodes a volume's voxels into the features that the model's predictions take. `capacity` counts floats;
/// `feature_count` receives how many were written (entire_model_info.feature_count). Takes milliseconds to
/// seconds; may run on several threads at once.
///
/// Fails with ENTIRE_SIZE_MISMATCH (a capacity below the feature count), ENTIRE_UNSUPPORTED (a model without
/// an encoder), ENTIRE_NOT_READY (a volume of bricks, without voxels), ENTIRE_OUT_OF_MEMORY,
/// ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_model_encode(
    model: *const entire_model,
    volume: *const entire_volume,
    features: *mut f32,
    capacity: usize,
    feature_count: *mut usize,
) -> entire_result {
    entry!(reading(model, |loaded| {
        check_pointer(feature_count, "feature_count (output)")?;
        let volume = borrow(volume)?;
        let count = loaded.volumenet()?.0.feature_len();
        if capacity < count {
            refuse!(ENTIRE_SIZE_MISMATCH, "features holds {capacity} floats; the model writes {count}");
        }
        loaded.encode(volume, slice_mut(features, count, "features")?)?;
        write(feature_count, count, "feature_count (output)")
    }))
}

/// Predicts one frame's time from the model's inputs in the file's order. Only the network is evaluated,
/// without the correction that a session learns. May run on several threads at once; does not allocate as
/// long as no more than ENTIRE_CONCURRENT_PREDICTIONS calls run on the model at the same time. Results below
/// 1e-6 s, which networks give for cheap frames, are returned as 1e-6 s.
///
/// Fails with ENTIRE_SIZE_MISMATCH (another number of inputs than the model takes), ENTIRE_INVALID_ARGUMENT
/// (an input that is not finite), ENTIRE_INVALID_MODEL (the model's result is not a frame time),
/// ENTIRE_UNSUPPORTED (a model without a prediction network), ENTIRE_NULL_ARGUMENT.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_model_predict(
    model: *const entire_model,
    inputs: *const f32,
    input_count: usize,
    seconds: *mut f32,
) -> entire_result {
    entry!(reading(model, |loaded| {
        check_pointer(seconds, "seconds (output)")?;
        let inputs = slice(inputs, input_count, "inputs")?;
        let (net, pool) = loaded.prednet()?;
        check_inputs(inputs, net.inputs(), 1)?;
        let predicted = pool.with(|| net.scratch(1), |scratch| net.predict(inputs, scratch))?;
        write(seconds, frame_time(predicted)?, "seconds (output)")
    }))
}

/// Predicts many frames at once: `inputs` holds `rows` rows of `input_count` numbers, `seconds` receives
/// `rows` numbers. Equal to entire_model_predict on each row, up to rounding. Takes memory for `rows` numbers
/// while it runs.
///
/// Fails as entire_model_predict does, for the first row that fails, and with ENTIRE_OUT_OF_MEMORY.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_model_predict_batch(
    model: *const entire_model,
    inputs: *const f32,
    rows: usize,
    input_count: usize,
    seconds: *mut f32,
) -> entire_result {
    entry!(reading(model, |loaded| {
        let (net, _) = loaded.prednet()?;
        let Some(count) = rows.checked_mul(input_count) else {
            refuse!(
                ENTIRE_SIZE_MISMATCH,
                "{rows} rows of {input_count} inputs are more than memory can hold; check the counts"
            );
        };
        let inputs = slice(inputs, count, "inputs")?;
        let seconds = slice_mut(seconds, rows, "seconds (output)")?;
        if rows == 0 {
            return Ok(());
        }
        check_inputs(inputs, net.inputs(), rows)?;
        let scratch = || net.scratch(ROWS_AT_ONCE);
        // Predictions are written to separate memory first, so that a failed call leaves the caller's
        // array unchanged.
        let mut predicted = try_vec(rows, 0.0f32)?;
        loaded.rows.with(scratch, |scratch| {
            net.predict_batch(Executor::Serial, inputs, &mut predicted, std::slice::from_mut(scratch))
        })??;
        for (row, answer) in predicted.iter_mut().enumerate() {
            *answer = frame_time(*answer).map_err(|e| e.within(format_args!("row {row}")))?;
        }
        seconds.copy_from_slice(&predicted);
        Ok(())
    }))
}

fn check_inputs(inputs: &[f32], expected: usize, rows: usize) -> Outcome {
    if inputs.len() != expected.saturating_mul(rows) {
        refuse!(
            ENTIRE_SIZE_MISMATCH,
            "{} inputs in {rows} row(s) were given; the model takes {expected} per row, as \
             entire_model_describe states",
            inputs.len()
        );
    }
    if let Some(i) = inputs.iter().position(|v| !v.is_finite()) {
        let (column, row, value) = (i % expected, i / expected, inputs[i]);
        refuse!(
            ENTIRE_INVALID_ARGUMENT,
            "input {column} of row {row} is {value}; inputs must be finite. Rows and inputs count from 0"
        );
    }
    Ok(())
}

/// Releases the caller's reference to a model; NULL does nothing. Sessions hold references of their own, so a
/// model may be freed before the sessions that use it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn entire_model_free(model: *mut entire_model) {
    entry!(freeing(model))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_with_a_nul_stays_readable() {
        assert_eq!(kept_text("a\0b").unwrap().to_str().unwrap(), "a\u{fffd}b");
    }
}
