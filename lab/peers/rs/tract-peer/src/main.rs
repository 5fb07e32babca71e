// SPDX-License-Identifier: MIT OR Apache-2.0
//! The inference library tract as a server; the crate `common` has the protocol.

use common::*;
use tract_onnx::prelude::*;

fn main() {
    let n = threads();
    if n > 1 {
        tract_linalg::multithread::set_default_executor(tract_linalg::multithread::Executor::multithread(n));
    }
    serve(|dir, name, batch| {
        (|| -> TractResult<Case> {
            let shape: Vec<usize> =
                if name.starts_with("vol") { vec![1, 1, 128, 128, 128] } else { vec![batch, 16] };
            let m = tract_onnx::onnx()
                .model_for_path(format!("{dir}/{name}.onnx"))?
                .with_input_fact(0, f32::fact(&shape).into())?
                .into_optimized()?
                .into_runnable()?;
            let x: TValue = Tensor::from_shape(&shape, &input(dir, name, batch))?.into();
            let mut state = m.spawn()?;
            Ok(Box::new(move || {
                let r = state.run(tvec!(x.clone())).unwrap();
                r[0].try_as_plain_ram().unwrap().as_slice::<f32>().unwrap().to_vec()
            }))
        })()
        .map_err(|e| format!("{e:?}"))
    });
}
