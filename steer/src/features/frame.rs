//! Estimated work of one frame, for any ray step and for any image size of the same aspect ratio.

use super::cost::uncached_share;
use super::{
    Footprint, MAX_PROBE_SIDE, PROBE_SIDE, Probe, SHADOW_DIRECTION, SHADOW_STEP, SceneQuantity,
    TransferSummary, UnitCosts, VolumeSummary,
};
use entire_core::Result;
use entire_core::kernels::Level;
use entire_core::scene::{Arcball, Frame, Shading, Skipping};
use glam::Vec3;

/// Number of rays along each side of the footprint's rectangle over which [`along`] averages.
const ALONG_SIDE: usize = 3;

/// Returns the shares of borders normal to x, to y and to z among the voxel borders that rays cross. The
/// shares are means over [`ALONG_SIDE`]² rays through the footprint's rectangle, or the shares of the central
/// ray if the box is not visible.
fn along(frame: &Frame, relative_spacing: Vec3, footprint: &Footprint) -> Vec3 {
    let (_, [forward, right, up]) = frame.camera.ray_basis(frame.width, frame.height);
    // Along each axis, a ray of direction d crosses |d| / spacing borders per unit of length. The shares do
    // not depend on the unit of length.
    let share = |direction: Vec3| {
        let crossed = direction.abs() / relative_spacing;
        crossed / crossed.element_sum()
    };
    if !(footprint.share > 0.0) {
        return share(forward);
    }
    let at = |axis: usize, i: usize| {
        let (low, high) = (footprint.low[axis], footprint.high[axis]);
        low + (high - low) * (i as f32 + 0.5) / ALONG_SIDE as f32
    };
    let mut sum = Vec3::ZERO;
    for i in 0..ALONG_SIDE * ALONG_SIDE {
        sum += share(forward + at(0, i % ALONG_SIDE) * right + at(1, i / ALONG_SIDE) * up);
    }
    sum / (ALONG_SIDE * ALONG_SIDE) as f32
}

/// Returns the sine of the angle between the central ray and the shadow rays. It is the distance of a shadow
/// ray's sample from the primary ray, in units of the distance from the shadow ray's start. A shadow ray
/// along the primary ray reads voxels that the primary ray has just read.
fn aside(frame: &Frame) -> f32 {
    let (_, [forward, ..]) = frame.camera.ray_basis(frame.width, frame.height);
    forward.normalize_or_zero().cross(Vec3::from_array(SHADOW_DIRECTION).normalize_or_zero()).length()
}

/// Side of the pixel tiles whose rays a renderer marches in lockstep, in pixels.
const TILE_SIDE: f32 = 8.0;

/// Settings that a controller may change from frame to frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Setting {
    /// Ray step in multiples of the reference step.
    pub step: f32,
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Shading mode.
    pub shading: Shading,
    /// Skipping mode.
    pub skipping: Skipping,
}

impl From<&Frame> for Setting {
    fn from(frame: &Frame) -> Self {
        let Frame { step, width, height, shading, skipping, .. } = *frame;
        Self { step, width, height, shading, skipping }
    }
}

/// Changes since the preceding frame, as far as the caller knows. The default means that only the camera has
/// changed, by a smooth motion.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Changes {
    /// True if there is no preceding frame, or if the renderer's pipeline was rebuilt.
    pub first: bool,
    /// True if the transfer function changed.
    pub transfer: bool,
    /// True if the volume changed.
    pub volume: bool,
    /// True if the image size changed.
    pub size: bool,
    /// True if the shading, skipping or termination mode changed.
    pub mode: bool,
    /// True if the camera jumped (a cut, not a motion).
    pub camera: bool,
}

impl Changes {
    /// True if any flag is set; the times of earlier frames are then a poor predictor.
    pub(crate) fn any(&self) -> bool {
        self.first || self.transfer || self.volume || self.size || self.mode || self.camera
    }
}

