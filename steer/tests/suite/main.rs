//! The integration tests that need no harness of their own, as one program.

mod hot_calls;
mod units;
