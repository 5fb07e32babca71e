//! Loads a model and predicts without libc, and prints the bits of the results.
//!
//! Built with the profile `freestanding` on x86-64 Linux, with `ENTIRE_FREESTANDING_MODEL` naming a model
//! file to embed, it has its own entry point, a fixed arena as its only memory, its own panic handler, and
//! two system calls (write, exit). Built in any other way, it is an ordinary program that takes the model
//! file as its argument and prints the same results.
#![cfg_attr(freestanding, no_std)]
#![cfg_attr(freestanding, no_main)]

#[cfg(all(freestanding, not(panic = "abort")))]
compile_error!("without libc a panic cannot unwind: build with --profile freestanding");

#[cfg(freestanding)]
mod machine;

#[cfg(not(freestanding))]
fn main() -> std::process::ExitCode {
    let Some(path) = std::env::args_os().nth(1) else {
        eprintln!("usage: entire-freestanding MODEL.safetensors");
        return std::process::ExitCode::from(2);
    };
    let mut text = String::new();
    let result = std::fs::read(&path)
        .map_err(|e| e.to_string())
        .and_then(|model| entire_freestanding::report(&model, &mut text));
    print!("{text}");
    match result {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("{}: {message}", path.display());
            std::process::ExitCode::FAILURE
        }
    }
}