/// Estimated work of a whole frame. All values are counts, except the ray spacing and the share of reads that
/// wait for memory; none is negative.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Work {
    pub(crate) pixels: f64,
    /// Number of rays that meet the volume's box.
    pub(crate) rays: f64,
    /// Number of samples along primary rays.
    pub(crate) samples: f64,
    /// Number of jumps over empty blocks, of primary rays and of shadow rays.
    pub(crate) skips: f64,
    /// Number of samples in a renderer that runs a tile of pixels in lockstep until the tile's longest ray
    /// ends.
    pub(crate) lane_samples: f64,
    /// Number of samples with opacity if shading is on, otherwise 0.
    pub(crate) shaded: f64,
    /// Number of samples along shadow rays; 0 without single scattering.
    pub(crate) shadow_samples: f64,
    /// Number of samples along shadow rays, plus the samples during which rays wait. In a renderer that
    /// marches eight adjacent rays in lockstep, the others wait while any of the eight casts a shadow ray.
    pub(crate) lane_shadow_samples: f64,
    /// [`Self::lane_shadow_samples`] of rays that are [`UNSHARED_SHADING`] reference steps apart, times
    /// [`aside`]: samples along shadow rays whose reads the primary ray does not share.
    pub(crate) parted_shadow_samples: f64,
    /// Number of runs: consecutive samples between two jumps. 0 without skipping.
    pub(crate) runs: f64,
    /// Number of lookups in the skip map during runs, along primary and shadow rays; 0 without skipping.
    pub(crate) segments: f64,
    /// Largest number of samples of a single ray.
    pub(crate) longest_samples: f64,
    /// Largest number of lookups in the skip map by a single ray; 0 without skipping.
    pub(crate) longest_segments: f64,
    /// Largest number of samples along the shadow rays of a single ray.
    pub(crate) longest_shadow_samples: f64,
    /// Distance of neighboring rays at the mean depth of the samples, in reference steps.
    pub(crate) ray_spacing: f64,
    /// Number w of voxels that the frame touches. It is below the volume's number of voxels n, and below
    /// [`VOXELS_PER_READ`] times the number r of reads that no neighboring ray shares:
    /// w = 1 / (1 / n + 1 / ([`VOXELS_PER_READ`] r)).
    pub(crate) touched: f64,
    /// Of the reads that no neighboring ray shares, the share that waits for memory, 0…1: [`uncached_share`]
    /// with [`UnitCosts::CACHED_VOXELS`]. A model file may have another number of cached voxels
    /// ([`UnitCosts::cached_voxels`]).
    pub(crate) uncached: f64,
    /// Share of a ray's reads that no neighboring ray shares, 0…1; half at [`UNSHARED_SPACING`].
    pub(crate) unshared: f64,
    /// This share for the reads of shading; half at [`UNSHARED_SHADING`].
    pub(crate) unshared_shading: f64,
    /// [`new_reads`] of the samples along primary rays.
    pub(crate) new_reads: f64,
    /// [`new_reads`] of the samples along shadow rays.
    pub(crate) new_shadow_reads: f64,
}

/// Share of a ray's reads that no neighboring ray shares, 0…1: s²/(s² + d²) at `ray_spacing` s, where d =
/// `half` is the spacing at which the share is one half.
fn unshared(ray_spacing: f64, half: f64) -> f64 {
    let square = ray_spacing * ray_spacing;
    square / (square + half * half)
}

/// Number of voxels that an unshared read brings into the cache: four cache lines of 16 packed voxels.
pub(crate) const VOXELS_PER_READ: f64 = 64.0;

/// Ray spacing at which half of a sample's reads are shared with no other ray, in reference steps.
pub(crate) const UNSHARED_SPACING: f64 = 2.0;

/// Ray spacing at which half of the reads of shading are shared with no other ray, in reference steps.
pub(crate) const UNSHARED_SHADING: f64 = 8.0;

/// Reads of a sample that the preceding sample of its ray does not share, divided by these reads of samples
/// one reference step apart; `distance` is that of the samples, in reference steps. The share of reads that
/// the preceding sample does not share is d / (d + [`UNSHARED_SPACING`]) at distance d.
fn new_reads(distance: f32) -> f64 {
    let distance = f64::from(distance);
    (1.0 + UNSHARED_SPACING) * distance / (distance + UNSHARED_SPACING)
}

/// Factor on the number of shadow samples for which rays far apart wait because their own sample is
/// transparent. With a factor of 1, the number would be that of a volume whose visible voxels are spread
/// evenly over each cell. The factor exceeds 1 because visible voxels lie close together. Fitted to training
/// frames of two machines.
const WAITING_TRANSPARENT: f64 = 4.0;

/// Factor on the number of shadow samples for which rays far apart wait because they have already ended. The
/// number is the product of this factor, the number of all shadow samples, the share of rays that end early,
/// and [`Probe::ends_apart`]. The factor was fitted to training frames of two machines.
const WAITING_ENDED: f64 = 10.0;

