//! Times this crate's inference for `make bars-inference`, which compares this crate with other libraries.
//! For each line `NAME BATCH SECONDS` of its input (network, batch size, duration of the measurement), the
//! program prints one line `@@{json}` with the result. So a script can alternate between programs of several
//! libraries.
//!
//! usage: peer_server [--storage f32|f16|bf16|int8] MODELS
//!
//! `MODELS` is a folder of networks in the format of `lab/peers` (`NAME.safetensors` with `l0.weight`, …,
//! `inputs.safetensors`). The environment variable `PEER_THREADS` sets the number of threads (1 or 2).
//! Special names:
//!
//! - `accuracy/NAME` returns the largest relative error of the seconds against a float64 evaluation. The
//!   network's output is taken as the logarithm of seconds.
//! - `small/warm` and `small/cold` return the times of a 2×64 network on 24 inputs. Before each cold call,
//!   the weights are evicted from the first two cache levels.
//! - `vol_…` runs a VolumeNet on a byte volume, `vol_…:f32` on the float volume that the other libraries get.
//! - `resample/N` resamples N³ bytes to 128³; `read` in its result is the time of reading the bytes once.

use entire_core::kernels::{Executor, Level, SELU_ALPHA, SELU_SCALE, Storage};
use entire_core::nn::{
    ConvBlockParts, DenseParts, Dtype, Normalization, PredNet, PredNetParts, Resampler, Target, VolumeNet,
    VolumeNetParts,
};
use entire_core::scene::{Scalars, VolumeOptions, VolumeView};
use safetensors::SafeTensors;
use std::collections::HashMap;
use std::io::{BufRead, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

type Problem = Box<dyn std::error::Error>;

struct Options {
    models: PathBuf,
    storage: Storage,
    /// Pool of two threads; `None` for one thread.
    pool: Option<rayon::ThreadPool>,
}

impl Options {
    fn executor(&self) -> Executor<'_> {
        self.pool.as_ref().map_or(Executor::Serial, Executor::Rayon)
    }
}

fn options() -> Result<Options, Problem> {
    let (mut models, mut storage) = (None, Storage::F32);
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        if argument == "--storage" {
            let name = arguments.next().ok_or("--storage needs a value")?;
            storage = Storage::ALL.into_iter().find(|s| s.to_string() == name).ok_or("unknown storage")?;
        } else {
            models = Some(PathBuf::from(argument));
        }
    }
    let pool = match std::env::var("PEER_THREADS").as_deref() {
        Ok("2") => Some(rayon::ThreadPoolBuilder::new().num_threads(2).build()?),
        _ => None,
    };
    Ok(Options { models: models.ok_or("usage: peer_server [--storage S] MODELS")?, storage, pool })
}

fn floats(file: &SafeTensors<'_>, name: &str) -> Result<(Vec<usize>, Vec<f32>), Problem> {
    let tensor = file.tensor(name).map_err(|e| format!("{name}: {e}"))?;
    let numbers =
        tensor.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    Ok((tensor.shape().to_vec(), numbers))
}

fn prednet(path: &Path) -> Result<PredNetParts, Problem> {
    let bytes = std::fs::read(path).map_err(|e| format!("{}: {e}", path.display()))?;
    let file = SafeTensors::deserialize(&bytes)?;
    let count = file.names().iter().filter(|name| name.ends_with(".weight")).count();
    let mut layers = Vec::new();
    for i in 0..count {
        let (shape, weight) = floats(&file, &format!("l{i}.weight"))?;
        let (_, bias) = floats(&file, &format!("l{i}.bias"))?;
        layers.push(DenseParts { inputs: shape[1], outputs: shape[0], weight, bias, dtype: Dtype::F32 });
    }
    Ok(PredNetParts { layers, input: None, output: None, target: Target::Seconds })
}

fn inputs(models: &Path, rows: usize) -> Result<Vec<f32>, Problem> {
    let bytes = std::fs::read(models.join("inputs.safetensors"))?;
    let (shape, mut numbers) = floats(&SafeTensors::deserialize(&bytes)?, "pred")?;
    numbers.truncate(rows * shape[1]);
    Ok(numbers)
}

/// A prepared case: each call runs one inference and returns the sum of the outputs.
type Case<'a> = Box<dyn FnMut() -> f64 + 'a>;

