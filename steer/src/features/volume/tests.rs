//! Compares summaries made on several threads, and summaries updated from one time step to the next, with new
//! summaries made on one thread.

use super::*;
use entire_core::ErrorKind;
use entire_core::scene::Scalars;
use entire_core::scene::VolumeOptions;
use std::vec::Vec;

const DIMS: [usize; 3] = [37, 21, 43];

/// The voxels of a volume, stored in each of the four types.
struct Volume {
    bytes: Vec<u8>,
    words: Vec<u16>,
    signed: Vec<i16>,
    floats: Vec<f32>,
}

struct Random(u32);

impl Random {
    fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        ((self.0 >> 8) as usize * n) >> 24
    }
}

impl Volume {
    fn new() -> Self {
        let mut random = Random(5);
        // Some cells are constant, others are not.
        let voxel = |i: usize| if (i / 7000) % 2 == 0 { 9 } else { random.below(256) as u8 };
        Self::of((0..DIMS.iter().product()).map(voxel).collect())
    }

    fn of(bytes: Vec<u8>) -> Self {
        let floats = bytes.iter().map(|&b| match b {
            3 => f32::NAN,
            4 => f32::INFINITY,
            5 => f32::NEG_INFINITY,
            b => f32::from(b) * 0.37 - 40.0,
        });
        Self {
            words: bytes.iter().map(|&b| u16::from(b) * 257).collect(),
            signed: bytes.iter().map(|&b| (i16::from(b) - 128) * 256).collect(),
            floats: floats.collect(),
            bytes,
        }
    }

    /// The first planes of the volume in each type.
    fn planes(&self, planes: usize) -> [VolumeView<'_>; 4] {
        let part = ..DIMS[0] * DIMS[1] * planes;
        let view = |scalars, range| {
            let options = VolumeOptions { range: Some(range), ..VolumeOptions::default() };
            VolumeView::with(scalars, [DIMS[0], DIMS[1], planes], options).unwrap()
        };
        [
            view(Scalars::U8(&self.bytes[part]), (0.0, 255.0)),
            view(Scalars::U16(&self.words[part]), (300.0, 65_000.0)),
            view(Scalars::I16(&self.signed[part]), (-32_768.0, 32_767.0)),
            view(Scalars::F32(&self.floats[part]), (-30.0, 50.0)),
        ]
    }

    fn whole(&self) -> [VolumeView<'_>; 4] {
        self.planes(DIMS[2])
    }
}

#[test]
#[cfg(feature = "rayon")]
fn threads_change_no_bit() {
    let volume = Volume::new();
    for threads in [2, 3, 7] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        for whole in volume.whole() {
            for cells in [48, 3, 1] {
                let [one, several] = [Executor::Serial, Executor::Rayon(&pool)]
                    .map(|executor| VolumeSummary::with_cells(&whole, cells, executor).unwrap());
                assert_eq!(one, several);
            }
        }
    }
}

/// Writes new values to all, some or none of the voxels in a random box. Returns the box.
fn change(bytes: &mut [u8], random: &mut Random) -> [core::ops::Range<usize>; 3] {
    let most = [3, 12, 64][random.below(3)];
    let within = core::array::from_fn(|a| {
        let start = random.below(DIMS[a]);
        start..(start + 1 + random.below(most)).min(DIMS[a])
    });
    let ([xs, ys, zs], how, fixed) = (&within, random.below(4), random.below(8) as u8);
    for (z, y) in zs.clone().flat_map(|z| ys.clone().map(move |y| (z, y))) {
        for x in xs.clone().filter(|_| how > 0) {
            let value = if how == 1 { fixed } else { random.below(256) as u8 };
            if how < 3 || random.below(30) == 0 {
                bytes[x + DIMS[0] * (y + DIMS[1] * z)] = value;
            }
        }
    }
    within
}

