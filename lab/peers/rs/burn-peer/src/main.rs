// SPDX-License-Identifier: MIT OR Apache-2.0
//! The inference library burn as a server; the crate `common` has the protocol.

use burn::module::Param;
use burn::nn::conv::{Conv3d, Conv3dConfig};
use burn::nn::{BatchNorm, BatchNormConfig, Linear, LinearConfig, PaddingConfig3d};
use burn::prelude::*;
use burn::tensor::activation::selu;
use burn::tensor::TensorData;
use common::*;

fn t<const D: usize>(s: &Tensors, k: &str, dev: &Device) -> Tensor<D> {
    let (sh, d) = s.get(k);
    Tensor::from_data(TensorData::new(d.clone(), sh.clone()), dev)
}

fn linear(s: &Tensors, k: &str, dev: &Device) -> Linear {
    let sh = &s.get(&format!("{k}.weight")).0;
    let mut l = LinearConfig::new(sh[1], sh[0]).init(dev);
    let (wd, w) = s.get(&format!("{k}.weight"));
    // burn stores weights as [in, out].
    let (o, i) = (wd[0], wd[1]);
    let mut tr = vec![0f32; o * i];
    for a in 0..o {
        for b in 0..i {
            tr[b * o + a] = w[a * i + b];
        }
    }
    l.weight = Param::from_tensor(Tensor::from_data(TensorData::new(tr, [i, o]), dev));
    l.bias = Some(Param::from_tensor(t::<1>(s, &format!("{k}.bias"), dev)));
    l
}

fn main() {
    let which = std::env::var("BURN_WHICH").unwrap_or("flex".into());
    serve(move |dir, name, batch| {
        let dev = if which == "ndarray" { Device::ndarray() } else { Device::flex() };
        let s = Tensors::load(&format!("{dir}/{name}.safetensors"));
        if name.starts_with("vol") {
            let mut blocks: Vec<(Conv3d, BatchNorm)> = vec![];
            for i in 0..6 {
                let sh = s.get(&format!("c{i}.weight")).0.clone();
                let mut c = Conv3dConfig::new([sh[1], sh[0]], [3, 3, 3])
                    .with_stride([2, 2, 2])
                    .with_padding(PaddingConfig3d::Explicit(1, 1, 1))
                    .init(&dev);
                c.weight = Param::from_tensor(t::<5>(&s, &format!("c{i}.weight"), &dev));
                c.bias = Some(Param::from_tensor(t::<1>(&s, &format!("c{i}.bias"), &dev)));
                let mut bn = BatchNormConfig::new(sh[0]).init(&dev);
                bn.gamma = Param::from_tensor(t::<1>(&s, &format!("c{i}.bn.weight"), &dev));
                bn.beta = Param::from_tensor(t::<1>(&s, &format!("c{i}.bn.bias"), &dev));
                bn.running_mean = burn::module::RunningState::new(t::<1>(&s, &format!("c{i}.bn.mean"), &dev));
                bn.running_var = burn::module::RunningState::new(t::<1>(&s, &format!("c{i}.bn.var"), &dev));
                blocks.push((c, bn));
            }
            let fc = linear(&s, "fc", &dev);
            let x: Tensor<5> =
                Tensor::from_data(TensorData::new(input(dir, name, 1), [1, 1, 128, 128, 128]), &dev);
            let f: Case = Box::new(move || {
                let mut h = x.clone();
                for (c, b) in &blocks {
                    h = selu(b.forward(c.forward(h)));
                }
                let f: Tensor<2> = h.flatten(1, 4);
                fc.forward(f).into_data().try_to_vec::<f32>().unwrap()
            });
            Ok(f)
        } else {
            let ls: Vec<Linear> = (0..s.layers()).map(|i| linear(&s, &format!("l{i}"), &dev)).collect();
            let x: Tensor<2> = Tensor::from_data(TensorData::new(input(dir, name, batch), [batch, 16]), &dev);
            let f: Case = Box::new(move || {
                let mut h = x.clone();
                for (i, l) in ls.iter().enumerate() {
                    h = l.forward(h);
                    if i + 1 < ls.len() {
                        h = selu(h);
                    }
                }
                h.into_data().try_to_vec::<f32>().unwrap()
            });
            Ok(f)
        }
    });
}
