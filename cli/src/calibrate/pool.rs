//! Candidate frames: what is known of each before any is drawn.

use super::Settings;
use crate::collection::Job;
use crate::dataset::{Scene, Table, TimedFrame};
use crate::files::open_volume;
use crate::identity::{self, Identity};
use crate::inputs::{Layout, measure, work_of};
use crate::scenes::{DEFAULT_RADII, SceneDistribution};
use crate::volume::Reading;
use anyhow::{Result, ensure};
use entire_core::calibrate::blank_prior;
use entire_core::features::{Changes, PROBE_SIDE};
use entire_core::model::ModelFile;
use entire_core::predict::{COST_QUANTITIES, COSTS};
use entire_core::scene::DEFAULT_FOV_Y_DEGREES;
use indicatif::ProgressBar;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Candidates per volume and size.
const PER_VOLUME: u64 = 36;

/// Every so many candidates one is random: drawn as users draw, at any cost.
const RANDOM_EVERY: u64 = 3;

/// Volumes of fewer voxels are rendered enlarged by 2 along every axis as well: what a frame costs depends on
/// how much of the volume the caches hold.
const SMALL_VOLUME: u64 = 160 * 160 * 160;

/// A frame that may be drawn.
#[derive(Clone, Debug)]
pub struct Candidate {
    /// The volume's index.
    pub volume: usize,
    /// Its enlargement.
    pub factor: usize,
    /// What is shown.
    pub scene: Scene,
    /// Inputs of each prior model, in its order.
    pub rows: Vec<Vec<f32>>,
    /// Estimated work: 1, then the counts.
    pub work: [f64; COSTS],
    /// Whether it is one of those that are drawn as users draw.
    pub random: bool,
}

/// All candidates, and the model that calibration starts from.
pub struct Pool {
    /// The volume files.
    pub volumes: Vec<PathBuf>,
    /// Identities of their files.
    pub files: Vec<Vec<Identity>>,
    /// Options of their reading.
    pub reading: Reading,
    /// The candidates; a frame's number is its index.
    pub candidates: Vec<Candidate>,
    /// The models that calibration may start from; at least one.
    pub priors: Vec<ModelFile>,
    /// Seconds by the first of them, for its own machine.
    pub expected: Vec<f64>,
}

impl Pool {
    /// Identities of the volumes' files, by the names that frames have.
    pub fn named_files(&self) -> BTreeMap<String, Vec<Identity>> {
        let name = |path: &PathBuf| path.to_string_lossy().into_owned();
        self.volumes.iter().map(name).zip(self.files.iter().cloned()).collect()
    }

    /// Draws candidates of every volume and computes what is known of them.
    ///
    /// # Errors
    /// When a volume cannot be read, or priors cast different numbers of probe rays.
    pub fn draw(
        settings: &Settings,
        mut priors: Vec<ModelFile>,
        threads: &rayon::ThreadPool,
    ) -> Result<Self> {
        ensure!(!settings.volumes.is_empty(), "there is no volume to calibrate with; name some");
        let scenes = SceneDistribution {
            radii: DEFAULT_RADII.to_vec(),
            lobes: (1, 4),
            min_size: settings.sizes.0,
            max_size: settings.sizes.1,
            steps: settings.steps.clone(),
        };
        scenes.check()?;
        let files = settings.volumes.iter().map(|path| identity::of_volume(path)).collect::<Result<_>>()?;
        let mut frames = Vec::new();
        let mut places = Vec::new();
        for (v, path) in settings.volumes.iter().enumerate() {
            let volume = open_volume(path, &settings.reading)?;
            let voxels = volume.view().shape().voxels;
            let factors: &[usize] = if voxels < SMALL_VOLUME { &[2, 1] } else { &[1] };
            let job = Job::from_path(path);
            for &factor in factors {
                for index in 0..PER_VOLUME {
                    let drawn = scenes.draw(settings.seed + factor as u64, &job.seed_name(), index);
                    let scene = Scene {
                        volume: path.to_string_lossy().into_owned(),
                        member: job.member.clone(),
                        time_step: job.time_step,
                        dims: volume.dims().map(|n| (n * factor) as u32),
                        camera: drawn.camera,
                        fov_y_degrees: DEFAULT_FOV_Y_DEGREES,
                        width: drawn.width,
                        height: drawn.height,
                        step: drawn.step,
                        shading: settings.shading,
                        skipping: settings.skipping,
                        termination: settings.termination,
                        lobes: drawn.lobes,
                    };
                    places.push((v, factor, index % RANDOM_EVERY == 0));
                    frames.push(TimedFrame {
                        table: 0,
                        number: frames.len() as u64,
                        scene,
                        repeats: Vec::new(),
                    });
                }
            }
        }
        if priors.is_empty() {
            priors.push(blank_prior(PROBE_SIDE)?);
        }
        let layouts: Vec<Layout> =
            priors.iter().map(|p| Layout::of_model(&p.to_model()?)).collect::<Result<_>>()?;
        let probe_side = layouts[0].probe_side();
        ensure!(
            layouts.iter().all(|l| l.probe_side() == probe_side),
            "the models to start from cast different numbers of probe rays; name one of them with --prior"
        );
        let tables = [Table {
            path: PathBuf::new(),
            manifest: None,
            frames: Vec::new(),
            hash: 0,
            features: None,
            root: None,
        }];
        let refs: Vec<&TimedFrame> = frames.iter().collect();
        let bar = ProgressBar::hidden();
        let known = measure(&tables, &refs, Some(probe_side), None, threads, &bar, |_, inputs| {
            let rows: Vec<Vec<f32>> = layouts
                .iter()
                .map(|layout| {
                    let mut row = vec![0.0; layout.width()];
                    layout.write(inputs, &mut row)?;
                    Ok(row)
                })
                .collect::<Result<_>>()?;
            let work = inputs.features.work(&inputs.setting);
            let count = |q| inputs.features.quantity(q, &inputs.setting, &work, Changes::default()) as f32;
            Ok((rows, COST_QUANTITIES.map(count)))
        })?;
        let candidates: Vec<Candidate> = frames
            .iter()
            .zip(known)
            .zip(places)
            .map(|((frame, (rows, counted)), (volume, factor, random))| {
                let work = work_of(counted);
                Candidate { volume, factor, scene: frame.scene.clone(), rows, work, random }
            })
            .collect();
        let model = priors[0].to_model()?;
        let rows: Vec<f32> = candidates.iter().flat_map(|c| c.rows[0].iter().copied()).collect();
        let expected = crate::fit::predict_rows(&model, &rows, layouts[0].width())?;
        let (volumes, reading) = (settings.volumes.clone(), settings.reading.clone());
        Ok(Self { volumes, files, reading, candidates, priors, expected })
    }
}