/// Features of a camera's view of a volume under a transfer function, measured once per frame.
///
/// [`FrameFeatures::of`] marches the probe; [`FrameFeatures::quantities`] then evaluates any step, shading
/// mode, skipping mode and image size (of the same aspect ratio) without marching again. But single
/// scattering and skipping by a distance map can be evaluated only if the measured frame has them. No method
/// allocates.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameFeatures {
    /// Number of rays along each side of the probe.
    pub(crate) probe_side: usize,
    level: Level,
    pub(crate) probe: Probe,
    pose: Arcball,
    occupied_share: f32,
    visible_share: f32,
    mean_extinction: f32,
    voxels: f32,
    remapped: bool,
    along: Vec3,
    aside: f32,
}

impl Default for FrameFeatures {
    /// Features of a frame in which no ray meets the volume.
    fn default() -> Self {
        Self::with_probe_side(PROBE_SIDE)
    }
}

impl FrameFeatures {
    /// Measures a frame with `probe_side`² rays; a `probe_side` above [`MAX_PROBE_SIDE`] is reduced to it.
    /// With more rays, a measurement takes longer and its estimates have a smaller variance. With
    /// `probe_side` 0 no ray is cast, and quantities that [need the probe](SceneQuantity::needs_probe) have
    /// the values of rays that meet no volume. For [`Skipping::Distance`], the first frame of a transfer
    /// function also computes its distance map. `transfer` must be made from `volume`; if its cells or blocks
    /// differ from those of `volume`, no ray is cast.
    ///
    /// # Errors
    /// As [`Frame::checked`].
    pub fn of(
        volume: &VolumeSummary,
        transfer: &mut TransferSummary,
        frame: &Frame,
        probe_side: usize,
    ) -> Result<Self> {
        let mut features = Self::with_probe_side(probe_side);
        features.measure(volume, transfer, frame)?;
        Ok(features)
    }

    /// The default features, of a frame in which no ray meets the volume. Later measurements use `side`²
    /// rays.
    pub(crate) fn with_probe_side(side: usize) -> Self {
        Self {
            probe_side: side.min(MAX_PROBE_SIDE),
            level: Level::detect(),
            probe: Probe::nothing(),
            pose: Arcball { rx: 0.0, ry: 0.0, dz: 0.0 },
            occupied_share: 0.0,
            visible_share: 0.0,
            mean_extinction: 0.0,
            voxels: 0.0,
            remapped: false,
            along: Vec3::splat(1.0 / 3.0),
            aside: 1.0,
        }
    }

    /// Measures a frame like [`FrameFeatures::of`], with the number of rays set before.
    pub(crate) fn measure(
        &mut self,
        volume: &VolumeSummary,
        transfer: &mut TransferSummary,
        frame: &Frame,
    ) -> Result<()> {
        frame.checked()?;
        if frame.skipping == Skipping::Distance {
            transfer.prepare_distance();
        }
        self.probe = Probe::on(Some(self.level), volume, transfer, frame, self.probe_side);
        self.pose = frame.camera.to_arcball();
        self.occupied_share = transfer.occupied_share;
        self.visible_share = transfer.visible_share;
        self.mean_extinction = transfer.mean_extinction;
        self.voxels = volume.voxels() as f32;
        self.remapped = volume.remapped;
        self.along = along(frame, volume.shape().relative_spacing, &self.probe.footprint);
        self.aside = aside(frame);
        Ok(())
    }

    /// Adapts the features to another view without casting rays: recomputes the volume's place in the image
    /// and keeps the results of the rays. The view must be close to the measured view; nothing but the view
    /// may differ. Returns false, and changes nothing, if no ray met the volume or the new footprint is
    /// empty.
    pub(crate) fn turn(&mut self, volume: &VolumeSummary, frame: &Frame) -> Result<bool> {
        frame.checked()?;
        if !self.probe.turn(volume.shape(), frame) {
            return Ok(false);
        }
        self.pose = frame.camera.to_arcball();
        self.along = along(frame, volume.shape().relative_spacing, &self.probe.footprint);
        self.aside = aside(frame);
        Ok(true)
    }

    /// Sets the number of rays along each side of the next probe.
    pub(crate) fn set_probe_side(&mut self, side: usize) {
        self.probe_side = side.min(MAX_PROBE_SIDE);
    }

    /// The arcball pose of the frame's camera.
    pub(crate) fn pose(&self) -> Arcball {
        self.pose
    }

