"""Writes toy.safetensors: a small model file with both networks, for examples and tests of the C library.

It is fitted to a formula: 2 ns per pixel and sample, and fewer samples for a longer step, a more opaque transfer
function and a more distant camera. No real device behaves like this; `entire train` makes models of real devices.

    python make.py toy.safetensors
"""

import json
import sys

import torch
from safetensors.torch import save_file

GROUPS = [("volume_features", 2), ("camera", 3), ("resolution", 2), ("transfer_function", 3), ("step_size", 1)]
HIDDEN = [24, 16]


def frames(count):
    rand = lambda low, high: low + (high - low) * torch.rand(count, 1)
    features = torch.randn(count, 2)
    rx, ry, dz = rand(-90, 90), rand(-180, 180), rand(1.2, 5.0)
    width, height = 2 ** rand(5, 10), 2 ** rand(5, 10)
    center, spread, height_ = rand(0, 1), rand(0.0005, 0.05), rand(0, 1)
    step = 2 ** rand(-1, 4)
    inputs = torch.cat([features, rx, ry, dz, width, height, center, spread, height_, step], 1)
    covered = (1.4 / dz).clamp(max=1.0) ** 2
    samples = 120 / step / (1 + 2 * height_) * (1 + 0.1 * features[:, :1])
    seconds = 2e-9 * width * height * covered * samples.clamp(min=1) + 1e-4
    return inputs, seconds.log()


def main():
    torch.manual_seed(3)
    x, y = frames(60000)
    mean, std = x.mean(0), x.std(0)
    y_mean, y_std = y.mean(), y.std()
    sizes = [sum(size for _, size in GROUPS), *HIDDEN, 1]
    layers = [torch.nn.Linear(a, b) for a, b in zip(sizes, sizes[1:])]
    for layer in layers:
        torch.nn.init.kaiming_normal_(layer.weight, nonlinearity="linear")
    net = torch.nn.Sequential(*[m for layer in layers for m in (layer, torch.nn.SELU())][:-1])
    optimizer = torch.optim.Adam(net.parameters(), 3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 2500)
    for _ in range(2500):
        pick = torch.randint(len(x), (1024,))
        loss = ((net((x[pick] - mean) / std) * y_std + y_mean - y[pick]) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    print("root mean square error of log seconds:", loss.sqrt().item(), file=sys.stderr)

    tensors = {}
    for i, layer in enumerate(layers):
        tensors[f"prednet.{i}.weight"] = layer.weight.detach()
        tensors[f"prednet.{i}.bias"] = layer.bias.detach()
    tensors["prednet.input.mean"], tensors["prednet.input.std"] = mean, std
    tensors["prednet.output.mean"], tensors["prednet.output.std"] = y_mean.reshape(1), y_std.reshape(1)
    channels = [1, 2, 4]
    for i, (a, b) in enumerate(zip(channels, channels[1:])):
        conv, norm = torch.nn.Conv3d(a, b, 3, 2, 1), torch.nn.BatchNorm3d(b)
        tensors[f"volumenet.encoder.{i}.conv.weight"] = conv.weight.detach()
        tensors[f"volumenet.encoder.{i}.conv.bias"] = conv.bias.detach()
        tensors[f"volumenet.encoder.{i}.bn.weight"] = norm.weight.detach()
        tensors[f"volumenet.encoder.{i}.bn.bias"] = norm.bias.detach()
        tensors[f"volumenet.encoder.{i}.bn.running_mean"] = norm.running_mean
        tensors[f"volumenet.encoder.{i}.bn.running_var"] = norm.running_var
    head = torch.nn.Linear(channels[-1] * 4**3, 2)
    tensors["volumenet.fc.weight"], tensors["volumenet.fc.bias"] = head.weight.detach(), head.bias.detach()
    metadata = {
        "entire.format": "1",
        "entire.inputs": json.dumps([{"name": name, "size": size} for name, size in GROUPS]),
        "entire.target": "log_seconds",
        "entire.volumenet": json.dumps({"input": 16, "blocks": [{"stride": 2, "padding": 1}] * 2}),
        "entire.renderer": "toy renderer of the C examples",
        "entire.device": "none: a formula",
        "entire.step_reference": "smallest voxel spacing",
        "entire.provenance": "tests/golden/toy_model/make.py",
    }
    save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, sys.argv[1], metadata=metadata)


main()
