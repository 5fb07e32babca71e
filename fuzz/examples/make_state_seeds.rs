//! Writes the seeds of the target `state`: the states of a new session and of a session after some frames.
//!
//! `cargo run --manifest-path fuzz/Cargo.toml --example make_state_seeds`

use entire_fuzz::state::{fresh, learned};
use std::path::Path;

fn main() -> std::io::Result<()> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus/state");
    std::fs::create_dir_all(&folder)?;
    std::fs::write(folder.join("new"), fresh())?;
    std::fs::write(folder.join("learned"), learned())
}
