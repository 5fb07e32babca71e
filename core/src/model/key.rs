//! Names of metadata entries and input groups in a model file.

use crate::Result;
use crate::error::bail;
use crate::names::names;
use alloc::string::String;
use core::str::FromStr;

/// The format version that this crate reads and writes.
pub(crate) const FORMAT: &str = "1";

/// Metadata entries of a model file. Files may hold other entries, which are kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Key {
    /// `entire.format`: version of the file format, `1`.
    Format,
    /// `entire.inputs`: JSON array of the input groups in order.
    Inputs,
    /// `entire.target`: `seconds` or `log_seconds`.
    Target,
    /// `entire.volumenet`: JSON object with the edge of VolumeNet's input in voxels, and the stride and the
    /// padding of each block.
    VolumeNet,
    /// `entire.scene_features`: JSON array of the scene features' names in order.
    SceneFeatures,
    /// `entire.renderer`: the renderer of the timings (free text).
    Renderer,
    /// `entire.device`: the device of the timings (free text).
    Device,
    /// `entire.clock`: the clock whose seconds the model predicts: `cpu` (processor time), `wall` or
    /// `device`.
    Clock,
    /// `entire.step_reference`: the meaning of step 1 in the timings (free text).
    StepReference,
    /// `entire.provenance`: origin of the weights (free text, or JSON).
    Provenance,
    /// `entire.calibration`: JSON object with `level` (0.95) and `log_factor` (ln of upper bound /
    /// prediction). Analytic models also have `low` and `high`: smallest and largest values, over the
    /// training frames, of ln(pixels + 1) and of ln(count / pixels + 0.01) for rays, skips, samples and
    /// `lane_samples`. Networks may also have `input_low` and `input_high`: ends of the range to which each
    /// input is clamped (`InputRange` of `entire-steer`). Optional.
    Calibration,
    /// `entire.unit_costs`: JSON object that maps names to unit costs in seconds. The input
    /// `estimated_seconds` is computed from them. The names are `frame` and those in `COST_QUANTITIES` of
    /// `entire-steer`; the unit cost of a missing name is 0.
    UnitCosts,
    /// `entire.cached_voxels`: number of voxels that the caches hold, for the file's scene features and unit
    /// costs, as a decimal number. In a frame that touches this many voxels, half of the reads that no
    /// neighboring ray shares wait for memory. Without this entry, the number is that of
    /// `UnitCosts::SOFTWARE` of `entire-steer`.
    CachedVoxels,
    /// `entire.probe_side`: number of rays along each side of the probe that measured the scene features, as
    /// a decimal number from 1 to `MAX_PROBE_SIDE` of `entire-steer`. Without this entry, the number is
    /// `PROBE_SIDE` of `entire-steer`.
    ProbeSide,
    /// `entire.lobe_order`: order of Gaussian lobes in a model's inputs: `center` for ascending centers.
    /// Without this entry, lobes keep the caller's order. A sum of lobes does not depend on their order; a
    /// network that always sees the same order need not learn this independence.
    LobeOrder,
    /// `entire.quality`: JSON object of the four numbers of `Quality` of `entire-steer`: picture errors of
    /// coarser steps and smaller images, for the renderer that [`Key::Renderer`] names. Optional.
    Quality,
}

names! { Key:
    Format "entire.format",
    Inputs "entire.inputs",
    Target "entire.target",
    VolumeNet "entire.volumenet",
    SceneFeatures "entire.scene_features",
    Renderer "entire.renderer",
    Device "entire.device",
    Clock "entire.clock",
    StepReference "entire.step_reference",
    Provenance "entire.provenance",
    Calibration "entire.calibration",
    UnitCosts "entire.unit_costs",
    CachedVoxels "entire.cached_voxels",
    ProbeSide "entire.probe_side",
    LobeOrder "entire.lobe_order",
    Quality "entire.quality",
}

impl From<Key> for String {
    fn from(key: Key) -> Self {
        key.name().into()
    }
}

/// Input groups that this version supplies. `Display` gives the name that model files use for a group;
/// `FromStr` parses this name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum GroupKind {
    /// `volume_features`: VolumeNet's output.
    VolumeFeatures,
    /// `camera`: rotations R_x and R_y in degrees, and camera distance D_z in radii of the bounding sphere.
    Camera,
    /// `resolution`: the image's width and height in pixels.
    Resolution,
    /// `transfer_function`: center, width and height of each Gaussian lobe.
    TransferFunction,
    /// `step_size`: the ray step in multiples of the reference step.
    StepSize,
    /// `scene_features`: the scene features that [`Key::SceneFeatures`] names.
    SceneFeatures,
}

impl GroupKind {
    /// Returns the group with this name, or `None` if this version has no such group.
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
