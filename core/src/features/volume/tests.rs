//! Slabs and threads against the whole volume at once.

use super::*;
use crate::ErrorKind;
use crate::kernels::Helper;
use crate::scene::Scalars;
use crate::scene::VolumeOptions;
use std::vec::Vec;

const DIMS: [usize; 3] = [37, 21, 43];

/// The planes of a volume, every type with values at both ends of its range.
struct Volume {
    bytes: Vec<u8>,
    words: Vec<u16>,
    signed: Vec<i16>,
    floats: Vec<f32>,
}

impl Volume {
    fn new() -> Self {
        let mut state = 5u32;
        let bytes: Vec<u8> = (0..DIMS.iter().product())
            .map(|i: usize| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                // Constant cells among others.
                if (i / 7000).is_multiple_of(2) { 9 } else { (state >> 24) as u8 }
            })
            .collect();
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
    // Not a whole number of layers, too many planes, another type, another range.
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
