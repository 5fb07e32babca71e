//! The names that a model file uses, each stated once.

use crate::Result;
use crate::error::bail;
use crate::names::names;
use alloc::string::String;
use core::fmt;
use core::str::FromStr;

/// The one format that this version reads and writes.
pub(crate) const FORMAT: &str = "1";

/// What the metadata of a model file states. Files may hold other entries, which stay as they are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Key {
    /// `entire.format`: version of the file format, `1`.
    Format,
    /// `entire.inputs`: JSON array of the input groups in order.
    Inputs,
    /// `entire.target`: `seconds` or `log_seconds`.
    Target,
    /// `entire.volumenet`: JSON object: input edge, stride and padding per block.
    VolumeNet,
    /// `entire.scene_features`: JSON array of the scene features' names in order.
    SceneFeatures,
    /// `entire.renderer`: what rendered the frames that the timings come from (free text).
    Renderer,
    /// `entire.device`: the device that the timings come from (free text).
    Device,
    /// `entire.clock`: the clock whose seconds the model predicts: `cpu` (processor time), `wall` or `device`.
    Clock,
    /// `entire.step_reference`: what a step of 1 meant in the timings (free text).
    StepReference,
    /// `entire.provenance`: where the weights come from (free text, JSON where structured).
    Provenance,
    /// `entire.calibration`: JSON object with `level` (0.95), `log_factor` (ln of upper bound / prediction),
    /// for analytic models `low` and `high` (the range of their work), and for learned factors `input_low` and
    /// `input_high` (one number per input, within which inputs are held: `InputRange` of `entire-steer`).
    /// Optional.
    Calibration,
    /// `entire.unit_costs`: JSON object of seconds by name behind the input `estimated_seconds`: `frame` and
    /// those of `COST_QUANTITIES` of `entire-steer`; names that are missing cost nothing.
    UnitCosts,
    /// `entire.probe_side`: rays along each side of the probe behind the scene features, 1 to
    /// `MAX_PROBE_SIDE` of `entire-steer` in decimal;
    /// `PROBE_SIDE` of `entire-steer` where it is missing.
    ProbeSide,
    /// `entire.lobe_order`: the order in which a model takes Gaussian lobes: `center` for ascending centers.
    /// Without it, lobes go in as they are given. A sum of lobes does not depend on their order; a network
    /// that always sees the same order need not learn so.
    LobeOrder,
    /// `entire.quality`: JSON object of the four numbers of `Quality` of `entire-steer`: what coarser
    /// steps and smaller images cost the pictures of the renderer that [`Key::Renderer`] names. Optional.
    Quality,
}

impl Key {
    /// The key as files have it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Format => "entire.format",
            Self::Inputs => "entire.inputs",
            Self::Target => "entire.target",
            Self::VolumeNet => "entire.volumenet",
            Self::SceneFeatures => "entire.scene_features",
            Self::Renderer => "entire.renderer",
            Self::Device => "entire.device",
            Self::Clock => "entire.clock",
            Self::StepReference => "entire.step_reference",
            Self::Provenance => "entire.provenance",
            Self::Calibration => "entire.calibration",
            Self::UnitCosts => "entire.unit_costs",
            Self::ProbeSide => "entire.probe_side",
            Self::LobeOrder => "entire.lobe_order",
            Self::Quality => "entire.quality",
        }
    }
}

impl fmt::Display for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl From<Key> for String {
    fn from(key: Key) -> Self {
        key.name().into()
    }
}

/// The input groups that this version supplies. `Display` writes a group's name as model files have it,
/// `FromStr` reads it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum GroupKind {
    /// `volume_features`: VolumeNet's output.
    VolumeFeatures,
    /// `camera`: R_x, R_y (degrees) and D_z (bounding-sphere radii).
    Camera,
    /// `resolution`: the image's width and height in pixels.
    Resolution,
    /// `transfer_function`: (c, w, h) per Gaussian lobe.
    TransferFunction,
    /// `step_size`: the ray step in multiples of the reference step.
    StepSize,
    /// `scene_features`: the physical features named by [`Key::SceneFeatures`].
    SceneFeatures,
}

impl GroupKind {
    const ALL: [Self; 6] = [
        Self::VolumeFeatures,
        Self::Camera,
        Self::Resolution,
        Self::TransferFunction,
        Self::StepSize,
        Self::SceneFeatures,
    ];

    /// The group of this name, where this version knows it.
    pub(crate) fn find(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|g| g.name() == name)
    }
}

names! { GroupKind:
    VolumeFeatures "volume_features",
    Camera "camera",
    Resolution "resolution",
    TransferFunction "transfer_function",
    StepSize "step_size",
    SceneFeatures "scene_features",
}

impl FromStr for GroupKind {
    type Err = crate::Error;

    /// # Errors
    /// [`crate::ErrorKind::MissingInput`] for a group that this version cannot supply.
    fn from_str(name: &str) -> Result<Self> {
        match Self::find(name) {
            Some(group) => Ok(group),
            None => bail!(
                MissingInput,
                "the model takes an input group {name:?} that this version does not supply; known are \
                 volume_features, camera, resolution, transfer_function, step_size, scene_features"
            ),
        }
    }
}