    /// Estimated work of the frame at a setting. Counts are monotonic: never smaller for a finer step, nor
    /// for a larger image of the same aspect ratio. The share of reads that no neighboring ray shares
    /// ([`unshared`]) is smaller in a larger image.
    pub(crate) fn work(&self, setting: &Setting) -> Work {
        let p = &self.probe;
        let pixels = f64::from(setting.width) * f64::from(setting.height);
        let rays = pixels * f64::from(p.footprint.share);
        let inv = 1.0 / setting.step;
        let skipping = setting.skipping != Skipping::None;
        let (length, longest) =
            if skipping { (p.occupied, p.occupied_max) } else { (p.occupied + p.empty, p.all_max) };
        // A ray that ends early still takes the sample that crosses the opacity threshold. On average, this
        // sample lies half a step beyond the crossing.
        let crossing = 0.5 * p.terminated;
        let per_ray = length * inv + crossing;
        let skips =
            if skipping { p.skips(setting.step, setting.skipping == Skipping::Distance) } else { 0.0 };
        // The excess of the longest ray's length over the mean length is measured on neighboring probe rays.
        // The factor `tile` scales this excess to a tile of pixels: half the tile's side, divided by the
        // distance of neighboring probe rays; at most 1.
        let tile = (0.5 * TILE_SIDE / (p.spacing * setting.height as f32)).min(1.0);
        let per_lane = per_ray + tile * (longest - length).max(0.0) * inv;
        let shaded = if setting.shading == Shading::None { 0.0 } else { p.visible * inv };
        let (mut shadow, mut shadow_skips, mut shadow_segments) = (0.0, 0.0, 0.0);
        if setting.shading.scatters() {
            let length = if skipping { p.shadow } else { p.shadow_all };
            // A shadow ray begins one shadow step away from the visible sample. A ray that ends early takes
            // the sample that crosses the threshold, on average half a shadow step beyond the crossing; any
            // other ray ends on average half a shadow step before the border of the box.
            let crossing = p.shadow_ended - 0.5 * p.visible;
            shadow = (inv * (length * inv * (1.0 / SHADOW_STEP) + crossing)).max(0.0);
            shadow_skips = if skipping { p.shadow_skips * inv } else { 0.0 };
            shadow_segments = p.shadow_segments * inv;
        }
        let longest_length = if skipping { p.longest.occupied } else { p.longest.all };
        let (mut longest_segments, mut longest_shadow) = (p.longest.segments, 0.0);
        if setting.shading.scatters() {
            let length = if skipping { p.longest.shadow } else { p.longest.shadow_all };
            longest_shadow = inv * inv * length * (1.0 / SHADOW_STEP);
            longest_segments += p.longest.shadow_segments * inv;
        }
        let shadow_samples = rays * f64::from(shadow);
        let ray_spacing = f64::from(p.spread / setting.height as f32);
        let [lane_shadow_samples, parted_shadow_samples] = if shadow_samples > 0.0 {
            [ray_spacing, UNSHARED_SHADING].map(|spacing| shadow_samples * self.waiting(spacing))
        } else {
            [0.0; 2]
        };
        let mut work = Work {
            pixels,
            rays,
            samples: rays * f64::from(per_ray),
            skips: rays * f64::from(skips + shadow_skips),
            lane_samples: rays * f64::from(per_lane),
            shaded: rays * f64::from(shaded),
            shadow_samples,
            lane_shadow_samples,
            parted_shadow_samples: f64::from(self.aside) * parted_shadow_samples,
            runs: if skipping { rays * f64::from(p.runs) } else { 0.0 },
            segments: if skipping { rays * f64::from(p.segments + shadow_segments) } else { 0.0 },
            longest_samples: f64::from(longest_length * inv + crossing),
            longest_segments: if skipping { f64::from(longest_segments) } else { 0.0 },
            longest_shadow_samples: f64::from(longest_shadow),
            ray_spacing,
            touched: 0.0,
            uncached: 0.0,
            unshared: unshared(ray_spacing, UNSHARED_SPACING),
            unshared_shading: unshared(ray_spacing, UNSHARED_SHADING),
            new_reads: new_reads(setting.step),
            new_shadow_reads: new_reads(SHADOW_STEP * setting.step),
        };
        let local = if setting.shading.is_lit() { work.shaded } else { 0.0 };
        let reads =
            work.samples * work.unshared + (local + work.parted_shadow_samples) * work.unshared_shading;
        let (read, voxels) = (VOXELS_PER_READ * reads, f64::from(self.voxels));
        work.touched = if read > 0.0 { read * voxels / (read + voxels) } else { 0.0 };
        work.uncached = uncached_share(work.touched, UnitCosts::CACHED_VOXELS);
        work
    }

