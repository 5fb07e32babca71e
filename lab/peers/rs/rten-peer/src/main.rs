// SPDX-License-Identifier: MIT OR Apache-2.0
//! The inference library RTen as a server; the crate `common` has the protocol.

use common::*;
use rten::{Model, ModelOptions, ValueView};
use rten_tensor::prelude::*;
use rten_tensor::Tensor;

fn main() {
    serve(|dir, name, batch| {
        let file = match name.strip_suffix("_int8") {
            Some(b) => format!("{dir}/{b}_elu_int8.onnx"),
            None if name.starts_with("vol") => format!("{dir}/{name}.onnx"),
            None => format!("{dir}/{name}_elu.onnx"),
        };
        let mut o = ModelOptions::with_all_ops();
        o.prepack_weights(true);
        let m = o.load_file(&file).map_err(|e| e.to_string())?;
        let shape: Vec<usize> =
            if name.starts_with("vol") { vec![1, 1, 128, 128, 128] } else { vec![batch, 16] };
        let x: Tensor<f32> = Tensor::from_data(shape.as_slice(), input(dir, name, batch));
        let xi = m.node_id("x").unwrap();
        let yi = m.node_id("y").unwrap();
        Ok(Box::new(move || {
            let r = m.run(vec![(xi, ValueView::from(x.view()).into())], &[yi], None).unwrap();
            let t: Tensor<f32> = r.into_iter().next().unwrap().try_into().unwrap();
            t.to_vec()
        }))
    });
}
