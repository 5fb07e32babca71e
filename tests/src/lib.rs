//! tests (see ARCHITECTURE.md).
