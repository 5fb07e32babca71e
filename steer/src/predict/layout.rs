//! Layout of a model's input rows: input groups, their order and their format.

use super::{GroupKind, InputRange, Inputs, UnitCosts};
use crate::features::{MAX_PROBE_SIDE, PROBE_SIDE, SceneFeature, SceneQuantity, Setting, far_ratio};
use crate::memory::chunks_mut;
use alloc::string::ToString;
use alloc::vec::Vec;
use entire_core::Result;
use entire_core::bail;
use entire_core::model::{InputGroup, Key, Model, ModelFile};
use entire_core::nn::PredNetParts;
use entire_core::scene::{Arcball, GaussianLobe};

/// Layout of a model's inputs: its groups in order, with their sizes, and the parameters needed to compute
/// them.
#[derive(Clone, Debug, PartialEq)]
pub struct InputLayout {
    /// The groups in order, each with its number of values.
    pub groups: Vec<(GroupKind, usize)>,
    /// The scene features, in order: one for each value of their group.
    pub scene_features: Vec<SceneFeature>,
    /// Unit costs for the scene feature `estimated_seconds`; `None` if the model file has none.
    pub unit_costs: Option<UnitCosts>,
    /// Number of cached voxels of the scene features ([`UnitCosts::cached_voxels`]).
    pub cached_voxels: f64,
    /// True if Gaussian lobes are sorted by center; false if they keep the caller's order.
    pub sorted_lobes: bool,
    /// Number of rays along each side of the probe that measures the scene features, 1 to [`MAX_PROBE_SIDE`];
    /// 0 if no scene feature needs a probe.
    pub probe_side: usize,
    /// Range of the training data, to which rows are clamped for the network; `None` if it is unknown.
    pub range: Option<InputRange>,
}

impl InputLayout {
    /// Returns the layout of a new model. `lobes` is the number of Gaussian lobes of the transfer functions,
    /// and `volume_features` the number of outputs of the VolumeNet. Each is ignored if no group needs it.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for an empty list, a repeated group, or a group without values.
    pub fn new(
        groups: &[GroupKind],
        scene_features: Vec<SceneFeature>,
        lobes: usize,
        volume_features: usize,
    ) -> Result<Self> {
        if groups.is_empty() {
            bail!(InvalidArgument, "a model needs at least one input group");
        }
        let mut sized = Vec::with_capacity(groups.len());
        for (i, &group) in groups.iter().enumerate() {
            if groups[..i].contains(&group) {
                bail!(InvalidArgument, "input group {} is named twice", group.name());
            }
            let (size, missing) = match group {
                GroupKind::VolumeFeatures => {
                    (volume_features, "needs an encoder; name a model file that holds a VolumeNet")
                }
                GroupKind::Camera => (3, ""),
                GroupKind::Resolution => (2, ""),
                GroupKind::TransferFunction => (3 * lobes, "needs at least one Gaussian lobe"),
                GroupKind::StepSize => (1, ""),
                GroupKind::SceneFeatures => (scene_features.len(), "names no feature"),
            };
            if size == 0 {
                bail!(InvalidArgument, "the input group {} {missing}", group.name());
            }
            sized.push((group, size));
        }
        Ok(Self {
            groups: sized,
            probe_side: if need_probe(&scene_features) { PROBE_SIDE } else { 0 },
            scene_features,
            unit_costs: None,
            cached_voxels: UnitCosts::CACHED_VOXELS,
            sorted_lobes: false,
            range: None,
        })
    }

    /// Returns the layout of a model file.
    ///
    /// # Errors
    /// [`crate::ErrorKind::MissingInput`] for an unknown input group, [`crate::ErrorKind::Unsupported`] for
    /// an unknown scene feature or order of lobes, [`crate::ErrorKind::InvalidModel`] for an invalid probe
    /// side, or for unit costs, a number of cached voxels or a training range that are not valid.
    pub fn of_model(model: &Model) -> Result<Self> {
        let groups = model
            .inputs
            .iter()
            .map(|group| Ok((group.name.parse::<GroupKind>()?, group.size)))
            .collect::<Result<Vec<_>>>()?;
        let scene_features = model.scene_features.iter().map(|n| n.parse()).collect::<Result<Vec<_>>>()?;
        let probe_side = if need_probe(&scene_features) { stated_probe_side(model)? } else { 0 };
        Ok(Self {
            range: InputRange::of(model, groups.iter().map(|(_, size)| size).sum())?,
            groups,
            scene_features,
            unit_costs: UnitCosts::of(model)?,
            cached_voxels: stored_cached_voxels(model)?,
            sorted_lobes: takes_sorted_lobes(model)?,
            probe_side,
        })
    }

