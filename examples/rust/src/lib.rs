//! Rust examples of entire.
