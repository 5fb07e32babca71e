// SPDX-License-Identifier: MIT OR Apache-2.0
//! The inference library RTen as a server, which reads lines `NAME BATCH SECONDS` and answers each with
//! `@@{json}`.
//!
//! usage: rten-peer MODELS

use rten::{ModelOptions, ValueView};
use rten_tensor::prelude::*;
use rten_tensor::Tensor;
use std::collections::HashMap;
use std::io::{BufRead, Write};
use std::time::{Duration, Instant};

/// A prepared case: each call runs one inference and returns the output, whose sum is reported.
type Case = Box<dyn FnMut() -> Vec<f32>>;

/// Inputs of a network: a volume, or `batch` rows.
fn input(dir: &str, name: &str, batch: usize) -> Vec<f32> {
    let path = format!("{dir}/inputs.safetensors");
    let bytes = std::fs::read(&path).unwrap_or_else(|e| panic!("{path}: {e}"));
    let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let (tensor, count) = if name.starts_with("vol") { ("vol", usize::MAX) } else { ("pred", batch * 16) };
    let numbers = file.tensor(tensor).unwrap();
    numbers.data().chunks_exact(4).take(count).map(|c| f32::from_le_bytes(c.try_into().unwrap())).collect()
}

fn case(dir: &str, name: &str, batch: usize) -> Result<Case, String> {
    let file = match name.strip_suffix("_int8") {
        Some(b) => format!("{dir}/{b}_elu_int8.onnx"),
        None if name.starts_with("vol") => format!("{dir}/{name}.onnx"),
        None => format!("{dir}/{name}_elu.onnx"),
    };
    let mut o = ModelOptions::with_all_ops();
    o.prepack_weights(true);
    let m = o.load_file(&file).map_err(|e| e.to_string())?;
    let shape: Vec<usize> = if name.starts_with("vol") { vec![1, 1, 128, 128, 128] } else { vec![batch, 16] };
    let x: Tensor<f32> = Tensor::from_data(shape.as_slice(), input(dir, name, batch));
    let xi = m.node_id("x").unwrap();
    let yi = m.node_id("y").unwrap();
    Ok(Box::new(move || {
        let r = m.run(vec![(xi, ValueView::from(x.view()).into())], &[yi], None).unwrap();
        let t: Tensor<f32> = r.into_iter().next().unwrap().try_into().unwrap();
        t.to_vec()
    }))
}

fn main() {
    let dir = std::env::args().nth(1).expect("model dir");
    std::panic::set_hook(Box::new(|_| {}));
    let mut cache: HashMap<(String, usize), Case> = HashMap::new();
    for line in std::io::stdin().lock().lines() {
        let line = line.unwrap();
        let p: Vec<&str> = line.split_whitespace().collect();
        let (name, batch, secs) =
            (p[0].to_string(), p[1].parse::<usize>().unwrap(), p[2].parse::<f64>().unwrap());
        let key = (name.clone(), batch);
        let r = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| -> Result<String, String> {
            if !cache.contains_key(&key) {
                let c = case(&dir, &name, batch)?;
                cache.insert(key.clone(), c);
            }
            Ok(measure(cache.get_mut(&key).unwrap(), secs))
        }));
        let out = match r {
            Ok(Ok(s)) => s,
            Ok(Err(e)) => format!("{{\"err\":{e:?}}}"),
            Err(e) => {
                let m = e
                    .downcast_ref::<String>()
                    .cloned()
                    .or(e.downcast_ref::<&str>().map(|s| s.to_string()))
                    .unwrap_or("panic".into());
                format!("{{\"err\":{m:?}}}")
            }
        };
        println!("@@{out}");
        std::io::stdout().flush().unwrap();
    }
}

fn measure(f: &mut Case, secs: f64) -> String {
    let check: f64 = f().iter().map(|&x| x as f64).sum();
    let t0 = Instant::now();
    let mut warm = 0;
    while warm < 2 || (t0.elapsed().as_secs_f64() < secs * 0.15 && warm < 2000) {
        std::hint::black_box(f());
        warm += 1;
    }
    let est = t0.elapsed().as_secs_f64() / warm as f64;
    let group = if est < 3e-6 { (3e-6 / est).ceil() as usize } else { 1 };
    let end = Instant::now() + Duration::from_secs_f64(secs);
    let mut v = Vec::with_capacity(1 << 16);
    loop {
        let t = Instant::now();
        for _ in 0..group {
            std::hint::black_box(f());
        }
        let e = Instant::now();
        v.push((e - t).as_nanos() as f64 / group as f64);
        if e > end && v.len() >= 3 {
            break;
        }
    }
    v.sort_by(|a, b| a.total_cmp(b));
    format!("{{\"min\":{},\"med\":{},\"n\":{},\"check\":{}}}", v[0], v[v.len() / 2], v.len() * group, check)
}
