//! Candidate frames of a calibration, with their features, before any is rendered.

use super::Settings;
use crate::collection::Job;
use anyhow::{Result, ensure};
use entire_core::model::ModelFile;
use entire_io::dataset::{Manifest, Scene, Table, TimedFrame};
use entire_io::identity::{self, Identity};
use entire_io::scenes::SceneDistribution;
use entire_io::volume::open_volume;
use entire_steer::calibrate::prior_costs;
use entire_steer::features::SceneQuantity;
use entire_steer::predict::{COST_QUANTITIES, COSTS, UnitCosts};
use entire_train::inputs::{measure, work_of};
use indicatif::ProgressBar;

/// Number of candidates per volume and enlargement.
const PER_VOLUME: u64 = 36;

/// Interval between random candidates, in candidates: one in three is random. Random candidates represent
/// typical frames: they are chosen without regard to their information gain. The error is measured on random
/// frames alone if there are enough of them.
const RANDOM_EVERY: u64 = 3;

/// Number of voxels below which a volume is also rendered enlarged by 2 along every axis: the cost of a frame
/// depends on the share of the volume that fits in the caches.
pub(crate) const SMALL_VOLUME: u64 = 160 * 160 * 160;

/// Smallest number of voxels of the largest enlargement: more than most caches hold.
const LARGE_VOLUME: u64 = 300 * 300 * 300;

/// Largest enlargement factor: volumes enlarged further are unlike real ones.
const LARGEST_FACTOR: usize = 4;

/// Number of volumes of which one is also rendered with at least [`LARGE_VOLUME`] voxels.
const LARGE_EVERY: usize = 4;

/// Factors by which the volume with this index is enlarged along every axis.
fn factors(index: usize, voxels: u64) -> Vec<usize> {
    let mut out = if voxels < SMALL_VOLUME { vec![2, 1] } else { vec![1] };
    let large = |factor: &usize| voxels * (*factor as u64).pow(3) >= LARGE_VOLUME;
    if index.is_multiple_of(LARGE_EVERY) {
        out.extend((1..=LARGEST_FACTOR).find(large).filter(|factor| !out.contains(factor)));
    }
    out
}

#[derive(Clone, Debug)]
pub(crate) struct Candidate {
    pub(crate) volume: usize,
    /// Enlargement factor of the volume along every axis.
    pub(crate) factor: usize,
    pub(crate) scene: Scene,
    /// Estimated work: 1, then the values of [`COST_QUANTITIES`].
    pub(crate) work: [f64; COSTS],
    /// True for random candidates (every [`RANDOM_EVERY`]-th one), which represent typical frames.
    pub(crate) random: bool,
}

impl Candidate {
    /// Returns the estimated mean number of samples per pixel. If it is at most 1, hardly anything of the
    /// volume is visible.
    pub(crate) fn samples_per_pixel(&self) -> f64 {
        let count = |quantity: SceneQuantity| -> f64 {
            COST_QUANTITIES.iter().zip(&self.work[1..]).filter(|(q, _)| **q == quantity).map(|(_, n)| n).sum()
        };
        count(SceneQuantity::Samples) / count(SceneQuantity::Pixels).max(1.0)
    }
}

pub(crate) struct Pool {
    /// Identities of each volume's files.
    pub(crate) files: Vec<Vec<Identity>>,
    /// The candidates; a frame's number is its index.
    pub(crate) candidates: Vec<Candidate>,
    pub(crate) prior: UnitCosts,
    /// Seconds of each candidate on the prior's own machine, predicted by the prior.
    pub(crate) expected: Vec<f64>,
}

