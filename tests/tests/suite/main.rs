//! The tests across crates that need no harness of their own, as one program.

mod architecture;
mod freestanding;
mod hostile_weights;
mod mutants;
mod no_alloc;
mod probe_counts;
