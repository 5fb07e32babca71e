//! Fits a model to frames timed on the present machine.
//!
//! A session adds its observed frames to a `Calibration` ([`crate::Session::record`]), which keeps frames and
//! fits a model to them, so that a program calibrates without leaving its render loop. [`fit_frames`] fits a
//! model to frames that were timed elsewhere. Both take models of other machines as prior.

mod pictures;
mod posterior;
#[cfg(test)]
pub(crate) mod tests;

pub use pictures::{FittedQuality, Picture, fit_quality};
pub use posterior::{Chosen, Observed, fit_frames, prior_costs};

use crate::features::UnitCosts;
use crate::memory::mixed;
use crate::predict::{COSTS, Clock, Quality, UpperBound};
use alloc::string::ToString;
use alloc::vec::Vec;
use core::ops::RangeInclusive;
use entire_core::Result;
use entire_core::bail;
use entire_core::memory::{reserve, room};
use entire_core::model::{Key, ModelFile};
use entire_core::names;
use posterior::{FEWEST_GROUPS, PriorModel};

/// Smallest number of frames that a model is fitted to.
pub const FEWEST_FRAMES: usize = 8;

/// Range of the number of frames that a [`Calibration`] may keep.
const KEPT_FRAMES: RangeInclusive<usize> = FEWEST_FRAMES..=65_536;

/// Number of time intervals for cross-validation, used if there are too few volumes and transfer functions.
const STRETCHES: u64 = 5;

/// Scene of a timed frame: hashes of its volume and its transfer function.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Shown {
    /// Hash of the volume ([`crate::VolumeSummary::fingerprint`]).
    pub(crate) volume: u64,
    /// Hash of the transfer function's opacities ([`crate::features::TransferSummary::fingerprint`]).
    pub(crate) transfer: u64,
}

/// Kind of the groups of frames that are held out together in cross-validation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum HeldOut {
    /// None: there were too few frames. The errors are those of the frames that the model was fitted to.
    Nothing = 0,
    /// Volumes: the errors are those expected for volumes that were not timed.
    Volumes = 1,
    /// Transfer functions: the errors are those expected for the same volumes under transfer functions that
    /// were not timed.
    TransferFunctions = 2,
    /// Time intervals: the errors are those expected for the same scenes in views that were not timed.
    Stretches = 3,
}

names! { HeldOut:
    Nothing "nothing",
    Volumes "volumes",
    TransferFunctions "transfer functions",
    Stretches "stretches of time",
}

/// A model fitted to recorded frames ([`crate::Session::calibrate`]).
#[derive(Clone, Debug)]
pub struct Calibrated {
    /// The model file.
    pub file: ModelFile,
    /// Number of frames that the model was fitted to.
    pub frames: usize,
    /// Groups that were held out to measure `median_error`, `rmse_over_sd` and `upper`.
    pub held_out: HeldOut,
    /// Median of |predicted / measured − 1| over held-out frames.
    pub median_error: f64,
    /// Root mean square error of the seconds of held-out frames, divided by the standard deviation of these
    /// seconds; NaN if all of these seconds are equal.
    pub rmse_over_sd: f64,
    /// Upper bound from the held-out frames.
    pub upper: UpperBound,
    /// Picture quality law; `None` if [`fit_quality`] cannot fit a law to the added pictures.
    pub quality: Option<FittedQuality>,
}

/// Timed frames of one renderer, up to a largest number. Beyond this number, new frames replace kept frames
/// at random, so that the kept frames are a uniform random sample of all frames.
#[derive(Clone, Debug)]
pub(crate) struct Calibration {
    prior: PriorModel,
    kept: Vec<Kept>,
    capacity: usize,
    offered: u64,
    pictures: Vec<Picture>,
}

#[derive(Clone, Copy, Debug)]
struct Kept {
    work: [f64; COSTS],
    seconds: f64,
    shown: Shown,
    /// Number of frames offered before this one.
    order: u64,
}

