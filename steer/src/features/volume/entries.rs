//! Conversion of stored values to table entries.

use entire_core::scene::{Scalars, VolumeView};

/// Mapping from stored values to entries of a 256-entry table.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Map {
    /// The range that maps to [0, 1].
    pub(super) range: (f32, f32),
    /// Table entries per unit of the stored values; `None` if this ratio is not finite and positive.
    scale: Option<f32>,
    /// Table entry of each byte that is counted: for volumes of bytes, the entry nearest to the stored value;
    /// for other types, the byte itself, because it is an entry already.
    pub(super) near: [u8; 256],
    /// [`Map::below`] and [`Map::above`] of each byte; used for volumes of bytes only.
    ends: [[u8; 2]; 256],
}

impl Map {
    pub(super) fn new(volume: &VolumeView<'_>) -> Self {
        let (low, high) = volume.range();
        let width = high - low;
        let scale = 255.0 / width;
        let scale = (width > 0.0 && scale > 0.0 && scale.is_finite()).then_some(scale);
        let near_of = core::array::from_fn(|v| v as u8);
        let mut map = Self { range: (low, high), scale, near: near_of, ends: [[0; 2]; 256] };
        if let Scalars::U8(_) = volume.scalars() {
            map.near = core::array::from_fn(|v| near(map.position(v as f32)));
            map.ends = core::array::from_fn(|v| [map.below(v as f32), map.above(v as f32)]);
        }
        map
    }

    /// Returns the position of a stored voxel value in the transfer function's table, 0 to 255 and not
    /// rounded: 255 times the result of [`normalize`](entire_core::scene::normalize).
    #[inline(always)]
    fn position(&self, value: f32) -> f32 {
        match self.scale {
            Some(scale) => scaled(value, self.range.0, scale),
            None => entire_core::scene::normalize(self.range, value) * 255.0,
        }
    }

    /// Returns the highest entry at or below a stored value.
    fn below(&self, value: f32) -> u8 {
        self.position(value) as u8
    }

    /// Returns the lowest entry at or above a stored value.
    fn above(&self, value: f32) -> u8 {
        super::ceil_entry(self.position(value))
    }
}

#[inline(always)]
fn scaled(value: f32, low: f32, scale: f32) -> f32 {
    let t = (value - low) * scale;
    // In this order of comparisons NaN becomes 0.
    let t = if t > 0.0 { t } else { 0.0 };
    if t < 255.0 { t } else { 255.0 }
}

/// The entry nearest to a position in 0…255, in arithmetic that compilers vectorize.
#[inline(always)]
fn near(position: f32) -> u8 {
    /// 2²³: adding this number rounds a value to an integer, which the low bits then hold.
    const SHIFT: f32 = 8_388_608.0;
    let v = position + 0.5;
    let rounded = (v + SHIFT) - SHIFT;
    let floor = if rounded > v { rounded - 1.0 } else { rounded };
    (floor + SHIFT).to_bits() as u8
}

/// Types of stored values.
pub(super) trait Voxel: bytemuck::Pod + Into<f32> + Send + Sync + core::fmt::Debug {
    /// The smallest value of the type.
    const LOWEST: Self;
    /// The largest value of the type.
    const HIGHEST: Self;
    /// True if stored values are counted directly, without conversion to entries.
    const IS_ENTRY: bool;
    /// True if values may be NaN or infinite.
    const IS_FLOAT: bool = false;

    #[inline(always)]
    fn number(self) -> f32 {
        self.into()
    }
    fn lesser(self, other: Self) -> Self;
    fn greater(self, other: Self) -> Self;
    /// Returns the value, or negative infinity in place of NaN.
    #[inline(always)]
    fn known(self) -> Self {
        self
    }
    #[inline(always)]
    fn is_non_finite(self) -> bool {
        false
    }
    /// The stored bytes if [`Voxel::IS_ENTRY`] is true, otherwise an empty slice.
    #[inline(always)]
    fn bytes(_: &[Self]) -> &[u8] {
        &[]
    }
    /// The highest entry at or below `low`, and the lowest entry at or above `high`.
    #[inline(always)]
    fn ends([low, high]: [Self; 2], map: &Map) -> [u8; 2] {
        [map.below(low.number()), map.above(high.number())]
    }
    /// Returns the table entry that is nearest to a value.
    #[inline(always)]
    fn entry_of(value: Self, map: &Map) -> u8 {
        near(map.position(value.number()))
    }
    /// Writes the bytes that are counted for a row of values, unless [`Voxel::IS_ENTRY`] is true. Returns the
    /// number of values that are NaN or infinite.
    #[inline(always)]
    fn entries(row: &[Self], map: &Map, out: &mut [u8]) -> u32 {
        let low = map.range.0;
        match map.scale {
            Some(scale) => {
                for (out, v) in out.iter_mut().zip(row) {
                    *out = near(scaled(v.number(), low, scale));
                }
            }
            None => {
                for (out, v) in out.iter_mut().zip(row) {
                    *out = near(map.position(v.number()));
                }
            }
        }
        row.iter().map(|v| u32::from(v.is_non_finite())).sum()
    }
}

macro_rules! integer {
    ($type:ty) => {
        const LOWEST: Self = <$type>::MIN;
        const HIGHEST: Self = <$type>::MAX;
        #[inline(always)]
        fn lesser(self, other: Self) -> Self {
            Ord::min(self, other)
        }
        #[inline(always)]
        fn greater(self, other: Self) -> Self {
            Ord::max(self, other)
        }
    };
}

impl Voxel for u8 {
    integer!(u8);
    const IS_ENTRY: bool = true;
    #[inline(always)]
    fn bytes(values: &[Self]) -> &[u8] {
        values
    }
    #[inline(always)]
    fn ends([low, high]: [Self; 2], map: &Map) -> [u8; 2] {
        [map.ends[usize::from(low)][0], map.ends[usize::from(high)][1]]
    }
    #[inline(always)]
    fn entry_of(value: Self, _: &Map) -> u8 {
        value
    }
    #[inline(always)]
    fn entries(_: &[Self], _: &Map, _: &mut [u8]) -> u32 {
        0
    }
}

impl Voxel for u16 {
    integer!(u16);
    const IS_ENTRY: bool = false;
}

impl Voxel for i16 {
    integer!(i16);
    const IS_ENTRY: bool = false;
}

impl Voxel for f32 {
    const LOWEST: Self = f32::NEG_INFINITY;
    const HIGHEST: Self = f32::INFINITY;
    const IS_ENTRY: bool = false;
    const IS_FLOAT: bool = true;
    #[inline(always)]
    fn lesser(self, other: Self) -> Self {
        if other < self { other } else { self }
    }
    #[inline(always)]
    fn greater(self, other: Self) -> Self {
        if other > self { other } else { self }
    }
    #[inline(always)]
    fn known(self) -> Self {
        if self.is_nan() { f32::NEG_INFINITY } else { self }
    }
    #[inline(always)]
    fn is_non_finite(self) -> bool {
        !self.is_finite()
    }
}
