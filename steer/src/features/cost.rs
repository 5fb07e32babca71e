//! Unit costs: seconds per count of estimated work.

use super::{FrameFeatures, SceneQuantity, Setting};

/// Number of unit costs of the analytic model: one per frame, then one per quantity of [`COST_QUANTITIES`].
pub const COSTS: usize = 28;

/// Quantities that have a unit cost, in the order of [`UnitCosts`] after its first element, the cost per
/// frame.
pub const COST_QUANTITIES: [SceneQuantity; COSTS - 1] = [
    SceneQuantity::Pixels,
    SceneQuantity::Rays,
    SceneQuantity::Skips,
    SceneQuantity::Samples,
    SceneQuantity::LaneSamples,
    SceneQuantity::Runs,
    SceneQuantity::Segments,
    SceneQuantity::LocalSamples,
    SceneQuantity::ScatterSamples,
    SceneQuantity::ShadowSamples,
    SceneQuantity::LaneShadowSamples,
    SceneQuantity::FarSkips,
    SceneQuantity::FarSamples,
    SceneQuantity::TouchedVoxels,
    SceneQuantity::FarSegments,
    SceneQuantity::FarLocalSamples,
    SceneQuantity::FarShadowSamples,
    SceneQuantity::FarX,
    SceneQuantity::FarY,
    SceneQuantity::FarZ,
    SceneQuantity::RemappedSamples,
    SceneQuantity::LongestSamples,
    SceneQuantity::LongestSegments,
    SceneQuantity::LongestShadowSamples,
    SceneQuantity::FarLongestSamples,
    SceneQuantity::FarLongestSegments,
    SceneQuantity::FarLongestShadowSamples,
];

/// Number of unit costs that can be nonzero for renderers of every kind. The next unit cost, for the
/// conversion of stored values, is nonzero only for renderers like [`UnitCosts::CONVERSION`]. The unit costs
/// after it, for the longest ray, are nonzero only for renderers like [`UnitCosts::GPU`].
pub(crate) const COMMON_COSTS: usize = 21;

/// Indices in [`UnitCosts::seconds`], one for each unit cost of the longest ray. Each index selects the unit
/// cost of the same kind of work, where the work is that of all rays: samples, lookups in the skip map, or
/// shadow samples.
const OF_ALL_RAYS: [usize; COSTS - COMMON_COSTS - 1] = [4, 7, 10, 4, 7, 10];

/// Index of [`SceneQuantity::TouchedVoxels`] in [`UnitCosts::seconds`].
const TOUCHED_VOXELS: usize = {
    let mut i = 1;
    while !matches!(COST_QUANTITIES[i - 1], SceneQuantity::TouchedVoxels) {
        i += 1;
    }
    i
};

/// Constants of the analytic model on one machine.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UnitCosts {
    /// Seconds per frame, then per unit of each of [`COST_QUANTITIES`].
    pub seconds: [f64; COSTS],
    /// Number of voxels that the caches hold. In a frame that touches this many voxels, half of the reads
    /// that no neighboring ray shares wait for memory. The quantities are computed with the number of
    /// [`UnitCosts::SOFTWARE`]; [`UnitCosts::time`] converts them to this number.
    pub cached_voxels: f64,
}

impl UnitCosts {
    /// Number of cached voxels with which the quantities of frames are computed. These voxels take 16 MB in a
    /// renderer that packs a voxel into four bytes.
    pub(crate) const CACHED_VOXELS: f64 = 4.0e6;

    /// Unit costs of a software renderer, in seconds of processor time: geometric means of the costs measured
    /// on three machines with two processors each. `lab/scripts/typical_costs.py` prints such means. The
    /// first observed frames of a session set the scale of the costs; from then on, only the ratios of the
    /// costs matter.
    pub const SOFTWARE: Self = Self::new([
        3.2e-4, 9.4e-8, 6.3e-9, 7.5e-9, 1.4e-9, 1.5e-8, 1.3e-8, 1.5e-8, 5.1e-10, 2.3e-10, 1.6e-9, 7.1e-9,
        1.0e-7, 5.7e-9, 1.0e-10, 3.9e-8, 3.6e-8, 1.5e-8, 2.5e-9, 8.0e-9, 3.3e-8, 0.0, 0.0, 0.0, 0.0, 0.0,
        0.0, 0.0,
    ]);

    /// The first set of [`UnitCosts::OF_UNKNOWN`].
    pub(crate) const CONVERSION: Self = {
        let mut costs = Self::SOFTWARE;
        costs.seconds[COMMON_COSTS] = 2.0e-9;
        costs
    };

