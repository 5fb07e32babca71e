//! One file per instruction set of x86-64.

/// Defines methods of a token by intrinsics, and adds the first argument, `self`. Bodies use no pointers, since the
/// SAFETY comment is about the instruction set alone.
macro_rules! methods {
    ($(fn $name:ident($($argument:ident: $type:ty),*) -> $result:ty { $($body:tt)* })*) => {$(
        #[inline(always)]
        fn $name(self, $($argument: $type),*) -> $result {
            // SAFETY: the token proves that the CPU has the instructions.
            unsafe { $($body)* }
        }
    )*};
}

pub(crate) mod avx2;
// Compilers before 1.89 lack the AVX-512 intrinsics.
#[cfg(entire_avx512)]
#[allow(clippy::incompatible_msrv, reason = "compiled only where the compiler has them")]
pub(crate) mod avx512;
