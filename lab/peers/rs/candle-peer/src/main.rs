// SPDX-License-Identifier: MIT OR Apache-2.0
//! The inference library candle as a server; the crate `common` has the protocol.

use candle_core::{DType, Device, Tensor};
use candle_nn::{Linear, Module};
use common::*;

fn main() {
    // A network's name may end in a data type, as in pred_12c256:f16. The weights are read from NAME_elu,
    // since they contain the scale of SELU.
    serve(|dir, name, batch| {
        if name.starts_with("vol") {
            return Err("no conv3d in candle".into());
        }
        (|| -> candle_core::Result<Case> {
            let (base, dt) = name.split_once(':').unwrap_or((name, "f32"));
            let dt = match dt {
                "f16" => DType::F16,
                "bf16" => DType::BF16,
                _ => DType::F32,
            };
            let s = Tensors::load(&format!("{dir}/{base}_elu.safetensors"));
            let dev = Device::Cpu;
            let n = s.layers();
            let mut ls = vec![];
            for i in 0..n {
                let (ws, w) = s.get(&format!("l{i}.weight"));
                let (_, b) = s.get(&format!("l{i}.bias"));
                ls.push(Linear::new(
                    Tensor::from_slice(w, (ws[0], ws[1]), &dev)?.to_dtype(dt)?,
                    Some(Tensor::from_slice(b, ws[0], &dev)?.to_dtype(dt)?),
                ));
            }
            let x = Tensor::from_slice(&input(dir, base, batch), (batch, 16), &dev)?.to_dtype(dt)?;
            Ok(Box::new(move || {
                let mut h = x.clone();
                for (i, l) in ls.iter().enumerate() {
                    h = l.forward(&h).unwrap();
                    if i + 1 < n {
                        h = h.elu(1.6732632423543772).unwrap();
                    }
                }
                h.to_dtype(DType::F32).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap()
            }))
        })()
        .map_err(|e| e.to_string())
    });
}
