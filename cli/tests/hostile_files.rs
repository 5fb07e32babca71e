//! Arbitrary bytes in place of volumes, models, tables, paths, task lists and farm jobs: the committed corpus
//! and mutations of it. Readers never panic and never allocate more memory than the input justifies.

// These modules contain the checks that the fuzz targets run.
#[allow(unreachable_pub, reason = "a library of its own for the fuzz targets")]
#[path = "../../fuzz/src/checks.rs"]
mod checks;
#[allow(unreachable_pub, reason = "a library of its own for the fuzz targets")]
#[path = "../../fuzz/src/records.rs"]
mod records;

use entire_core::model::Model;
use entire_farm as farm;
use entire_io::volume::{Format, hostile::read_any};
use entire_io::{dataset, path, volume};
use libtest_mimic::{Arguments, Failed, Trial};
use peak_alloc::PeakAlloc;
use proptest::prelude::*;
use proptest::test_runner::{Config, RngAlgorithm, TestRng, TestRunner};
use std::path::{Path, PathBuf};

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// Default number of mutations in one run; `PROPTEST_CASES` sets another. The fuzz targets try many more.
const CASES: u32 = 3_000;

type Check = fn(&[u8]);

const TARGETS: [(&str, Check); 13] = [
    ("table", records::check_table),
    ("features", records::check_features),
    ("manifest", records::check_manifest),
    ("path", records::check_path),
    ("tasks", records::check_tasks),
    ("job", records::check_job),
    ("nrrd", |input| checks::check_volume(read_any(Format::Nrrd, input))),
    ("metaimage", |input| checks::check_volume(read_any(Format::MetaImage, input))),
    ("vti", |input| checks::check_volume(read_any(Format::VtkImage, input))),
    ("nifti", |input| checks::check_volume(read_any(Format::Nifti, input))),
    ("json", |input| checks::check_volume(read_any(Format::Json, input))),
    ("raw", |input| checks::check_volume(read_any(Format::Raw, input))),
    ("model", |input| checks::check_model(Model::from_bytes(input))),
];

fn corpus() -> Vec<(Check, PathBuf, Vec<u8>)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus");
    let mut found = Vec::new();
    for (name, check) in TARGETS {
        let before = found.len();
        let mut files: Vec<PathBuf> =
            std::fs::read_dir(root.join(name)).unwrap().map(|entry| entry.unwrap().path()).collect();
        files.sort();
        for path in files {
            let bytes = std::fs::read(&path).unwrap();
            found.push((check, path, bytes));
        }
        assert!(found.len() > before, "no corpus for {name}");
    }
    found
}

/// Runs a check and returns the peak of additionally allocated bytes.
fn peak_of(check: Check, input: &[u8]) -> usize {
    let before = MEMORY.current_usage();
    MEMORY.reset_peak_usage();
    check(input);
    MEMORY.peak_usage().saturating_sub(before)
}

/// Returns the limit of a reader's additional memory for an input, in bytes: buffers, a few times the input's
/// length for its text and numbers, and the largest output of a deflate stream of that length.
fn bound(input: &[u8]) -> usize {
    let words: [&[u8]; 3] = [b"zip", b"ZLib", b"CompressedData"];
    let starts: [&[u8]; 5] = [b"\x1f\x8b", b"\x78\x9c", b"\x78\x5e", b"\x78\x01", b"\x78\xda"];
    let packed = words.iter().chain(&starts).any(|mark| input.windows(mark.len()).any(|w| w == *mark));
    // A block of bzip2 holds up to 900,000 bytes of run lengths, of which five can encode 255 equal bytes.
    let blocks = input.windows(6).filter(|w| *w == [0x31, 0x41, 0x59, 0x26, 0x53, 0x59]).count();
    // A bzip2 decoder allocates four bytes for each of a block's 900,000 bytes as soon as it has read a
    // stream's header.
    let decoder = if input.windows(3).any(|w| w == b"BZh") { 4 << 20 } else { 0 };
    (1 << 19)
        + input.len() * if packed { 3 * 1032 } else { 64 }
        + decoder
        + blocks * (3 * 46_000_000 + (8 << 20))
}

