//! The safetensors model file, read all or nothing.
