//! Options and execution of the subcommands, one module each; the module `farm` has four subcommands.

pub(crate) mod disturb;
pub(crate) mod farm;
pub(crate) mod frames;
pub(crate) mod gpu_study;
pub(crate) mod paper;
pub(crate) mod record;
pub(crate) mod replay;
pub(crate) mod stress;
pub(crate) mod study;
pub(crate) mod tune;
