//! The names, units and order of scene features, as model files use them (`entire.scene_features`).

use crate::Result;
use crate::error::bail;
use alloc::string::String;
use core::fmt;
use core::str::FromStr;

/// The words of the table's last two columns.
macro_rules! flag {
    (yes) => {
        true
    };
    (no) => {
        false
    };
}

macro_rules! quantities {
    ($(
        $variant:ident, $name:literal, $unit:literal, $floor:literal, $step:ident, $probe:ident, $doc:literal;
    )*) => {
        /// A physical quantity of a scene that the core computes.
        ///
        /// | name | unit | log floor | depends on the step | needs the probe | meaning |
        /// |---|---|---|---|---|---|
        $(#[doc = concat!(
            "| `", $name, "` | ", $unit, " | ", $floor, " | ", stringify!($step), " | ",
            stringify!($probe), " | ", $doc, " |"
        )])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        #[non_exhaustive]
        pub enum SceneQuantity {
            $(#[doc = $doc] $variant,)*
        }

        impl SceneQuantity {
            /// Every quantity, in the order of the table.
            pub const ALL: &'static [Self] = &[$(Self::$variant,)*];

            /// The name used in model files: what `Display` writes.
            pub(crate) const fn name(self) -> &'static str {
                match self { $(Self::$variant => $name,)* }
            }

            /// What the log variant adds before it takes the natural logarithm.
            pub(crate) const fn log_floor(self) -> f64 {
                match self { $(Self::$variant => $floor,)* }
            }

            /// Whether the ray step of the setting enters it.
            pub(crate) const fn depends_on_step(self) -> bool {
                match self { $(Self::$variant => flag!($step),)* }
            }

            /// Whether rays must be cast to know it. The others follow from camera, image size, transfer
            /// function and volume at once.
            pub const fn needs_probe(self) -> bool {
                match self { $(Self::$variant => flag!($probe),)* }
            }
        }
    };
}

