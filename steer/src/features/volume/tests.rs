//! Compares summaries made by slabs and threads with those of the whole volume.

use super::*;
use entire_core::ErrorKind;
use entire_core::kernels::Helper;
use entire_core::scene::Scalars;
use entire_core::scene::VolumeOptions;
use std::vec::Vec;

const DIMS: [usize; 3] = [37, 21, 43];

/// The planes of a volume; every type has values at both ends of its range.
struct Volume {
    bytes: Vec<u8>,
    words: Vec<u16>,
    signed: Vec<i16>,
    floats: Vec<f32>,
}

/// Pseudo-random numbers.
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
        // Constant cells among others.
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

    fn slabs(&self, planes: core::ops::Range<usize>) -> [VolumeView<'_>; 4] {
        let voxels = DIMS[0] * DIMS[1];
        let part = voxels * planes.start..voxels * planes.end;
        let view = |scalars, range| {
            VolumeView::with(
                scalars,
                [DIMS[0], DIMS[1], planes.len()],
                VolumeOptions { range: Some(range), ..VolumeOptions::default() },
            )
            .unwrap()
        };
        [
            view(Scalars::U8(&self.bytes[part.clone()]), (0.0, 255.0)),
            view(Scalars::U16(&self.words[part.clone()]), (300.0, 65_000.0)),
            view(Scalars::I16(&self.signed[part.clone()]), (-32_768.0, 32_767.0)),
            view(Scalars::F32(&self.floats[part]), (-30.0, 50.0)),
        ]
    }
}

/// The summary of a whole volume on the executor's threads.
fn summary_on(whole: &VolumeView<'_>, options: SummaryOptions, executor: Executor<'_>) -> VolumeSummary {
    let mut builder = SummaryBuilder::new(whole, whole.dims()[2], options).unwrap();
    builder.add(whole, executor).unwrap();
    builder.finish().unwrap()
}

#[test]
fn slabs_and_threads_change_no_bit() {
    let volume = Volume::new();
    let helper = Helper::new();
    std::thread::scope(|scope| {
        scope.spawn(|| helper.serve());
        for (kind, whole) in volume.slabs(0..DIMS[2]).iter().enumerate() {
            for cells_per_axis in [48, 3, 1] {
                let options = SummaryOptions { cells_per_axis };
                let expected = VolumeSummary::new(whole, options).unwrap();
                for executor in [Executor::Serial, Executor::Helper(&helper)] {
                    assert_eq!(summary_on(whole, options, executor), expected);
                    for multiple in [1, 2] {
                        let mut builder = SummaryBuilder::new(whole, DIMS[2], options).unwrap();
                        while let Some(planes) = builder.next_planes() {
                            let end = planes.start + multiple * planes.len();
                            let slab = volume.slabs(planes.start..end.min(DIMS[2]))[kind];
                            builder.add(&slab, executor).unwrap();
                        }
                        assert_eq!(builder.finish().unwrap(), expected, "{kind} {cells_per_axis} {multiple}");
                    }
                }
            }
        }
        helper.stop();
    });
}

#[test]
#[cfg(feature = "rayon")]
fn pools_change_no_bit() {
    let volume = Volume::new();
    for threads in [2, 3, 7] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        for whole in volume.slabs(0..DIMS[2]) {
            let options = SummaryOptions::default();
            let found = summary_on(&whole, options, Executor::Rayon(&pool));
            assert_eq!(found, VolumeSummary::new(&whole, options).unwrap());
        }
    }
}

#[test]
fn slabs_that_do_not_fit_are_refused_and_leave_no_trace() {
    let volume = Volume::new();
    let [bytes, words, ..] = volume.slabs(0..DIMS[2]);
    let options = SummaryOptions::default();
    let mut builder = SummaryBuilder::new(&bytes, DIMS[2], options).unwrap();
    let executor = Executor::Serial;
    assert_eq!(builder.next_planes(), Some(0..8));
    // A partial layer, too many planes, another type, another range.
    let [part, ..] = volume.slabs(0..12);
    let [eight, eight_words, ..] = volume.slabs(0..8);
    assert_eq!(builder.add(&part, executor).unwrap_err().kind(), ErrorKind::SizeMismatch);
    assert_eq!(builder.add(&words, executor).unwrap_err().kind(), ErrorKind::InvalidArgument);
    assert_eq!(builder.add(&eight_words, executor).unwrap_err().kind(), ErrorKind::InvalidArgument);
    let shifted = VolumeOptions { range: Some((0.0, 254.0)), ..VolumeOptions::default() };
    let other = VolumeView::with(eight.scalars(), eight.dims(), shifted).unwrap();
    assert_eq!(builder.add(&other, executor).unwrap_err().kind(), ErrorKind::InvalidArgument);
    assert_eq!(builder.clone().finish().unwrap_err().kind(), ErrorKind::NotReady);
    builder.add(&eight, executor).unwrap();
    assert_eq!(builder.next_planes(), Some(8..16));
    assert_eq!(builder.add(&bytes, executor).unwrap_err().kind(), ErrorKind::SizeMismatch);
    builder.add(&volume.slabs(8..DIMS[2])[0], executor).unwrap();
    assert_eq!(builder.next_planes(), None);
    assert_eq!(builder.finish().unwrap(), VolumeSummary::new(&bytes, options).unwrap());
    assert!(SummaryBuilder::new(&bytes, 0, options).is_err());
}

