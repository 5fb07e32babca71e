//! The integration tests of the C library, as one program.

mod header;
mod kinds;
mod parity;
