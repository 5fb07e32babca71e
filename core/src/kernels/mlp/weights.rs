//! Packed weights loaded as vectors and widened to f32.

use crate::kernels::simd::Simd;

/// Storage format whose weights are loaded for two successive inputs at a time.
pub(super) trait Format {
    /// Loads two vectors of a panel with `n` outputs: the weights of inputs `k` and `k + 1` (`k` even),
    /// starting at output `o`.
    ///
    /// # Safety
    /// The panel must hold the weights of inputs `k` and `k + 1` from output `o` on.
    unsafe fn pair<S: Simd>(simd: S, panel: *const f32, n: usize, k: usize, o: usize) -> (S::F, S::F);
}

pub(super) struct AsF32;
pub(super) struct AsF16;
pub(super) struct AsBf16;

impl Format for AsF32 {
    #[inline(always)]
    unsafe fn pair<S: Simd>(simd: S, panel: *const f32, n: usize, k: usize, o: usize) -> (S::F, S::F) {
        // SAFETY: the caller guarantees that the panel holds the weights of inputs `k` and `k + 1` from
        // output `o` on.
        unsafe { (simd.load(panel.add(k * n + o)), simd.load(panel.add((k + 1) * n + o))) }
    }
}

impl Format for AsF16 {
    #[inline(always)]
    unsafe fn pair<S: Simd>(simd: S, panel: *const f32, n: usize, k: usize, o: usize) -> (S::F, S::F) {
        let panel = panel.cast::<u16>();
        // SAFETY: the caller guarantees that the panel holds the weights of inputs `k` and `k + 1` from
        // output `o` on.
        unsafe { (simd.load_f16(panel.add(k * n + o)), simd.load_f16(panel.add((k + 1) * n + o))) }
    }
}

impl Format for AsBf16 {
    #[inline(always)]
    unsafe fn pair<S: Simd>(simd: S, panel: *const f32, n: usize, k: usize, o: usize) -> (S::F, S::F) {
        // SAFETY: the caller guarantees that the panel holds the weights of inputs `k` and `k + 1` from
        // output `o` on.
        unsafe { simd.load_bf16_pairs(panel.cast::<u32>().add(k / 2 * n + o)) }
    }
}

/// Widens a panel's weights to f32 and returns a pointer to them.
///
/// # Safety
/// `weights` must hold `inputs` × `n` weights of the format, and `wide` must hold as many floats.
#[inline(always)]
pub(super) unsafe fn widen<S: Simd, W: Format>(
    simd: S,
    weights: *const f32,
    inputs: usize,
    n: usize,
    wide: *mut f32,
) -> *const f32 {
    for k in (0..inputs).step_by(2) {
        for o in (0..n).step_by(S::LANES) {
            // SAFETY: the caller guarantees that `weights` and `wide` hold `inputs` × `n` numbers each; `n`
            // is a multiple of `LANES`, and `inputs` is even.
            unsafe {
                let (even, odd) = W::pair(simd, weights, n, k, o);
                simd.store(wide.add(k * n + o), even);
                simd.store(wide.add((k + 1) * n + o), odd);
            }
        }
    }
    wide
}