fn case<'a>(options: &'a Options, name: &str, rows: usize) -> Result<Case<'a>, Problem> {
    if name.starts_with("vol") {
        return encoding(options, name);
    }
    let parts = prednet(&options.models.join(format!("{name}.safetensors")))?;
    let net = PredNet::with(&parts, Level::detect(), options.storage)?;
    let x = inputs(&options.models, rows)?;
    if rows == 1 {
        let mut scratch = net.scratch(1)?;
        return Ok(Box::new(move || f64::from(net.predict(&x, &mut scratch))));
    }
    let executor = options.executor();
    let threads = executor.threads();
    let scratch = || net.scratch(rows.div_ceil(threads));
    let mut scratches = (0..threads).map(|_| scratch()).collect::<Result<Vec<_>, _>>()?;
    let mut y = vec![0.0; rows];
    Ok(Box::new(move || {
        net.predict_batch(executor, &x, &mut y, &mut scratches).expect("sizes that fit");
        y.iter().copied().map(f64::from).sum()
    }))
}

/// Reads a VolumeNet in the format of `lab/peers`; batch normalization is folded into weights and biases.
fn volumenet(path: &Path) -> Result<VolumeNetParts, Problem> {
    let bytes = std::fs::read(path).map_err(|e| format!("{}: {e}", path.display()))?;
    let file = SafeTensors::deserialize(&bytes)?;
    let (mut blocks, mut edge) = (Vec::new(), 128);
    while let Ok((shape, mut weight)) = floats(&file, &format!("c{}.weight", blocks.len())) {
        let statistic = |name: &str| -> Result<Vec<f32>, Problem> {
            Ok(floats(&file, &format!("c{}.{name}", blocks.len()))?.1)
        };
        let (mut bias, gain, shift) = (statistic("bias")?, statistic("bn.weight")?, statistic("bn.bias")?);
        let (mean, variance) = (statistic("bn.mean")?, statistic("bn.var")?);
        let taps = weight.len() / shape[0];
        for (o, row) in weight.chunks_exact_mut(taps).enumerate() {
            let factor = f64::from(gain[o]) / (f64::from(variance[o]) + 1e-5).sqrt();
            row.iter_mut().for_each(|w| *w = (f64::from(*w) * factor) as f32);
            bias[o] = ((f64::from(bias[o]) - f64::from(mean[o])) * factor + f64::from(shift[o])) as f32;
        }
        blocks.push(ConvBlockParts {
            inputs: shape[1],
            outputs: shape[0],
            kernel: 3,
            stride: 2,
            padding: 1,
            weight,
            bias,
            input_edge: edge,
            output_edge: edge / 2,
            dtype: Dtype::F32,
        });
        edge /= 2;
    }
    let (shape, weight) = floats(&file, "fc.weight")?;
    let (_, bias) = floats(&file, "fc.bias")?;
    let fc = DenseParts { inputs: shape[1], outputs: shape[0], weight, bias, dtype: Dtype::F32 };
    Ok(VolumeNetParts { input: 128, blocks, fc })
}

fn encoding<'a>(options: &'a Options, name: &str) -> Result<Case<'a>, Problem> {
    let (name, from_floats) = name.strip_suffix(":f32").map_or((name, false), |name| (name, true));
    let parts = volumenet(&options.models.join(format!("{name}.safetensors")))?;
    let net = VolumeNet::with(&parts, Level::detect())?;
    let file = std::fs::read(options.models.join("inputs.safetensors"))?;
    let (_, volume) = floats(&SafeTensors::deserialize(&file)?, "vol")?;
    let bytes: Vec<u8> = volume.iter().map(|v| (v * 255.0).round() as u8).collect();
    let executor = options.executor();
    let (mut scratch, mut features) = (net.scratch(), vec![0.0; net.feature_len()]);
    Ok(Box::new(move || {
        let view = if from_floats {
            // The network maps this range to [-1, 1], so the floats stay unchanged, as in the other
            // libraries.
            let options = VolumeOptions { range: Some((-1.0, 1.0)), ..VolumeOptions::default() };
            VolumeView::with(Scalars::F32(&volume), [128; 3], options)
        } else {
            VolumeView::new(Scalars::U8(&bytes), [128; 3])
        };
        let view = view.expect("a volume of the network's size");
        net.encode(&view, &mut scratch, executor, &mut features).expect("sizes that fit");
        features.iter().copied().map(f64::from).sum()
    }))
}

