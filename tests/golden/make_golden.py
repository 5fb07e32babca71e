#!/usr/bin/env python3
"""Writes the golden models beside this script: small model files, inputs, and float64 results.

usage: python make_golden.py        (needs torch and safetensors; the results are committed)

Weights are rounded to the format they are stored in before they are evaluated, so the numbers in golden.json hold for the
stored weights exactly. Seeds are fixed; the files change only with torch's random generator.
"""
import json
import pathlib

import torch
from safetensors.torch import save_file

HERE = pathlib.Path(__file__).resolve().parent
DTYPES = {"F32": torch.float32, "F16": torch.float16, "BF16": torch.bfloat16}


def groups(width):
    """Returns input groups with a total size of `width`."""
    if width == 16:
        sizes = {"volume_features": 2, "camera": 3, "resolution": 2, "transfer_function": 9}
    elif width == 24:
        sizes = {"scene_features": 23, "step_size": 1}
    else:
        sizes = {"scene_features": width}
    return [{"name": name, "size": size} for name, size in sizes.items()]


def selu(x):
    return torch.nn.functional.selu(x)


def prednet(name, dims, target, normalised, dtype, seed):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    tensors = {}
    for i, (inputs, outputs) in enumerate(zip(dims, dims[1:])):
        tensors[f"prednet.{i}.weight"] = (normal(outputs, inputs) / inputs**0.5).to(DTYPES[dtype])
        tensors[f"prednet.{i}.bias"] = (0.2 * normal(outputs) + (0.7 if i == len(dims) - 2 else 0)).float()
    x = normal(9, dims[0])
    if normalised:
        mean, std = 20 * normal(dims[0]), torch.exp(normal(dims[0]))
        tensors["prednet.input.mean"], tensors["prednet.input.std"] = mean.float(), std.float()
        tensors["prednet.output.mean"] = torch.tensor([-5.25])
        tensors["prednet.output.std"] = torch.tensor([1.5])
        x = x * std + mean
    x = x.float()
    y = x.double()
    if normalised:
        y = (y - tensors["prednet.input.mean"].double()) / tensors["prednet.input.std"].double()
    last = len(dims) - 2
    for i in range(last + 1):
        y = y @ tensors[f"prednet.{i}.weight"].double().T + tensors[f"prednet.{i}.bias"].double()
        y = y if i == last else selu(y)
    if normalised:
        y = y * tensors["prednet.output.std"].double() + tensors["prednet.output.mean"].double()
    y = torch.exp(y) if target == "log_seconds" else y
    layout = groups(dims[0])
    metadata = {"entire.format": "1", "entire.target": target, "entire.inputs": json.dumps(layout)}
    for group in layout:
        if group["name"] == "scene_features":
            metadata["entire.scene_features"] = json.dumps([f"feature_{i}" for i in range(group["size"])])
    save_file(tensors, HERE / f"{name}.safetensors", metadata=metadata)
    # Results near 0 come from sums that nearly cancel, and are useless for relative errors.
    scale = y.abs().max()
    keep = [i for i in range(len(y)) if y[i, 0].abs() > 0.02 * scale]
    return {
        "model": f"{name}.safetensors",
        "dtype": dtype,
        "dims": dims,
        "inputs": [x[i].tolist() for i in keep],
        "seconds": [y[i, 0].item() for i in keep],
    }