/// A random box of voxels, and new values for all, some or none of its voxels.
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
    let helper = Helper::new();
    std::thread::scope(|scope| {
        scope.spawn(|| helper.serve());
        for (kind, cells_per_axis) in (0..4).flat_map(|kind| [48, 3, 1].map(|cells| (kind, cells))) {
            let (options, mut random) = (SummaryOptions { cells_per_axis }, Random(kind as u32));
            let mut volume = Volume::new();
            let mut series = SummarySeries::new(&volume.slabs(0..DIMS[2])[kind], DIMS[2], options).unwrap();
            for step in 0..if cfg!(miri) { 4 } else { 24 } {
                let mut bytes = core::mem::take(&mut volume.bytes);
                let within = change(&mut bytes, &mut random);
                volume = Volume::of(bytes);
                let whole = volume.slabs(0..DIMS[2])[kind];
                let executor = [Executor::Serial, Executor::Helper(&helper)][random.below(2)];
                let known = (random.below(2) == 0).then_some(within);
                if random.below(2) == 0 {
                    series.update(&whole, known, executor).unwrap();
                } else {
                    // Slab by slab, with a stop now and then.
                    series.begin(known).unwrap();
                    let mut stop = random.below(4);
                    while let Some(planes) = series.next_planes() {
                        if stop == 0 {
                            assert_eq!(series.summary().unwrap_err().kind(), ErrorKind::NotReady);
                            break;
                        }
                        stop -= 1;
                        let end = (planes.start + planes.len() * (1 + random.below(2))).min(DIMS[2]);
                        series.add(&volume.slabs(planes.start..end)[kind], executor).unwrap();
                    }
                    if series.summary().is_err() {
                        continue;
                    }
                }
                let expected = VolumeSummary::new(&whole, options).unwrap();
                assert!(*series.summary().unwrap() == expected, "{kind} {cells_per_axis} {step}");
            }
        }
        helper.stop();
    });
}

#[test]
fn a_series_takes_other_strides_and_large_blocks() {
    let (dims, options) = ([130usize, 9, 20], SummaryOptions { cells_per_axis: 1 });
    let mut voxels: Vec<u16> = (0..dims.iter().product()).map(|i: usize| (i * 7919 % 1000) as u16).collect();
    // z is the fastest axis in memory.
    let strides = Some([dims[1] * dims[2], dims[2], 1]);
    let known = VolumeOptions { strides, range: Some((5.0, 700.0)), ..VolumeOptions::default() };
    fn of(voxels: &[u16], dims: [usize; 3], known: VolumeOptions) -> VolumeView<'_> {
        VolumeView::with(Scalars::U16(voxels), dims, known).unwrap()
    }
    let mut series = SummarySeries::new(&of(&voxels, dims, known), dims[2], options).unwrap();
    for step in 0..6 {
        voxels[step * 3571 % 23_000] = 40_000 + step as u16;
        let expected = VolumeSummary::new(&of(&voxels, dims, known), options).unwrap();
        assert_eq!(*series.update(&of(&voxels, dims, known), None, Executor::Serial).unwrap(), expected);
    }
}

#[test]
fn a_series_reads_only_what_was_announced() {
    let mut volume = Volume::new();
    let [whole, ..] = volume.slabs(0..DIMS[2]);
    let options = SummaryOptions::default();
    let mut series = SummarySeries::new(&whole, DIMS[2], options).unwrap();
    let first = series.update(&whole, Some([0..1, 0..1, 0..1]), Executor::Serial).unwrap().clone();
    assert_eq!(first, VolumeSummary::new(&whole, options).unwrap());
    series.begin(Some([3..9, 0..21, 17..30])).unwrap();
    assert_eq!(series.next_planes(), Some(16..24));
    assert_eq!(series.add(&whole, Executor::Serial).unwrap_err().kind(), ErrorKind::SizeMismatch);
    series.add(&volume.slabs(16..24)[0], Executor::Serial).unwrap();
    assert_eq!(series.next_planes(), Some(24..32));
    series.add(&volume.slabs(24..43)[0], Executor::Serial).unwrap();
    assert_eq!(series.next_planes(), None);
    assert_eq!(*series.summary().unwrap(), first);
    assert_eq!(
        series.add(&volume.slabs(0..8)[0], Executor::Serial).unwrap_err().kind(),
        ErrorKind::SizeMismatch
    );
    // Changes outside the box are missed until they are searched.
    volume.bytes[0] ^= 255;
    let [whole, words, ..] = volume.slabs(0..DIMS[2]);
    assert_eq!(*series.update(&whole, Some([30..37, 0..21, 9..10]), Executor::Serial).unwrap(), first);
    assert_eq!(*series.update(&whole, Some([0..37, 5..5, 9..10]), Executor::Serial).unwrap(), first);
    let found = series.update(&whole, None, Executor::Serial).unwrap();
    assert_eq!(*found, VolumeSummary::new(&whole, options).unwrap());
    for refused in [[0..38, 0..1, 0..1], [0..1, 9..44, 0..1]] {
        assert_eq!(series.begin(Some(refused)).unwrap_err().kind(), ErrorKind::InvalidArgument);
    }
    assert!(series.update(&words, None, Executor::Serial).is_err());
    assert_eq!(
        series.update(&volume.slabs(0..8)[0], None, Executor::Serial).unwrap_err().kind(),
        ErrorKind::SizeMismatch
    );
    assert!(series.summary().is_ok());
}
