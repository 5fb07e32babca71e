//! Overhead of the C interface: `entire_model_predict` through the installed shared library against
//! `PredNet::predict` called from Rust, batch 1, medians over interleaved runs. Printed by `make bars-ffi`.
//!
//!     overhead LIBENTIRE.so MODEL.safetensors

use entire_core::model::Model;
use entire_core::nn::PredNet;
use std::ffi::{CString, c_char, c_void};
use std::time::Instant;

/// Number of calls per run.
const CALLS: usize = 2000;
/// Number of runs in each language. Runs of Rust and C alternate, so that a disturbance affects both.
const RUNS: usize = 301;

unsafe extern "C" {
    fn dlopen(path: *const c_char, flags: i32) -> *mut c_void;
    fn dlsym(library: *mut c_void, name: *const c_char) -> *mut c_void;
}
const RTLD_NOW: i32 = 2;

type OpenModel = unsafe extern "C" fn(*const c_char, *mut *mut c_void) -> u32;
type PredictModel = unsafe extern "C" fn(*const c_void, *const f32, usize, *mut f32) -> u32;

fn median(seconds: &mut [f64]) -> f64 {
    seconds.sort_by(f64::total_cmp);
    seconds[seconds.len() / 2]
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let [library, path] = arguments.as_slice() else {
        // `cargo test --benches` and `cargo bench` without arguments have no library to measure.
        println!("usage: overhead LIBENTIRE.so MODEL.safetensors");
        return;
    };
    let bytes = std::fs::read(path).unwrap_or_else(|e| panic!("{path}: {e}"));
    let model = Model::from_bytes(&bytes).expect("a model file");
    let net =
        PredNet::new(model.prednet.as_ref().expect("a prediction network")).expect("a prediction network");
    let mut scratch = net.scratch(1).unwrap();
    let mut inputs = vec![0.5f32; net.inputs()];

    let library = CString::new(library.as_str()).expect("a path");
    // SAFETY: the path is a C string, and the library is never closed.
    let handle = unsafe { dlopen(library.as_ptr(), RTLD_NOW) };
    assert!(!handle.is_null(), "{library:?} cannot be loaded");
    let symbol = |name: &std::ffi::CStr| {
        // SAFETY: the library is open, and the name is a C string.
        let found = unsafe { dlsym(handle, name.as_ptr()) };
        assert!(!found.is_null(), "{library:?} has no {name:?}");
        found
    };
    // SAFETY: `OpenModel` is the type of entire_model_open in entire.h.
    let open: OpenModel = unsafe { std::mem::transmute(symbol(c"entire_model_open")) };
    // SAFETY: `PredictModel` is the type of entire_model_predict in advanced.h.
    let predict: PredictModel = unsafe { std::mem::transmute(symbol(c"entire_model_predict")) };
    let mut c_model = std::ptr::null_mut();
    let c_path = CString::new(path.as_str()).expect("a path");
    // SAFETY: the path is a C string, and `c_model` has room for one pointer.
    assert_eq!(unsafe { open(c_path.as_ptr(), &raw mut c_model) }, 0);

    let (mut rust, mut c, mut difference) = (Vec::new(), Vec::new(), Vec::new());
    let mut sum = 0.0f64;
    for run in 0..RUNS {
        inputs[0] = run as f32 * 1e-3;
        let start = Instant::now();
        for _ in 0..CALLS {
            sum += f64::from(net.predict(std::hint::black_box(&inputs), &mut scratch));
        }
        let by_rust = start.elapsed().as_secs_f64() / CALLS as f64;
        let start = Instant::now();
        for _ in 0..CALLS {
            let mut seconds = 0.0;
            let at = std::hint::black_box(&inputs);
            // SAFETY: the model is live, `at` has the stated number of inputs, and `seconds` has room for one
            // number.
            unsafe { predict(c_model, at.as_ptr(), at.len(), &raw mut seconds) };
            sum -= f64::from(seconds);
        }
        let by_c = start.elapsed().as_secs_f64() / CALLS as f64;
        rust.push(by_rust * 1e9);
        c.push(by_c * 1e9);
        difference.push((by_c - by_rust) * 1e9);
    }
    assert_eq!(sum, 0.0, "Rust and C predict different numbers");
    println!("rust_ns {:.1}", median(&mut rust));
    println!("c_ns {:.1}", median(&mut c));
    println!("overhead_ns {:.1}", median(&mut difference));
}
