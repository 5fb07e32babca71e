"""Compares entire's PredNet trainer with PyTorch: both train in turns on the same frames, with the same initial
weights, settings and threads. Prints one `bar` line for the speed and one for the final loss; both are short without
PyTorch. Exit status 1 when a bar is short.

    python lab/scripts/bars_train.py --frames 100000 --preset 12C256
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bar_lines import Bars

ROOT = Path(__file__).resolve().parents[2]


def arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="12C256")
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--epochs", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=2, help="runs of each trainer; the fastest is compared")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    return parser.parse_args()


def train_torch(folder, widths, args):
    """Trains once in PyTorch; returns the seconds, and the mean loss of each epoch."""
    import numpy as np
    import torch
    from torch import nn

    torch.set_num_threads(args.threads)
    read = lambda name: torch.from_numpy(np.fromfile(folder / name, dtype="<f4").copy())  # noqa: E731
    inputs, targets = read("inputs.bin").reshape(-1, widths[0]), read("seconds.bin")
    flat = read("weights.bin")
    layers, at = [], 0
    for i, (a, b) in enumerate(zip(widths, widths[1:])):
        linear = nn.Linear(a, b)
        with torch.no_grad():
            linear.weight.copy_(flat[at : at + a * b].reshape(b, a))
            linear.bias.copy_(flat[at + a * b : at + a * b + b])
        at += a * b + b
        layers.append(linear)
        if i + 2 < len(widths):
            layers.append(nn.SELU(inplace=True))
    model = nn.Sequential(*layers)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-4, fused=True)
    steps = -(-len(targets) // args.batch) * args.epochs
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, eta_min=1e-6)
    generator = torch.Generator().manual_seed(1)
    losses = []
    started = time.perf_counter()
    for _ in range(args.epochs):
        order = torch.randperm(len(targets), generator=generator)
        total = 0.0
        for chosen in order.split(args.batch):
            optimizer.zero_grad(set_to_none=True)
            loss = nn.functional.mse_loss(model(inputs[chosen])[:, 0], targets[chosen])
            loss.backward()
            nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            optimizer.step()
            schedule.step()
            total += loss.item() * len(chosen)
        losses.append(total / len(targets))
    return time.perf_counter() - started, losses


def main():
    args = arguments()
    with Bars({"train_speed_over_pytorch": 1.0, "train_loss_over_pytorch": 1.1}, {"train_speed_over_pytorch"}) as bars:
        measure(args, bars)


def measure(args, bars):
    try:
        import numpy  # noqa: F401
        import torch
    except ImportError as error:
        sys.exit(f"{error}: pip install torch numpy, or name a Python that has them: make bars-train PYTHON=…")
    example = ["--package", "entire-cli", "--example", "train_speed", "--release"]
    subprocess.run(["cargo", "build", "--quiet", *example], cwd=ROOT, check=True)
    target = os.environ.get("CARGO_TARGET_DIR", ROOT / "target")
    program = Path(target) / "release" / "examples" / "train_speed"
    ours, theirs = [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = [program, folder, args.preset, args.frames, args.batch, args.epochs, args.threads]
        for turn in range(args.rounds):
            result = json.loads(subprocess.run([str(c) for c in command], check=True, capture_output=True).stdout)
            ours.append((result["seconds"], result["losses"][-1]))
            seconds, losses = train_torch(folder, result["widths"], args)
            theirs.append((seconds, losses[-1]))
            print(
                f"turn {turn + 1}: entire {ours[-1][0]:.2f} s, loss {ours[-1][1]:.5f}; "
                f"PyTorch {torch.__version__} {seconds:.2f} s, loss {losses[-1]:.5f}",
                flush=True,
            )
    samples = args.frames * args.epochs
    fastest, peer = min(ours)[0], min(theirs)[0]
    print(
        f"{args.preset}, {args.frames} frames, batch {args.batch}, {args.epochs} epochs, {args.threads} threads: "
        f"entire {samples / fastest:.0f} frames/s, PyTorch {samples / peer:.0f} frames/s"
    )
    bars.found("train_speed_over_pytorch", peer / fastest)
    bars.found("train_loss_over_pytorch", ours[-1][1] / theirs[-1][1])


if __name__ == "__main__":
    main()