impl Pool {
    /// Draws candidates of every volume and computes their features.
    pub(crate) fn draw(
        settings: &Settings,
        (priors, typical): (&[ModelFile], &UnitCosts),
        threads: &rayon::ThreadPool,
    ) -> Result<Self> {
        ensure!(!settings.volumes.is_empty(), "no volume to calibrate with was given; name volume files");
        let ((min_size, max_size), steps) = (settings.sizes, settings.steps.clone());
        let scenes =
            SceneDistribution { lobes: (1, 4), min_size, max_size, steps, ..SceneDistribution::default() };
        scenes.check()?;
        let files = settings.volumes.iter().map(|path| identity::of_volume(path)).collect::<Result<_>>()?;
        let mut frames = Vec::new();
        let mut places = Vec::new();
        for (v, path) in settings.volumes.iter().enumerate() {
            let volume = open_volume(path, &settings.reading)?;
            let voxels = volume.view().shape().voxels;
            let job = Job::from_path(path);
            for factor in factors(v, voxels) {
                for index in 0..PER_VOLUME {
                    let drawn =
                        scenes.draw(settings.seed.wrapping_add(factor as u64), &job.seed_name(), index);
                    let dims = volume.dims().map(|n| n * factor);
                    let modes = (settings.shading, settings.skipping, settings.termination);
                    let scene = job.scene(drawn, dims, modes);
                    places.push((v, factor, index % RANDOM_EVERY == 0));
                    let number = frames.len() as u64;
                    frames.push(TimedFrame { table: 0, number, scene, repeats: Vec::new() });
                }
            }
        }
        let (prior, probe_side) = prior_costs(priors, typical)?;
        // Features are computed from volumes that are read with the same options as for rendering.
        let read = serde_json::json!({ "reading": settings.reading });
        let manifest = Some(Manifest { settings: read, ..Manifest::default() });
        let tables = [Table { manifest, ..Table::default() }];
        let refs: Vec<&TimedFrame> = frames.iter().collect();
        let bar = ProgressBar::hidden();
        let known = measure(&tables, &refs, Some(probe_side), None, threads, &bar, |_, inputs| {
            let of = inputs.features.quantities(inputs.setting);
            Ok(COST_QUANTITIES.map(|q| of(q) as f32))
        })?;
        let candidates: Vec<Candidate> = frames
            .iter()
            .zip(known)
            .zip(places)
            .map(|((frame, counted), (volume, factor, random))| {
                let work = work_of(counted);
                Candidate { volume, factor, scene: frame.scene.clone(), work, random }
            })
            .collect();
        let expected = candidates.iter().map(|c| prior.time(&c.work)).collect();
        Ok(Self { files, candidates, prior, expected })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use entire_io::volume::{Range, Reading};

    #[test]
    fn every_seed_draws_candidates() {
        let folder = tempfile::tempdir().unwrap();
        let path = Settings::write_volume(folder.path(), 6, |i| i as u8);
        let threads = entire_io::options::thread_pool(Some(1)).unwrap();
        for seed in [0, u64::MAX] {
            let settings = Settings { seed, ..Settings::brief(vec![path.clone()]) };
            let pool = Pool::draw(&settings, (&[], &UnitCosts::SOFTWARE), &threads).unwrap();
            // No factor enlarges 6³ voxels to [`LARGE_VOLUME`], so the only factors are 1 and 2.
            assert_eq!(pool.candidates.len() as u64, 2 * PER_VOLUME);
        }
    }

    #[test]
    fn candidates_have_the_work_of_the_volume_as_it_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = Settings::write_volume(folder.path(), 16, |i| (i % 50) as u8);
        let threads = entire_io::options::thread_pool(Some(1)).unwrap();
        let works = |range: Range| {
            let reading = Reading { range, ..Reading::default() };
            let settings = Settings { reading, ..Settings::brief(vec![path.clone()]) };
            let pool = Pool::draw(&settings, (&[], &UnitCosts::SOFTWARE), &threads).unwrap();
            pool.candidates.iter().map(|c| c.work).collect::<Vec<_>>()
        };
        // By default, the scalar range of 8-bit voxels is 0 to 255.
        assert_eq!(works(Range::Default), works(Range::Given(0.0, 255.0)));
        assert_eq!(works(Range::Data), works(Range::Given(0.0, 49.0)));
        assert_ne!(works(Range::Default), works(Range::Data));
    }

    #[test]
    fn some_volumes_are_also_rendered_larger_than_a_cache() {
        let cases: [(usize, u64, &[usize]); 6] = [
            (0, 96 * 96 * 96, &[2, 1, 4]),
            (1, 96 * 96 * 96, &[2, 1]),
            (3, 192 * 192 * 192, &[1]),
            (4, 192 * 192 * 192, &[1, 2]),
            (8, 512 * 512 * 512, &[1]),
            (0, 72 * 72 * 72, &[2, 1]),
        ];
        for (index, voxels, expected) in cases {
            assert_eq!(factors(index, voxels), expected, "{index}, {voxels}");
        }
    }
}