#[test]
fn a_series_gives_the_summary_of_every_time_step() {
    #[cfg(feature = "rayon")]
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
    #[cfg(feature = "rayon")]
    let executors = [Executor::Serial, Executor::Rayon(&pool)];
    #[cfg(not(feature = "rayon"))]
    let executors = [Executor::Serial; 2];
    for (kind, cells) in (0..4).flat_map(|kind| [48, 3, 1].map(|cells| (kind, cells))) {
        let mut random = Random(kind as u32);
        let mut volume = Volume::new();
        let mut series = SummarySeries::with_cells(&volume.whole()[kind], cells).unwrap();
        assert_eq!(series.summary().unwrap_err().kind(), ErrorKind::NotReady);
        for step in 0..24 {
            let mut bytes = core::mem::take(&mut volume.bytes);
            let within = change(&mut bytes, &mut random);
            volume = Volume::of(bytes);
            let whole = volume.whole()[kind];
            let executor = executors[random.below(2)];
            let known = (random.below(2) == 0).then_some(within);
            series.update(&whole, known, executor).unwrap();
            let expected = VolumeSummary::with_cells(&whole, cells, Executor::Serial).unwrap();
            assert!(*series.summary().unwrap() == expected, "{kind} {cells} {step}");
        }
    }
}

#[test]
fn a_series_takes_other_strides_and_large_blocks() {
    let dims = [130usize, 9, 20];
    let mut voxels: Vec<u16> = (0..dims.iter().product()).map(|i: usize| (i * 7919 % 1000) as u16).collect();
    // z is the fastest axis in memory.
    let strides = Some([dims[1] * dims[2], dims[2], 1]);
    let known = VolumeOptions { strides, range: Some((5.0, 700.0)), ..VolumeOptions::default() };
    fn of(voxels: &[u16], dims: [usize; 3], known: VolumeOptions) -> VolumeView<'_> {
        VolumeView::with(Scalars::U16(voxels), dims, known).unwrap()
    }
    let mut series = SummarySeries::with_cells(&of(&voxels, dims, known), 1).unwrap();
    for step in 0..6 {
        voxels[step * 3571 % 23_000] = 40_000 + step as u16;
        let view = of(&voxels, dims, known);
        let expected = VolumeSummary::with_cells(&view, 1, Executor::Serial).unwrap();
        assert_eq!(*series.update(&view, None, Executor::Serial).unwrap(), expected);
    }
}

#[test]
fn a_series_reads_only_what_was_announced() {
    let mut volume = Volume::new();
    let [whole, ..] = volume.whole();
    let mut series = SummarySeries::new(&whole).unwrap();
    let first = series.update(&whole, Some([0..1, 0..1, 0..1]), Executor::Serial).unwrap().clone();
    assert_eq!(first, VolumeSummary::new(&whole).unwrap());
    // Changes outside the box are missed until an update without a box.
    volume.bytes[0] ^= 255;
    let [whole, words, ..] = volume.whole();
    assert_eq!(*series.update(&whole, Some([30..37, 0..21, 9..10]), Executor::Serial).unwrap(), first);
    assert_eq!(*series.update(&whole, Some([0..37, 5..5, 9..10]), Executor::Serial).unwrap(), first);
    let found = series.update(&whole, None, Executor::Serial).unwrap();
    assert_eq!(*found, VolumeSummary::new(&whole).unwrap());
    let [short, ..] = volume.planes(8);
    let mut refused = |volume: &VolumeView<'_>, changed| {
        series.update(volume, changed, Executor::Serial).unwrap_err().kind()
    };
    for beyond in [[0..38, 0..1, 0..1], [0..1, 9..44, 0..1]] {
        assert_eq!(refused(&whole, Some(beyond)), ErrorKind::InvalidArgument);
    }
    assert_eq!(refused(&words, None), ErrorKind::InvalidArgument);
    assert_eq!(refused(&short, None), ErrorKind::SizeMismatch);
    let spacing = [1.0, 2.0, 1.0];
    let stretched = VolumeOptions { spacing, range: Some(whole.range()), ..VolumeOptions::default() };
    let stretched = VolumeView::with(whole.scalars(), DIMS, stretched).unwrap();
    assert_eq!(refused(&stretched, None), ErrorKind::InvalidArgument);
    assert!(series.summary().is_ok());
}
