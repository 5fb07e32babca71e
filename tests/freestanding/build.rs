//! On x86-64 Linux, links the program without the C runtime if ENTIRE_FREESTANDING_MODEL is set. The variable
//! names the model that is embedded in the program.

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-env-changed=ENTIRE_FREESTANDING_MODEL");
    println!("cargo::rustc-check-cfg=cfg(freestanding)");
    let is = |key: &str, value: &str| std::env::var(key).as_deref() == Ok(value);
    let linux = is("CARGO_CFG_TARGET_OS", "linux") && is("CARGO_CFG_TARGET_ARCH", "x86_64");
    if linux && std::env::var_os("ENTIRE_FREESTANDING_MODEL").is_some() {
        println!("cargo:rustc-cfg=freestanding");
        for argument in ["-nostartfiles", "-nodefaultlibs", "-static", "-no-pie"] {
            println!("cargo:rustc-link-arg-bins={argument}");
        }
    }
}
