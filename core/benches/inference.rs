//! Measures the time of PredNet for each network, SIMD level and storage type, and the times of VolumeNet and
//! of resampling for each level, on one thread. Compares the times with the machine's limits (memory
//! bandwidth and peak arithmetic rate), which are measured in the same run. Times in the table are in
//! microseconds.
//!
//! ```text
//! cargo bench -p entire-core --bench inference [-- [--only TEXT] [--calls N]]
//! ```
//!
//! | column | meaning |
//! |---|---|
//! | setup | time of packing the weights |
//! | warm | minimum, median, 99th percentile and maximum of successive calls |
//! | cold | median with the weights evicted from the first two cache levels before each call |
//! | flushed | median with the weights (resampling: voxels) flushed from every cache before each call |
//! | bytes | bytes that one call reads: weights (VolumeNet: weights and voxels; resampling: voxels) |
//! | floor | lower bound of a call's time: the larger of bytes / bandwidth and FLOP / peak rate |
//! | ratio | median of the warm times / floor |
//!
//! VolumeNet `vol A` has the channels 1-8-16-32-64-128-256, `vol B` 1-16-32-64-128-256-256 (kernel 3, stride
//! 2, two features), both on a volume of 128³ bytes; `512 u8` resamples 512³ bytes to 128³. The column
//! `flushed` is empty for VolumeNet.
#![allow(clippy::incompatible_msrv, reason = "needs the newest compiler, unlike the library")]

use entire_core::kernels::{Executor, Level, Storage};
use entire_core::nn::{
    ConvBlockParts, DenseParts, Dtype, Normalization, PredNet, PredNetParts, Resampler, Target, VolumeNet,
    VolumeNetParts,
};
use entire_core::scene::{Scalars, VolumeView};
use std::hint::black_box;
use std::time::{Duration, Instant};

/// Networks: name, number of inputs, widths of the hidden layers.
const NETWORKS: [(&str, usize, &[usize]); 5] = [
    ("2x64", 24, &[64, 64]),
    ("0C256", 16, &[256, 128, 64, 32, 16]),
    ("4C256", 16, &[256, 256, 256, 256, 256, 128, 64, 32, 16]),
    ("12C64", 16, &[64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 64, 32, 16]),
    ("12C256", 16, &[256, 256, 256, 256, 256, 256, 256, 256, 256, 256, 256, 256, 256, 128, 64, 32, 16]),
];

/// Normally distributed pseudo-random numbers.
struct Normal(u64);

impl Normal {
    fn uniform(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }

