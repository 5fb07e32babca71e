//! Engines that run bundles: processes of this machine, HyperQueue or Slurm. Users install the last two.

mod hyperqueue;
mod local;
mod slurm;

pub use hyperqueue::{HyperQueue, Options as HyperQueueOptions};
pub use local::Local;
pub use slurm::{Options as SlurmOptions, Slurm};

use super::record::{BundleOrder, Line, Order};
use anyhow::{Context, Result};
use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Maximum number, per slot, of bundles or processes that end one after another before a task begins.
pub(crate) const MAX_FRUITLESS_STARTS: usize = 3;

/// A bundle for an engine.
#[derive(Clone, Debug)]
pub struct Bundle {
    /// Number of the bundle.
    pub number: u64,
    /// Slot of the bundle, if it is bound to one.
    pub slot: Option<usize>,
    /// The work orders of the bundle's tasks.
    pub orders: Vec<Order>,
    /// Time that is requested from the engine for the bundle, seconds: the sum of the 99 % quantile of its
    /// rendering time, twice its expected loading time, and its overhead. The sum is doubled for each earlier
    /// loss of a task, at most six times. Infinite for workers of this machine, which need no request.
    pub upper_s: f64,
}

impl Bundle {
    /// Returns the bundle as a worker reads it. `run`: number of the run that sends the bundle.
    fn order(&self, run: u64) -> BundleOrder {
        BundleOrder { bundle: self.number, run, tasks: self.orders.clone() }
    }
}

/// Events of an engine.
#[derive(Clone, Debug)]
pub enum Event {
    /// A line that a worker wrote: the number of its bundle, and the line.
    Line(u64, Line),
    /// A bundle was lost with its worker, or refused: its number, and the reason (empty if the loss does not
    /// count as a failure).
    Lost(u64, String),
    /// A slot has a new worker, which holds no volume.
    Fresh(usize),
    /// The engine itself has ended: all its bundles are lost.
    Down(String),
}

/// Properties of an engine.
#[derive(Clone, Copy, Debug, Default)]
pub struct Properties {
    /// Name of the engine.
    pub name: &'static str,
    /// Number of bundles that run at once.
    pub slots: usize,
    /// True if each bundle is sent to a given slot, whose persistent worker keeps its volume.
    pub bound: bool,
    /// Longest time that the engine grants a bundle, seconds; `None` for no limit.
    pub limit: Option<f64>,
    /// Number of bundles that wait inside the engine, so that no slot waits for the driver. All other tasks
    /// wait in the planner, where their order can still change.
    pub waiting: usize,
}

/// An engine. All engines run the same worker (`entire farm-worker`), which writes images and answers into
/// the database's folder; that folder must be reachable from every node under the same path.
pub trait Engine {
    /// Properties of the engine.
    fn properties(&self) -> Properties;
    /// Sends bundles, the most urgent first. A bundle that the engine refuses is lost.
    ///
    /// # Errors
    /// When a bundle cannot be written.
    fn submit(&mut self, bundles: &[Bundle]) -> Result<()>;
    /// Changes the order of waiting bundles, the most urgent first. The default implementation does nothing;
    /// the queues of engines that cannot reorder are kept short instead.
    ///
    /// # Errors
    /// When the engine refuses to change the order.
    fn reprioritize(&mut self, _bundles: &[u64]) -> Result<()> {
        Ok(())
    }
    /// Cancels waiting bundles; running ones end after their current task. If the engine refuses to cancel a
    /// bundle, a note says so, and the bundle ends before its first task.
    ///
    /// # Errors
    /// None of the engines fails.
    fn cancel(&mut self) -> Result<()>;
    /// Events since the last call; waits at most `wait` for one.
    ///
    /// # Errors
    /// When the engine does not answer.
    fn poll(&mut self, wait: Duration) -> Result<Vec<Event>>;
    /// Activity of each slot, for display; empty if it is unknown.
    fn nodes(&self) -> Vec<String> {
        Vec::new()
    }
}

pub(crate) fn utf8(word: &OsStr) -> Result<String> {
    word.to_str().map(str::to_owned).with_context(|| format!("{} is not UTF-8; rename it", word.display()))
}

/// Paths that engines use.
#[derive(Clone, Debug)]
pub struct Places {
    /// Folder of the database in which the driver and the workers keep the journal, orders and answers.
    pub state: PathBuf,
    /// Command line of this program: an executable file, then arguments. With the argument
    /// `farm-worker` appended, it runs the worker.
    pub program: Vec<OsString>,
}

/// The file that gets the output of a bundle's worker.
fn log_of(state: &Path, bundle: u64) -> PathBuf {
    state.join("logs").join(format!("bundle-{bundle}.log"))
}

impl Places {
    pub(crate) fn worker(&self, bundle: u64) -> Result<Vec<String>> {
        self.command(&utf8(self.state.as_os_str())?, &bundle.to_string())
    }

    /// Returns the command line of a bundle's worker. `state` and `bundle`: texts for the state folder and
    /// the bundle's number, for example variables of a template.
    pub(crate) fn command(&self, state: &str, bundle: &str) -> Result<Vec<String>> {
        let mut line = self.program.iter().map(|word| utf8(word)).collect::<Result<Vec<_>>>()?;
        line.extend(["farm-worker", state, "--bundle", bundle].map(String::from));
        Ok(line)
    }

    /// Writes the file `orders/NUMBER.json`, from which the bundle's worker reads its tasks, and an empty
    /// spool file. An NFS client caches the absence of a file, while it checks an existing file at each
    /// opening, so the driver sees answers without delay.
    pub(crate) fn write_order(&self, bundle: &Bundle, run: u64) -> Result<()> {
        let spool = crate::spool::path(&self.state, bundle.number);
        let made = File::options().create(true).append(true).open(&spool);
        made.with_context(|| format!("cannot write {}", spool.display()))?;
        let path = self.state.join("orders").join(format!("{}.json", bundle.number));
        entire_io::files::write_whole(&path, &serde_json::to_vec(&bundle.order(run))?)
    }
}

/// Removes the files of a finished bundle from the database's state folder.
pub(crate) fn clear(state: &Path, bundle: u64) {
    for (folder, end) in [("orders", ".json"), ("spool", ".jsonl"), ("cancel", "")] {
        let _ = std::fs::remove_file(state.join(folder).join(format!("{bundle}{end}")));
    }
    let _ = std::fs::remove_file(log_of(state, bundle));
}

/// Tells the worker of a bundle, through the database's state folder, to end after its current task.
pub(crate) fn cancel(state: &Path, bundle: u64) {
    let _ = std::fs::write(state.join("cancel").join(bundle.to_string()), b"");
}
