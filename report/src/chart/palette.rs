//! Colors and dashes.

use plotters::style::RGBColor;

/// Colors that red-green color-blind readers can tell apart (Okabe and Ito's set without black, and some of
/// Tol's), each as a pair for a light and a dark background.
pub(super) const PALETTE: [(u32, u32); 11] = [
    (0x0072b2, 0x56a8e0),
    (0xd55e00, 0xff8a3d),
    (0x009e73, 0x2fc9a0),
    (0xaa3377, 0xe388bb),
    (0x8c6d00, 0xe6c229),
    (0x4b4b4b, 0xc9c9c9),
    (0x56b4e9, 0x9bd4f5),
    (0x7f3f00, 0xc98d5a),
    (0x332288, 0x9a8cf0),
    (0xcc3311, 0xff7a66),
    (0x111111, 0xf2f2f2),
];

/// Dashes of lines for print, by color: lengths of dashes and gaps in turn, pixels. Empty for a solid line.
pub(super) const DASHES: [&[u32]; 11] = [
    &[],
    &[7, 3],
    &[2, 3],
    &[9, 3, 2, 3],
    &[5, 2, 1, 2, 1, 2],
    &[1, 2],
    &[12, 4],
    &[4, 4],
    &[9, 2, 1, 2],
    &[3, 1],
    &[],
];

/// Color of titles, names of axes and series, and horizontal and diagonal lines across the plot.
pub(super) const INK: (u32, u32) = (0x1c2024, 0xe8eaed);
/// Color of texts at ticks, points and lines across the plot.
pub(super) const DIM: (u32, u32) = (0x555b63, 0xa9b0b8);
pub(super) const GRID: (u32, u32) = (0xe4e7ea, 0x2a2f36);
/// Color of the plot's frame and of vertical lines across the plot.
pub(super) const FRAME: (u32, u32) = (0x8a9199, 0x6a727b);

/// Returns every color on a light background with its counterpart on a dark background.
pub(super) fn pairs() -> impl Iterator<Item = (u32, u32)> {
    PALETTE.into_iter().chain([INK, DIM, GRID, FRAME])
}

/// Returns the color on a light background, in which the chart is drawn.
pub(super) fn light((light, _): (u32, u32)) -> RGBColor {
    let [_, r, g, b] = light.to_be_bytes();
    RGBColor(r, g, b)
}