    fn next(&mut self) -> f32 {
        let (u, v) = (1.0 - self.uniform(), self.uniform());
        ((-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()) as f32
    }
}

fn network(inputs: usize, hidden: &[usize]) -> PredNetParts {
    let mut normal = Normal(0x9e37_79b9_7f4a_7c15);
    let mut layers = Vec::new();
    let mut width = inputs;
    for &outputs in hidden.iter().chain(&[1]) {
        let scale = 1.0 / (width as f32).sqrt();
        layers.push(DenseParts {
            inputs: width,
            outputs,
            weight: (0..width * outputs).map(|_| scale * normal.next()).collect(),
            bias: (0..outputs).map(|_| 0.1 * normal.next()).collect(),
            dtype: Dtype::F32,
        });
        width = outputs;
    }
    PredNetParts {
        layers,
        input: Some(Normalization { mean: vec![0.25; inputs], std: vec![1.5; inputs] }),
        output: Some(Normalization { mean: vec![-4.0], std: vec![0.5] }),
        target: Target::LogSeconds,
    }
}

/// VolumeNets: name, output channels of the blocks.
const VOLUME_NETWORKS: [(&str, [usize; 6]); 2] =
    [("vol A", [8, 16, 32, 64, 128, 256]), ("vol B", [16, 32, 64, 128, 256, 256])];

/// Edge of VolumeNet's input, in voxels.
const INPUT_EDGE: usize = 128;

/// Edge of the volume that is resampled to VolumeNet's input, in voxels.
const LARGE_EDGE: usize = 512;

fn volume_network(channels: &[usize]) -> VolumeNetParts {
    let mut normal = Normal(0x1234_5678_9abc_def1);
    let (mut inputs, mut edge) = (1, INPUT_EDGE);
    let mut blocks = Vec::new();
    for &outputs in channels {
        let weights = outputs * inputs * 27;
        let scale = 1.0 / (inputs as f32 * 27.0).sqrt();
        blocks.push(ConvBlockParts {
            inputs,
            outputs,
            kernel: 3,
            stride: 2,
            padding: 1,
            weight: (0..weights).map(|_| scale * normal.next()).collect(),
            bias: (0..outputs).map(|_| 0.1 * normal.next()).collect(),
            input_edge: edge,
            output_edge: edge / 2,
            dtype: Dtype::F32,
        });
        (inputs, edge) = (outputs, edge / 2);
    }
    let inputs = inputs * edge * edge * edge;
    let scale = 1.0 / (inputs as f32).sqrt();
    let fc = DenseParts {
        inputs,
        outputs: 2,
        weight: (0..2 * inputs).map(|_| scale * normal.next()).collect(),
        bias: vec![0.0; 2],
        dtype: Dtype::F32,
    };
    VolumeNetParts { input: INPUT_EDGE, blocks, fc }
}

/// Returns the bytes of a smooth volume with some noise.
fn volume(edge: usize) -> Vec<u8> {
    let mut noise = Normal(99);
    (0..edge * edge * edge)
        .map(|i| {
            let [x, y, z] = [i % edge, i / edge % edge, i / edge / edge].map(|c| c as f32 / edge as f32);
            (100.0 + 80.0 * (9.0 * x).sin() * (7.0 * y + 5.0 * z).cos() + 50.0 * noise.uniform() as f32) as u8
        })
        .collect()
}

/// Contents of one line of the table. Times are in nanoseconds; those in `warm` are sorted.
struct Row<'a> {
    network: &'a str,
    level: Level,
    storage: &'a str,
    rows: usize,
    setup: Option<f64>,
    warm: Vec<f64>,
    cold: Option<f64>,
    flushed: Option<f64>,
    bytes: usize,
    floor: Option<f64>,
}

impl Row<'_> {
    fn print(&self) {
        let Row { network, storage, rows, warm, bytes, .. } = self;
        let [setup, cold, flushed] =
            [self.setup, self.cold, self.flushed].map(|t| t.map_or(String::new(), microseconds));
        let median = percentile(warm, 50);
        let [best, p50, p99, worst] =
            [warm[0], median, percentile(warm, 99), warm[warm.len() - 1]].map(microseconds);
        let (floor, ratio) =
            self.floor.map_or_else(Default::default, |f| (microseconds(f), format!("{:.2}", median / f)));
        println!(
            "{network:7} {:7} {storage:4} {rows:>4} {setup:>9} | {best:>9} {p50:>9} {p99:>9} {worst:>9} {:>8} | \
             {cold:>9} {flushed:>9} | {bytes:>9} {floor:>8} {ratio:>6}",
            self.level.isa(),
            warm.len()
        );
    }
}

/// Returns the lower bound of a call's time in nanoseconds.
fn floor(bytes: usize, macs: usize, bandwidth: Option<f64>, peak: Option<f64>) -> Option<f64> {
    let bytes = bandwidth.map(|b| bytes as f64 / b * 1e9);
    let flop = peak.map(|p| (2 * macs) as f64 / p * 1e9);
    bytes.into_iter().chain(flop).reduce(f64::max)
}

/// Measures the machine's peak arithmetic rate and memory bandwidth with the instructions of one SIMD level.
#[cfg(target_arch = "x86_64")]
#[allow(unsafe_code, reason = "peak rates can only be measured with the instructions themselves")]
mod limits {
    use super::{Instant, black_box};
    use std::arch::x86_64::*;

    /// Defines a function that runs twelve independent chains of an instruction and returns their arithmetic
    /// operations per second. One instruction does `$operations` operations.
    macro_rules! rate {
        ($name:ident, $feature:literal, $zero:ident, $operations:literal, [$($i:literal)*],
         |$x:ident, $y:ident, $sum:ident| $next:expr) => {
            #[target_feature(enable = $feature)]
            fn $name(rounds: usize) -> f64 {
                let ($x, $y) = (black_box($zero()), black_box($zero()));
                let mut sums = [$zero(); 12];
                let start = Instant::now();
                for _ in 0..rounds {
                    $(
                        let $sum = sums[$i];
                        sums[$i] = $next;
                    )*
                }
                let seconds = start.elapsed().as_secs_f64();
                black_box(sums);
                (rounds * 12 * $operations) as f64 / seconds
            }
        };
    }