    /// True if an input depends on the ray step.
    pub fn knows_step(&self) -> bool {
        self.groups.iter().any(|g| g.0 == GroupKind::StepSize)
            || self.scene_features.iter().any(|f| f.quantity.depends_on_step())
    }

    /// Number of values per row.
    pub fn width(&self) -> usize {
        self.groups.iter().map(|(_, size)| size).sum()
    }

    /// Stores a network with this layout in a model file: the network's tensors and the description of its
    /// inputs. Without a range, the file keeps its range.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidTensor`] if the parts do not fit together or a weight overflows its
    /// format, [`crate::ErrorKind::InvalidModel`] if the file's calibration is damaged.
    pub fn store(&self, net: &PredNetParts, file: &mut ModelFile) -> Result<()> {
        let group = |&(kind, size): &(GroupKind, usize)| InputGroup { name: kind.name().into(), size };
        file.set_prednet(net, &self.groups.iter().map(group).collect::<Vec<_>>())?;
        if self.sorted_lobes {
            file.metadata.insert(Key::LobeOrder.into(), "center".into());
        }
        if let Some(costs) = &self.unit_costs {
            file.metadata.insert(Key::UnitCosts.into(), costs.to_json()?);
        }
        if !self.scene_features.is_empty() {
            let names: Vec<_> = self.scene_features.iter().map(ToString::to_string).collect();
            file.metadata.insert(Key::SceneFeatures.into(), serde_json::Value::from(names).to_string());
            if self.cached_voxels == UnitCosts::CACHED_VOXELS {
                file.metadata.remove(Key::CachedVoxels.name());
            } else {
                file.metadata.insert(Key::CachedVoxels.into(), self.cached_voxels.to_string());
            }
            store_probe_side(self.probe_side, file);
        }
        self.range.as_ref().map_or(Ok(()), |range| range.store(file))
    }

    /// Widens the range of the training data by rows of `width` inputs each. Without a range, the rows give
    /// it, and the inputs beyond `width` are never clamped. Values that are not finite are ignored.
    pub fn widen(&mut self, rows: &[f32], width: usize) {
        match &mut self.range {
            Some(range) => range.extend(rows, width),
            None => self.range = Some(InputRange::of_rows(rows, width, self.width() - width)),
        }
    }

    /// Clamps a row to the training range, if it is known.
    pub fn hold(&self, row: &mut [f32]) {
        if let Some(range) = &self.range {
            range.hold(row);
        }
    }

    /// Writes a frame's row of [`InputLayout::width`] values.
    ///
    /// # Errors
    /// [`crate::ErrorKind::MissingInput`] if a group was not supplied or has another size than in the model,
    /// [`crate::ErrorKind::SizeMismatch`] for a row whose length is not [`InputLayout::width`].
    pub fn write(&self, inputs: &Inputs<'_>, row: &mut [f32]) -> Result<()> {
        let Inputs { features, setting, .. } = *inputs;
        let (mut work, mut seconds) = (None, None);
        let scene = |quantity, costs: Option<&UnitCosts>| match costs {
            Some(costs) => Some(*seconds.get_or_insert_with(|| costs.time(&features.cost_work(&setting)))),
            None => {
                let work = work.get_or_insert_with(|| features.work(&setting));
                Some(features.quantity_of(quantity, &setting, work))
            }
        };
        self.write_from(inputs, scene, row)
    }

    /// Writes a row as [`InputLayout::write`] does, but with `scene` in place of [`Inputs::features`].
    /// `scene` returns a quantity of the scene in its unit, or `None` if it is unknown. If `scene` gets unit
    /// costs, the quantity is the seconds that the frame's work takes with these costs.
    ///
    /// # Errors
    /// As [`InputLayout::write`].
    pub fn write_from(
        &self,
        inputs: &Inputs<'_>,
        mut scene: impl FnMut(SceneQuantity, Option<&UnitCosts>) -> Option<f64>,
        row: &mut [f32],
    ) -> Result<()> {
        let (found, width) = (row.len(), self.width());
        if found != width {
            bail!(
                SizeMismatch,
                "the row has {found} numbers, but the model takes {width}; see InputLayout::width"
            );
        }
        let mut rest = row;
        for &(group, size) in &self.groups {
            let (here, after) = rest.split_at_mut(size);
            self.write_group(group, inputs, &mut scene, here)?;
            rest = after;
        }
        Ok(())
    }

