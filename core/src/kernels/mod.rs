//! Vector kernels behind a level token: the only module of this crate with `unsafe`.