/// Returns, as JSON, the times of resampling `n`³ bytes to 128³, and the minimum time in which the same
/// threads read the bytes once.
fn resampling(options: &Options, n: usize, seconds: f64) -> Result<String, Problem> {
    let bytes: Vec<u8> = (0..n * n * n).map(|i| (i.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
    let view = VolumeView::new(Scalars::U8(&bytes), [n; 3])?;
    let executor = options.executor();
    let (mut resampler, mut out) = (Resampler::new(Level::detect()), vec![0.0; 128 * 128 * 128]);
    let (mut times, mut read) = (Vec::new(), f64::INFINITY);
    let end = Instant::now() + Duration::from_secs_f64(seconds);
    while Instant::now() < end || times.len() < 5 {
        read = read.min(reading(&bytes, executor));
        let begin = Instant::now();
        resampler.resample(&view, 128, &mut out, executor)?;
        times.push(begin.elapsed().as_nanos() as f64);
    }
    times.sort_by(f64::total_cmp);
    let (min, median, check) = (times[0], times[times.len() / 2], f64::from(out[0]));
    Ok(format!(r#"{{"min":{min},"med":{median},"n":{},"read":{read},"check":{check}}}"#, times.len()))
}

/// Time in nanoseconds in which the executor's threads read all bytes once.
fn reading(bytes: &[u8], executor: Executor<'_>) -> f64 {
    let begin = Instant::now();
    if executor.threads() > 1 {
        let (left, right) = bytes.split_at(bytes.len() / 2);
        let read = |piece| move || _ = std::hint::black_box(mixed(piece));
        executor.join(read(left), read(right));
    } else {
        std::hint::black_box(mixed(bytes));
    }
    begin.elapsed().as_nanos() as f64
}

#[inline(never)]
fn mixed(bytes: &[u8]) -> u64 {
    let mut lanes = [[0u8; 64]; 8];
    for block in bytes.chunks_exact(512) {
        for (lane, line) in lanes.iter_mut().zip(block.chunks_exact(64)) {
            for (a, &b) in lane.iter_mut().zip(line) {
                *a ^= b;
            }
        }
    }
    lanes.iter().flatten().map(|&b| u64::from(b)).sum()
}

fn float64(parts: &PredNetParts, row: &[f32]) -> f64 {
    let mut x: Vec<f64> = row.iter().copied().map(f64::from).collect();
    for (i, layer) in parts.layers.iter().enumerate() {
        let last = i + 1 == parts.layers.len();
        let neuron = |(weights, bias): (&[f32], &f32)| {
            let sum: f64 =
                weights.iter().zip(&x).map(|(&w, x)| f64::from(w) * x).sum::<f64>() + f64::from(*bias);
            match sum {
                y if last => y,
                y if y > 0.0 => SELU_SCALE * y,
                y => SELU_SCALE * SELU_ALPHA * y.exp_m1(),
            }
        };
        x = layer.weight.chunks_exact(layer.inputs).zip(&layer.bias).map(neuron).collect();
    }
    x[0]
}

/// Returns the largest relative error of the predicted seconds, over single and batched predictions.
fn accuracy(options: &Options, name: &str, rows: usize) -> Result<f64, Problem> {
    let mut parts = prednet(&options.models.join(format!("{name}.safetensors")))?;
    parts.target = Target::LogSeconds;
    let net = PredNet::with(&parts, Level::detect(), options.storage)?;
    let x = inputs(&options.models, rows)?;
    let exact: Vec<f64> = x.chunks_exact(net.inputs()).map(|row| float64(&parts, row).exp()).collect();
    let mut batch = vec![0.0; rows];
    net.predict_batch(Executor::Serial, &x, &mut batch, std::slice::from_mut(&mut net.scratch(rows)?))?;
    let mut scratch = net.scratch(1)?;
    let single: Vec<f32> = x.chunks_exact(net.inputs()).map(|row| net.predict(row, &mut scratch)).collect();
    let error = |found: &[f32]| {
        let errors = exact.iter().zip(found).map(|(&y, &f)| (f64::from(f) - y).abs() / y);
        errors.fold(0.0f64, f64::max)
    };
    Ok(error(&single).max(error(&batch)))
}

/// Returns, as JSON, the times of `predict` calls of a 2×64 network with 24 normalized inputs. The network's
/// output is the logarithm of seconds.
fn small(options: &Options, cold: bool, seconds: f64) -> Result<String, Problem> {
    let number = |i: usize| ((i * 2_654_435_761) % 2000) as f32 / 10_000.0 - 0.1;
    let layer = |inputs: usize, outputs: usize| DenseParts {
        inputs,
        outputs,
        weight: (0..inputs * outputs).map(number).collect(),
        bias: (0..outputs).map(number).collect(),
        dtype: Dtype::F32,
    };
    let parts = PredNetParts {
        layers: vec![layer(24, 64), layer(64, 64), layer(64, 1)],
        input: Some(Normalization { mean: vec![0.5; 24], std: vec![2.0; 24] }),
        output: Some(Normalization { mean: vec![-4.0], std: vec![0.5] }),
        target: Target::LogSeconds,
    };
    let net = PredNet::with(&parts, Level::detect(), options.storage)?;
    let (x, mut scratch) = ([0.7f32; 24], net.scratch(1)?);
    if !cold {
        let mut case: Case<'_> =
            Box::new(move || f64::from(net.predict(std::hint::black_box(&x), &mut scratch)));
        return Ok(measure(&mut case, seconds));
    }
    // The buffer is more than twice as large as the second-level cache of current cores, so that writing the
    // buffer evicts the weights from the first two levels.
    let mut eviction = vec![1u8; 8 << 20];
    // Time of reading the clock, in nanoseconds; it is subtracted from each call's time.
    let clock = (0..1000).map(|_| Instant::now().elapsed().as_nanos()).min().unwrap_or(0);
    let end = Instant::now() + Duration::from_secs_f64(seconds);
    let mut times = Vec::new();
    while Instant::now() < end || times.len() < 20 {
        eviction.iter_mut().step_by(64).for_each(|byte| *byte = byte.wrapping_add(1));
        std::hint::black_box(&eviction);
        let begin = Instant::now();
        std::hint::black_box(net.predict(std::hint::black_box(&x), &mut scratch));
        times.push(begin.elapsed().as_nanos().saturating_sub(clock) as f64);
    }
    times.sort_by(f64::total_cmp);
    Ok(format!(r#"{{"min":{},"med":{},"n":{}}}"#, times[0], times[times.len() / 2], times.len()))
}

fn measure(case: &mut Case<'_>, seconds: f64) -> String {
    let check = case();
    let start = Instant::now();
    let mut warm = 0u32;
    while warm < 2 || (start.elapsed().as_secs_f64() < seconds * 0.15 && warm < 2000) {
        std::hint::black_box(case());
        warm += 1;
    }
    let estimate = start.elapsed().as_secs_f64() / f64::from(warm);
    // The clock takes tens of nanoseconds, so short calls are timed in groups.
    let group = if estimate < 3e-6 { (3e-6 / estimate).ceil() as u32 } else { 1 };
    let end = Instant::now() + Duration::from_secs_f64(seconds);
    let mut times = Vec::with_capacity(1 << 16);
    loop {
        let begin = Instant::now();
        for _ in 0..group {
            std::hint::black_box(case());
        }
        let now = Instant::now();
        times.push((now - begin).as_nanos() as f64 / f64::from(group));
        if now > end && times.len() >= 3 {
            break;
        }
    }
    times.sort_by(f64::total_cmp);
    let (min, median) = (times[0], times[times.len() / 2]);
    format!(r#"{{"min":{min},"med":{median},"n":{},"check":{check}}}"#, times.len() * group as usize)
}

/// Answers each line of the input.
fn serve(options: &Options) {
    let mut cases: HashMap<(String, usize), Case<'_>> = HashMap::new();
    let mut answer = |line: &str| -> Result<String, Problem> {
        let mut words = line.split_whitespace();
        let mut word = || words.next().ok_or("expected: NAME BATCH SECONDS");
        let (name, rows, seconds) = (word()?.to_owned(), word()?.parse()?, word()?.parse()?);
        if let Some(name) = name.strip_prefix("accuracy/") {
            return Ok(format!(r#"{{"error":{}}}"#, accuracy(options, name, rows)?));
        }
        if let Some(kind) = name.strip_prefix("small/") {
            return small(options, kind == "cold", seconds);
        }
        if let Some(edge) = name.strip_prefix("resample/") {
            return resampling(options, edge.parse()?, seconds);
        }
        let key = (name, rows);
        if !cases.contains_key(&key) {
            let case = case(options, &key.0, rows)?;
            cases.insert(key.clone(), case);
        }
        Ok(measure(cases.get_mut(&key).expect("it was put there"), seconds))
    };
    for line in std::io::stdin().lock().lines() {
        let result = line.map_err(Problem::from).and_then(|line| answer(&line));
        println!("@@{}", result.unwrap_or_else(|e| format!(r#"{{"err":{:?}}}"#, e.to_string())));
        let _ = std::io::stdout().flush();
    }
}

fn main() -> Result<(), Problem> {
    let options = options()?;
    match &options.pool {
        Some(pool) => pool.install(|| serve(&options)),
        None => serve(&options),
    }
    Ok(())
}
