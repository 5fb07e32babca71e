//! A predictor in place of a renderer, for distillation: a frame takes only the time of a prediction.

use entire_core::model::Model;
use entire_core::scene::{Arcball, Frame, TransferTable, VolumeView};
use entire_io::dataset::Clock;
use entire_steer::features::{Changes, FrameFeatures, Setting, TransferSummary, VolumeSummary};
use entire_steer::predict::{Inputs, Predictor, load};
use entire_vk_raycaster::{Error, FrameTime, Image, Preparation, Rendered, Renderer, Result};

/// Renderer that draws nothing. Its wall time, and its time by the model's clock, are the model's prediction.
/// It has no time by other clocks, so that a model that is fitted to its times states the same clock. If the
/// model states no clock, the times by all clocks are the prediction.
pub struct Teacher {
    name: String,
    clock: Option<Clock>,
    predictor: Box<dyn Predictor + Send>,
    summary: Option<VolumeSummary>,
    transfer: Option<TransferSummary>,
}

impl Teacher {
    /// Returns a teacher named `name` from a model whose only inputs are scene features.
    ///
    /// # Errors
    /// When the model predicts no times, or has inputs other than scene features.
    pub fn new(name: &str, model: &Model) -> anyhow::Result<Self> {
        let predictor = load(model)?;
        if let Some(group) = model.inputs.iter().find(|g| g.name != "scene_features") {
            anyhow::bail!(
                "the model takes {}; a teacher must be a model on scene_features alone, such as \
                 models/unshaded-selected.safetensors",
                group.name
            );
        }
        let clock = entire_io::clock::of(model);
        Ok(Self { name: name.into(), clock, predictor, summary: None, transfer: None })
    }
}

impl Renderer for Teacher {
    fn device(&self) -> String {
        format!("the predictor {}", self.name)
    }

    fn backend(&self) -> &'static str {
        "teacher"
    }

    fn set_volume(&mut self, volume: &VolumeView<'_>) -> Result<Preparation> {
        let summary = VolumeSummary::new(volume);
        self.summary = Some(summary.map_err(|e| Error::new(e.to_string()))?);
        self.transfer = None;
        Ok(Preparation::default())
    }

    fn set_transfer(&mut self, table: &TransferTable) -> Result<Preparation> {
        let summary = self.summary.as_ref().ok_or_else(|| Error::new("no volume was set"))?;
        let transfer = TransferSummary::new(summary, table);
        self.transfer = Some(transfer.map_err(|e| Error::new(e.to_string()))?);
        Ok(Preparation::default())
    }

    fn render(&mut self, frame: &Frame) -> Result<Rendered> {
        let (Some(summary), Some(transfer)) = (&self.summary, &mut self.transfer) else {
            return Err(Error::new("volume or transfer function was not set"));
        };
        let features = FrameFeatures::of(summary, transfer, frame, self.predictor.probe_side());
        let inputs = Inputs {
            features: &features.map_err(|e| Error::new(e.to_string()))?,
            setting: Setting::from(frame),
            changes: Changes::default(),
            // The scene features already contain the camera.
            camera: Arcball { rx: 0.0, ry: 0.0, dz: 2.0 },
            volume_features: None,
            lobes: None,
        };
        let prediction = self.predictor.predict(&inputs).map_err(|e| Error::new(e.to_string()))?;
        let seconds = f64::from(prediction.seconds);
        let by = |clock: Clock| self.clock.is_none_or(|c| c == clock).then_some(seconds);
        Ok(Rendered {
            image: Image { width: 0, height: 0, rgba: Vec::new() },
            time: FrameTime { device: by(Clock::Device), wall: seconds, cpu: by(Clock::Cpu) },
            counts: None,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use entire_core::model::{InputGroup, ModelFile};
    use entire_core::nn::{DenseParts, Dtype, PredNetParts, Target};
    use entire_core::scene::{Camera, TransferFunction};
    use entire_io::volume::{Volume, VolumeData};
    use entire_steer::features::PROBE_SIDE;
    use entire_steer::predict::{AnalyticModel, COSTS, UnitCosts};

    fn volume() -> Volume {
        let value = |i: u32| if i % 16 < 8 { 0 } else { (i * i / 97 % 251) as u8 };
        Volume::new(VolumeData::U8((0..16 * 16 * 16).map(value).collect()), [16; 3], [1.0; 3], "v").unwrap()
    }

    #[test]
    fn it_takes_as_long_as_its_model_says() {
        let mut seconds = [0.0; COSTS];
        (seconds[0], seconds[1]) = (1e-3, 1e-6);
        let costs = UnitCosts { seconds, ..UnitCosts::SOFTWARE };
        let mut work = [0.0; COSTS];
        (work[0], work[1]) = (1.0, 1200.0);
        let fitted = AnalyticModel::fit(&costs, &[(work, costs.time(&work))], PROBE_SIDE).unwrap().0;
        let file = fitted.to_model_file().unwrap();
        let mut teacher = Teacher::new("a model", &file.to_model().unwrap()).unwrap();
        assert_eq!((teacher.backend(), teacher.device().as_str()), ("teacher", "the predictor a model"));
        let camera = Camera::from_arcball(Arcball { rx: 25.0, ry: -60.0, dz: 2.0 }).unwrap();
        let frame = Frame::new(camera, 40, 30).unwrap();
        assert!(teacher.render(&frame).is_err(), "nothing was set");
        let volume = volume();
        let lobes = entire_io::dataset::parse_lobes("0.8 0.01 0.9").unwrap();
        let table = TransferFunction::Gaussian(lobes).to_table().unwrap();
        assert!(teacher.set_transfer(&table).is_err(), "no volume was set");
        teacher.set_volume(&volume.view()).unwrap();
        teacher.set_transfer(&table).unwrap();
        let time = teacher.render(&frame).unwrap().time;
        // The unit costs are 1e-3 s per frame and 1e-6 s per pixel.
        assert!((time.wall / (1e-3 + 1200.0 * 1e-6) - 1.0).abs() < 1e-5, "{time:?}");
        assert_eq!((time.device, time.cpu), (Some(time.wall), Some(time.wall)));
        // Setting another volume clears the transfer function.
        teacher.set_volume(&volume.view()).unwrap();
        assert!(teacher.render(&frame).is_err());
        // Only the clock that the model states has a time, besides the wall.
        for (clock, has) in
            [(Clock::Wall, [false, false]), (Clock::Device, [true, false]), (Clock::Cpu, [false, true])]
        {
            let mut file = file.clone();
            entire_io::clock::set(&mut file, clock);
            let mut teacher = Teacher::new("a model", &file.to_model().unwrap()).unwrap();
            teacher.set_volume(&volume.view()).unwrap();
            teacher.set_transfer(&table).unwrap();
            let time = teacher.render(&frame).unwrap().time;
            assert_eq!([time.device.is_some(), time.cpu.is_some()], has, "{clock:?}");
        }
    }

    #[test]
    fn a_model_that_needs_more_than_a_scene_is_refused() {
        let layer =
            DenseParts { inputs: 3, outputs: 1, weight: vec![0.1; 3], bias: vec![1.0], dtype: Dtype::F32 };
        let parts = PredNetParts { layers: vec![layer], input: None, output: None, target: Target::Seconds };
        let mut file = ModelFile::default();
        file.set_prednet(&parts, &[InputGroup { name: "camera".into(), size: 3 }]).unwrap();
        let error = Teacher::new("m", &file.to_model().unwrap()).err().unwrap().to_string();
        assert!(error.contains("camera") && error.contains("scene_features"), "{error}");
    }
}
