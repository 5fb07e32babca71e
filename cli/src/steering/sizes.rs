//! Image sizes and volumes along a path: which frame shows which volume, at which size.

use entire_vk_raycaster::Image;

/// Which volume of a series a frame shows: each for `hold` frames in turn, the first alone where `hold` is 0.
pub fn volume_at(hold: u32, volumes: usize, frame: usize) -> usize {
    if hold == 0 { 0 } else { (frame / hold as usize) % volumes.max(1) }
}

/// The image scale of a frame: that of the last change at or before it, 1 before the first.
pub fn scale_at(scales: &[(u32, f32)], frame: usize) -> f32 {
    scales.iter().rev().find(|(from, _)| *from as usize <= frame).map_or(1.0, |(_, s)| *s)
}

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
