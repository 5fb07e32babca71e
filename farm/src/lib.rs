//! Render farms: image databases are planned, rendered on an engine, and recorded so that no result is lost.
//! Measured times correct the plan.
//!
//! [`list`] has task lists and static assignments (`entire schedule`). The other modules are `entire farm`: a
//! job file becomes tasks ([`job`]), tasks get expected times ([`predict`], [`learn`], [`load`]), a planner
//! sends them in bundles ([`planner`], [`dispatch`]), an engine runs them ([`engine`], [`worker`]), a journal
//! records the results ([`database`]). The simulator ([`simulate`]) uses the same planner.

mod cinema;
mod command;
pub mod database;
pub mod dispatch;
pub mod drive;
pub mod engine;
pub mod job;
mod job_file;
mod journal;
pub mod learn;
pub mod list;
pub mod load;
mod natural;
pub mod openjd;
pub mod planner;
pub mod predict;
pub mod record;
pub mod report;
mod session;
pub mod show;
pub mod simulate;
mod spool;
pub mod survey;
pub mod worker;

pub use command::quoted;
pub use list::{
    By, Method, Schedule, Span, Task, Timeline, parse_tasks, plan, play, read_tasks, simulate_queue, times,
    volume_numbers,
};
