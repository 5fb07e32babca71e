//! Sets the model, the renderer and the clock to which a session's learned state is bound, and saves the
//! state as bytes.

use super::{HybridOptions, Session, controller_for};
use crate::adapt::state::{Reader, Writer, seal, unseal};
use crate::predict::{Clock, Predictor};
use alloc::borrow::ToOwned;
use alloc::boxed::Box;
use alloc::vec::Vec;
use entire_core::Result;
use entire_core::bail;

/// Tag of saved states: kind and version.
const TAG: [u8; 4] = *b"ENS2";

/// Longest name of a renderer or clock, in bytes.
const MAX_NAME: usize = 256;

impl Session {
    /// Replaces the predictor. Observations and pending plans are forgotten; volume, transfer function,
    /// limits and the probe of [`Session::with_probe`] stay. Recorded frames stay if the predictor needs the
    /// same number of probe rays as the previous one; otherwise they are dropped. VolumeNet's output stays
    /// too. If the two predictors have different encoders, set the volume again with the output of the new
    /// encoder ([`Session::set_volume`]).
    ///
    /// # Errors
    /// As [`Session::new`]; on an error nothing has changed.
    pub fn set_predictor(
        &mut self,
        predictor: Box<dyn Predictor + Send>,
        options: HybridOptions,
    ) -> Result<()> {
        self.controller = controller_for(&*predictor, options)?;
        self.predictor = predictor;
        self.set_probe();
        self.weigh_pictures();
        self.converted = false;
        self.reconcile_clocks();
        self.reset();
        Ok(())
    }

    /// Names the renderer whose frames are observed and the clock of their times. Both names are empty
    /// initially. Learned state and recorded frames are of one renderer and clock, so they are forgotten if a
    /// name that was not empty changes. Saved states contain both names, and [`Session::load_state`] refuses
    /// a state whose names differ from the session's.
    ///
    /// A clock named `cpu`, `wall` or `device` is compared with the model's clock ([`Session::clocks`]).
    /// If they differ, the session keeps the model's ratios between scenes and learns a common factor from
    /// the first frames. If the result of the comparison changes, the learned state is forgotten.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for a name of more than 256 bytes.
    pub fn set_timing_source(&mut self, renderer: &str, clock: &str) -> Result<()> {
        for (what, name) in [("renderer", renderer), ("clock", clock)] {
            if name.len() > MAX_NAME {
                bail!(
                    InvalidArgument,
                    "the {what}'s name has {} bytes, but at most {MAX_NAME} are accepted; shorten the name",
                    name.len()
                );
            }
        }
        let renamed =
            self.timing.iter().zip([renderer, clock]).any(|(old, new)| !old.is_empty() && old != new);
        self.timing = [renderer.to_owned(), clock.to_owned()];
        self.weigh_pictures();
        if let Some(recording) = self.recording.as_mut().filter(|_| renamed) {
            recording.clear();
        }
        if self.reconcile_clocks() || renamed {
            self.reset();
        }
        Ok(())
    }

    /// The clock of observed frames, and the clock whose seconds the model predicts. The first is `None`
    /// unless [`Session::set_timing_source`] named `cpu`, `wall` or `device`; the second is `None` if the
    /// model's file does not state it.
    #[must_use]
    pub fn clocks(&self) -> [Option<Clock>; 2] {
        [Clock::named(&self.timing[1]), self.predictor.clock()]
    }

    /// Compares the two clocks; the result is true if both are known and differ. If the result has changed
    /// since the previous call, passes it to the controller and returns true; the caller then resets the
    /// session.
    pub(super) fn reconcile_clocks(&mut self) -> bool {
        let converted = matches!(self.clocks(), [Some(own), Some(other)] if own != other);
        let new = converted != self.converted;
        if new {
            self.converted = converted;
            self.controller.convert(converted);
        }
        new
    }

    /// The learned state as bytes for [`Session::load_state`]: little-endian numbers after a tag and version,
    /// bound to the model and the timing source, with a checksum at the end.
    #[must_use]
    pub fn save_state(&self) -> Vec<u8> {
        let mut out = Vec::new();
        let mut w = Writer(&mut out);
        w.tag(TAG);
        w.u64(u64::from(self.predictor.identity()));
        self.timing.iter().for_each(|name| w.text(name));
        self.controller.save(&mut out);
        seal(&mut out);
        out
    }

    /// Restores the learned state of an earlier session with the same model, timing source and kind of
    /// controller; on an error nothing changes.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] for bytes that are cut short or damaged, and for a state whose
    /// version or controller is not this session's; [`crate::ErrorKind::Unsupported`] if the model or the
    /// timing source differs.
    pub fn load_state(&mut self, bytes: &[u8]) -> Result<()> {
        // The tag is checked before the checksum, so that bytes of another kind are not reported as damaged.
        Reader(bytes).tag(TAG)?;
        let mut r = Reader(unseal(bytes)?);
        r.tag(TAG)?;
        let (found, own) = (r.u64()?, u64::from(self.predictor.identity()));
        if found != own {
            bail!(
                Unsupported,
                "the saved state was learned with the model of checksum {found:08x}, but this session's \
                 model has {own:08x}; load it into a session with that model, or start without it"
            );
        }
        for (what, own) in ["renderer", "clock"].into_iter().zip(&self.timing) {
            let found = r.text(MAX_NAME)?;
            if found != own {
                bail!(
                    Unsupported,
                    "the saved state was learned from the {what} {found:?}, but this session's is {own:?}; \
                     name the timing source before loading, or start without the state"
                );
            }
        }
        self.controller.load(r.0)?;
        self.pending.fill(None);
        // The state contains no last frame. So the next frame has no preceding frame, as after a reset.
        self.changes.first = true;
        Ok(())
    }
}
