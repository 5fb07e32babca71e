#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Generates the benchmark networks from fixed seeds, as safetensors and ONNX.

usage: gen.py FOLDER

Per network NAME:
  NAME.safetensors   weights ([out, in] dense, [out, in, 3, 3, 3] convolution, batch normalization statistics)
  NAME.onnx          Gemm, Conv, BatchNormalization and Selu, as an exporter writes them
  NAME_elu.onnx      PredNet alone: SELU(x) = GAMMA * ELU(x; ALPHA), GAMMA folded into the next layer; the same
                     function, for libraries without a Selu operator (weights: NAME_elu.safetensors)
  NAME_int8.onnx     PredNet alone: ONNX Runtime's dynamic quantization, weights per channel
and inputs.safetensors, the inputs that every contestant gets.
"""
import logging
import pathlib
import sys

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from safetensors.numpy import save_file

ALPHA, GAMMA = 1.6732632423543772, 1.0507009873554805
PREDNETS = {"tiny": None, "pred_0c256": (0, 256), "pred_4c256": (4, 256), "pred_12c256": (12, 256),
            "pred_18c256": (18, 256), "pred_4c64": (4, 64), "pred_12c64": (12, 64)}
VOLUMENETS = {"vol_a": [8, 16, 32, 64, 128, 256], "vol_b": [16, 32, 64, 128, 256, 256]}


def widths(shape):
    """Layer widths: 16 inputs, a first layer, the given number of hidden layers of the same width, widths halved down to
    16, then 1."""
    if shape is None:
        return [16, 1]
    depth, width = shape
    out = [16] + [width] * (depth + 1)
    while out[-1] > 16:
        out.append(out[-1] // 2)
    return out + [1]


def prednet(dims, rng):
    weights = {}
    for i, (a, b) in enumerate(zip(dims, dims[1:])):
        weights[f"l{i}.weight"] = (rng.standard_normal((b, a)) / np.sqrt(a)).astype(np.float32)
        weights[f"l{i}.bias"] = (0.1 * rng.standard_normal(b)).astype(np.float32)
    return weights


def prednet_nodes(dims, elu):
    nodes, x, layers = [], "x", len(dims) - 1
    for i in range(layers):
        last = i == layers - 1
        y = "y" if last else f"h{i}"
        nodes.append(helper.make_node("Gemm", [x, f"l{i}.weight", f"l{i}.bias"], [y], transB=1))
        if not last:
            x = f"a{i}"
            gain = {} if elu else {"gamma": GAMMA}
            nodes.append(helper.make_node("Elu" if elu else "Selu", [y], [x], alpha=ALPHA, **gain))
    return nodes


def volumenet(channels, rng):
    """Six blocks of Conv3d, batch normalization and SELU on 128 x 128 x 128 voxels, then a dense layer of two outputs."""
    def normal(*shape):
        return rng.standard_normal(shape)

    weights, nodes, x, before = {}, [], "x", 1
    for i, count in enumerate(channels):
        k = f"c{i}"
        weights[f"{k}.weight"] = (normal(count, before, 3, 3, 3) / np.sqrt(27 * before)).astype(np.float32)
        weights[f"{k}.bias"] = (0.1 * normal(count)).astype(np.float32)
        weights[f"{k}.bn.weight"] = (1 + 0.1 * normal(count)).astype(np.float32)
        weights[f"{k}.bn.bias"] = (0.1 * normal(count)).astype(np.float32)
        weights[f"{k}.bn.mean"] = (0.1 * normal(count)).astype(np.float32)
        weights[f"{k}.bn.var"] = (1 + 0.1 * rng.random(count)).astype(np.float32)
        nodes.append(helper.make_node("Conv", [x, f"{k}.weight", f"{k}.bias"], [f"{k}.y"], kernel_shape=[3] * 3,
                                      strides=[2] * 3, pads=[1] * 6, dilations=[1] * 3, group=1))
        statistics = [f"{k}.bn.{s}" for s in ("weight", "bias", "mean", "var")]
        nodes.append(helper.make_node("BatchNormalization", [f"{k}.y", *statistics], [f"{k}.z"], epsilon=1e-5))
        nodes.append(helper.make_node("Selu", [f"{k}.z"], [f"{k}.a"], alpha=ALPHA, gamma=GAMMA))
        x, before = f"{k}.a", count
    nodes.append(helper.make_node("Flatten", [x], ["flat"], axis=1))
    weights["fc.weight"] = (normal(2, 2048) / np.sqrt(2048)).astype(np.float32)
    weights["fc.bias"] = (0.1 * normal(2)).astype(np.float32)
    nodes.append(helper.make_node("Gemm", ["flat", "fc.weight", "fc.bias"], ["y"], transB=1))
    return weights, nodes


def write_onnx(path, weights, nodes, input_shape, output_shape):
    graph = helper.make_graph(
        nodes, "net",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, input_shape)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, output_shape)],
        [numpy_helper.from_array(v, k) for k, v in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, path)


def quantize(folder, name):
    try:
        logging.disable(logging.WARNING)
        from onnxruntime.quantization import QuantType, quantize_dynamic
    except ImportError:
        print("onnxruntime is not there: no int8 networks")
        return
    for suffix in ("", "_elu"):
        quantize_dynamic(folder / f"{name}{suffix}.onnx", folder / f"{name}{suffix}_int8.onnx",
                         weight_type=QuantType.QInt8, per_channel=True)


def main():
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    folder = pathlib.Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(1)
    inputs = {"pred": rng.uniform(-1, 1, (4096, 16)).astype(np.float32),
              "vol": rng.uniform(0, 1, (1, 1, 128, 128, 128)).astype(np.float32)}
    for seed, (name, shape) in enumerate(PREDNETS.items(), 100):
        dims = widths(shape)
        weights = prednet(dims, np.random.default_rng(seed))
        products = sum(a * b for a, b in zip(dims, dims[1:]))
        print(f"{name}: widths {dims}, {products + sum(dims[1:])} parameters, {products} products")
        save_file(weights, folder / f"{name}.safetensors", metadata={"dims": ",".join(map(str, dims))})
        write_onnx(folder / f"{name}.onnx", weights, prednet_nodes(dims, False), ["N", 16], ["N", 1])
        folded = {k: v.copy() for k, v in weights.items()}
        for i in range(1, len(dims) - 1):
            folded[f"l{i}.weight"] *= np.float32(GAMMA)
        save_file(folded, folder / f"{name}_elu.safetensors")
        write_onnx(folder / f"{name}_elu.onnx", folded, prednet_nodes(dims, True), ["N", 16], ["N", 1])
        quantize(folder, name)
    for seed, (name, channels) in enumerate(VOLUMENETS.items(), 200):
        weights, nodes = volumenet(channels, np.random.default_rng(seed))
        print(f"{name}: channels {channels}, {sum(v.size for v in weights.values())} parameters")
        save_file(weights, folder / f"{name}.safetensors")
        write_onnx(folder / f"{name}.onnx", weights, nodes, [1, 1, 128, 128, 128], [1, 2])
    # Written last: a file of inputs means that the networks exist.
    save_file(inputs, folder / "inputs.safetensors")


if __name__ == "__main__":
    main()