    rate!(fma512, "avx512f", _mm512_setzero_ps, 32, [0 1 2 3 4 5 6 7 8 9 10 11],
          |x, y, sum| _mm512_fmadd_ps(x, y, sum));
    rate!(fma256, "avx2,fma", _mm256_setzero_ps, 16, [0 1 2 3 4 5 6 7 8 9 10 11],
          |x, y, sum| _mm256_fmadd_ps(x, y, sum));
    rate!(dot512, "avx512f,avx512vnni", _mm512_setzero_si512, 128, [0 1 2 3 4 5 6 7 8 9 10 11],
          |x, y, sum| _mm512_dpbusd_epi32(sum, x, y));

    /// Defines a function that reads floats once and adds them to four vectors of `$lanes` sums.
    macro_rules! read {
        ($name:ident, $feature:literal, $zero:ident, $load:ident, $add:ident, $lanes:literal) => {
            #[target_feature(enable = $feature)]
            fn $name(data: &[f32]) {
                let (mut a, mut b, mut c, mut d) = ($zero(), $zero(), $zero(), $zero());
                for chunk in data.chunks_exact(4 * $lanes) {
                    let p = chunk.as_ptr();
                    // SAFETY: the chunk holds the four vectors that are read.
                    unsafe {
                        a = $add(a, $load(p));
                        b = $add(b, $load(p.add($lanes)));
                        c = $add(c, $load(p.add(2 * $lanes)));
                        d = $add(d, $load(p.add(3 * $lanes)));
                    }
                }
                black_box((a, b, c, d));
            }
        };
    }

    read!(sum512, "avx512f", _mm512_setzero_ps, _mm512_loadu_ps, _mm512_add_ps, 16);
    read!(sum256, "avx2,fma", _mm256_setzero_ps, _mm256_loadu_ps, _mm256_add_ps, 8);

    /// Returns the peak rate in FLOP per second (with `int8`: integer operations per second), or `None` if
    /// the level lacks such instructions.
    pub(super) fn peak(level: super::Level, int8: bool) -> Option<f64> {
        // Takes the fastest of many short runs, which is the one least disturbed by other processes.
        let best = |f: &dyn Fn() -> f64| Some((0..600).map(|_| f()).fold(0.0, f64::max));
        match level.isa() {
            // SAFETY: a level exists only if the CPU has its instructions, and the name shows that VNNI is
            // among them.
            "avx512" if int8 && level.to_string().contains("vnni") => best(&|| unsafe { dot512(100_000) }),
            _ if int8 => None,
            // SAFETY: an AVX-512 level exists only if the CPU has AVX-512.
            "avx512" => best(&|| unsafe { fma512(100_000) }),
            // SAFETY: an AVX2 level exists only if the CPU has AVX2 and FMA.
            "avx2" => best(&|| unsafe { fma256(100_000) }),
            _ => None,
        }
    }

    /// Returns the bandwidth of repeated reads of the same `bytes` bytes, in bytes per second; `None` for the
    /// scalar level.
    pub(super) fn bandwidth(level: super::Level, bytes: usize) -> Option<f64> {
        // The data fills whole cache lines, as packed weights do. The data is written before it is read,
        // because the system maps all unwritten memory to one page of zeros.
        let all = vec![1f32; bytes.next_multiple_of(256) / 4 + 16];
        let data = &all[all.as_ptr().align_offset(64)..][..bytes.next_multiple_of(256) / 4];
        let rounds = (1 << 22) / bytes + 1;
        let read: &dyn Fn() = match level.isa() {
            // SAFETY: an AVX-512 level exists only if the CPU has AVX-512.
            "avx512" => &|| unsafe { sum512(black_box(data)) },
            // SAFETY: an AVX2 level exists only if the CPU has AVX2.
            "avx2" => &|| unsafe { sum256(black_box(data)) },
            _ => return None,
        };
        let time = |_| {
            let start = Instant::now();
            for _ in 0..rounds {
                read();
            }
            start.elapsed().as_secs_f64() / rounds as f64
        };
        Some(bytes as f64 / (0..60).map(time).fold(f64::INFINITY, f64::min))
    }

