"""VolumeNet: the convolutional autoencoder whose encoder turns a volume into its feature vector.

The encoder is six blocks of Conv3d (kernel 3, stride 2, padding 1), batch normalization and SELU, then one fully
connected layer; the decoder mirrors it with transposed convolutions. Input volumes are floats in [-1, 1], in the layout
(batch, 1, z, y, x).
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import nrrd
import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import nn

# The paper's figure gives the channels only as a picture; these are this project's choice.
DEFAULT_CHANNELS = (8, 16, 32, 64, 128, 256)


class EncoderBlock(nn.Module):
    """Conv3d(k3, s2, p1) + BatchNorm3d + SELU: halves every side."""

    def __init__(self, channels_in: int, channels_out: int):
        super().__init__()
        self.conv = nn.Conv3d(channels_in, channels_out, kernel_size=3, stride=2, padding=1)
        self.bn = nn.BatchNorm3d(channels_out, eps=1e-5)
        self.activation = nn.SELU()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.activation(self.bn(self.conv(x)))


class DecoderBlock(nn.Module):
    """ConvTranspose3d(k3, s2, p1, output padding 1), doubling every side; then BatchNorm3d + SELU unless it is the last."""

    def __init__(self, channels_in: int, channels_out: int, last: bool):
        super().__init__()
        self.conv = nn.ConvTranspose3d(
            channels_in, channels_out, kernel_size=3, stride=2, padding=1, output_padding=1
        )
        self.bn = nn.Identity() if last else nn.BatchNorm3d(channels_out, eps=1e-5)
        self.activation = nn.Identity() if last else nn.SELU()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.activation(self.bn(self.conv(x)))


class VolumeNet(nn.Module):
    """The autoencoder. `size` is the input's side (a multiple of 2^blocks), `features` the length of the code."""

    def __init__(self, size: int = 128, features: int = 2, channels: tuple[int, ...] = DEFAULT_CHANNELS):
        super().__init__()
        if size % 2 ** len(channels):
            raise ValueError(
                f"input size is {size}; with {len(channels)} blocks it must be a multiple of {2 ** len(channels)}"
            )
        if features < 1 or not channels or min(channels) < 1:
            raise ValueError("features and every channel count must be at least 1")
        self.size, self.features, self.channels = size, features, tuple(channels)
        widths = (1, *channels)
        self.encoder = nn.ModuleList(EncoderBlock(a, b) for a, b in zip(widths, widths[1:]))
        self.coarse = (channels[-1], *(size // 2 ** len(channels),) * 3)
        flat = math.prod(self.coarse)
        self.fc = nn.Linear(flat, features)
        self.decoder = nn.ModuleDict(
            {
                "fc": nn.Linear(features, flat),
                "blocks": nn.ModuleList(
                    DecoderBlock(b, a, last=i == len(channels) - 1)
                    for i, (a, b) in enumerate(reversed(list(zip(widths, widths[1:]))))
                ),
            }
        )

    def encode(self, volumes: torch.Tensor) -> torch.Tensor:
        """(B, 1, size, size, size) in [-1, 1] -> (B, features)."""
        for block in self.encoder:
            volumes = block(volumes)
        return self.fc(volumes.flatten(1))

    def decode(self, codes: torch.Tensor) -> torch.Tensor:
        """(B, features) -> (B, 1, size, size, size); not clamped."""
        x = self.decoder["fc"](codes).unflatten(1, self.coarse)
        for block in self.decoder["blocks"]:
            x = block(x)
        return x

    def forward(self, volumes: torch.Tensor) -> torch.Tensor:
        return self.decode(self.encode(volumes))


def _axis_weights(source: int, target: int) -> np.ndarray:
    """(target, source) matrix: exact area average when shrinking, linear between voxel centers when growing."""
    weights = np.zeros((target, source))
    ratio = source / target
    for i in range(target):
        if target < source:
            low, high = i * ratio, (i + 1) * ratio
            for j in range(int(low), min(int(math.ceil(high)), source)):
                weights[i, j] = max(0.0, min(high, j + 1) - max(low, j)) / ratio
        else:
            position = min(max((i + 0.5) * ratio - 0.5, 0.0), source - 1.0)
            j = min(int(position), source - 1)
            t = position - j
            weights[i, j] += 1.0 - t
            if t > 0.0:
                weights[i, j + 1] += t
    return weights


def resample(volume: np.ndarray, size: int) -> np.ndarray:
    """(z, y, x) of any sides -> (size, size, size), each axis by itself: area average down, linear up."""
    out = volume.astype(np.float64)
    for axis in range(3):
        if out.shape[axis] != size:
            weights = _axis_weights(out.shape[axis], size)
            out = np.moveaxis(np.tensordot(weights, out, axes=(1, axis)), 0, axis)
    return out


def read_volume(path: Path, scalar_range: tuple[float, float] | None = None) -> np.ndarray:
    """An NRRD file (.nrrd, .nhdr) as (z, y, x) in [0, 1].

    The range maps to 0..1: the given range, else 0..255 for unsigned bytes, else the finite minimum and maximum. Values
    outside of the range are clamped, NaN becomes 0.
    """
    data, _ = nrrd.read(str(path), index_order="C")
    if data.ndim != 3:
        raise ValueError(f"{path} has {data.ndim} dimensions; a scalar volume with 3 is needed")
    if scalar_range is None:
        if data.dtype == np.uint8:
            scalar_range = (0.0, 255.0)
        else:
            finite = data[np.isfinite(data)]
            scalar_range = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    low, high = scalar_range
    values = data.astype(np.float64)
    values = (values - low) / (high - low) if high > low else np.zeros_like(values)
    return np.clip(np.nan_to_num(values, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)


def network_input(path: Path, size: int, scalar_range: tuple[float, float] | None = None) -> torch.Tensor:
    """A volume file in the form of the network's input: (1, size, size, size) float32 in [-1, 1]."""
    return torch.from_numpy((resample(read_volume(path, scalar_range), size) * 2.0 - 1.0).astype(np.float32))[None]


def save_model(
    model: VolumeNet, path: Path, dtype: torch.dtype, provenance: dict, encoder_only: bool = False
) -> None:
    """Writes encoder, code layer and (unless `encoder_only`) decoder as one model file."""
    tensors: dict[str, torch.Tensor] = {}
    for name, value in model.state_dict().items():
        if name.endswith("num_batches_tracked") or (encoder_only and name.startswith("decoder.")):
            continue
        tensors["volumenet." + name] = value.detach().to("cpu", dtype).contiguous()
    for name, value in tensors.items():
        if not torch.isfinite(value).all():
            raise ValueError(f"{name} is not finite as {dtype}; the file was not written")
    metadata = {
        "entire.format": "1",
        "entire.volumenet": json.dumps(
            {"input": model.size, "blocks": [{"stride": 2, "padding": 1} for _ in model.channels]}
        ),
        "entire.provenance": json.dumps(provenance),
    }
    part = path.with_suffix(path.suffix + ".part")
    save_file(tensors, str(part), metadata=metadata)
    part.chmod(0o644)
    part.replace(path)


def load_model(path: Path, dtype: torch.dtype = torch.float32) -> VolumeNet:
    """Reads a model file that holds a VolumeNet written by `save_model`, ready to encode (and decode)."""
    with safe_open(str(path), framework="pt") as file:
        metadata = file.metadata() or {}
        tensors = {
            name.removeprefix("volumenet."): file.get_tensor(name)
            for name in file.keys()
            if name.startswith("volumenet.")
        }
    if metadata.get("entire.format") != "1" or "entire.volumenet" not in metadata:
        raise ValueError(f"{path} holds no VolumeNet of model-file format 1")
    described = json.loads(metadata["entire.volumenet"])
    channels = tuple(tensors[f"encoder.{i}.conv.weight"].shape[0] for i in range(len(described["blocks"])))
    model = VolumeNet(described["input"], tensors["fc.weight"].shape[0], channels)
    missing, unexpected = model.load_state_dict({k: v.float() for k, v in tensors.items()}, strict=False)
    missing = [m for m in missing if not m.endswith("num_batches_tracked") and not m.startswith("decoder.")]
    if missing or unexpected:
        raise ValueError(f"{path}: missing tensors {missing}, unknown tensors {unexpected}")
    return model.to(dtype).eval()


@dataclass(frozen=True)
class VolumeFile:
    """A volume on disk with its `dataset/member`, from its folders."""

    path: Path
    dataset: str
    member: str


def find_volumes(root: Path, datasets: list[str] | None = None) -> list[VolumeFile]:
    """All NRRD files under `root`, sorted.

    `root/A/B/file` belongs to dataset A, member A/B; `root/A/file` to dataset A, member A/file; `root/file` is a
    dataset and member of its own.
    """
    found = []
    for path in sorted(p for p in root.rglob("*") if p.suffix in (".nrrd", ".nhdr") and p.is_file()):
        parts = path.relative_to(root).parts
        dataset = parts[0] if len(parts) > 1 else path.stem
        member = "/".join(parts[:2]) if len(parts) > 2 else "/".join((*parts[:-1], path.stem))
        if datasets is None or dataset in datasets:
            found.append(VolumeFile(path, dataset, member))
    return found


def card(name: str, model: VolumeNet, provenance: dict, dtype: str, encoder_only: bool) -> str:
    """The model card, in Markdown."""
    settings, members, psnr = provenance["settings"], provenance["members"], provenance["psnr_db"]
    datasets = sorted({d for part in psnr.values() for d in part})
    rows = "\n".join(
        f"| {d} | " + " | ".join(f"{psnr[p][d]:.2f}" if d in psnr[p] else "-" for p in psnr) + " |" for d in datasets
    )
    split = "\n".join(
        f"- {part}: {provenance['volumes'][part]} volumes of {', '.join(names) if names else 'no member'}"
        for part, names in members.items()
    )
    return f"""# {name}

VolumeNet: turns a volume into {model.features} features (PredNet's input group `volume_features`). Input {model.size}^3,
channels 1-{"-".join(map(str, model.channels))}, weights stored as {dtype.upper()}{", encoder only" if encoder_only else ", decoder included"}.

## Use

```
entire encode --model {name}.safetensors VOLUME
entire train --data FRAMES.csv --out MODEL.safetensors --volumenet {name}.safetensors --inputs volume_features,camera,resolution,transfer_function
```

## Data and split

By {"single volume" if provenance.get("split_by") == "volume" else "ensemble member"}. SHA-256 of all files in order: `{provenance["data_sha256"]}`.

{split}

## Training

{provenance["what"]} (paper: {provenance["paper"]}), {settings["optimizer"]}, batch {settings["batch"]}, learning rate
{settings["learning_rate"][0]:g} to {settings["learning_rate"][1]:g}, {settings["schedule"]}, gradients clipped at norm {settings["clip_norm"]:g}, seed {settings["seed"]}.
Ran {provenance["epochs_run"]} epochs ({provenance["stopped"]}); the weights are those of epoch {provenance["best_epoch"]}, the lowest validation loss.
Machine: {provenance["machine"]}; {provenance["date"]}.

## Reconstruction, PSNR in dB (mean over volumes)

| dataset | {" | ".join(psnr)} |
|---|{"---|" * len(psnr)}
{rows}

## Limits

{model.features} numbers describe a volume coarsely: they tell members and time steps of the training ensembles apart, and say
little about volumes of another kind. Validation and test volumes reconstruct worse than training volumes where the
ensemble has few members.
"""
