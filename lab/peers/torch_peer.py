# SPDX-License-Identifier: MIT OR Apache-2.0
"""PyTorch as a server (see pycommon.py). Variants: eager, jit, jitofi, fold, foldcl, bf16, compile."""
import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from pycommon import THREADS, get_input, serve, weights

torch.set_num_threads(THREADS)
torch.set_num_interop_threads(1)


def tensor(array):
    return torch.from_numpy(array.copy())


def dense(w, key):
    rows, columns = w[f"{key}.weight"].shape
    layer = nn.Linear(columns, rows)
    layer.weight.data, layer.bias.data = tensor(w[f"{key}.weight"]), tensor(w[f"{key}.bias"])
    return layer


def build(name):
    w = weights(name)
    modules = []
    if name.startswith("vol"):
        for i in range(6):
            k = f"c{i}"
            count, before = w[f"{k}.weight"].shape[:2]
            conv = nn.Conv3d(before, count, 3, stride=2, padding=1)
            conv.weight.data, conv.bias.data = tensor(w[f"{k}.weight"]), tensor(w[f"{k}.bias"])
            norm = nn.BatchNorm3d(count)
            norm.weight.data, norm.bias.data = tensor(w[f"{k}.bn.weight"]), tensor(w[f"{k}.bn.bias"])
            norm.running_mean, norm.running_var = tensor(w[f"{k}.bn.mean"]), tensor(w[f"{k}.bn.var"])
            modules += [conv, norm, nn.SELU()]
        modules += [nn.Flatten(), dense(w, "fc")]
    else:
        layers = sum(k.endswith(".weight") for k in w)
        for i in range(layers):
            modules.append(dense(w, f"l{i}"))
            if i < layers - 1:
                modules.append(nn.SELU())
    return nn.Sequential(*modules).eval()


def fold(model):
    """The model with batch normalization folded into the convolutions."""
    out, rest = [], list(model)
    while rest:
        module = rest.pop(0)
        out.append(fuse_conv_bn_eval(module, rest.pop(0)) if isinstance(module, nn.Conv3d) else module)
    return nn.Sequential(*out).eval()


def make(variant, name, batch):
    x = tensor(get_input(name, batch))
    model = build(name)
    for parameter in model.parameters():
        parameter.requires_grad_(False)
    if "bf16" in variant:
        model, x = fold(model).to(torch.bfloat16), x.to(torch.bfloat16)
    if "fold" in variant:
        model = fold(model)
    if "cl" in variant:
        model, x = model.to(memory_format=torch.channels_last_3d), x.to(memory_format=torch.channels_last_3d)
    if "jit" in variant:
        with torch.inference_mode():
            model = torch.jit.freeze(torch.jit.trace(model, x))
            model = torch.jit.optimize_for_inference(model) if "ofi" in variant else model
    if "compile" in variant:
        # Not `import torch._inductor.config`: that makes `torch` a local name, which is unbound in all other variants.
        from torch._inductor import config

        config.freezing = True
        model = torch.compile(model)
    # Freezing refuses tensors that were made in inference mode.
    mode = torch.no_grad if "compile" in variant else torch.inference_mode

    def call():
        with mode():
            return model(x)

    return call


serve(make)
