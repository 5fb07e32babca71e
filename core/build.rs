//! Sets the flag `entire_avx512` if the compiler has the AVX-512 intrinsics (1.89 and newer).

use std::process::Command;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rustc-check-cfg=cfg(entire_avx512)");
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let told = Command::new(rustc).arg("--version").output();
    let text = told.map(|out| String::from_utf8_lossy(&out.stdout).into_owned()).unwrap_or_default();
    // The text is, for example, "rustc 1.95.0 (…)". A compiler whose version cannot be read counts as 1.89 or
    // newer.
    let minor = text.split('.').nth(1).and_then(|minor| minor.parse::<u32>().ok());
    if minor.is_none_or(|minor| minor >= 89) {
        println!("cargo::rustc-cfg=entire_avx512");
    }
}