    /// Two sets of typical unit costs for a renderer of unknown kind. Both contain [`UnitCosts::SOFTWARE`], and
    /// a cost per converted voxel value: some renderers, such as VTK's fixed-point mapper and yt, look each
    /// stored value up in a table. The second set is for a GPU. It also has unit costs for the samples, the
    /// lookups in the skip map and the shadow samples of the longest ray. Each of them is set to 10⁴ times the
    /// unit cost of the same work of all rays. Measured ratios are lower on a processor with two cores, and
    /// higher on a large GPU.
    pub const OF_UNKNOWN: [Self; 2] = {
        let mut costs = Self::CONVERSION;
        let mut longest = COMMON_COSTS + 1;
        while longest < COSTS {
            costs.seconds[longest] = 1.0e4 * costs.seconds[OF_ALL_RAYS[longest - COMMON_COSTS - 1]];
            longest += 1;
        }
        [Self::CONVERSION, costs]
    };

    /// Unit costs of a GPU that marches all rays of an image at once. A frame takes about as long as its
    /// longest ray, plus the work of all rays divided by the throughput (Brent's bound of parallel time: work
    /// over processors, plus the longest chain of dependent operations). Geometric means of the costs
    /// measured with each shading mode on an NVIDIA H100; `lab/scripts/typical_costs.py` prints such means.
    pub const GPU: Self = Self::new([
        5.1e-6, 9.6e-12, 4.5e-13, 6.2e-12, 1.1e-12, 2.4e-13, 1.2e-12, 2.9e-13, 1.5e-11, 5.7e-13, 7.1e-13,
        3.6e-12, 1.4e-10, 1.4e-12, 6.8e-14, 4.0e-12, 3.4e-12, 1.5e-10, 2.0e-12, 3.1e-12, 4.4e-12, 0.0,
        7.3e-7, 1.5e-6, 3.8e-8, 4.5e-7, 8.5e-6, 4.4e-7,
    ]);

    /// Returns unit costs in seconds, per frame and then per unit of each of [`COST_QUANTITIES`], with
    /// [`Self::CACHED_VOXELS`].
    pub(crate) const fn new(seconds: [f64; COSTS]) -> Self {
        Self { seconds, cached_voxels: Self::CACHED_VOXELS }
    }

    /// Returns the name and the seconds of each unit cost: `frame`, then the quantities of
    /// [`COST_QUANTITIES`].
    pub fn named(&self) -> impl Iterator<Item = (&'static str, f64)> + '_ {
        core::iter::once("frame").chain(COST_QUANTITIES.iter().map(|q| q.name())).zip(self.seconds)
    }

    /// Returns the seconds that `work` takes. The elements of `work` are 1 for the frame, then the values of
    /// [`COST_QUANTITIES`].
    pub fn time(&self, work: &[f64; COSTS]) -> f64 {
        self.seconds.iter().zip(self.work(work)).map(|(c, w)| c * w).sum()
    }

    /// Returns the amounts of work for [`Self::cached_voxels`].
    pub(crate) fn work(&self, work: &[f64; COSTS]) -> [f64; COSTS] {
        let mut out = *work;
        if self.cached_voxels != Self::CACHED_VOXELS {
            let ratio = far_ratio(work[TOUCHED_VOXELS], self.cached_voxels);
            let counts = out[1..].iter_mut().zip(&COST_QUANTITIES);
            counts.filter(|(_, quantity)| quantity.is_far()).for_each(|(w, _)| *w *= ratio);
        }
        out
    }
}

/// Returns the share of reads that wait for memory, 0…1, among the reads that no neighboring ray shares:
/// w² / (w² + C²) for w `touched` voxels and C `cached_voxels`. The square makes the share rise steeply at
/// w = C: nearly all reads hit the caches if the voxels fit, nearly none if they do not.
pub(super) fn uncached_share(touched: f64, cached_voxels: f64) -> f64 {
    touched * touched / sum_of_squares(touched, cached_voxels)
}

/// Returns [`uncached_share`] with `cached_voxels`, divided by this share with [`UnitCosts::CACHED_VOXELS`],
/// for a frame that touches `touched` voxels.
pub(crate) fn far_ratio(touched: f64, cached_voxels: f64) -> f64 {
    sum_of_squares(touched, UnitCosts::CACHED_VOXELS) / sum_of_squares(touched, cached_voxels)
}

fn sum_of_squares(a: f64, b: f64) -> f64 {
    a * a + b * b
}

impl FrameFeatures {
    /// Returns the work in the order of the unit costs: 1 for the frame, then the values of
    /// [`COST_QUANTITIES`].
    pub fn cost_work(&self, setting: &Setting) -> [f64; COSTS] {
        let work = self.work(setting);
        let mut out = [1.0; COSTS];
        for (slot, &quantity) in out[1..].iter_mut().zip(&COST_QUANTITIES) {
            *slot = self.quantity_of(quantity, setting, &work);
        }
        out
    }
}
