"""Draws middle slices of volumes above VolumeNet's reconstructions of them, as one PNG.

    python reconstruct.py --model ../../out/volumenet-128f2.safetensors --out slices.png VOLUME.nrrd ...
"""

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np
import torch

from volumenet import load_model, network_input


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, required=True, help="model file with VolumeNet's encoder and decoder")
    parser.add_argument("--out", type=Path, required=True, help="the picture to write")
    parser.add_argument("volumes", type=Path, nargs="+", help="NRRD volumes")
    args = parser.parse_args()
    model = load_model(args.model)
    columns = []
    for path in args.volumes:
        volume = network_input(path, model.size)
        with torch.no_grad():
            made = model(volume[None])[0]
        middle = model.size // 2
        columns.append(np.concatenate([v[0, middle].clamp(-1, 1).numpy() for v in (volume, made)]))
    plt.imsave(args.out, np.concatenate(columns, axis=1), cmap="gray", vmin=-1, vmax=1)


if __name__ == "__main__":
    main()
