"""Trains VolumeNet on every NRRD volume under a folder and writes a model file that `entire` reads.

    python train_volumenet.py                                    # the volumes in ../../data, 128^3, F = 2
    python train_volumenet.py --data PATH --size 64 --features 4 --out ../../out/volumenet-64f4.safetensors

Adam with a cosine learning rate 1e-3 -> 1e-5, batch 16, gradient clipping at norm 1, early stopping on the validation
volumes' reconstruction error, split by ensemble member. Ctrl-C keeps the best network so far; `--resume` continues from
the last checkpoint.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import json
import platform
import random
import signal
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import torch
from torch import nn
from tqdm import tqdm

from volumenet import DEFAULT_CHANNELS, VolumeFile, VolumeNet, card, find_volumes, network_input, save_model

HERE = Path(__file__).resolve().parent


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=HERE.parent.parent / "data", help="folder with volumes")
    parser.add_argument("--datasets", type=lambda s: s.split(","), help="only these first-level folders")
    parser.add_argument("--out", type=Path, help="model file (default: out/volumenet-<size>f<features>.safetensors)")
    parser.add_argument("--size", type=int, default=128, help="input side (default 128)")
    parser.add_argument("--features", type=int, default=2, help="length F of the feature vector (default 2)")
    parser.add_argument(
        "--channels",
        type=lambda s: tuple(int(c) for c in s.split(",")),
        default=DEFAULT_CHANNELS,
        help="output channels of the blocks (default 8,16,32,64,128,256)",
    )
    parser.add_argument("--epochs", type=int, default=200)
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--lr", type=float, default=1e-3, help="first learning rate")
    parser.add_argument("--lr-final", type=float, default=1e-5, help="last learning rate")
    parser.add_argument("--clip", type=float, default=1.0, help="largest gradient norm")
    parser.add_argument("--patience", type=int, default=40, help="epochs without a better validation loss before stopping")
    parser.add_argument("--minutes", type=float, help="stop after this many minutes and keep the best weights")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--split",
        choices=("member", "volume"),
        default="member",
        help="keep members whole (default), or split 80/10/10 by volume, as the paper does for MAESTROeX",
    )
    parser.add_argument("--val-members", type=lambda s: s.split(","), help="dataset/member,... for validation")
    parser.add_argument("--test-members", type=lambda s: s.split(","), help="dataset/member,... for testing")
    parser.add_argument(
        "--parts",
        type=Path,
        metavar="JSON",
        help='JSON file of the split: {"train": [...], "validation": [...], "test": [...]} of dataset/member/file',
    )
    parser.add_argument("--dtype", choices=("f32", "f16", "bf16"), default="f16", help="how weights are stored")
    parser.add_argument("--encoder-only", action="store_true", help="leave the decoder out of the model file")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, help="CPU threads")
    parser.add_argument("--resume", action="store_true", help="continue from the checkpoint beside the model file")
    args = parser.parse_args()
    for name in ("size", "features", "epochs", "batch", "patience"):
        if getattr(args, name) < 1:
            parser.error(f"--{name} must be at least 1")
    if args.out is None:
        args.out = HERE.parent.parent / "out" / f"volumenet-{args.size}f{args.features}.safetensors"
    return args


def split(files: list[VolumeFile], args: argparse.Namespace) -> dict[str, list[VolumeFile]]:
    """Training, validation and test volumes; a member is split only with --split volume or --parts."""
    if args.parts:
        if args.test_members or args.val_members:
            sys.exit("--val-members and --test-members do not go with --parts")
        named = json.loads(args.parts.read_text())
        by_name = {f"{f.member}/{f.path.name}": f for f in files}
        parts = {}
        for name in ("train", "validation", "test"):
            missing = [v for v in named.get(name, []) if v not in by_name]
            if missing:
                sys.exit(f"{args.parts}: {name} names {missing[0]}, which is not under {args.data}")
            parts[name] = [by_name[v] for v in named.get(name, [])]
        if not parts["train"]:
            sys.exit(f"{args.parts} names no volume for training")
        return parts
    if args.split == "volume":
        if args.test_members or args.val_members:
            sys.exit("--val-members and --test-members go with --split member")
        shuffled = files[:]
        random.Random(args.seed).shuffle(shuffled)
        tenth = round(len(files) / 10)
        parts = {"train": shuffled[2 * tenth :], "validation": shuffled[tenth : 2 * tenth], "test": shuffled[:tenth]}
        return {name: sorted(part, key=lambda f: f.path) for name, part in parts.items()}
    members = sorted({f.member for f in files})
    for name in (args.val_members or []) + (args.test_members or []):
        if name not in members:
            sys.exit(f"member {name!r} is not there; found: {', '.join(members)}")
    test, val = set(args.test_members or []), set(args.val_members or [])
    if args.test_members is None and args.val_members is None:
        shuffled = members[:]
        random.Random(args.seed).shuffle(shuffled)
        tenth = max(1, round(len(members) / 10)) if len(members) >= 3 else 0
        test, val = set(shuffled[:tenth]), set(shuffled[tenth : 2 * tenth])
    parts = {"train": [], "validation": [], "test": []}
    for file in files:
        part = "test" if file.member in test else "validation" if file.member in val else "train"
        parts[part].append(file)
    if not parts["train"]:
        sys.exit("no volume is left for training; name fewer members in --val-members and --test-members")
    return parts


@torch.no_grad()
def reconstruction(model: VolumeNet, volumes: torch.Tensor, batch: int) -> np.ndarray:
    """Mean squared error of each volume in [-1, 1] units, evaluation mode."""
    model.eval()
    errors = []
    for i in range(0, len(volumes), batch):
        x = volumes[i : i + batch].to(memory_format=torch.channels_last_3d)
        errors.append(((model(x) - x) ** 2).mean(dim=(1, 2, 3, 4)).cpu().numpy())
    return np.concatenate(errors) if errors else np.zeros(0)


def psnr(errors: np.ndarray) -> float:
    """Mean over volumes of the peak signal-to-noise ratio, dB; the peak-to-peak range of the data is 2."""
    return float(np.mean(10.0 * np.log10(4.0 / np.maximum(errors, 1e-12))))


def main() -> None:
    args = options()
    if args.threads:
        torch.set_num_threads(args.threads)
    torch.manual_seed(args.seed)
    torch.backends.cudnn.benchmark = True
    files = find_volumes(args.data, args.datasets)
    if not files:
        sys.exit(f"no .nrrd or .nhdr file under {args.data}; name a folder with --data")
    parts = split(files, args)
    digest = hashlib.sha256()
    tensors = {}
    for name, members in parts.items():
        tensors[name] = torch.zeros((len(members), 1, args.size, args.size, args.size))
        for i, file in enumerate(tqdm(members, desc=f"reading {name}", leave=False)):
            digest.update(file.path.read_bytes())
            tensors[name][i] = network_input(file.path, args.size)
        tensors[name] = tensors[name].to(args.device)
    print(", ".join(f"{len(v)} {k} volumes" for k, v in parts.items()))

    model = VolumeNet(args.size, args.features, args.channels).to(args.device, memory_format=torch.channels_last_3d)
    optimizer = torch.optim.Adam(model.parameters(), lr=args.lr, betas=(0.9, 0.999))
    batches = -(-len(parts["train"]) // args.batch)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.epochs * batches, eta_min=args.lr_final)
    loss_function = nn.MSELoss()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    checkpoint = args.out.with_suffix(".checkpoint.pt")
    best_state, best_loss, best_epoch, first_epoch = None, float("inf"), -1, 0
    history: list[dict] = []
    if args.resume and checkpoint.exists():
        saved = torch.load(checkpoint, map_location=args.device, weights_only=True)
        model.load_state_dict(saved["model"])
        optimizer.load_state_dict(saved["optimizer"])
        schedule.load_state_dict(saved["schedule"])
        best_state, best_loss, best_epoch = saved["best_state"], saved["best_loss"], saved["best_epoch"]
        first_epoch, history = saved["epoch"] + 1, saved["history"]
        print(f"resuming after epoch {first_epoch}")

    stop = {"now": False}

    def on_signal(_number, _frame):
        if stop["now"]:
            raise KeyboardInterrupt
        stop["now"] = True
        print("\nstopping after this batch; the best weights so far are kept", file=sys.stderr)

    signal.signal(signal.SIGINT, on_signal)
    signal.signal(signal.SIGTERM, on_signal)

    # Without validation volumes the training loss decides.
    judged = "validation" if len(parts["validation"]) else "train"
    started, why = time.monotonic(), f"all {args.epochs} epochs done"
    bar = tqdm(range(first_epoch, args.epochs), initial=first_epoch, total=args.epochs, unit="epoch")
    for epoch in bar:
        generator = torch.Generator().manual_seed(args.seed * 100_003 + epoch)
        order = torch.randperm(len(parts["train"]), generator=generator).to(args.device)
        model.train()
        total = 0.0
        for i in range(0, len(order), args.batch):
            chosen = order[i : i + args.batch]
            if len(chosen) == 1 and len(order) > 1 and args.size == 2 ** len(args.channels):
                break  # batch normalization needs more than one value per channel
            x = tensors["train"][chosen].to(memory_format=torch.channels_last_3d)
            optimizer.zero_grad(set_to_none=True)
            loss = loss_function(model(x), x)
            loss.backward()
            nn.utils.clip_grad_norm_(model.parameters(), args.clip)
            optimizer.step()
            schedule.step()
            total += loss.item() * len(chosen)
            if stop["now"]:
                break
        if stop["now"]:
            why = f"interrupted in epoch {epoch + 1}"
            break
        judged_loss = float(reconstruction(model, tensors[judged], args.batch).mean())
        history.append({"epoch": epoch + 1, "train": total / len(order), judged: judged_loss})
        if judged_loss < best_loss:
            best_loss, best_epoch = judged_loss, epoch
            best_state = {k: v.detach().clone() for k, v in model.state_dict().items()}
        bar.set_postfix(train=f"{total / len(order):.5f}", val=f"{judged_loss:.5f}", best=f"{best_loss:.5f}")
        part = checkpoint.with_suffix(".part")
        torch.save(
            {
                "model": model.state_dict(),
                "optimizer": optimizer.state_dict(),
                "schedule": schedule.state_dict(),
                "best_state": best_state,
                "best_loss": best_loss,
                "best_epoch": best_epoch,
                "epoch": epoch,
                "history": history,
            },
            part,
        )
        part.replace(checkpoint)
        if epoch - best_epoch >= args.patience:
            why = f"early stop: no better {judged} loss in {args.patience} epochs"
            break
        if args.minutes and time.monotonic() - started > 60 * args.minutes:
            why = f"time limit of {args.minutes} minutes"
            break
    bar.close()
    if best_state is None:
        sys.exit("stopped before the first epoch was over; nothing was written")

    model.load_state_dict(best_state)
    results = {}
    for name, members in parts.items():
        errors = reconstruction(model, tensors[name], args.batch)
        by_dataset = defaultdict(list)
        for file, error in zip(members, errors):
            by_dataset[file.dataset].append(error)
        results[name] = {d: round(psnr(np.array(e)), 2) for d, e in sorted(by_dataset.items())}
    seconds = time.monotonic() - started
    provenance = {
        "what": "VolumeNet autoencoder, reconstruction loss",
        "paper": "ENTIRE: Learning-based Volume Rendering Time Prediction",
        "data_sha256": digest.hexdigest(),
        "members": {name: sorted({f.member for f in members}) for name, members in parts.items()},
        "volumes": {name: len(members) for name, members in parts.items()},
        "files": {name: [f"{f.member}/{f.path.name}" for f in found] for name, found in parts.items()},
        "split_by": "volume" if args.parts else args.split,
        "channels": list(args.channels),
        "settings": {
            "batch": args.batch,
            "optimizer": "Adam(0.9, 0.999)",
            "learning_rate": [args.lr, args.lr_final],
            "schedule": f"cosine over {args.epochs} epochs",
            "clip_norm": args.clip,
            "patience": args.patience,
            "seed": args.seed,
        },
        "epochs_run": len(history),
        "best_epoch": best_epoch + 1,
        "stopped": why,
        "psnr_db": results,
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads, {args.device}, torch {torch.__version__}",
        "date": datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%d"),
    }
    dtype = {"f32": torch.float32, "f16": torch.float16, "bf16": torch.bfloat16}[args.dtype]
    save_model(model, args.out, dtype, provenance, args.encoder_only)
    args.out.with_suffix(".md").write_text(card(args.out.stem, model, provenance, args.dtype, args.encoder_only))
    args.out.with_suffix(".json").write_text(
        json.dumps({"provenance": provenance, "history": history, "seconds": round(seconds, 1)}, indent=1) + "\n"
    )
    print(f"{why}; best epoch {best_epoch + 1}, {judged} loss {best_loss:.6f}, {seconds:.0f} s")
    print(f"{'PSNR, dB':<12}" + "".join(f"{name:>14}" for name in results))
    for dataset in sorted({d for r in results.values() for d in r}):
        cells = (f"{results[n][dataset]:>14.2f}" if dataset in results[n] else f"{'-':>14}" for n in results)
        print(f"{dataset:<12.24}" + "".join(cells))
    print(f"wrote {args.out}")


if __name__ == "__main__":
    main()
