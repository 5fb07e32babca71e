//! Pictures: their sizes, and how far one lies from another.

use entire_vk_raycaster::Image;
use image_compare::Algorithm;

/// Pictures that are equal, or closer than this, count as this many decibels.
pub const BEST_PSNR: f64 = 100.0;

/// A picture brought to another size, bilinearly.
pub fn resized(picture: &Image, width: u32, height: u32) -> Option<Image> {
    if (picture.width, picture.height) == (width, height) {
        return Some(picture.clone());
    }
    let full = image::RgbaImage::from_raw(picture.width, picture.height, picture.rgba.clone())?;
    let out = image::imageops::resize(&full, width, height, image::imageops::FilterType::Triangle);
    Some(Image { width, height, rgba: out.into_raw() })
}

/// Side lengths of an image whose rays stand `distance` pixels apart, as [`entire_core::control::Plan`] has it.
pub fn sampled_size(size: (u32, u32), distance: f32) -> (u32, u32) {
    let side = |n: u32| ((f64::from(n) / f64::from(distance)) as u32).max(1);
    (side(size.0), side(size.1))
}

/// Side lengths at a scale.
pub fn scaled_size(size: (u32, u32), scale: f32) -> (u32, u32) {
    let side = |n: u32| ((n as f32 * scale).round() as u32).max(1);
    (side(size.0), side(size.1))
}

/// Peak signal-to-noise ratio of two 8-bit RGBA pictures over red, green and blue, decibels; infinite when
/// they are equal. `None` when they differ in size.
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

/// Root mean squared difference of colors between two pictures of one size, on a scale of 0 to 255; `None` when
/// they differ in size.
pub fn rmse(a: &[u8], b: &[u8]) -> Option<f64> {
    let decibels = psnr(a, b)?;
    Some(255.0 * 10f64.powf(-decibels / 20.0))
}

/// Luma of a picture.
fn luma(picture: &Image) -> Option<image::GrayImage> {
    let gray = picture
        .rgba
        .chunks_exact(4)
        .map(|p| {
            ((54 * u32::from(p[0]) + 183 * u32::from(p[1]) + 18 * u32::from(p[2]) + 127) / 255).min(255) as u8
        })
        .collect();
    image::GrayImage::from_raw(picture.width, picture.height, gray)
}

/// Structural similarity of two pictures of one size, 0 to 1 (mean SSIM over windows of 8 × 8 pixels of their
/// luma). `None` when they differ in size.
pub fn ssim(a: &Image, b: &Image) -> Option<f64> {
    if (a.width, a.height) != (b.width, b.height) {
        return None;
    }
    let found =
        image_compare::gray_similarity_structure(&Algorithm::MSSIMSimple, &luma(a)?, &luma(b)?).ok()?;
    Some(found.score.clamp(0.0, 1.0))
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
    fn likeness_is_one_for_equal_pictures_and_falls() {
        let picture = |f: &dyn Fn(u32, u32) -> u8| Image {
            width: 32,
            height: 32,
            rgba: (0..32 * 32u32).flat_map(|i| [f(i % 32, i / 32); 4]).collect(),
        };
        let a = picture(&|x, y| (x * 8) as u8 ^ (y * 4) as u8);
        let b = picture(&|x, y| ((x * 8) as u8 ^ (y * 4) as u8).saturating_add(9));
        let c = picture(&|x, _| (x * 8) as u8);
        assert_eq!((ssim(&a, &a), rmse(&a.rgba, &a.rgba)), (Some(1.0), Some(0.0)));
        let (near, far) = (ssim(&a, &b).unwrap(), ssim(&a, &c).unwrap());
        assert!(near < 1.0 && far < near, "{near} {far}");
        assert_eq!(ssim(&a, &picture(&|_, _| 0)).map(|v| v < 0.5), Some(true));
        let small = resized(&a, 16, 16).unwrap();
        assert_eq!(ssim(&a, &small), None);
        assert_eq!(scaled_size((100, 3), 0.1), (10, 1));
    }

    #[test]
    fn a_constant_difference_is_its_own_root_mean_square() {
        let (a, b) = ([10u8, 20, 30, 255].repeat(64), [17u8, 13, 37, 0].repeat(64));
        assert!((rmse(&a, &b).unwrap() - 7.0).abs() < 1e-9);
        assert_eq!(rmse(&a, &b[4..]), None);
    }
}
