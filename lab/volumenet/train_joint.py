"""Trains VolumeNet together with PredNet, with a loss of frame times (the paper's future work), and writes the encoder.

    python train_joint.py --frames ../../data/timings/none-train.csv.gz --data PATH --size 64 --features 2
    entire train --data ../../data/timings/none-train.csv.gz --volumenet ../../out/joint-64f2.safetensors \\
        --preset 12C256 --inputs volume_features,camera,resolution,transfer_function --out paper-joint.safetensors

Frames are rows of timing tables of `entire collect`; their volumes' paths are relative to --data. Each step takes some
volumes (--batch) and some frames of each (--frames-per-volume). The loss is the mean squared error of standardized ln
seconds plus --reconstruction times the mean squared error of the voxels. Early stopping uses the validation members.
PredNet is discarded: `entire train` trains the shipped one, with the encoder's features.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import gzip
import json
import math
import platform
import random
import statistics
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import torch
from torch import nn
from tqdm import tqdm

from volumenet import DEFAULT_CHANNELS, VolumeNet, card, load_model, network_input, save_model

HERE = Path(__file__).resolve().parent
LOBES = 3


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=Path, nargs="+", required=True, help="timing tables (.csv or .csv.gz)")
    parser.add_argument("--data", type=Path, default=HERE.parent.parent / "data", help="folder that the volumes' paths start from")
    parser.add_argument("--out", type=Path, help="model file (default: out/joint-<size>f<features>.safetensors)")
    parser.add_argument("--volumenet", type=Path, help="start from this encoder (its size and features)")
    parser.add_argument("--size", type=int, default=64, help="input side (default 64)")
    parser.add_argument("--features", type=int, default=2, help="length F of the feature vector (default 2)")
    parser.add_argument("--layers", type=int, default=4, help="hidden layers of PredNet, each 256 wide (default 4)")
    parser.add_argument("--clock", choices=("cpu", "wall", "device"), default="cpu", help="clock of the frame times")
    parser.add_argument("--reconstruction", type=float, default=1.0, help="weight of the reconstruction loss (default 1)")
    parser.add_argument("--steps", type=int, default=1500, help="optimizer steps at most")
    parser.add_argument("--batch", type=int, default=8, help="volumes per step")
    parser.add_argument("--frames-per-volume", type=int, default=32, help="frames of each volume per step")
    parser.add_argument("--lr", type=float, default=1e-3, help="first learning rate; falls to 1/100 by a half cosine")
    parser.add_argument("--clip", type=float, default=1.0, help="largest gradient norm")
    parser.add_argument("--judge-every", type=int, default=50, help="steps between evaluations on the validation frames")
    parser.add_argument("--patience", type=int, default=10, help="evaluations without a better validation loss before stopping")
    parser.add_argument("--val-members", type=lambda s: s.split(","), help="dataset/member,... (default: a tenth)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--dtype", choices=("f32", "f16", "bf16"), default="f16", help="how weights are stored")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, help="CPU threads")
    return parser.parse_args()


def frames_of(tables: list[Path], clock: str) -> dict[str, list[tuple[list[float], float]]]:
    """Frames by volume: inputs (camera, resolution, transfer function), and ln of the median seconds of the repeats."""
    repeats: dict[tuple, list[float]] = defaultdict(list)
    inputs: dict[tuple, tuple[str, list[float]]] = {}
    for table in tables:
        opened = gzip.open(table, "rt") if table.suffix == ".gz" else open(table)
        with opened as file:
            for number, row in enumerate(csv.DictReader(file), start=2):
                seconds = row[f"seconds_{clock}"]
                if not seconds:
                    sys.exit(f"{table}, line {number}: no seconds_{clock}; take another --clock")
                lobes = [[float(x) for x in lobe.split()] for lobe in row["tf"].split(";")]
                if len(lobes) > LOBES or any(len(lobe) != 3 for lobe in lobes):
                    sys.exit(f"{table}, line {number}: the transfer function is not of at most {LOBES} Gaussian lobes")
                lobes = sorted(lobes) + [[0.0, 0.0, 0.0]] * (LOBES - len(lobes))
                pixels = [math.log(float(row["width_px"])), math.log(float(row["height_px"]))]
                turn = [math.radians(float(row[f"camera_{a}_deg"])) for a in ("rx", "ry")]
                camera = [f(a) for a in turn for f in (math.sin, math.cos)] + [float(row["camera_dz_radii"])]
                shape = [x for mean, peak, width in lobes for x in (mean, math.log(peak + 1e-6), math.log(width + 1e-6))]
                key = (str(table), row["volume"], row["frame"])
                repeats[key].append(float(seconds))
                inputs[key] = (row["volume"], camera + pixels + shape)
    found: dict[str, list] = defaultdict(list)
    for key, seconds in repeats.items():
        volume, values = inputs[key]
        found[volume].append((values, math.log(statistics.median(seconds))))
    return found


def member_of(volume: str) -> str:
    """`dataset/member` of `…/dataset/member/file`."""
    return "/".join(Path(volume).parts[-3:-1])


def main() -> None:
    args = options()
    if args.threads:
        torch.set_num_threads(args.threads)
    torch.manual_seed(args.seed)
    chooser = random.Random(args.seed)
    by_volume = frames_of(args.frames, args.clock)
    members = sorted({member_of(v) for v in by_volume})
    if args.val_members is None:
        args.val_members = chooser.sample(members, max(1, round(len(members) / 10)))
    unknown = set(args.val_members) - set(members)
    if unknown:
        sys.exit(f"no frames of {', '.join(sorted(unknown))}; found: {', '.join(members)}")
    parts = {"train": [], "validation": []}
    for volume in sorted(by_volume):
        parts["validation" if member_of(volume) in args.val_members else "train"].append(volume)
    if not parts["train"]:
        sys.exit("no volume is left for training; name fewer members in --val-members")

    start = load_model(args.volumenet) if args.volumenet else None
    if start is not None:
        args.size, args.features = start.size, start.features
    if args.out is None:
        args.out = HERE.parent.parent / "out" / f"joint-{args.size}f{args.features}.safetensors"
    channels = start.channels if start is not None else DEFAULT_CHANNELS
    model = VolumeNet(args.size, args.features, channels)
    if start is not None:
        model.load_state_dict(start.state_dict())
    model = model.to(args.device, memory_format=torch.channels_last_3d)
    grids, frames, times = {}, {}, {}
    for volume in tqdm(sorted(by_volume), desc="reading", leave=False):
        path = args.data / volume
        if not path.exists():
            sys.exit(f"{path} is missing; say with --data where the paths of the tables start")
        grids[volume] = network_input(path, args.size)
        frames[volume] = torch.tensor([x for x, _ in by_volume[volume]], dtype=torch.float32)
        times[volume] = torch.tensor([t for _, t in by_volume[volume]], dtype=torch.float32)
    x = torch.cat([frames[v] for v in parts["train"]])
    t = torch.cat([times[v] for v in parts["train"]])
    mean, sd, t_mean, t_sd = x.mean(0), x.std(0).clamp_min(1e-6), t.mean(), t.std()

    widths = [x.shape[1] + args.features] + [256] * args.layers
    layers = [m for a, b in zip(widths, widths[1:]) for m in (nn.Linear(a, b), nn.SELU())]
    prednet = nn.Sequential(*layers, nn.Linear(256, 1)).to(args.device)
    weights = [*model.parameters(), *prednet.parameters()]
    optimizer = torch.optim.Adam(weights, lr=args.lr)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.steps, eta_min=args.lr / 100)

    def time_error(codes: torch.Tensor, rows: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        taken = torch.cat([codes, ((rows - mean) / sd).to(args.device)], dim=1)
        return ((prednet(taken)[:, 0] - ((target - t_mean) / t_sd).to(args.device)) ** 2).mean()

    @torch.no_grad()
    def judge(part: str) -> float:
        """Standard deviation of the error of ln seconds over a part's frames."""
        model.eval()
        total = count = 0.0
        for volume in parts[part]:
            code = model.encode(grids[volume][None].to(args.device))
            total += float(time_error(code.expand(len(frames[volume]), -1), frames[volume], times[volume])) * len(frames[volume])
            count += len(frames[volume])
        return math.sqrt(total / count) * float(t_sd)

    judged = "validation" if parts["validation"] else "train"
    best, best_state, best_step, history = math.inf, None, 0, []
    started, why = time.monotonic(), f"all {args.steps} steps done"
    bar = tqdm(range(1, args.steps + 1), unit="step")
    try:
        for step in bar:
            model.train()
            volumes = chooser.sample(parts["train"], min(args.batch, len(parts["train"])))
            batch = torch.stack([grids[v] for v in volumes]).to(args.device, memory_format=torch.channels_last_3d)
            codes = model.encode(batch)
            rows = [torch.randint(len(frames[v]), (args.frames_per_volume,)) for v in volumes]
            loss = time_error(
                codes.repeat_interleave(args.frames_per_volume, 0),
                torch.cat([frames[v][r] for v, r in zip(volumes, rows)]),
                torch.cat([times[v][r] for v, r in zip(volumes, rows)]),
            )
            if args.reconstruction > 0.0:
                loss = loss + args.reconstruction * nn.functional.mse_loss(model.decode(codes), batch)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(weights, args.clip)
            optimizer.step()
            schedule.step()
            if step % args.judge_every == 0 or step == args.steps:
                now = {"step": step, "train": judge("train"), judged: judge(judged)}
                history.append(now)
                if now[judged] < best:
                    best, best_step = now[judged], step
                    best_state = {k: v.detach().clone() for k, v in model.state_dict().items()}
                bar.set_postfix(train=f"{now['train']:.3f}", val=f"{now[judged]:.3f}", best=f"{best:.3f}")
                if (step - best_step) // args.judge_every >= args.patience:
                    why = f"early stop: no better {judged} loss in {args.patience} looks"
                    break
    except KeyboardInterrupt:
        why = "interrupted"
        print("\nstopping; the best weights so far are kept", file=sys.stderr)
    bar.close()
    if best_state is None:
        sys.exit("stopped before the first evaluation on the validation frames; nothing was written")
    model.load_state_dict(best_state)
    model.eval()

    psnr = {}
    with torch.no_grad():
        for part, volumes in parts.items():
            by_dataset = defaultdict(list)
            for volume in volumes:
                grid = grids[volume][None].to(args.device)
                error = float(((model(grid) - grid) ** 2).mean())
                by_dataset[member_of(volume).split("/")[0]].append(10.0 * math.log10(4.0 / max(error, 1e-12)))
            psnr[part] = {d: round(float(np.mean(v)), 2) for d, v in sorted(by_dataset.items())}
    provenance = {
        "what": f"VolumeNet trained jointly with a PredNet of {args.layers} x 256 on ln seconds, plus {args.reconstruction:g} x reconstruction loss",
        "paper": "ENTIRE: Learning-based Volume Rendering Time Prediction",
        "data_sha256": "-",
        "tables": [p.name for p in args.frames],
        "members": {part: sorted({member_of(v) for v in volumes}) for part, volumes in parts.items()},
        "volumes": {part: len(volumes) for part, volumes in parts.items()},
        "channels": list(channels),
        "settings": {
            "batch": f"{args.batch} volumes x {args.frames_per_volume} frames",
            "optimizer": "Adam(0.9, 0.999)",
            "learning_rate": [args.lr, args.lr / 100],
            "schedule": f"cosine over {args.steps} steps",
            "clip_norm": args.clip,
            "patience": args.patience,
            "seed": args.seed,
        },
        "epochs_run": history[-1]["step"],
        "best_epoch": best_step,
        "error_ln_seconds": {judged: round(best, 4)},
        "stopped": why,
        "psnr_db": psnr,
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads, {args.device}, torch {torch.__version__}",
        "date": datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%d"),
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    dtype = {"f32": torch.float32, "f16": torch.float16, "bf16": torch.bfloat16}[args.dtype]
    save_model(model, args.out, dtype, provenance, encoder_only=True)
    args.out.with_suffix(".md").write_text(
        card(args.out.stem, model, provenance, args.dtype, True).replace(" epochs (", " steps (").replace("those of epoch", "those of step")
    )
    args.out.with_suffix(".json").write_text(
        json.dumps({"provenance": provenance, "history": history, "seconds": round(time.monotonic() - started, 1)}, indent=1) + "\n"
    )
    print(f"{why}; best step {best_step}: error of ln seconds {best:.3f} ({judged}); wrote {args.out}")


if __name__ == "__main__":
    main()
