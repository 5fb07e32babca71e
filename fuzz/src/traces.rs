//! Invariants of traces.

use crate::records::accepted;
use crate::trace::Trace;

/// Checks that an accepted trace has a volume, at least two ray steps at full image size in every frame, and
/// positive seconds.
pub fn check_trace(input: &[u8]) {
    let Ok(text) = std::str::from_utf8(input) else { return };
    let Some(trace) = accepted(Trace::parse(text)) else { return };
    assert!(!trace.volumes.is_empty());
    assert!(trace.frames.len() <= trace.path.frames as usize);
    for frame in &trace.frames {
        assert!(frame.iter().filter(|p| p.scale == 1.0).count() >= 2);
        assert!(frame.iter().flat_map(|p| &p.seconds).all(|s| s.is_finite() && *s > 0.0));
    }
}
