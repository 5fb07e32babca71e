//! Settings of a session for picture quality: smaller images, and the picture quality law.

use super::Session;
use crate::predict::Quality;
use entire_core::Result;
use entire_core::bail;

impl Session {
    /// Allows plans to coarsen the image: neighboring rays are up to `distance` pixels apart along each side
    /// (VTK's ImageSampleDistance). Ray step and image are coarsened together
    /// ([`Plan::image_sample_distance`](super::Plan::image_sample_distance)), from `step_alone` times the
    /// finest step on; a `step_alone` of 1 couples step and image from the start. A `distance` of 1, the
    /// initial value, keeps the full image size. The predictor should depend on the image size.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] unless 1 ≤ `distance` ≤ 64 and 1 ≤ `step_alone` ≤ 64.
    pub fn set_max_image_sample_distance(&mut self, distance: f32, step_alone: f32) -> Result<()> {
        let alone =
            "step_alone (a multiple of the finest step; the image is coarsened only at larger ray steps)";
        for (what, v) in [("the largest image sample distance", distance), (alone, step_alone)] {
            if !(1.0..=64.0).contains(&v) {
                bail!(InvalidArgument, "{what} is {v}; it must be 1 to 64");
            }
        }
        self.coarsening.set_max_distance(distance, step_alone);
        Ok(())
    }

    /// Sets the picture quality law of this renderer, so that plans coarsen the step or the image, whichever
    /// adds less error. With `None`, the initial value, the law in the model file is used, if the model was
    /// calibrated with the renderer that [`Session::set_timing_source`] named, or if no renderer was named;
    /// otherwise the law that is built in for the renderer of this name ([`Quality::built_in`]). With a law,
    /// `step_alone` of [`Session::set_max_image_sample_distance`] has no effect.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InvalidArgument`] unless the weight is 1e-3 to 1e3, the exponents are 0.05 to 8
    /// and the share of rays is 0 to 0.9.
    pub fn set_quality(&mut self, quality: Option<Quality>) -> Result<()> {
        if let Some(quality) = &quality {
            quality.check()?;
        }
        self.quality = quality;
        self.weigh_pictures();
        Ok(())
    }

    /// The picture quality law that plans use: that of [`Session::set_quality`] if one was set, otherwise the
    /// model's, otherwise the built-in one; `None` if there is none of them.
    #[must_use]
    pub fn quality(&self) -> Option<Quality> {
        let renderer = &self.timing[0];
        self.quality.or_else(|| self.predictor.quality(renderer)).or_else(|| Quality::built_in(renderer))
    }

    /// Recomputes, from the present picture quality law, the image sizes that plans choose.
    pub(super) fn weigh_pictures(&mut self) {
        self.coarsening.set_quality(self.quality());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::HybridOptions;
    use crate::predict::AnalyticModel;
    use crate::predict::load;
    use alloc::boxed::Box;

    const LAW: Quality =
        Quality { image_weight: 4.0, step_exponent: 1.3, image_exponent: 0.8, ray_share: 0.25 };

    #[test]
    fn what_the_model_states_holds_for_its_renderer_until_the_caller_knows_better() {
        let mut file = AnalyticModel::default().to_model_file().unwrap();
        LAW.store(&mut file).unwrap();
        file.metadata.insert(entire_core::model::Key::Renderer.into(), "mine".into());
        let mut session =
            Session::new(load(&file.to_model().unwrap()).unwrap(), HybridOptions::default()).unwrap();
        session.set_max_image_sample_distance(4.0, 1.0).unwrap();
        let path = |session: &Session| session.coarsening;
        let by_model = path(&session);
        assert_eq!(session.quality(), Some(LAW));
        session.set_timing_source("other", "cpu").unwrap();
        assert!(session.quality().is_none() && path(&session) != by_model);
        session.set_timing_source("vtkFixedPointVolumeRayCastMapper", "cpu").unwrap();
        assert_eq!(session.quality().map(|q| q.image_weight), Some(5.9));
        session.set_timing_source("mine", "cpu").unwrap();
        assert_eq!(path(&session), by_model);
        let own = Quality { image_weight: 40.0, ..LAW };
        session.set_quality(Some(own)).unwrap();
        assert!(session.quality() == Some(own) && path(&session) != by_model);
        session.set_quality(None).unwrap();
        assert_eq!((session.quality(), path(&session)), (Some(LAW), by_model));
        session.set_predictor(Box::new(AnalyticModel::default()), HybridOptions::default()).unwrap();
        assert!(session.quality().is_none() && path(&session) != by_model);
    }
}