#[derive(Clone, Debug)]
enum Change {
    /// Flips the bits of a mask in a byte.
    Flip(prop::sample::Index, u8),
    /// Replaces this many bytes at a position by the given bytes, or removes them if none are given. Near the
    /// end of the input, fewer bytes exist and are replaced.
    Replace(prop::sample::Index, usize, Vec<u8>),
    Double(prop::sample::Index, usize),
    /// Replaces the n-th number by a word.
    Number(prop::sample::Index, &'static str),
}

const WORDS: &str = "0 1 2 -1 7 65536 99999 4294967295 4294967296 9223372036854775807 18446744073709551615 \
                     18446744073709551616 1e309 nan inf -0 1e-40 %";

fn change() -> impl Strategy<Value = Change> {
    use prop::sample::Index;
    let words: Vec<&str> = WORDS.split(' ').collect();
    prop_oneof![
        3 => (any::<Index>(), 1u8..).prop_map(|(at, mask)| Change::Flip(at, mask)),
        1 => any::<Index>().prop_map(|at| Change::Replace(at, usize::MAX, Vec::new())),
        1 => (any::<Index>(), 1usize..64).prop_map(|(at, n)| Change::Replace(at, n, Vec::new())),
        1 => (any::<Index>(), 1usize..64).prop_map(|(at, n)| Change::Double(at, n)),
        4 => (any::<Index>(), prop::sample::select(words)).prop_map(|(at, w)| Change::Number(at, w)),
        1 => (any::<Index>(), prop_oneof![Just(0), Just(u64::MAX), Just(1 << 40), any::<u64>()])
            .prop_map(|(at, word)| Change::Replace(at, 8, word.to_le_bytes().to_vec())),
    ]
}

fn apply(input: &mut Vec<u8>, change: &Change) {
    if input.is_empty() {
        return;
    }
    match change {
        Change::Flip(at, mask) => {
            let at = at.index(input.len());
            input[at] ^= mask;
        }
        Change::Replace(at, n, bytes) => {
            let at = at.index(input.len());
            let end = at.saturating_add(*n).min(input.len());
            input.splice(at..end, bytes.iter().copied().take(end - at));
        }
        Change::Double(at, n) => {
            let at = at.index(input.len());
            let part = input[at..(at + n).min(input.len())].to_vec();
            input.splice(at..at, part);
        }
        Change::Number(at, word) => {
            // Runs of digits in the first 1500 bytes, where headers are.
            let head = &input[..input.len().min(1500)];
            let starts: Vec<usize> = (0..head.len())
                .filter(|&i| head[i].is_ascii_digit() && (i == 0 || !head[i - 1].is_ascii_digit()))
                .collect();
            if let Some(&start) = starts.get(at.index(starts.len().max(1))) {
                let end = (start..input.len()).find(|&i| !input[i].is_ascii_digit()).unwrap_or(input.len());
                input.splice(start..end, word.bytes());
            }
        }
    }
}

fn arbitrary_bytes_never_panic_and_never_take_more_memory_than_they_call_for() -> Result<(), Failed> {
    let corpus = corpus();
    for (check, path, bytes) in &corpus {
        let peak = peak_of(*check, bytes);
        assert!(peak <= bound(bytes), "{}: {peak} bytes allocated for {}", path.display(), bytes.len());
    }
    let defaults = Config::default();
    let cases = if std::env::var_os("PROPTEST_CASES").is_some() { defaults.cases } else { CASES };
    let config = Config { cases, failure_persistence: None, ..defaults };
    let rng = TestRng::from_seed(RngAlgorithm::ChaCha, &[7; 32]);
    let mut runner = TestRunner::new_with_rng(config, rng);
    let strategy = (0..corpus.len(), prop::collection::vec(change(), 1..5));
    let result = runner.run(&strategy, |(seed, changes)| {
        let (check, path, bytes) = &corpus[seed];
        let mut input = bytes.clone();
        changes.iter().for_each(|change| apply(&mut input, change));
        let peak = peak_of(*check, &input);
        prop_assert!(
            peak <= bound(&input),
            "{} changed by {changes:?}: {peak} bytes allocated for {}",
            path.display(),
            input.len()
        );
        Ok(())
    });
    result.map_err(|error| error.to_string().into())
}

// One trial per process: memory is counted for the whole process.
fn main() {
    let arguments = Arguments::from_args();
    let check = arbitrary_bytes_never_panic_and_never_take_more_memory_than_they_call_for;
    libtest_mimic::run(
        &arguments,
        vec![Trial::test("arbitrary_bytes_never_panic_and_never_take_more_memory_than_they_call_for", check)],
    )
    .exit();
}
