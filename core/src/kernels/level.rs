//! Detects at run time which instructions kernels may use.

use crate::Result;
#[cfg(any(feature = "std", test))]
use crate::error::bail;
use crate::names::names;
use core::fmt;
use core::sync::atomic::{AtomicU32, Ordering};

/// Environment variable that caps the level chosen by [`Level::detect`]: `scalar`, `avx2` or `avx512`.
///
/// The variable is read only with the feature `std`, and only once: at the first [`Level::detect`] or
/// [`Level::check_override`] of the process. The variable can lower the level, but never raise it above the
/// highest level of the CPU.
#[cfg(any(feature = "std", test))]
pub(crate) const LEVEL_VARIABLE: &str = "ENTIRE_LEVEL";

/// Instruction sets that kernels are written for. Each includes those before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) enum Isa {
    /// Portable Rust, vectorized by the compiler; the reference in the tests of the other instruction sets.
    Scalar,
    /// x86-64 with AVX2, FMA, F16C and POPCNT.
    Avx2,
    /// x86-64 with AVX-512 F, BW, DQ and VL (and everything of [`Isa::Avx2`]).
    Avx512,
}

names! { Isa:
    Scalar "scalar",
    Avx2 "avx2",
    Avx512 "avx512",
}

impl Isa {
    /// Returns the instruction set with this name.
    #[cfg(any(feature = "std", test))]
    fn named(text: &str) -> Result<Self> {
        match Self::ALL.iter().find(|isa| isa.name() == text) {
            Some(&isa) => Ok(isa),
            None => bail!(
                InvalidArgument,
                "unknown level {text:?}: use \"scalar\", \"avx2\" or \"avx512\" (or leave {LEVEL_VARIABLE} \
                 unset)"
            ),
        }
    }
}

const HAS_AVX2: u32 = 1 << 1;
const HAS_AVX512: u32 = 1 << 2;
const HAS_VNNI: u32 = 1 << 3;
const DETECTION_BIT: u32 = 1 << 31;

/// Proof that the CPU has the instructions of one instruction set: scalar, AVX2 or AVX-512.
///
/// Results are bit-identical for the same model, inputs and level, with and without the feature `std`.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct Level {
    pub(super) isa: Isa,
    /// True if the level includes AVX512_VNNI (8-bit integer dot products).
    vnni: bool,
}

impl Level {
    /// The portable level, available on every machine.
    pub(crate) const SCALAR: Level = Level { isa: Isa::Scalar, vnni: false };

    /// The highest level of this CPU, capped by the environment variable `ENTIRE_LEVEL` (`scalar`, `avx2` or
    /// `avx512`) if the feature `std` is on. An unknown value of the variable is ignored;
    /// [`Level::check_override`] reports it.
    pub fn detect() -> Self {
        #[cfg(feature = "std")]
        if let Ok(Some(cap)) = Self::override_isa() {
            return Self::at_most(*cap);
        }
        Self::at_most(Isa::Avx512)
    }

    /// The highest level of this CPU that is not above `cap`; ignores the environment.
    pub(crate) fn at_most(cap: Isa) -> Self {
        let best = Isa::ALL.into_iter().rev().filter(|&isa| isa <= cap).find_map(Self::exactly);
        best.unwrap_or(Self::SCALAR)
    }

    /// The level of exactly this instruction set; `None` if the CPU or the architecture lacks it.
    pub(crate) fn exactly(isa: Isa) -> Option<Self> {
        let found = features();
        match isa {
            Isa::Scalar => Some(Self::SCALAR),
            Isa::Avx2 => (found & HAS_AVX2 != 0).then_some(Level { isa, vnni: false }),
            // Compilers before 1.89 have no AVX-512 intrinsics.
            Isa::Avx512 => (cfg!(entire_avx512) && found & HAS_AVX512 != 0)
                .then_some(Level { isa, vnni: found & HAS_VNNI != 0 }),
        }
    }

    /// Every level this CPU has, lowest first.
    pub fn available() -> impl Iterator<Item = Level> {
        Isa::ALL.into_iter().filter_map(Self::exactly)
    }

    /// Checks `ENTIRE_LEVEL`, for programs that want to refuse a misspelled override. Always `Ok` without
    /// `std`.
    ///
    /// # Errors
    /// [`InvalidArgument`](crate::ErrorKind::InvalidArgument) for a value that names no level,
    /// [`Unsupported`](crate::ErrorKind::Unsupported) for a level that this CPU does not have.
    pub fn check_override() -> Result<()> {
        #[cfg(feature = "std")]
        if let Some(isa) = Self::override_isa().clone()?.filter(|&isa| Self::exactly(isa).is_none()) {
            bail!(
                Unsupported,
                "{LEVEL_VARIABLE}={isa}, but this CPU's highest level is {}: unset the variable or lower its level",
                Self::at_most(Isa::Avx512)
            );
        }
        Ok(())
    }

    /// Instruction set that [`LEVEL_VARIABLE`] names; `None` if the variable is not set or empty. The
    /// variable is read only once, since in C it is not safe to read the environment while another thread
    /// changes it.
    #[cfg(feature = "std")]
    fn override_isa() -> &'static Result<Option<Isa>> {
        static SAID: std::sync::OnceLock<Result<Option<Isa>>> = std::sync::OnceLock::new();
        SAID.get_or_init(|| match std::env::var(LEVEL_VARIABLE) {
            Ok(text) if text.is_empty() => Ok(None),
            Ok(text) => Isa::named(&text).map(Some),
            Err(std::env::VarError::NotPresent) => Ok(None),
            Err(std::env::VarError::NotUnicode(text)) => Isa::named(&text.to_string_lossy()).map(Some),
        })
    }

    /// Name of the instruction set: `scalar`, `avx2` or `avx512`, as in `ENTIRE_LEVEL`.
    pub const fn isa(self) -> &'static str {
        self.isa.name()
    }

    /// True if the level includes AVX512_VNNI (8-bit integer dot products).
    pub(crate) const fn has_vnni(self) -> bool {
        self.vnni
    }
}