    /// Returns the number of shadow samples of eight rays in lockstep, divided by the number without
    /// lockstep; at least 1. A ray waits while another ray shades if its own sample is transparent or if it
    /// has ended. Adjacent rays shade at the same time. Rays [`UNSHARED_SHADING`] apart wait half as long as
    /// rays far apart. `ray_spacing` is in reference steps.
    fn waiting(&self, ray_spacing: f64) -> f64 {
        let p = &self.probe;
        let transparent = if p.visible > 0.0 { (f64::from(p.busy / p.visible) - 1.0).max(0.0) } else { 0.0 };
        let ended = f64::from(p.terminated * p.ends_apart);
        let apart = ray_spacing / (ray_spacing + UNSHARED_SHADING);
        1.0 + apart * (WAITING_TRANSPARENT * transparent + WAITING_ENDED * ended)
    }

    /// Returns a function that gives the value of any quantity at a setting; the work at the setting is
    /// evaluated once. Counts are monotonic: never smaller for a finer step, nor for a larger image of the
    /// same aspect ratio. Exceptions are the counts that wait for memory (`far_…`): they may be smaller in a
    /// larger image, whose rays are closer together and share more reads.
    pub fn quantities(&self, setting: Setting) -> impl Fn(SceneQuantity) -> f64 {
        let work = self.work(&setting);
        move |quantity| self.quantity_of(quantity, &setting, &work)
    }

    /// Value of a quantity, from the work at the setting.
    pub(crate) fn quantity_of(&self, quantity: SceneQuantity, setting: &Setting, work: &Work) -> f64 {
        use SceneQuantity as Q;
        let p = &self.probe;
        let per_pixel = |v: f64| v / work.pixels.max(1.0);
        let only = |counts: bool, v: f64| if counts { v } else { 0.0 };
        let (far, far_shading) = (work.unshared * work.uncached, work.unshared_shading * work.uncached);
        match quantity {
            Q::Pixels => work.pixels,
            Q::Rays => work.rays,
            Q::Skips => work.skips,
            Q::Samples => work.samples,
            Q::LaneSamples => work.lane_samples,
            Q::Runs => work.runs,
            Q::Segments => work.segments,
            Q::LocalSamples => only(setting.shading.is_lit(), work.shaded),
            Q::ScatterSamples => only(setting.shading.scatters(), work.shaded),
            Q::ShadowSamples => work.shadow_samples,
            Q::LaneShadowSamples => work.lane_shadow_samples,
            Q::FarSkips => work.skips * far,
            Q::FarSamples => work.lane_samples * (work.new_reads * far),
            Q::TouchedVoxels => work.touched,
            Q::FarSegments => work.segments * far,
            Q::FarLocalSamples => {
                only(setting.shading.is_lit(), work.shaded) * (work.new_reads * far_shading)
            }
            Q::FarShadowSamples => work.parted_shadow_samples * work.new_shadow_reads * far_shading,
            Q::FarX => work.samples * (work.new_reads * far) * f64::from(self.along.x),
            Q::FarY => work.samples * (work.new_reads * far) * f64::from(self.along.y),
            Q::FarZ => work.samples * (work.new_reads * far) * f64::from(self.along.z),
            Q::RemappedSamples => f64::from(u8::from(self.remapped)) * work.samples,
            Q::EstimatedSeconds => UnitCosts::SOFTWARE.time(&self.cost_work(setting)),
            Q::SamplesPerPixel => per_pixel(work.samples),
            Q::ShadowPerPixel => per_pixel(work.shadow_samples),
            Q::SegmentsPerRay => work.segments / work.rays.max(1.0),
            Q::RaySpacing => work.ray_spacing,
            Q::FootprintShare => f64::from(p.footprint.share),
            Q::MeanChord => f64::from(p.mean_chord),
            Q::TerminatedShare => f64::from(p.terminated),
            Q::Divergence => {
                if work.samples > 0.0 {
                    work.lane_samples / work.samples - 1.0
                } else {
                    0.0
                }
            }
            Q::OccupiedShare => f64::from(self.occupied_share),
            Q::VisibleShare => f64::from(self.visible_share),
            Q::MeanExtinction => f64::from(self.mean_extinction),
            Q::Voxels => f64::from(self.voxels),
            Q::Step => f64::from(setting.step),
            Q::LongestSamples => work.longest_samples,
            Q::LongestSegments => work.longest_segments,
            Q::LongestShadowSamples => work.longest_shadow_samples,
            Q::FarLongestSamples => work.longest_samples * far,
            Q::FarLongestSegments => work.longest_segments * far,
            Q::FarLongestShadowSamples => f64::from(self.aside) * work.longest_shadow_samples * far_shading,
        }
    }
}
