//! Passes the git commit of the build to the compiler, so that tables and reports can state it. The words
//! "with local changes" follow if files differed from the commit when this crate was built. Edits in crates
//! that depend on this crate do not update these words: each update would rebuild all dependent crates.

use std::path::Path;
use std::process::Command;

fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
}

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    for folder in ["src", "../core/src", "../steer/src", "../vk-raycaster/src"] {
        if Path::new(folder).exists() {
            println!("cargo::rerun-if-changed={folder}");
        }
    }
    for name in ["HEAD", "logs/HEAD"] {
        if let Some(path) = git(&["rev-parse", "--git-path", name]).filter(|p| Path::new(p).exists()) {
            println!("cargo::rerun-if-changed={path}");
        }
    }
    // A copy of this crate in another project's repository has no commit of this project.
    let own = git(&["rev-parse", "--show-prefix"]).is_some_and(|folder| folder == "io/");
    if let Some(commit) = git(&["rev-parse", "--short=12", "HEAD"]).filter(|_| own) {
        let changed = git(&["status", "--porcelain", "--untracked-files=no"]).is_some_and(|s| !s.is_empty());
        println!(
            "cargo::rustc-env=ENTIRE_COMMIT={commit}{}",
            if changed { " with local changes" } else { "" }
        );
    }
}
