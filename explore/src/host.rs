//! Services that the window needs of the program that opens it.

use anyhow::Result;
use entire_core::scene::{Shading, Skipping, VolumeView};
use entire_io::volume::{Volume, Watcher};
use entire_steer::Session;
use entire_vk_raycaster::Image;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};

/// A predictor that is ready for one volume.
pub trait Steering: Send + Sync {
    /// Name of the predictor, for display.
    fn title(&self) -> String;

    /// Hash of the model. A session continues with the next volume if the predictors of both volumes have the
    /// same hash.
    fn identity(&self) -> u32;

    /// VolumeNet's output for the volume, if the predictor uses it.
    fn volume_features(&self) -> Option<&[f32]>;

    /// Returns a new session with one of the [`Host::controllers`].
    ///
    /// # Errors
    /// When the predictor cannot be made.
    fn session(&self, controller: &str) -> Result<Session>;

    /// True if the controller chooses the number of pixels between rays in addition to the ray step, by the
    /// quality law of its session. All other [`Host::controllers`] choose the ray step alone.
    fn chooses_image_sample_distance(&self, controller: &str) -> bool;
}

/// The program that opens the window. Threads that load volumes call its methods, too.
pub trait Host: Send + Sync {
    /// Reads a volume file, reports its progress, and stops once reading is canceled.
    ///
    /// # Errors
    /// When the file cannot be read, or reading was canceled.
    fn open(&self, file: &Path, progress: &Arc<Progress>) -> Result<Volume>;

    /// Returns the predictor for a volume, a shading mode and the device that draws.
    ///
    /// # Errors
    /// When a model file is invalid.
    fn steering(&self, volume: &VolumeView<'_>, shading: Shading, device: &str) -> Result<Arc<dyn Steering>>;

    /// Name and title of every controller.
    fn controllers(&self) -> Vec<(&'static str, &'static str)>;

    /// Writes a picture as a PNG file without its opacity: its colors are blended over black. An existing
    /// file stays until the new one is complete.
    ///
    /// # Errors
    /// When the file cannot be written; the message names the file.
    fn write_picture(&self, file: &Path, picture: &Image) -> Result<()>;

    /// Returns two commands in one line: the first calibrates a model to this machine, the second opens the
    /// volume again.
    fn calibration(&self, volume: &Path, shading: Shading) -> String;
}

/// Progress of reading a file, and a request to stop. The reader and the window share one instance.
#[derive(Debug, Default)]
pub struct Progress {
    done: AtomicU64,
    total: AtomicU64,
    cancelled: AtomicBool,
    /// Stage of the load.
    pub(crate) stage: AtomicUsize,
}

impl Watcher for Progress {
    fn expect(&self, bytes: u64) {
        self.total.fetch_add(bytes, Ordering::Relaxed);
    }

    fn advance(&self, bytes: u64) -> io::Result<()> {
        self.done.fetch_add(bytes, Ordering::Relaxed);
        self.check()
    }
}

impl Progress {
    /// Requests that the reader stops.
    pub fn cancel(&self) {
        self.cancelled.store(true, Ordering::Relaxed);
    }

    /// Fails if the reader was asked to stop.
    pub(crate) fn check(&self) -> io::Result<()> {
        if self.cancelled.load(Ordering::Relaxed) {
            return Err(io::Error::other("cancelled"));
        }
        Ok(())
    }

    /// The share that was read, 0 to 1.
    pub fn share(&self) -> f32 {
        let total = self.total.load(Ordering::Relaxed).max(1);
        (self.done.load(Ordering::Relaxed) as f64 / total as f64).min(1.0) as f32
    }
}

/// Options of the window.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Volume files: one, or the time steps of a series in order; none for an empty window.
    pub volumes: Vec<PathBuf>,
    /// Target frame time, seconds.
    pub target: f64,
    /// Name of one of the [`Host::controllers`].
    pub controller: String,
    /// Shading of each sample.
    pub shading: Shading,
    /// Skipping of empty space.
    pub skipping: Skipping,
    /// Accumulated opacity at which a ray stops.
    pub termination: f32,
    /// Size of the window, pixels.
    pub size: (u32, u32),
    /// File of events to play instead of user input, JSON lines.
    pub script: Option<PathBuf>,
    /// File to which every frame is written as a row of CSV.
    pub log: Option<PathBuf>,
}
