//! Names, units and order of scene features in model files (`entire.scene_features`).

use core::fmt;
use core::str::FromStr;
use entire_core::Result;
use entire_core::bail;
use entire_core::names;

/// Converts an entry of the two yes/no columns in the table of quantities to a `bool`.
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
        /// A physical quantity of a scene. The logarithm of a quantity ([`SceneFeature::log`]) is
        /// ln(value + log floor).
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

        names! { SceneQuantity: $($variant $name,)* }

        impl SceneQuantity {
            /// Offset of the log variant, `floor` in ln(value + floor), in the quantity's unit.
            pub(crate) const fn log_floor(self) -> f64 {
                match self { $(Self::$variant => $floor,)* }
            }

            /// True if the quantity depends on the ray step of the setting.
            pub(crate) const fn depends_on_step(self) -> bool {
                match self { $(Self::$variant => flag!($step),)* }
            }

            /// True if the quantity needs probe rays. All other quantities follow from camera, setting,
            /// transfer function and volume alone.
            pub const fn needs_probe(self) -> bool {
                match self { $(Self::$variant => flag!($probe),)* }
            }
        }
    };
}

// Columns: variant, name, unit, log floor, depends on the step, needs the probe, meaning.
quantities! {
    Pixels, "pixels", "pixels", 1.0, no, no, "pixels of the image";
    Rays, "rays", "rays", 1.0, no, no, "pixels whose ray meets the volume's box";
    Skips, "skips", "jumps", 1.0, yes, yes,
        "expected jumps over empty blocks, those of shadow rays included";
    Samples, "samples", "samples", 1.0, yes, yes, "expected samples of the frame up to early termination";
    LaneSamples, "lane_samples", "samples", 1.0, yes, yes,
        "number of samples if every ray of a tile of 8 x 8 pixels were as long as the tile's longest ray";
    Runs, "runs", "runs", 1.0, no, yes, "expected runs of samples between jumps over empty blocks";
    Segments, "segments", "segments", 1.0, yes, yes,
        "expected reads of the skip map within runs, those along shadow rays included: each read gives the \
         distance to the nearest empty block, and the renderer takes the samples within this distance \
         without another read";
    LocalSamples, "local_samples", "samples", 1.0, yes, yes,
        "visible samples, if the frame has local lighting; 0 without local lighting";
    ScatterSamples, "scatter_samples", "samples", 1.0, yes, yes,
        "visible samples, if the frame has single scattering; 0 without single scattering";
    ShadowSamples, "shadow_samples", "samples", 1.0, yes, yes,
        "samples along shadow rays; 0 without single scattering";
    LaneShadowSamples, "lane_shadow_samples", "samples", 1.0, yes, yes,
        "samples along shadow rays, plus waiting: while one ray of a group of eight adjacent rays shades, \
         each sample along its shadow rays is also counted for every ray that waits";
    FarSkips, "far_skips", "jumps", 1.0, yes, yes,
        "jumps whose reads miss the caches: `skips` times the far share, which is the share of reads that \
         miss the caches";
    FarSamples, "far_samples", "samples", 1.0, yes, yes,
        "samples whose reads miss the caches: `lane_samples` times the far share, times 3 d / (d + 2) for samples d \
         reference steps apart (a sample that is close to the preceding one reads the same voxels)";
    TouchedVoxels, "touched_voxels", "voxels", 1.0, yes, yes,
        "voxels that the frame brings into the caches at least once: 1 / (1 / n + 1 / (64 r)) for n voxels of the \
         volume and r reads that no neighboring ray shares";
    FarSegments, "far_segments", "segments", 1.0, yes, yes,
        "reads of the skip map that miss the caches: `segments` times the far share";
    FarLocalSamples, "far_local_samples", "samples", 1.0, yes, yes,
        "`local_samples` times the share of reads for shading that miss the caches, times 3 d / (d + 2) as for \
         far_samples";
    FarShadowSamples, "far_shadow_samples", "samples", 1.0, yes, yes,
        "`lane_shadow_samples`, computed as if neighboring rays were eight reference steps apart, times the \
         share of reads for shading that miss the caches, times 3 d / (d + 2) as for far_samples, times the sine \
         of the angle between the central ray and the shadow rays";
    FarX, "far_x", "samples", 1.0, yes, yes,
        "`samples` times the far share, times 3 d / (d + 2) as for far_samples, times the share of crossed voxel \
         borders that are normal to x; rays along an axis read slowly if adjacent voxels of this axis are far \
         apart in memory";
    FarY, "far_y", "samples", 1.0, yes, yes, "as far_x, for borders normal to y";
    FarZ, "far_z", "samples", 1.0, yes, yes, "as far_x, for borders normal to z";
    RemappedSamples, "remapped_samples", "samples", 1.0, yes, yes,
        "0 for integers whose minimum is 0 and whose maximum is at most 32767; for all other volumes equal \
         to `samples`, since a renderer with lookup tables must shift or scale their values";
    EstimatedSeconds, "estimated_seconds", "seconds", 1.0e-9, yes, yes,
        "sum, over all kinds of work, of amount times unit cost; the unit costs are those of the model \
         file, or of a software renderer if the file has none";
    SamplesPerPixel, "samples_per_pixel", "samples/pixel", 0.01, yes, yes, "samples divided by the image's pixels";
    ShadowPerPixel, "shadow_per_pixel", "samples/pixel", 0.01, yes, yes,
        "samples along shadow rays, divided by the image's pixels";
    SegmentsPerRay, "segments_per_ray", "segments/ray", 0.1, yes, yes,
        "reads of the skip map (`segments`) divided by the number of rays that meet the volume's box";
    RaySpacing, "ray_spacing", "reference steps", 0.01, no, yes,
        "distance of neighboring rays at the mean depth of the samples";
    FootprintShare, "footprint_share", "1", 1.0e-6, no, no, "share of the image that the volume's box covers";
    MeanChord, "mean_chord", "reference steps", 1.0, no, yes,
        "mean length of the box along the rays that meet it";
    TerminatedShare, "terminated_share", "1", 0.01, no, yes, "share of rays that end early";
    Divergence, "divergence", "1", 0.01, yes, yes, "`lane_samples` divided by `samples`, minus 1";
    OccupiedShare, "occupied_share", "1", 0.0001, no, no,
        "share of blocks that are not empty under the transfer function";
    VisibleShare, "visible_share", "1", 0.001, no, no, "share of voxels with any opacity";
    MeanExtinction, "mean_extinction", "1/reference step", 1.0e-4, no, no, "extinction averaged over voxels";
    Voxels, "voxels", "voxels", 1.0, no, no, "voxels of the volume";
    Step, "step", "reference steps", 0.0, yes, no, "ray step";
    LongestSamples, "longest_samples", "samples", 1.0, yes, yes,
        "largest number of samples of a single ray; a GPU marches all rays of an image at once, but takes the samples \
         of a ray one after another";
    LongestSegments, "longest_segments", "segments", 1.0, yes, yes,
        "largest number of reads of the skip map by a single ray, its shadow rays included";
    LongestShadowSamples, "longest_shadow_samples", "samples", 1.0, yes, yes,
        "largest number of samples along the shadow rays of a single ray";
    FarLongestSamples, "far_longest_samples", "samples", 1.0, yes, yes,
        "`longest_samples` times the far share";
    FarLongestSegments, "far_longest_segments", "segments", 1.0, yes, yes,
        "`longest_segments` times the far share";
    FarLongestShadowSamples, "far_longest_shadow_samples", "samples", 1.0, yes, yes,
        "`longest_shadow_samples` times the share of reads for shading that miss the caches, times the sine \
         of the angle between the central ray and the shadow rays";
}

