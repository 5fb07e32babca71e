//! One file per instruction set of x86-64.

pub(crate) mod avx2;
// Compilers before 1.89 lack the AVX-512 intrinsics.
#[cfg(entire_avx512)]
#[allow(clippy::incompatible_msrv, reason = "compiled only where the compiler has them")]
pub(crate) mod avx512;
