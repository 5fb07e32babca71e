//! Integration tests that use the standard test harness, in one program.

mod hot_calls;
mod units;
