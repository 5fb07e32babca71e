#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Compares inference libraries, interleaved in one run, and writes the times of every window as JSON (see show.py).

usage: run.py MODELS RUST_PEERS OUT.json [--rounds N] [--secs S] [--extra NAME=COMMAND ...] [--nice N] [--threads 1,2]
              [--only TEXT] [--compile]

MODELS is the folder of gen.py, RUST_PEERS the one with the built Rust peer. Every peer is a server process, one per
number of threads. Each round visits every case and, in random order, every peer. A window is S seconds of repeated
calls, whose smallest and median time are kept. Missing peers are named and skipped.
"""
import argparse
import json
import os
import pathlib
import random
import sys
import time

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "scripts"))
from servers import Server, raise_priority, thread_counts  # noqa: E402

# By peer: server, environment, request for a network, and the networks that it can run: PredNet (p), VolumeNet (v).
PEERS = {
    "torch eager": ("torch", {}, "eager/{}", "pv"),
    "torch jit.freeze": ("torch", {}, "jit/{}", "pv"),
    "torch jit optimize_for_inference": ("torch", {}, "jitofi/{}", "pv"),
    "torch eager, BN folded": ("torch", {}, "fold/{}", "v"),
    "torch eager bf16": ("torch", {}, "bf16/{}", "pv"),
    "torch eager, BN folded, channels_last_3d": ("torch", {}, "foldcl/{}", "v"),
    "ORT (iobinding)": ("ort", {}, "bind/{}", "pv"),
    "ORT session.run": ("ort", {}, "run/{}", "p"),
    "ORT int8 dynamic": ("ort", {}, "int8/{}", "p"),
    "OpenVINO f32": ("ov", {}, "f32/{}", "pv"),
    "OpenVINO bf16": ("ov", {}, "bf16/{}", "pv"),
    "rten f32": ("rten", {}, "{}", "p"),
    "rten int8": ("rten", {}, "{}_int8", "p"),
}
COMPILED = {"torch compile (freezing)": ("torch", {}, "compile/{}", "pv")}
PYTHON_PEERS = ["torch", "ort", "ov"]
LARGE = ["pred_0c256", "pred_12c256", "pred_18c256", "pred_12c64", "pred_4c256"]
CASES = (
    [("tiny", 1)]
    + [(name, 1) for name in ["pred_0c256", "pred_4c256", "pred_12c256", "pred_18c256", "pred_4c64", "pred_12c64"]]
    + [(name, 384) for name in LARGE]
    + [("pred_12c256", 4096), ("pred_12c64", 4096), ("vol_a", 1), ("vol_b", 1)]
)
COMPILED_CASES = [("pred_12c256", 1), ("pred_12c64", 1), ("pred_12c256", 384), ("vol_a", 1)]


def arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models")
    parser.add_argument("rust")
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--secs", type=float, default=0.12)
    parser.add_argument("--extra", action="append", default=[], metavar="NAME=COMMAND",
                        help="a further server of the same protocol; it is asked for PredNets with one thread")
    parser.add_argument("--nice", type=int, default=0, help="raise the priority (needs root)")
    parser.add_argument("--threads", default="1,2")
    parser.add_argument("--only", default="", help="only cases whose `NAME BATCH` holds this text")
    parser.add_argument("--compile", action="store_true", help="compare torch.compile on four cases instead")
    return parser.parse_args()


def contestants(args):
    """The peers by name: command, environment, request, networks."""
    peers = PEERS
    if args.compile:
        peers = COMPILED | {name: PEERS[name] for name in ("torch eager", "ORT (iobinding)")}
    out = {}
    for name, (server, environment, asked, kinds) in peers.items():
        if server in PYTHON_PEERS:
            command = [sys.executable, str(HERE / f"{server}_peer.py"), args.models]
        else:
            command = [f"{args.rust}/{server}-peer", args.models]
        if pathlib.Path(command[0]).exists():
            out[name] = (command, environment, asked, kinds)
        else:
            print(f"missing, skipped: {name}", file=sys.stderr)
    for extra in args.extra:
        name, command = extra.split("=", 1)
        out[name] = (command.split() + [args.models], {}, "{}", "1")
    return out


def takes_part(kinds, case, threads):
    volume = case[0].startswith("vol")
    if kinds == "1":
        return threads == 1 and not volume
    return ("v" if volume else "p") in kinds


class Servers:
    """Server processes by command, environment and threads, started at the first request."""

    def __init__(self, nice):
        self.nice, self.running = nice, {}

    def ask(self, command, environment, threads, line):
        key = (*command, *environment.items(), threads)
        if key not in self.running:
            self.running[key] = Server(command, thread_counts(threads) | environment, self.nice)
        answer = self.running[key].ask(line)
        if self.running[key].process.poll() is not None:
            del self.running[key]
        return answer

    def end(self):
        for server in self.running.values():
            server.end()


def main():
    args = arguments()
    peers, servers = contestants(args), Servers(args.nice)
    cases = [c for c in (COMPILED_CASES if args.compile else CASES) if args.only in f"{c[0]} {c[1]}"]
    if args.nice:
        raise_priority(args.nice)
    results, slow, failed = [], {}, set()
    started = time.time()
    for turn in range(args.rounds):
        for threads in map(int, args.threads.split(",")):
            for case in cases:
                name, batch = case
                order = [p for p in peers if takes_part(peers[p][3], case, threads)]
                random.shuffle(order)
                for peer in order:
                    key = (peer, threads, case)
                    # A call of over 1 s is measured in the first round only, one of over 0.25 s in two of three rounds.
                    rarely = slow.get(key, 0) > 1e9 and turn > 0 or slow.get(key, 0) > 0.25e9 and turn % 3 == 2
                    if key in failed or rarely:
                        continue
                    command, environment, asked, _ = peers[peer]
                    answer = servers.ask(command, environment, threads, f"{asked.format(name)} {batch} {args.secs}")
                    if "err" in answer:
                        failed.add(key)
                        answer["n"] = 0
                    else:
                        slow[key] = answer["med"]
                    results.append({"peer": peer, "threads": threads, "name": name, "batch": batch, "round": turn,
                                    "load": os.getloadavg()[0], **answer})
                    time.sleep(0.02)
            args.out.write_text(json.dumps(results))
        print(f"round {turn + 1} of {args.rounds} after {time.time() - started:.0f} s, load {os.getloadavg()}",
              file=sys.stderr, flush=True)
    servers.end()


if __name__ == "__main__":
    main()
