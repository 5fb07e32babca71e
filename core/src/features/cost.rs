//! Unit costs: seconds per count of estimated work.

use super::{Changes, FrameFeatures, SceneQuantity, Setting};

/// Unit costs of the linear model: one for the frame itself, then one per quantity of [`COST_QUANTITIES`].
pub const COSTS: usize = 21;

/// The quantities that cost time, in the order of the unit costs after the first.
pub const COST_QUANTITIES: [SceneQuantity; COSTS - 1] = [
    SceneQuantity::Pixels,
    SceneQuantity::Rays,
    SceneQuantity::Skips,
    SceneQuantity::Samples,
    SceneQuantity::LaneSamples,
    SceneQuantity::LocalSamples,
    SceneQuantity::ScatterSamples,
    SceneQuantity::ShadowSamples,
    SceneQuantity::Runs,
    SceneQuantity::SpreadRuns,
    SceneQuantity::SpreadSamples,
    SceneQuantity::Segments,
    SceneQuantity::SpreadSegments,
    SceneQuantity::LaneShadowSamples,
    SceneQuantity::SpreadShadowSamples,
    SceneQuantity::SpreadLocalSamples,
    SceneQuantity::RemappedSamples,
    SceneQuantity::FarX,
    SceneQuantity::FarY,
    SceneQuantity::FarZ,
];

/// The first of [`COST_QUANTITIES`] are what every renderer may pay for; those beyond are for renderers that
/// convert each stored value or wait for memory ([`UnitCosts::CONVERTING`]), and cost others nothing.
pub(crate) const COMMON_COSTS: usize = 17;

/// Seconds of a frame and of each of [`COST_QUANTITIES`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UnitCosts(pub [f64; COSTS]);

impl UnitCosts {
    /// Of the order of a software renderer on a few cores; what matters are their ratios, since the first
    /// observations set the scale.
    pub const SOFTWARE: Self = Self([
        2.0e-4, 3.5e-8, 1.0e-8, 1.1e-8, 2.0e-9, 7.0e-9, 6.0e-9, 2.0e-8, 1.0e-9, 3.5e-8, 1.6e-7, 1.2e-8,
        1.0e-9, 1.0e-9, 4.0e-9, 1.0e-8, 2.0e-8, 0.0, 0.0, 0.0, 0.0,
    ]);

    /// [`UnitCosts::SOFTWARE`] of a renderer on the CPU that looks stored values up in tables and reads
    /// volumes larger than its caches voxel by voxel, as VTK's fixed-point mapper and yt do.
    pub const CONVERTING: Self = {
        let mut costs = Self::SOFTWARE.0;
        let mut i = COMMON_COSTS;
        while i < COSTS {
            costs[i] = 2.0e-9;
            i += 1;
        }
        Self(costs)
    };

    /// Each cost with its name: `frame`, then those of the quantities.
    pub fn named(&self) -> impl Iterator<Item = (&'static str, f64)> + '_ {
        core::iter::once("frame").chain(COST_QUANTITIES.iter().map(|q| q.name())).zip(self.0)
    }

    /// Seconds for work: a leading 1 for the frame, then the quantities' values.
    pub(crate) fn seconds(&self, work: &[f64; COSTS]) -> f64 {
        self.0.iter().zip(work).map(|(c, w)| c * w).sum()
    }
}

impl FrameFeatures {
    /// Work as unit costs count it: a leading 1 for the frame, then the quantities.
    pub(crate) fn cost_work(&self, setting: &Setting) -> [f64; COSTS] {
        let work = self.work(setting);
        let mut out = [1.0; COSTS];
        for (slot, &quantity) in out[1..].iter_mut().zip(&COST_QUANTITIES) {
            *slot = self.quantity(quantity, setting, &work, Changes::default());
        }
        out
    }
}
