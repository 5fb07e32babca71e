//! A renderer for tests: its images are uniformly gray, and its times follow a known formula.

use entire_core::scene::{Frame, TransferTable, VolumeView};
use entire_vk_raycaster::{Error, FrameTime, Image, Preparation, Rendered, Renderer, Result};

/// Renderer whose frames take (`fixed` + pixels · (mean table opacity) · `per_sample` / step) · noise, in
/// seconds.
pub(crate) struct ScriptedRenderer {
    pub(crate) fixed: f64,
    pub(crate) per_sample: f64,
    /// Standard deviation of the noise in ln(seconds). The noise is computed from a hash of the number
    /// of renderings.
    pub(crate) noise: f64,
    pub(crate) renderings: u64,
    volume: bool,
    weight: Option<f64>,
}

impl Default for ScriptedRenderer {
    fn default() -> Self {
        Self { fixed: 1e-3, per_sample: 1e-6, noise: 0.0, renderings: 0, volume: false, weight: None }
    }
}

impl ScriptedRenderer {
    /// Returns the seconds of a frame without noise; `weight` is the mean opacity of the transfer table.
    pub(crate) fn seconds(&self, weight: f64, (width, height): (u32, u32), step: f32) -> f64 {
        self.fixed + f64::from(width) * f64::from(height) * weight * self.per_sample / f64::from(step)
    }

    pub(crate) fn weight(table: &TransferTable) -> f64 {
        table.rgba().iter().map(|e| f64::from(e[3])).sum::<f64>() / table.rgba().len() as f64
    }
}

impl Renderer for ScriptedRenderer {
    fn device(&self) -> String {
        "a script".into()
    }

    fn backend(&self) -> &'static str {
        "cpu"
    }

    fn set_volume(&mut self, _: &VolumeView<'_>) -> Result<Preparation> {
        self.volume = true;
        Ok(Preparation::default())
    }

    fn set_transfer(&mut self, table: &TransferTable) -> Result<Preparation> {
        self.weight = Some(Self::weight(table));
        Ok(Preparation::default())
    }

    fn render(&mut self, frame: &Frame) -> Result<Rendered> {
        let weight = self.weight.filter(|_| self.volume).ok_or_else(|| Error::new("nothing was set"))?;
        self.renderings += 1;
        // The sum of 12 uniform numbers is close to normal; from hashes, it is the same in every run.
        let normal = (0..12).map(|i| {
            let h = entire_io::files::fnv1a(&(self.renderings * 12 + i).to_le_bytes());
            (h >> 11) as f64 / (1u64 << 53) as f64
        });
        let noise = (self.noise * (normal.sum::<f64>() - 6.0)).exp();
        let seconds = self.seconds(weight, (frame.width, frame.height), frame.step) * noise;
        // The gray level grows with the step, so that pictures at coarser steps have larger errors.
        let level = (frame.step * 2.0).min(255.0) as u8;
        let image = Image {
            width: frame.width,
            height: frame.height,
            rgba: vec![level; frame.width as usize * frame.height as usize * 4],
        };
        let time = FrameTime { device: Some(seconds), wall: seconds, cpu: Some(seconds) };
        Ok(Rendered { image, time, counts: None })
    }
}
