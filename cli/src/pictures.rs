//! Sizes of pictures, and error measures between two pictures.

use entire_vk_raycaster::Image;

/// Maximum PSNR in tables and means, decibels; equal pictures get this value.
pub const BEST_PSNR: f64 = 100.0;

/// Resizes a picture bilinearly; where it shrinks, by a triangle filter whose half width is one new pixel.
/// `None` if the old or the new picture has no pixels.
pub fn resized(picture: &Image, width: u32, height: u32) -> Option<Image> {
    let (from, to) =
        ([picture.width, picture.height].map(|n| n as usize), [width, height].map(|n| n as usize));
    if from == to {
        return Some(picture.clone());
    }
    if from.contains(&0) || to.contains(&0) || picture.rgba.len() != 4 * from[0] * from[1] {
        return None;
    }
    let (columns, rows) = (taps(from[0], to[0]), taps(from[1], to[1]));
    let mut tall = Vec::with_capacity(4 * from[0] * to[1]);
    for (first, weights) in &rows {
        tall.extend((0..4 * from[0]).map(|i| {
            weights
                .iter()
                .enumerate()
                .map(|(k, w)| w * f32::from(picture.rgba[4 * from[0] * (first + k) + i]))
                .sum::<f32>()
        }));
    }
    let mut rgba = Vec::with_capacity(4 * to[0] * to[1]);
    for row in tall.chunks_exact(4 * from[0]) {
        for (first, weights) in &columns {
            for channel in 0..4 {
                let sum: f32 =
                    weights.iter().enumerate().map(|(k, w)| w * row[4 * (first + k) + channel]).sum();
                rgba.push(sum.round().clamp(0.0, 255.0) as u8);
            }
        }
    }
    Some(Image { width, height, rgba })
}

/// Returns for each new pixel along one axis the index of its first source pixel, and the weights of the
/// source pixels from this one on, which sum to 1.
fn taps(from: usize, to: usize) -> Vec<(usize, Vec<f32>)> {
    let ratio = from as f32 / to as f32;
    let reach = ratio.max(1.0);
    let tap = |new: usize| {
        let center = (new as f32 + 0.5) * ratio;
        let first = ((center - reach).floor().max(0.0) as usize).min(from - 1);
        let end = ((center + reach).ceil() as usize).clamp(first + 1, from);
        let weight = |i: usize| (1.0 - ((i as f32 + 0.5 - center) / reach).abs()).max(0.0);
        let sum: f32 = (first..end).map(weight).sum();
        (first, (first..end).map(|i| weight(i) / sum).collect())
    };
    (0..to).map(tap).collect()
}

/// Side lengths, in pixels, of an image of full size `size` whose rays are `distance` pixels apart along each
/// side, rounded down as for an [`entire_steer::control::Plan`].
pub(crate) fn sampled_size(size: (u32, u32), distance: f32) -> (u32, u32) {
    let side = |n: u32| ((f64::from(n) / f64::from(distance)) as u32).max(1);
    (side(size.0), side(size.1))
}

/// Side lengths, in pixels, of an image of size `size` at a scale, rounded.
pub fn scaled_size(size: (u32, u32), scale: f32) -> (u32, u32) {
    let side = |n: u32| ((n as f32 * scale).round() as u32).max(1);
    (side(size.0), side(size.1))
}

/// Peak signal-to-noise ratio of two 8-bit RGBA pictures over red, green and blue, decibels; infinite when
/// they are equal. `None` when they differ in size or have no pixels.
pub fn psnr(a: &[u8], b: &[u8]) -> Option<f64> {
    if a.len() != b.len() || a.is_empty() {
        return None;
    }
    let sum: u64 = a
        .chunks_exact(4)
        .zip(b.chunks_exact(4))
        .map(|(p, q)| (0..3).map(|i| u64::from(p[i].abs_diff(q[i])).pow(2)).sum::<u64>())
        .sum();
    let mean = sum as f64 / (a.len() / 4 * 3) as f64;
    Some(if mean == 0.0 { f64::INFINITY } else { 10.0 * (255.0 * 255.0 / mean).log10() })
}

/// Root mean squared difference of colors between two pictures of one size, on a scale of 0 to 255; `None`
/// when they differ in size or have no pixels.
pub(crate) fn rmse(a: &[u8], b: &[u8]) -> Option<f64> {
    let decibels = psnr(a, b)?;
    Some(255.0 * 10f64.powf(-decibels / 20.0))
}

/// Side length in pixels of the windows that [`ssim`] compares.
const SSIM_WINDOW: usize = 8;

