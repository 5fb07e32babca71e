//! Runs a test on every level (instruction set) of the kernels.

use entire_core::kernels::Level;
use libtest_mimic::{Failed, Trial};

/// Instruction sets that kernels are written for.
const INSTRUCTION_SETS: [&str; 3] = ["scalar", "avx2", "avx512"];

/// Returns one trial per instruction set: `name::avx2`, … . A level that this CPU lacks is reported as
/// ignored, never as passed.
pub fn on_every_level(name: &'static str, test: fn(Level)) -> impl Iterator<Item = Trial> {
    INSTRUCTION_SETS.into_iter().map(move |isa| {
        let level = Level::available().find(|level| level.isa() == isa);
        let run = move || -> Result<(), Failed> {
            let level = level.ok_or("this CPU lacks the level")?;
            test(level);
            Ok(())
        };
        Trial::test(format!("{name}::{isa}"), run).with_ignored_flag(level.is_none())
    })
}