    /// Evicts `bytes` from every cache.
    pub(super) fn flush(bytes: &[u8]) {
        for line in bytes.chunks(64) {
            // SAFETY: CLFLUSH is part of SSE2, which x86-64 always has, and the line belongs to a live slice.
            unsafe { _mm_clflush(line.as_ptr()) };
        }
        // SAFETY: MFENCE is part of SSE2, which x86-64 always has.
        unsafe { _mm_mfence() };
    }
}

#[cfg(not(target_arch = "x86_64"))]
mod limits {
    pub(super) fn peak(_: super::Level, _: bool) -> Option<f64> {
        None
    }
    pub(super) fn bandwidth(_: super::Level, _: usize) -> Option<f64> {
        None
    }
    pub(super) fn flush(_: &[u8]) {}
}

/// Returns the sorted times of single calls in nanoseconds; the time of reading the clock is subtracted.
fn times(
    calls: usize,
    limit: Duration,
    clock: f64,
    mut before: impl FnMut(),
    mut call: impl FnMut(),
) -> Vec<f64> {
    let end = Instant::now() + limit;
    let mut found = Vec::with_capacity(calls);
    while found.len() < calls && (Instant::now() < end || found.len() < 20) {
        before();
        let start = Instant::now();
        call();
        found.push((start.elapsed().as_nanos() as f64 - clock).max(0.0));
    }
    found.sort_by(f64::total_cmp);
    found
}

fn percentile(sorted: &[f64], p: usize) -> f64 {
    sorted[(sorted.len() * p / 100).min(sorted.len() - 1)]
}

fn microseconds(nanoseconds: f64) -> String {
    format!("{:.2}", nanoseconds / 1e3)
}

fn machine() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let field = |name: &str| {
        info.lines()
            .find(|l| l.starts_with(name))
            .and_then(|l| l.split(": ").nth(1))
            .unwrap_or("unknown")
            .to_owned()
    };
    format!("{} (family {}, model {})", field("model name"), field("cpu family"), field("model\t"))
}

struct Options {
    only: String,
    calls: usize,
}

fn options() -> Options {
    let mut found = Options { only: String::new(), calls: 1_000_000 };
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--only" => found.only = arguments.next().unwrap_or_default(),
            "--calls" => found.calls = arguments.next().and_then(|n| n.parse().ok()).unwrap_or(found.calls),
            _ => {}
        }
    }
    found
}