impl SceneQuantity {
    /// True for counts that are multiplied by the far share, and so depend on the number of cached voxels.
    pub(crate) const fn is_far(self) -> bool {
        matches!(
            self,
            Self::FarSkips
                | Self::FarSamples
                | Self::FarSegments
                | Self::FarLocalSamples
                | Self::FarShadowSamples
                | Self::FarX
                | Self::FarY
                | Self::FarZ
                | Self::FarLongestSamples
                | Self::FarLongestSegments
                | Self::FarLongestShadowSamples
        )
    }

    /// Returns the log variant of a value: ln(value + floor), or −69 if value + floor is not positive.
    pub(crate) fn log(self, value: f64) -> f32 {
        libm::log((value + self.log_floor()).max(1.0e-30)) as f32
    }
}

/// A quantity or its logarithm. In model files, a quantity has its own name, and its logarithm has this name
/// with the prefix `log_`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct SceneFeature {
    /// The quantity.
    pub quantity: SceneQuantity,
    /// True for the log variant, ln(value + floor).
    pub log: bool,
}

impl FromStr for SceneFeature {
    type Err = entire_core::Error;

    /// Parses a name as [`SceneFeature`]'s `Display` writes it.
    ///
    /// # Errors
    /// [`crate::ErrorKind::Unsupported`] for an unknown name; the message lists all names.
    fn from_str(name: &str) -> Result<Self> {
        let (bare, log) = match name.strip_prefix("log_") {
            Some(rest) => (rest, true),
            None => (name, false),
        };
        match SceneQuantity::ALL.into_iter().find(|q| q.name() == bare) {
            Some(quantity) => Ok(Self { quantity, log }),
            None => {
                let known = SceneQuantity::ALL.map(SceneQuantity::name).join(", ");
                bail!(
                    Unsupported,
                    "scene feature {name:?} is unknown to this version; the known names are {known}, each \
                     also with the prefix log_"
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