    fn write_group(
        &self,
        group: GroupKind,
        inputs: &Inputs<'_>,
        scene: &mut impl FnMut(SceneQuantity, Option<&UnitCosts>) -> Option<f64>,
        out: &mut [f32],
    ) -> Result<()> {
        let size = out.len();
        match group {
            GroupKind::VolumeFeatures => match inputs.volume_features {
                Some(x) => copy(group, x, out),
                None => bail!(
                    MissingInput,
                    "the model takes {size} volume features and none were supplied; encode the volume first"
                ),
            },
            GroupKind::Camera => {
                let Arcball { rx, ry, dz } = inputs.camera;
                copy(group, &[rx, ry, dz], out)
            }
            GroupKind::Resolution => {
                let Setting { width, height, .. } = inputs.setting;
                copy(group, &[width, height].map(|n| n as f32), out)
            }
            GroupKind::TransferFunction => {
                let Some(lobes) = inputs.lobes else {
                    bail!(
                        MissingInput,
                        "the model takes Gaussian transfer-function parameters and none were supplied; \
                         describe the transfer function by 1 to {} lobes, or use a model with scene \
                         features, which accepts any transfer function",
                        size / 3
                    );
                };
                let wanted = size / 3;
                if lobes.is_empty() || lobes.len() > wanted {
                    bail!(
                        MissingInput,
                        "the model takes {wanted} Gaussian lobes, the transfer function has {}; describe it by \
                         at least one lobe and at most as many as the model was trained with",
                        lobes.len()
                    );
                }
                // If there are fewer lobes than the model takes, the tallest is split into equal lobes, so
                // that the sum of all lobes stays the same.
                let taller = |a: usize, b: usize| if lobes[b].height > lobes[a].height { b } else { a };
                let tallest = (0..lobes.len()).fold(0, taller);
                let shares = (1 + wanted - lobes.len()) as f32;
                for (i, slot) in out.chunks_exact_mut(3).enumerate() {
                    let of = if i < lobes.len() { i } else { tallest };
                    let GaussianLobe { center, width, height } = lobes[of];
                    let height = if of == tallest { height / shares } else { height };
                    slot.copy_from_slice(&[center, width, height]);
                }
                if self.sorted_lobes {
                    sort_lobes(out);
                }
                Ok(())
            }
            GroupKind::StepSize => copy(group, &[inputs.setting.step], out),
            GroupKind::SceneFeatures => {
                if self.scene_features.len() != size {
                    bail!(
                        MissingInput,
                        "the model takes {size} scene features, but its file names {}; it must name each",
                        self.scene_features.len()
                    );
                }
                for (slot, feature) in out.iter_mut().zip(&self.scene_features) {
                    *slot = self.scene_feature(*feature, scene)?;
                }
                Ok(())
            }
        }
    }

    fn scene_feature(
        &self,
        feature: SceneFeature,
        scene: &mut impl FnMut(SceneQuantity, Option<&UnitCosts>) -> Option<f64>,
    ) -> Result<f32> {
        let SceneFeature { quantity, log } = feature;
        let costs = self.unit_costs.as_ref().filter(|_| quantity == SceneQuantity::EstimatedSeconds);
        let value = match scene(quantity, costs) {
            Some(value) if quantity.is_far() && self.cached_voxels != UnitCosts::CACHED_VOXELS => {
                scene(SceneQuantity::TouchedVoxels, None)
                    .map(|touched| value * far_ratio(touched, self.cached_voxels))
            }
            value => value,
        };
        match value {
            Some(value) => Ok(if log { quantity.log(value) } else { value as f32 }),
            None => bail!(
                MissingInput,
                "the model takes the scene feature {feature}, which was not supplied; measure the frame with \
                 FrameFeatures"
            ),
        }
    }
}

fn need_probe(features: &[SceneFeature]) -> bool {
    features.iter().any(|f| f.quantity.needs_probe())
}

fn copy(group: GroupKind, values: &[f32], out: &mut [f32]) -> Result<()> {
    if out.len() != values.len() {
        let encoded = group == GroupKind::VolumeFeatures;
        let hint = if encoded { "; encode the volume with this model's VolumeNet" } else { "" };
        bail!(
            MissingInput,
            "the model's input group {group} has size {}, but {} values were given{hint}",
            out.len(),
            values.len()
        );
    }
    out.copy_from_slice(values);
    Ok(())
}

/// States the number of rays along each side of the probe in a model file, unless the model needs no probe
/// (`side` is 0) or `side` is the default.
pub(crate) fn store_probe_side(side: usize, file: &mut ModelFile) {
    if ![0, PROBE_SIDE].contains(&side) {
        file.metadata.insert(Key::ProbeSide.into(), side.to_string());
    }
}