/// Luma of a picture, 0 to 255 in whole numbers.
fn luma(picture: &Image) -> Vec<f64> {
    picture
        .rgba
        .chunks_exact(4)
        .map(|p| {
            let luma = (54 * u32::from(p[0]) + 183 * u32::from(p[1]) + 18 * u32::from(p[2]) + 127) / 255;
            f64::from(luma.min(255))
        })
        .collect()
}

/// Structural similarity of two pictures of one size, 0 to 1: SSIM over non-overlapping windows of 8 × 8
/// pixels of their luma, averaged by area. As in `image-compare` 0.5, variances and covariance are sums over
/// a window, not divided by its number of pixels. `None` when the pictures differ in size or have no pixels.
pub fn ssim(a: &Image, b: &Image) -> Option<f64> {
    let (width, height) = (a.width as usize, a.height as usize);
    let (first, second) = (luma(a), luma(b));
    if (a.width, a.height) != (b.width, b.height) || width * height == 0 || first.len() != second.len() {
        return None;
    }
    let (c1, c2) = ((0.01f64 * 255.0).powi(2), (0.03f64 * 255.0).powi(2));
    let mut total = 0.0;
    for y in (0..height).step_by(SSIM_WINDOW) {
        for x in (0..width).step_by(SSIM_WINDOW) {
            let rows = y..(y + SSIM_WINDOW).min(height);
            let columns = x..(x + SSIM_WINDOW).min(width);
            let area = (rows.len() * columns.len()) as f64;
            let pixels = || rows.clone().flat_map(|y| columns.clone().map(move |x| y * width + x));
            let mean = |luma: &[f64]| pixels().map(|i| luma[i]).sum::<f64>() / area;
            let (mean_a, mean_b) = (mean(&first), mean(&second));
            let (mut variances, mut covariance) = (0.0, 0.0);
            for i in pixels() {
                let (p, q) = (first[i] - mean_a, second[i] - mean_b);
                variances += p * p + q * q;
                covariance += p * q;
            }
            let likeness = (2.0 * mean_a * mean_b + c1) * (2.0 * covariance + c2)
                / ((mean_a * mean_a + mean_b * mean_b + c1) * (variances + c2));
            total += area * likeness;
        }
    }
    Some((total / (width * height) as f64).clamp(0.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn likeness_is_the_textbooks() {
        assert_eq!(psnr(&[1, 2, 3, 4], &[1, 2, 3, 99]), Some(f64::INFINITY));
        // One of three channels off by 3: mean square 3, 10 log10(255² / 3).
        assert!((psnr(&[1, 2, 3, 4], &[4, 2, 3, 4]).unwrap() - 43.3596).abs() < 1e-3);
        assert_eq!(psnr(&[1, 2, 3, 4], &[1, 2, 3, 4, 5, 6, 7, 8]), None);
        assert_eq!(psnr(&[], &[]), None);
    }

    #[test]
    fn a_constant_difference_is_its_own_root_mean_square() {
        let (a, b) = ([10u8, 20, 30, 255].repeat(64), [17u8, 13, 37, 0].repeat(64));
        assert!((rmse(&a, &b).unwrap() - 7.0).abs() < 1e-9);
        assert_eq!(rmse(&a, &b[4..]), None);
    }

    fn pattern(width: u32, height: u32, f: &dyn Fn(u32, u32) -> u8) -> Image {
        let pixel = |i: u32| {
            let v = f(i % width, i / width);
            [v, v / 2, 255 - v, v.wrapping_mul(7)]
        };
        Image { width, height, rgba: (0..width * height).flat_map(pixel).collect() }
    }

    /// The expected values were computed with the crates `image` 0.25 (filter Triangle) and `image-compare`
    /// 0.5 (MSSIMSimple).
    #[test]
    fn sizes_and_likeness_are_those_of_the_image_crates() {
        let f = |x: u32, y: u32| (x * x + 3 * y * y + x * y) as u8;
        let a = pattern(45, 27, &f);
        let b = pattern(45, 27, &|x, y| f(x, y).saturating_add((x % 5) as u8 * 4));
        assert!((ssim(&a, &b).unwrap() - 0.9959286713820774).abs() < 1e-12);
        for (width, height, hash) in
            [(90, 61, 0xcfc2_94db_c68f_9085), (20, 11, 0x2af2_6f27_4830_acb6), (7, 50, 0x2058_c1e8_bd30_44ec)]
        {
            let picture = resized(&a, width, height).unwrap();
            assert_eq!(entire_io::files::fnv1a(&picture.rgba), hash, "{width} x {height}");
        }
        assert_eq!(resized(&a, 0, 5), None);
        assert_eq!((ssim(&a, &a), ssim(&a, &pattern(27, 45, &f))), (Some(1.0), None));
        assert_eq!(scaled_size((100, 3), 0.1), (10, 1));
    }
}