impl fmt::Debug for Level {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl fmt::Display for Level {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.isa())?;
        f.write_str(if self.has_vnni() { "+vnni" } else { "" })
    }
}

/// Features of this CPU as bit flags, queried once: `cpuid` is slow under a hypervisor.
fn features() -> u32 {
    static FOUND: AtomicU32 = AtomicU32::new(0);
    let known = FOUND.load(Ordering::Relaxed);
    if known != 0 {
        return known;
    }
    let found = probe() | DETECTION_BIT;
    FOUND.store(found, Ordering::Relaxed);
    found
}

// Other architectures and Miri lack these instructions: everything runs on the portable level there.
#[cfg(any(not(target_arch = "x86_64"), miri))]
fn probe() -> u32 {
    0
}

/// Queries `cpuid` for the instructions and `xgetbv` for the registers that the operating system saves. With
/// and without `std` the same code runs, so that both choose the same level.
#[cfg(all(target_arch = "x86_64", not(miri)))]
fn probe() -> u32 {
    use core::arch::x86_64::{__cpuid_count, _xgetbv, CpuidResult};

    /// # Safety
    /// The CPU has XGETBV, and the operating system enabled it.
    #[target_feature(enable = "xsave")]
    unsafe fn enabled_state() -> u64 {
        // SAFETY: the caller guarantees XGETBV, and register 0 exists on every CPU with XGETBV.
        unsafe { _xgetbv(0) }
    }

    /// Returns the registers that CPUID writes for a leaf.
    #[allow(unused_unsafe, reason = "compilers before 1.94 call it unsafe")]
    fn cpuid(leaf: u32) -> CpuidResult {
        // SAFETY: every x86-64 CPU has the instruction CPUID.
        unsafe { __cpuid_count(leaf, 0) }
    }

    let bit = |word: u32, n: u32| word >> n & 1 != 0;
    if cpuid(0).eax < 7 {
        return 0;
    }
    let leaf1 = cpuid(1);
    let (fma, osxsave, avx, f16c) =
        (bit(leaf1.ecx, 12), bit(leaf1.ecx, 27), bit(leaf1.ecx, 28), bit(leaf1.ecx, 29));
    let popcnt = bit(leaf1.ecx, 23);
    if !osxsave {
        return 0;
    }
    // SAFETY: OSXSAVE states that the CPU has XGETBV and that the operating system enabled it.
    let state = unsafe { enabled_state() };
    let ymm = state & 0b110 == 0b110;
    let zmm = state & 0b1110_0110 == 0b1110_0110;
    let leaf7 = cpuid(7);
    let mut found = 0;
    if ymm && avx && fma && f16c && popcnt && bit(leaf7.ebx, 5) {
        found |= HAS_AVX2;
        if zmm && [16, 17, 30, 31].into_iter().all(|n| bit(leaf7.ebx, n)) {
            found |= HAS_AVX512;
            if bit(leaf7.ecx, 11) {
                found |= HAS_VNNI;
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ErrorKind;
    use alloc::vec::Vec;

    #[test]
    fn names_are_read_back_and_others_refused() {
        for isa in Isa::ALL {
            assert_eq!(Isa::named(isa.name()).unwrap(), isa);
        }
        let error = Isa::named("AVX-512").unwrap_err();
        assert_eq!(error.kind(), ErrorKind::InvalidArgument);
        assert!(error.to_string().contains("avx512"), "{error}");
    }

    #[test]
    fn levels_rise_and_start_with_scalar() {
        let levels: Vec<_> = Level::available().collect();
        assert_eq!(levels[0], Level::SCALAR);
        assert!(levels.windows(2).all(|pair| pair[0].isa < pair[1].isa));
        assert_eq!(Level::at_most(Isa::Avx512), *levels.last().unwrap());
    }

    #[test]
    fn a_cap_is_never_exceeded() {
        for cap in Isa::ALL {
            assert!(Level::at_most(cap).isa <= cap);
        }
    }

    #[cfg(all(target_arch = "x86_64", feature = "std", not(miri)))]
    #[test]
    fn agrees_with_the_standard_library() {
        let avx2 = std::is_x86_feature_detected!("avx2")
            && std::is_x86_feature_detected!("fma")
            && std::is_x86_feature_detected!("f16c")
            && std::is_x86_feature_detected!("popcnt");
        let avx512 = avx2
            && cfg!(entire_avx512)
            && std::is_x86_feature_detected!("avx512f")
            && std::is_x86_feature_detected!("avx512bw")
            && std::is_x86_feature_detected!("avx512dq")
            && std::is_x86_feature_detected!("avx512vl");
        assert_eq!(Level::exactly(Isa::Avx2).is_some(), avx2);
        assert_eq!(Level::exactly(Isa::Avx512).is_some(), avx512);
        if let Some(level) = Level::exactly(Isa::Avx512) {
            assert_eq!(level.has_vnni(), std::is_x86_feature_detected!("avx512vnni"));
        }
    }
}