fn main() {
    let options = options();
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let load = load.split(' ').next().unwrap_or("unknown").to_owned();
    let clock = (0..2000).map(|_| Instant::now().elapsed().as_nanos()).min().unwrap_or(0) as f64;
    println!("{}, load {load}, best level {}", machine(), Level::detect());
    let mut eviction = vec![1u8; 8 << 20];
    let mut evict = || {
        eviction.iter_mut().step_by(64).for_each(|byte| *byte = byte.wrapping_add(1));
        black_box(&eviction);
    };
    let small = volume(INPUT_EDGE);
    let large = volume(LARGE_EDGE);
    println!(
        "network level        rows  setup us | warm best       p50       p99     worst    calls \
         |  cold p50   flushed |     bytes    floor  ratio"
    );
    for level in Level::available() {
        let (peak, peak_int8) = (limits::peak(level, false), limits::peak(level, true));
        if let Some(peak) = peak {
            let int8 = peak_int8.map_or(String::new(), |p| format!(", {:.0} GOP/s int8", p / 1e9));
            println!("{level}: {:.0} GFLOP/s f32{int8}", peak / 1e9);
        }
        let wanted =
            |name: &str, storage: &str| format!("{name} {} {storage}", level.isa()).contains(&options.only);
        let short = Duration::from_millis(150);
        // Time limit of the warm calls of one row of the table. The table states the number of these calls,
        // which is at most `--calls`.
        let long = if level == Level::detect() { Duration::from_millis(2500) } else { short };
        for (network, inputs, hidden) in NETWORKS {
            let parts = self::network(inputs, hidden);
            let macs: usize = parts.layers.iter().map(|l| l.inputs * l.outputs).sum();
            for storage in Storage::ALL {
                if !wanted(network, storage.name()) {
                    continue;
                }
                let start = Instant::now();
                let net = PredNet::with(&parts, level, storage).expect("a network");
                let setup = start.elapsed().as_nanos() as f64;
                let peak = if storage == Storage::Int8 { peak_int8 } else { peak };
                let bytes = net.memory().len();
                let bandwidth = limits::bandwidth(level, bytes);
                let mut normal = Normal(7);
                let rows = 384;
                let x: Vec<f32> = (0..inputs * rows).map(|_| normal.next()).collect();
                let (mut scratch, mut batch) =
                    (net.scratch(1).expect("memory"), net.scratch(rows).expect("memory"));
                let mut seconds = vec![0.0; rows];
                let row = &x[..inputs];
                for _ in 0..50 {
                    black_box(net.predict(black_box(row), &mut scratch));
                }
                let mut call = || {
                    black_box(net.predict(black_box(row), &mut scratch));
                };
                let warm = times(options.calls, long, clock, || {}, &mut call);
                let cold = times(400, short, clock, &mut evict, &mut call);
                let flushed = times(400, short, clock, || limits::flush(net.memory()), &mut call);
                let batch = std::slice::from_mut(&mut batch);
                let batched =
                    || net.predict_batch(Executor::Serial, &x, &mut seconds, batch).expect("sizes that fit");
                let many = times(400, short, clock, || {}, batched);
                let line = Row {
                    network,
                    level,
                    storage: storage.name(),
                    rows: 1,
                    setup: Some(setup),
                    warm,
                    cold: Some(percentile(&cold, 50)),
                    flushed: Some(percentile(&flushed, 50)),
                    bytes,
                    floor: floor(bytes, macs, bandwidth, peak),
                };
                line.print();
                // The floor of a batch is unknown if the peak rate of the arithmetic is unknown.
                let floor = peak.and_then(|peak| floor(bytes, macs * rows, bandwidth, Some(peak)));
                Row { rows, setup: None, warm: many, cold: None, flushed: None, floor, ..line }.print();
            }
        }
        let storage = Storage::F32.name();
        let cube = VolumeView::new(Scalars::U8(&small), [INPUT_EDGE; 3]).expect("a volume");
        for (network, channels) in VOLUME_NETWORKS {
            if !wanted(network, storage) {
                continue;
            }
            let parts = volume_network(&channels);
            let macs: usize = parts.blocks.iter().map(|b| b.weight.len() * b.output_edge.pow(3)).sum();
            let weights: usize = parts.blocks.iter().map(|b| b.weight.len() + b.bias.len()).sum();
            let bytes = 4 * (weights + parts.fc.weight.len() + parts.fc.bias.len()) + small.len();
            let start = Instant::now();
            let net = VolumeNet::with(&parts, level).expect("a network");
            let setup = start.elapsed().as_nanos() as f64;
            let mut scratch = net.scratch();
            let mut features = vec![0.0; net.feature_len()];
            let mut call = || {
                net.encode(black_box(&cube), &mut scratch, Executor::Serial, &mut features)
                    .expect("sizes that fit");
            };
            call();
            let warm = times(options.calls, long, clock, || {}, &mut call);
            let cold = times(100, long, clock, &mut evict, &mut call);
            Row {
                network,
                level,
                storage,
                rows: 1,
                setup: Some(setup),
                warm,
                cold: Some(percentile(&cold, 50)),
                flushed: None,
                bytes,
                floor: floor(bytes, macs, limits::bandwidth(level, bytes), peak),
            }
            .print();
        }
        if wanted("512 u8", "") {
            let view = VolumeView::new(Scalars::U8(&large), [LARGE_EDGE; 3]).expect("a volume");
            let mut resampler = Resampler::new(level);
            let mut out = vec![0.0; INPUT_EDGE.pow(3)];
            let mut call = || {
                resampler
                    .resample(black_box(&view), INPUT_EDGE, &mut out, Executor::Serial)
                    .expect("sizes that fit");
            };
            call();
            let warm = times(options.calls, long, clock, || {}, &mut call);
            let cold = times(100, short, clock, &mut evict, &mut call);
            let flushed = times(100, short, clock, || limits::flush(&large), &mut call);
            Row {
                network: "512 u8",
                level,
                storage: "",
                rows: 1,
                setup: None,
                warm,
                cold: Some(percentile(&cold, 50)),
                flushed: Some(percentile(&flushed, 50)),
                bytes: large.len(),
                floor: floor(large.len(), 0, limits::bandwidth(level, large.len()), None),
            }
            .print();
        }
    }
}
