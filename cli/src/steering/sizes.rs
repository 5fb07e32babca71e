//! Image scales and volumes along a path.

/// Returns the index of the volume at a frame of a series: each volume is shown for `hold` frames in turn;
/// always 0 if `hold` is 0.
pub fn volume_at(hold: u32, volumes: usize, frame: usize) -> usize {
    if hold == 0 { 0 } else { (frame / hold as usize) % volumes.max(1) }
}

/// Returns the image scale at a frame: the scale of the last change at or before the frame, and 1 before the
/// first change.
pub fn scale_at(scales: &[(u32, f32)], frame: usize) -> f32 {
    scales.iter().rev().find(|(from, _)| *from as usize <= frame).map_or(1.0, |(_, s)| *s)
}
