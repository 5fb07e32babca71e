//! The native module of the Python package `entire`.
//!
//! Every class is a thin layer over `entire-core` and `entire-steer`: it checks Python's arguments, keeps the
//! owners of borrowed memory alive, and lets other Python threads run while voxels are scanned, volumes are
//! encoded or thousands of views are predicted. This module starts no thread, so that a process may fork and
//! an interpreter may end at any time.
#![allow(clippy::too_many_arguments, reason = "Python names the arguments")]

mod budget;
mod calibration;
mod camera;
mod command;
mod detach;
mod errors;
mod files;
mod frame;
mod held;
mod lock;
mod model;
mod plan;
mod session;
mod state;
mod transfer;
mod volume;

use pyo3::prelude::*;

/// The native part of `entire`; import the names from `entire`.
#[pymodule]
mod _native {
    #[pymodule_export]
    use crate::{
        budget::{FrameBudget, PassShare},
        camera::Camera,
        command::command,
        errors::{MissingInputError, ModelError, NotReadyError, RejectedObservationError},
        files::{machine_file, write_whole},
        held::Held,
        model::Model,
        plan::{Plan, Prediction},
        session::Session,
        transfer::TransferFunction,
        volume::Volume,
    };

    use super::*;

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))?;
        module.add("simd_level", entire_core::kernels::Level::detect().to_string())?;
        let end = wrap_pyfunction!(crate::detach::end, module)?;
        module.py().import("atexit")?.call_method1("register", (end,))?;
        Ok(())
    }
}