impl Calibration {
    /// Returns a calibration that keeps at most `frames` frames, from 8 to 65 536. `prior` is an analytic
    /// model of another machine or renderer. Without a prior, the fit starts from the unit costs of a
    /// software renderer.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for a number of frames outside the range,
    /// [`crate::ErrorKind::OutOfMemory`], and for the prior as [`prior_costs`].
    pub(crate) fn new(prior: Option<&ModelFile>, frames: usize) -> Result<Self> {
        if !KEPT_FRAMES.contains(&frames) {
            bail!(
                InvalidArgument,
                "a calibration is to keep {frames} frames; {} to {} are accepted",
                KEPT_FRAMES.start(),
                KEPT_FRAMES.end()
            );
        }
        let prior = match prior {
            Some(file) => PriorModel::new(core::slice::from_ref(file), &UnitCosts::SOFTWARE)?,
            None => PriorModel::default(),
        };
        Ok(Self { kept: room(frames)?, capacity: frames, offered: 0, prior, pictures: Vec::new() })
    }

    /// Drops all frames and pictures.
    pub(crate) fn clear(&mut self) {
        self.kept.clear();
        self.pictures.clear();
        self.offered = 0;
    }

    /// Number of kept frames.
    pub(crate) fn frames(&self) -> usize {
        self.kept.len()
    }

    /// Adds a picture that was compared with the same view at full quality. [`Calibration::fit`] then stores
    /// a picture quality law in the model ([`fit_quality`]), if at least three scenes were drawn at the same
    /// settings. The first 65 536 pictures are kept.
    ///
    /// # Errors
    /// As [`Picture::check`], and [`crate::ErrorKind::OutOfMemory`].
    pub(crate) fn add_picture(&mut self, picture: Picture) -> Result<()> {
        picture.check()?;
        if self.pictures.len() < *KEPT_FRAMES.end() {
            let wanted = self.pictures.len() + 1;
            reserve(&mut self.pictures, wanted)?;
            self.pictures.push(picture);
        }
        Ok(())
    }

    /// Adds a frame whose work is already computed; does not allocate.
    pub(crate) fn add_work(&mut self, work: &[f64; COSTS], shown: Shown, seconds: f64) {
        let frame = Kept { work: *work, seconds, shown, order: self.offered };
        // Reservoir sampling: every offered frame is kept with the same probability.
        let drawn = (mixed(0, self.offered) % (self.offered + 1)) as usize;
        self.offered += 1;
        if self.kept.len() < self.capacity {
            self.kept.push(frame);
        } else if let Some(slot) = self.kept.get_mut(drawn) {
            *slot = frame;
        }
    }

    /// Returns the kind of the groups to hold out, and the group of each frame.
    fn groups(&self) -> (HeldOut, Vec<u64>) {
        let distinct = |numbers: &[u64]| {
            let mut sorted = numbers.to_vec();
            sorted.sort_unstable();
            sorted.dedup();
            sorted.len()
        };
        let volumes: Vec<u64> = self.kept.iter().map(|k| k.shown.volume).collect();
        if distinct(&volumes) >= FEWEST_GROUPS {
            return (HeldOut::Volumes, volumes);
        }
        let of = |k: &Kept| k.shown.volume ^ k.shown.transfer.rotate_left(32);
        let transfers: Vec<u64> = self.kept.iter().map(of).collect();
        if distinct(&transfers) >= FEWEST_GROUPS {
            return (HeldOut::TransferFunctions, transfers);
        }
        if self.kept.len() < 3 * STRETCHES as usize {
            return (HeldOut::Nothing, volumes.iter().map(|_| 0).collect());
        }
        // Consecutive frames are similar, so whole intervals are held out.
        let last = self.kept.iter().map(|k| k.order).max().unwrap_or(0);
        let first = self.kept.iter().map(|k| k.order).min().unwrap_or(0);
        let stretch = |k: &Kept| STRETCHES * (k.order - first) / (last - first + 1);
        (HeldOut::Stretches, self.kept.iter().map(stretch).collect())
    }

