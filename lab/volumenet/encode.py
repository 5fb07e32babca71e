"""Prints the features of volumes, one line each, comma-separated, as `entire encode` does.

    python encode.py --model ../../models/volumenet-64f2.safetensors VOLUME.nrrd ...
"""

import argparse
from pathlib import Path

import torch

from volumenet import load_model, network_input


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, required=True, help="model file with a VolumeNet")
    parser.add_argument("--double", action="store_true", help="compute in float64")
    parser.add_argument("volumes", type=Path, nargs="+", help="NRRD volumes")
    args = parser.parse_args()
    model = load_model(args.model, torch.float64 if args.double else torch.float32)
    for path in args.volumes:
        volume = network_input(path, model.size).to(torch.float64 if args.double else torch.float32)
        with torch.no_grad():
            features = model.encode(volume[None])[0]
        print(",".join(f"{value:.9g}" for value in features.tolist()))


if __name__ == "__main__":
    main()
