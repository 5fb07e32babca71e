//! Runs a kernel in the version that is compiled for a SIMD level.

use super::Level;
#[cfg(target_arch = "x86_64")]
use super::level::Isa;
use super::simd::Kernel;

impl Level {
    /// Runs a kernel with this level's instructions.
    #[inline]
    pub fn run<K: Kernel>(self, kernel: K) -> K::Output {
        match self.isa {
            #[cfg(all(target_arch = "x86_64", entire_avx512))]
            Isa::Avx512 => {
                // SAFETY: this level exists only if the CPU has AVX-512 F, BW, DQ and VL.
                unsafe { super::x86_64::avx512::enter(kernel) }
            }
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => {
                // SAFETY: this level exists only if the CPU has AVX2, FMA, F16C and POPCNT.
                unsafe { super::x86_64::avx2::enter(kernel) }
            }
            _ => kernel.run(super::scalar::Scalar),
        }
    }

    /// Runs a kernel dominated by [`Simd::dot4`](super::Simd::dot4). AVX-512 is used only on CPUs with VNNI:
    /// without VNNI, AVX-512 is not faster than AVX2 here.
    #[inline]
    pub(crate) fn run_dot4<K: Kernel>(self, kernel: K) -> K::Output {
        match self.isa {
            #[cfg(all(target_arch = "x86_64", entire_avx512))]
            Isa::Avx512 if self.has_vnni() => {
                // SAFETY: this level exists only if the CPU has AVX-512 F, BW, DQ and VL, and `has_vnni` is
                // true only if the CPU has VNNI.
                unsafe { super::x86_64::avx512::enter_vnni(kernel) }
            }
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 | Isa::Avx512 => {
                // SAFETY: the levels AVX2 and AVX-512 exist only if the CPU has AVX2, FMA, F16C and POPCNT.
                unsafe { super::x86_64::avx2::enter(kernel) }
            }
            _ => kernel.run(super::scalar::Scalar),
        }
    }
}
