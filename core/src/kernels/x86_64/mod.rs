//! One file per instruction set of x86-64.

/// Defines methods of a token by intrinsics, and adds the first argument, `self`. Bodies use no pointers,
/// since the SAFETY comment is about the instruction set alone.
macro_rules! methods {
    ($(fn $name:ident($($argument:ident: $type:ty),*) -> $result:ty { $($body:tt)* })*) => {$(
        #[inline(always)]
        fn $name(self, $($argument: $type),*) -> $result {
            // SAFETY: the token proves that the CPU has the instructions.
            unsafe { $($body)* }
        }
    )*};
}

/// Defines methods of a token that prefetch a cache line.
macro_rules! prefetches {
    ($($name:ident $hint:ident)*) => {$(
        #[inline(always)]
        fn $name(self, p: *const f32) {
            // SAFETY: every x86-64 CPU has this instruction. A prefetch returns no data and never faults.
            unsafe { _mm_prefetch::<$hint>(p.cast()) }
        }
    )*};
}

pub(crate) mod avx2;
// Compilers before 1.89 lack the AVX-512 intrinsics.
#[cfg(entire_avx512)]
#[allow(clippy::incompatible_msrv, reason = "compiled only where the compiler has them")]
pub(crate) mod avx512;
