//! The integration tests of the core that need no harness of their own, as one program.

mod hot_calls;
mod units;
mod vtk_transfer;
