//! ffi (see ARCHITECTURE.md).
