//! One module per subcommand: its options and what it does.

pub mod farm;
pub mod record;
pub mod replay;
pub mod select;
pub mod stress;
pub mod study;
