//! Integration tests that need no harness of their own, in one program.

mod hot_calls;
mod units;
