//! Replaces a session's predictor.

use super::{HybridOptions, Recording, Session, controller_for};
use crate::predict::Predictor;
use alloc::boxed::Box;
use entire_core::Result;
use entire_core::bail;

impl Session {
    /// Replaces the predictor. Observations and pending plans are forgotten; volume, transfer function,
    /// limits, recorded frames and the probe of [`Session::with_probe`] stay. VolumeNet's output stays too;
    /// for a predictor with another encoder, set the volume again with the output of that encoder
    /// ([`Session::set_volume`]).
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] if frames are being recorded with another probe than the
    /// predictor's.
    pub fn set_predictor(
        &mut self,
        predictor: Box<dyn Predictor + Send>,
        options: HybridOptions,
    ) -> Result<()> {
        let side = self.side_for(&*predictor);
        let recorded = self.recording.as_ref().map(Recording::probe_side);
        if let Some(recorded) = recorded.filter(|recorded| ![0, side].contains(recorded)) {
            bail!(
                InvalidArgument,
                "frames are being recorded with a probe of {recorded} rays along each side, the new model's probe has \
                 {side}; take a model with the same probe"
            );
        }
        self.controller = controller_for(&*predictor, options);
        self.predictor = predictor;
        self.set_probe();
        self.weigh_pictures();
        self.converted = false;
        self.reconcile_clocks();
        self.reset();
        Ok(())
    }
}
