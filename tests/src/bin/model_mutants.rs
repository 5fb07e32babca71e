//! Runs mutants of model files one after another: `model_mutants FIRST END PROGRESS`, with seeds from FIRST
//! to END, END excluded. Before each mutant its seed is written to the file PROGRESS, so that the mutant that
//! ended the process is known. Prints the number of panics, the CPU seconds of the slowest mutant, and the
//! numbers of mutants that reached each stage.

use entire_tests::mutants::{Mutants, exercise};
use entire_tests::small_models;
use std::fs::OpenOptions;
use std::os::unix::fs::FileExt;
use std::panic::catch_unwind;
use std::sync::OnceLock;
use std::time::Instant;

/// CPU seconds of this thread, which other processes do not lengthen; wall time if the system does not report
/// them.
fn on_cpu() -> f64 {
    static START: OnceLock<Instant> = OnceLock::new();
    let nanoseconds = std::fs::read_to_string("/proc/thread-self/schedstat")
        .ok()
        .and_then(|text| text.split_whitespace().next()?.parse::<f64>().ok());
    nanoseconds.map_or_else(|| START.get_or_init(Instant::now).elapsed().as_secs_f64(), |n| n * 1.0e-9)
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [first, end, progress] = &arguments[..] else {
        eprintln!("usage: model_mutants FIRST END PROGRESS");
        std::process::exit(2);
    };
    let number = |text: &str| text.parse::<u64>().expect("a whole number");
    let file = OpenOptions::new()
        .create(true)
        .write(true)
        .truncate(false)
        .open(progress)
        .expect("the file of progress can be written");
    let mut mutants = Mutants::new(0, &small_models());
    let (mut panics, mut slowest) = (0, (0.0, 0));
    let mut counts = [0u64; 4];
    for seed in number(first)..number(end) {
        file.write_at(format!("{seed:>20}\n").as_bytes(), 0).expect("progress is written");
        mutants.reseed(seed);
        let bytes = mutants.next_file();
        let start = on_cpu();
        match catch_unwind(|| exercise(&bytes)) {
            Ok(o) => {
                for (count, yes) in counts.iter_mut().zip([o.opened, o.predicted, o.built, o.encoded]) {
                    *count += u64::from(yes);
                }
            }
            Err(_) => {
                eprintln!("panic at seed {seed}");
                panics += 1;
            }
        }
        let took = on_cpu() - start;
        if took > slowest.0 {
            slowest = (took, seed);
        }
    }
    let [opened, predicted, built, encoded] = counts;
    println!(
        "panics {panics} slowest {:.3} seed {} opened {opened} predicted {predicted} built {built} encoded \
         {encoded}",
        slowest.0, slowest.1
    );
}