    /// Fits a model to the frames; 500 of them take a second or less on one thread. `source` names the
    /// renderer and the clock of their times, and is stored in the file.
    ///
    /// # Errors
    /// [`crate::ErrorKind::NotReady`] for fewer than [`FEWEST_FRAMES`], [`crate::ErrorKind::OutOfMemory`],
    /// and as [`fit_frames`].
    pub(crate) fn fit(&self, source: [&str; 2]) -> Result<Calibrated> {
        if self.kept.len() < FEWEST_FRAMES {
            bail!(
                NotReady,
                "{} frames were observed; a fit needs at least {FEWEST_FRAMES}, better 50 or more of several volumes \
                 and transfer functions",
                self.kept.len()
            );
        }
        // The fit makes many small allocations, and each would abort the program if memory were short. So the
        // total is allocated once, and freed, to return an error instead.
        let pieces = self.kept.len() * (size_of::<Observed>() + 512);
        drop(room::<u8>(pieces)?);
        let (held_out, groups) = self.groups();
        let frames: Vec<Observed> = self
            .kept
            .iter()
            .zip(&groups)
            .map(|(k, &group)| Observed { work: k.work, seconds: k.seconds, group })
            .collect();
        let chosen = self.prior.choose(&frames, &UnitCosts::OF_UNKNOWN)?;
        let (median_error, rmse_over_sd) = chosen.errors(&frames);
        let logs = chosen.crossed.iter().zip(&frames).map(|(p, f)| libm::log(f.seconds / p));
        let upper = UpperBound::from_groups(logs.zip(groups));
        // If the pictures do not suffice for a fit, the model has no picture quality law.
        let quality = fit_quality(&self.pictures, Quality::built_in(source[0])).ok();
        let provenance = serde_json::json!({
            "what": "Calibrated to its host's renderer",
            "clock": stated(source[1]),
            "frames": frames.len(),
            "held_out": held_out.to_string(),
            "median_error": median_error,
            "rmse_over_sd": rmse_over_sd,
        });
        let mut file = chosen.file;
        let law = quality.as_ref().map(|fitted| &fitted.quality);
        write_metadata(&mut file, [source[0], "", source[1]], upper, law, provenance.to_string())?;
        Ok(Calibrated { file, frames: frames.len(), held_out, median_error, rmse_over_sd, upper, quality })
    }
}

/// Returns the text, or "not stated" if it is empty.
fn stated(text: &str) -> &str {
    if text.is_empty() { "not stated" } else { text }
}

/// Writes the metadata of a model that was fitted to measured frames: the renderer, the device and the clock
/// of their times, the upper bound, the picture quality law, and `provenance`, a JSON object. Without
/// `quality`, the file has no law: that of its prior may be the law of another renderer.
///
/// # Errors
/// As [`UpperBound::store`] and [`crate::Session::set_quality`].
pub fn write_metadata(
    file: &mut ModelFile,
    [renderer, device, clock]: [&str; 3],
    upper: UpperBound,
    quality: Option<&Quality>,
    provenance: String,
) -> Result<()> {
    upper.store(file)?;
    file.metadata.remove(Key::Quality.name());
    if let Some(quality) = quality {
        quality.store(file)?;
    }
    let metadata = &mut file.metadata;
    metadata.insert(Key::Renderer.into(), stated(renderer).to_string());
    metadata.insert(Key::Device.into(), stated(device).to_string());
    metadata.insert(Key::StepReference.into(), "smallest voxel spacing".into());
    // Programs compare the stored name with the clock of a session, so only a known name is stored.
    if let Some(clock) = Clock::named(clock) {
        metadata.insert(Key::Clock.into(), clock.name().into());
    } else {
        metadata.remove(Key::Clock.name());
    }
    metadata.insert(Key::Provenance.into(), provenance);
    Ok(())
}