// Variant, name, unit, log floor, depends on the step, needs the probe, meaning.
quantities! {
    Pixels, "pixels", "pixels", 1.0, no, no, "pixels of the image";
    Rays, "rays", "rays", 1.0, no, no, "pixels whose ray meets the volume's box";
    Samples, "samples", "samples", 1.0, yes, yes, "expected samples of the frame up to early termination";
    Skips, "skips", "jumps", 1.0, yes, yes, "expected jumps over empty blocks";
    LaneSamples, "lane_samples", "samples", 1.0, yes, yes,
        "samples where a tile of 8 x 8 pixels runs until its longest ray ends";
    LocalSamples, "local_samples", "samples", 1.0, yes, yes, "visible samples, with local shading; else 0";
    ScatterSamples, "scatter_samples", "samples", 1.0, yes, yes,
        "visible samples, with single scattering; else 0";
    ShadowSamples, "shadow_samples", "samples", 1.0, yes, yes,
        "samples along shadow rays, with single scattering; else 0";
    Runs, "runs", "runs", 1.0, no, yes, "expected runs of samples between jumps over empty blocks";
    SpreadSamples, "spread_samples", "samples", 1.0, yes, yes,
        "lane samples, each weighted by how little neighboring rays share";
    SpreadRuns, "spread_runs", "runs", 1.0, no, yes,
        "runs, each weighted by how little neighboring rays share";
    ShadedPerPixel, "shaded_per_pixel", "samples/pixel", 0.01, yes, yes,
        "visible samples over pixels of the image, with shading; else 0";
    ShadowPerPixel, "shadow_per_pixel", "samples/pixel", 0.01, yes, yes,
        "samples along shadow rays over pixels of the image";
    RunsPerRay, "runs_per_ray", "runs/ray", 0.1, no, yes, "runs over rays that meet the volume's box";
    EstimatedSeconds, "estimated_seconds", "seconds", 1.0e-9, yes, yes,
        "work times the unit costs that the model file holds, or those of a software renderer";
    RaySpacing, "ray_spacing", "reference steps", 0.01, no, yes,
        "distance of neighboring rays at the mean depth of the samples";
    SamplesPerPixel, "samples_per_pixel", "samples/pixel", 0.01, yes, yes, "samples over pixels of the image";
    SkipsPerPixel, "skips_per_pixel", "jumps/pixel", 0.01, yes, yes, "jumps over pixels of the image";
    FootprintShare, "footprint_share", "1", 1.0e-6, no, no, "share of the image that the volume's box covers";
    MeanChord, "mean_chord", "reference steps", 1.0, no, yes,
        "mean length of the box along the rays that meet it";
    MaxChord, "max_chord", "reference steps", 1.0, no, yes, "largest such length";
    TerminatedShare, "terminated_share", "1", 0.01, no, yes, "share of rays that end early";
    Divergence, "divergence", "1", 0.01, yes, yes, "lane samples over samples, less one";
    OccupiedShare, "occupied_share", "1", 0.0001, no, no,
        "share of blocks that are not empty under the transfer function";
    VisibleShare, "visible_share", "1", 0.001, no, no, "share of voxels with any opacity";
    MeanOpacity, "mean_opacity", "1", 1.0e-6, no, no, "opacity averaged over voxels";
    MeanSquareOpacity, "mean_square_opacity", "1", 1.0e-9, no, no, "squared opacity averaged over voxels";
    MeanExtinction, "mean_extinction", "1/reference step", 1.0e-4, no, no, "extinction averaged over voxels";
    MaxOpacity, "max_opacity", "1", 1.0e-6, no, no, "largest opacity of the transfer function";
    Step, "step", "reference steps", 0.0, yes, no, "ray step";
    Distance, "distance", "bounding-sphere radii", 0.001, no, no,
        "distance of the eye from the volume's center";
    FieldOfView, "field_of_view", "radians", 0.0, no, no, "vertical field of view";
    Tilt, "tilt", "1", 0.001, no, no, "|sin R_x|";
    Turn, "turn", "1", 0.001, no, no, "|sin 2 R_y|";
    Inside, "inside", "flag", 1.0, no, no, "1 with the eye inside the box";
    Voxels, "voxels", "voxels", 1.0, no, no, "voxels of the volume";
    BytesPerVoxel, "bytes_per_voxel", "bytes", 1.0, no, no, "size of a scalar";
    Anisotropy, "anisotropy", "1", 1.0e-6, no, no, "smallest over largest voxel spacing";
    Local, "shading_local", "flag", 1.0, no, no, "1 with local shading";
    Scatter, "shading_scatter", "flag", 1.0, no, no, "1 with single scattering";
    SkippingBlocks, "skipping_blocks", "flag", 1.0, no, no, "1 with block skipping";
    SkippingDistance, "skipping_distance", "flag", 1.0, no, no, "1 with the distance map";
    FirstFrame, "first_frame", "flag", 1.0, no, no, "1 for the first frame";
    TransferChanged, "transfer_changed", "flag", 1.0, no, no, "1 when the transfer function is new";
    VolumeChanged, "volume_changed", "flag", 1.0, no, no, "1 when the volume is new";
    SizeChanged, "size_changed", "flag", 1.0, no, no, "1 when the image size is new";
    Remapped, "remapped", "flag", 1.0, no, no,
        "1 unless the voxels are integers from 0 (which is among them) to at most 32767: a renderer that \
         looks values up in a table must shift or scale each";
    AlongX, "along_x", "1", 0.01, no, no,
        "share of the voxel borders crossed by rays that lie across x: where voxels are far apart in \
         memory along an axis, rays along it read slowly";
    AlongZ, "along_z", "1", 0.01, no, no, "the same across z";
    RemappedSamples, "remapped_samples", "samples", 1.0, yes, yes,
        "samples of a volume whose values are remapped; else 0";
    FarX, "far_x", "samples", 1.0, yes, yes,
        "samples read far from the one before: those that no ray beside shares, times the share of the \
         volume beyond a cache, times `along_x`";
    FarY, "far_y", "samples", 1.0, yes, yes, "the same across y";
    FarZ, "far_z", "samples", 1.0, yes, yes, "the same across z";
    Segments, "segments", "segments", 1.0, yes, yes,
        "expected looks at the skip map for samples: a run is cut where the distance to the nearest empty \
         block, which the map holds, is used up";
    SpreadSegments, "spread_segments", "segments", 1.0, yes, yes,
        "segments, each weighted by how little neighboring rays share";
    SegmentsPerRay, "segments_per_ray", "segments/ray", 0.1, yes, yes,
        "segments over rays that meet the volume's box";
    LaneShadowSamples, "lane_shadow_samples", "samples", 1.0, yes, yes,
        "samples along shadow rays where eight rays beside each other wait while any of them shades";
    SpreadShadowSamples, "spread_shadow_samples", "samples", 1.0, yes, yes,
        "samples along shadow rays with all eight waiting, each weighted by how little shadow rays of \
         neighboring rays share";
    SpreadLocalSamples, "spread_local_samples", "samples", 1.0, yes, yes,
        "visible samples, with local shading, each weighted by how little the gradients of neighboring rays \
         share; else 0";
}

impl fmt::Display for SceneQuantity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl From<SceneQuantity> for &'static str {
    fn from(quantity: SceneQuantity) -> Self {
        quantity.name()
    }
}

impl SceneQuantity {
    /// The log variant of a value: ln(value + floor), −69 where that is not positive.
    pub(crate) fn log(self, value: f64) -> f32 {
        libm::log((value + self.log_floor()).max(1.0e-30)) as f32
    }
}

/// A quantity as it stands or its logarithm. In files: the quantity's name, or that name after `log_`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct SceneFeature {
    /// What is measured.
    pub quantity: SceneQuantity,
    /// Whether ln(value + floor) is meant instead of the value.
    pub log: bool,
}

impl FromStr for SceneFeature {
    type Err = crate::Error;

    /// Reads a name as [`SceneFeature`]'s `Display` writes it.
    ///
    /// # Errors
    /// [`crate::ErrorKind::Unsupported`] for a name that this version does not compute; the message lists
    /// all.
    fn from_str(name: &str) -> Result<Self> {
        let (bare, log) = match name.strip_prefix("log_") {
            Some(rest) => (rest, true),
            None => (name, false),
        };
        match SceneQuantity::ALL.iter().find(|q| q.name() == bare) {
            Some(&quantity) => Ok(Self { quantity, log }),
            None => {
                let mut known = String::new();
                for q in SceneQuantity::ALL {
                    if !known.is_empty() {
                        known.push_str(", ");
                    }
                    known.push_str(q.name());
                }
                bail!(
                    Unsupported,
                    "scene feature {name:?} is not one that this version computes; known are {known}, each \
                     also with log_ before it"
                )
            }
        }
    }
}

impl fmt::Display for SceneFeature {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.log {
            f.write_str("log_")?;
        }
        f.write_str(self.quantity.name())
    }
}