fn stated_probe_side(model: &Model) -> Result<usize> {
    let Some(text) = model.metadata.get(Key::ProbeSide.name()) else { return Ok(PROBE_SIDE) };
    match text.parse::<usize>() {
        Ok(side) if (1..=MAX_PROBE_SIDE).contains(&side) => Ok(side),
        _ => bail!(
            InvalidModel,
            "{} is {text:?}; a whole number from 1 to {MAX_PROBE_SIDE} is expected",
            Key::ProbeSide
        ),
    }
}

/// Returns the number of cached voxels in a model file ([`Key::CachedVoxels`]).
pub(super) fn stored_cached_voxels(model: &Model) -> Result<f64> {
    let Some(text) = model.metadata.get(Key::CachedVoxels.name()) else {
        return Ok(UnitCosts::CACHED_VOXELS);
    };
    match text.parse::<f64>() {
        Ok(voxels) if voxels.is_finite() && voxels > 0.0 => Ok(voxels),
        _ => {
            bail!(InvalidModel, "{} is {text:?}; a positive number of voxels is expected", Key::CachedVoxels)
        }
    }
}

fn takes_sorted_lobes(model: &Model) -> Result<bool> {
    match model.metadata.get(Key::LobeOrder.name()).map(|s| s.as_str()) {
        None => Ok(false),
        Some("center") => Ok(true),
        Some(other) => bail!(
            Unsupported,
            "{} is {other:?}; only \"center\" is accepted; without this entry, lobes keep the order in \
             which the caller gives them",
            Key::LobeOrder
        ),
    }
}

/// Sorts the lobes of a `transfer_function` group by center. Each lobe is (center, width, height). The sort
/// is stable.
fn sort_lobes(group: &mut [f32]) {
    let (lobes, _) = chunks_mut::<3, _>(group);
    for end in 1..lobes.len() {
        let at = lobes[..end].partition_point(|lobe| !(lobes[end][0] < lobe[0]));
        lobes[at..=end].rotate_right(1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use alloc::vec;
    use entire_core::ErrorKind;

    #[test]
    fn lobes_are_sorted_by_center_whole_and_stably() {
        let mut group = [0.7, 1.0, 2.0, 0.1, 3.0, 4.0, 0.7, 5.0, 6.0, -0.2, 7.0, 8.0];
        sort_lobes(&mut group);
        assert_eq!(group, [-0.2, 7.0, 8.0, 0.1, 3.0, 4.0, 0.7, 1.0, 2.0, 0.7, 5.0, 6.0]);
        sort_lobes(&mut []);
        let mut one = [0.5, 0.1, 0.2];
        sort_lobes(&mut one);
        assert_eq!(one, [0.5, 0.1, 0.2]);
    }

    #[test]
    fn a_layout_knows_the_step_by_its_group_or_by_any_feature_that_depends_on_it() {
        let of = |groups: &[GroupKind], quantity| {
            InputLayout::new(groups, vec![SceneFeature { quantity, log: true }], 1, 1).unwrap().knows_step()
        };
        for quantity in SceneQuantity::ALL {
            assert_eq!(of(&[GroupKind::SceneFeatures], quantity), quantity.depends_on_step());
            assert!(of(&[GroupKind::SceneFeatures, GroupKind::StepSize], quantity));
        }
    }

    #[test]
    fn groups_that_cannot_be_laid_out_are_refused_by_name() {
        let says = |groups: &[GroupKind]| {
            let e = InputLayout::new(groups, Vec::new(), 0, 0).unwrap_err();
            assert_eq!(e.kind(), ErrorKind::InvalidArgument);
            e
        };
        assert!(says(&[]).to_string().contains("at least one input group"));
        assert!(says(&[GroupKind::Camera, GroupKind::Camera]).to_string().contains("camera is named twice"));
        assert!(says(&[GroupKind::VolumeFeatures]).to_string().contains("volume_features needs an encoder"));
        assert!(says(&[GroupKind::TransferFunction]).to_string().contains("at least one Gaussian lobe"));
        assert!(says(&[GroupKind::SceneFeatures]).to_string().contains("scene_features names no feature"));
        let layout = InputLayout::new(&[GroupKind::StepSize, GroupKind::Camera], Vec::new(), 0, 0).unwrap();
        assert_eq!((layout.width(), layout.probe_side), (4, 0));
        assert!(layout.groups.iter().map(|g| g.0).eq([GroupKind::StepSize, GroupKind::Camera]));
    }
}
