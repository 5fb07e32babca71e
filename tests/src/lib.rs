//! tests (see ARCHITECTURE.md).

pub mod levels;
