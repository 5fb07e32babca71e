//! The library's errors as Python exceptions.

use entire_core::{Error, ErrorKind};
use pyo3::exceptions::{PyMemoryError, PyRuntimeError, PyValueError};
use pyo3::{PyErr, create_exception};

create_exception!(
    entire,
    ModelError,
    PyValueError,
    "A model file that cannot be used: damaged, of another format, or without the network that the call \
     needs."
);
create_exception!(
    entire,
    MissingInputError,
    PyValueError,
    "The model takes an input that was not given, such as Gaussian lobes or volume features."
);
create_exception!(
    entire,
    NotReadyError,
    PyRuntimeError,
    "The call came too early: no volume or transfer function is set, or too few frames were recorded."
);

create_exception!(
    entire,
    RejectedObservationError,
    PyValueError,
    "A frame time was rejected, because its plan is unknown or was observed before, or because the time is \
     not finite, not positive or over 10,000 s. The session is unchanged."
);

/// The exception for an error of the library.
pub(crate) fn raise(error: Error) -> PyErr {
    let text = error.to_string();
    match error.kind() {
        ErrorKind::InvalidModel | ErrorKind::InvalidTensor | ErrorKind::Unsupported => {
            ModelError::new_err(text)
        }
        ErrorKind::MissingInput => MissingInputError::new_err(text),
        ErrorKind::RejectedObservation => RejectedObservationError::new_err(text),
        ErrorKind::NotReady => NotReadyError::new_err(text),
        ErrorKind::OutOfMemory => PyMemoryError::new_err(text),
        _ => PyValueError::new_err(text),
    }
}