def volumenet(name, edge, blocks, features, dtype, seed):
    """Writes an encoder and its voxels, and returns its golden features.

    A block is (channels, kernel, stride, padding, bias)."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    voxels = (255 * uniform(edge, edge, edge) ** 2).round().to(torch.uint8)
    x = (voxels.double() / 255 * 2 - 1)[None, None]
    tensors, channels = {}, 1
    for i, (outputs, kernel, stride, padding, bias) in enumerate(blocks):
        key = f"volumenet.encoder.{i}"
        fan_in = channels * kernel**3
        tensors[f"{key}.conv.weight"] = (1.4 * normal(outputs, channels, kernel, kernel, kernel) / fan_in**0.5).to(DTYPES[dtype])
        if bias:
            tensors[f"{key}.conv.bias"] = (0.3 * normal(outputs)).to(DTYPES[dtype])
        tensors[f"{key}.bn.weight"] = (1 + 0.4 * normal(outputs)).float()
        tensors[f"{key}.bn.bias"] = (0.3 * normal(outputs)).float()
        tensors[f"{key}.bn.running_mean"] = (0.3 * normal(outputs)).float()
        tensors[f"{key}.bn.running_var"] = (0.2 + 1.5 * uniform(outputs)).float()
        tensors[f"{key}.bn.num_batches_tracked"] = torch.tensor(17)
        w = {k.removeprefix(key + "."): t.double() for k, t in tensors.items() if k.startswith(key + ".")}
        x = torch.nn.functional.conv3d(x, w["conv.weight"], w.get("conv.bias"), stride=stride, padding=padding)
        x = torch.nn.functional.batch_norm(
            x, w["bn.running_mean"], w["bn.running_var"], w["bn.weight"], w["bn.bias"], training=False, eps=1e-5
        )
        x, channels = selu(x), outputs
    flat = x.flatten(1)
    tensors["volumenet.fc.weight"] = (normal(features, flat.shape[1]) / flat.shape[1] ** 0.5).to(DTYPES[dtype])
    tensors["volumenet.fc.bias"] = (0.3 * normal(features)).to(DTYPES[dtype])
    y = flat @ tensors["volumenet.fc.weight"].double().T + tensors["volumenet.fc.bias"].double()
    # A tensor of the training decoder, which readers ignore.
    tensors["volumenet.decoder.0.weight"] = torch.zeros(2)
    layout = {"input": edge, "blocks": [{"stride": s, "padding": p} for _, _, s, p, _ in blocks]}
    save_file(tensors, HERE / f"{name}.safetensors", metadata={"entire.format": "1", "entire.volumenet": json.dumps(layout)})
    (HERE / f"{name}.raw").write_bytes(voxels.numpy().tobytes())
    return {
        "model": f"{name}.safetensors",
        "dtype": dtype,
        "voxels": f"{name}.raw",
        "edge": edge,
        "features": y[0].tolist(),
    }


def main():
    deep = [16] + [24] * 13 + [16, 1]
    result = {
        "prednets": [
            prednet("single_layer", [7, 1], "seconds", False, "F32", 1),
            prednet("odd_sizes", [13, 33, 17, 5, 1], "seconds", False, "F32", 2),
            prednet("two_by_64", [24, 64, 64, 1], "log_seconds", True, "F32", 3),
            prednet("halving_tail", [16, 64, 64, 32, 16, 1], "seconds", True, "F32", 4),
            prednet("deep_narrow", deep, "log_seconds", False, "F32", 5),
            prednet("panels_f16", [9, 112, 80, 48, 1], "log_seconds", True, "F16", 6),
            prednet("panels_bf16", [9, 112, 80, 48, 1], "seconds", True, "BF16", 6),
            prednet("wide_bf16", [16, 256, 48, 1], "log_seconds", True, "BF16", 7),
        ],
        "volumenets": [
            volumenet("volume16", 16, [(4, 3, 2, 1, True), (9, 3, 2, 1, True)], 2, "F32", 11),
            volumenet("volume16_kernels", 16, [(5, 5, 2, 2, False), (7, 2, 1, 0, True), (8, 3, 3, 1, False)], 3, "F16", 12),
            volumenet("volume32", 32, [(6, 3, 2, 1, False), (8, 3, 2, 1, False), (10, 3, 2, 1, False), (16, 3, 2, 1, False)], 2, "F32", 13),
            volumenet("volume16_bf16", 16, [(6, 4, 2, 1, True), (10, 4, 2, 1, True), (11, 3, 1, 1, True)], 4, "BF16", 14),
        ],
    }
    (HERE / "golden.json").write_text(json.dumps(result, indent=1) + "\n")


main()
