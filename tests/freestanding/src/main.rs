//! Loads a model and predicts without libc, and prints the bits of the results.
//!
//! On x86-64 Linux, the variable `ENTIRE_FREESTANDING_MODEL` names a model file to embed in the program.
//! Built with this variable and the profile `freestanding`, the program has its own entry point, a fixed
//! arena as its only memory, its own panic handler, and two system calls (write, exit). With the variable but
//! another profile, it does not compile. Without the variable, or on another system, it does nothing.
#![cfg_attr(freestanding, no_std)]
#![cfg_attr(freestanding, no_main)]

#[cfg(all(freestanding, not(panic = "abort")))]
compile_error!("without libc a panic cannot unwind: build with --profile freestanding");

#[cfg(freestanding)]
mod machine;

#[cfg(not(freestanding))]
fn main() {}
