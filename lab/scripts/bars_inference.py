#!/usr/bin/env python3
"""Measures the inference bars afresh: one line `bar NAME VALUE LIMIT ok|short` each; exit status 1 when any is short.

usage: bars_inference.py --server PEER_SERVER --peers FOLDER --models FOLDER [--rust FOLDER] [--rounds N] [--seconds S] [--nice N]

Every contestant is a server process (line `NAME BATCH SECONDS` in, `@@{json}` out). Each round visits every bar and, in
random order, its contestants; a window is SECONDS of repeated calls. A ratio is the smallest time of ours over the
smallest time of theirs, all windows of one run. Peers that are not installed are named and skipped; a bar that has no
peer to be measured against is short.

Other rooms add rows: an executable `*_bars` beside PEER_SERVER, or named with --also, is run and its own `bar` lines
are passed on.
"""
import argparse
import json
import os
import pathlib
import random
import subprocess
import sys

# name, limit, our storage (several: the fastest counts), network, batch, threads, peers (several: the fastest counts)
ORT = ["ort"]
F32 = ["ort", "torch", "rten"]
VOLUME = ["ort", "torch", "ov"]
RATIOS = [
    ("12c256_f32_1_thread", 0.80, ["f32"], "pred_12c256", 1, 1, ORT),
    ("12c256_half_1_thread", 0.22, ["f16", "bf16"], "pred_12c256", 1, 1, ORT),
    ("12c256_int8_1_thread", 0.08, ["int8"], "pred_12c256", 1, 1, ORT),
    ("4c256_f32_1_thread", 0.45, ["f32"], "pred_4c256", 1, 1, ORT),
    ("12c64_f32_1_thread", 0.16, ["f32"], "pred_12c64", 1, 1, ORT),
    ("12c256_f32_2_threads", 0.45, ["f32"], "pred_12c256", 1, 2, ORT),
    ("12c256_batch384_f32_1_thread", 0.87, ["f32"], "pred_12c256", 384, 1, F32),
    ("12c256_batch384_f32_2_threads", 0.72, ["f32"], "pred_12c256", 384, 2, F32),
    ("12c256_batch384_int8_1_thread", 0.35, ["int8"], "pred_12c256", 384, 1, F32),
    ("volumenet_a_u8_1_thread", 0.35, ["f32"], "vol_a", 1, 1, VOLUME),
    ("volumenet_a_u8_2_threads", 0.35, ["f32"], "vol_a", 1, 2, VOLUME),
    ("volumenet_b_u8_1_thread", 0.53, ["f32"], "vol_b", 1, 1, VOLUME),
    ("volumenet_b_u8_2_threads", 0.53, ["f32"], "vol_b", 1, 2, VOLUME),
]
# name, limit, storage, networks: largest error against float64 (see the server's `accuracy/`)
ERRORS = [("error_f32", 1e-5, "f32", ["pred_0c256", "pred_4c256", "pred_12c256", "pred_12c64"])]
# name, limit as a multiple of the time in which as many threads read the bytes once, edge of the volume, threads
READS = [("resample_512_u8_2_threads", 1.5, 512, 2)]
# name, limit in microseconds, what the server measures
CALLS = [("2x64_warm_us", 0.5, "small/warm"), ("2x64_cold_us", 2.5, "small/cold")]
PEER_NAMES = {"ort": "bind/{}", "torch": "jitofi/{}", "rten": "{}", "ov": "f32/{}"}


class Server:
    def __init__(self, command, threads, nice):
        environment = dict(os.environ, PEER_THREADS=str(threads))
        for variable in ("RAYON", "RTEN", "OMP", "MKL"):
            environment[f"{variable}_NUM_THREADS"] = str(threads)
        raise_priority = (lambda: os.setpriority(os.PRIO_PROCESS, 0, nice)) if nice else None
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
            env=environment, preexec_fn=raise_priority,
        )

    def ask(self, name, batch, seconds):
        self.process.stdin.write(f"{name} {batch} {seconds}\n")
        self.process.stdin.flush()
        for line in self.process.stdout:
            if line.startswith("@@"):
                return json.loads(line[2:])
        return {"err": "the server ended"}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--server", required=True)
    parser.add_argument("--peers", required=True)
    parser.add_argument("--models", required=True)
    parser.add_argument("--rust", default="")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=0.1)
    parser.add_argument("--nice", type=int, default=0)
    parser.add_argument("--only", default="")
    parser.add_argument("--also", action="append", default=[])
    options = parser.parse_args()
    if options.nice:
        # Where the kernel schedules by session, niceness acts only inside one: raise this session's too.
        try:
            os.setsid()
        except OSError:
            pass
        try:
            pathlib.Path("/proc/self/autogroup").write_text(str(options.nice))
        except OSError as error:
            print(f"priority of the session not raised: {error}", file=sys.stderr)

    servers, missing = {}, {}

    def command(key):
        kind = key.split("/")
        if kind[0] == "ours":
            return [options.server, "--storage", kind[1], options.models]
        if kind[0] == "rten":
            return [f"{options.rust}/rten-peer", options.models]
        return [sys.executable, f"{options.peers}/{kind[0]}_peer.py", options.models]

    def ask(key, threads, name, batch, seconds):
        if key in missing:
            return None
        if (key, threads) not in servers:
            argv = command(key)
            if not os.path.exists(argv[0]) or (argv[0] == sys.executable and not os.path.exists(argv[1])):
                missing[key] = f"{argv[-2]} does not exist"
                return None
            servers[key, threads] = Server(argv, threads, options.nice)
        answer = servers[key, threads].ask(name, batch, seconds)
        if "err" in answer:
            missing[key] = answer["err"]
            return None
        return answer

    scripts = {k: f"{options.peers}/{k}_peer.py" for k in sorted({p.split("/")[0] for row in RATIOS for p in row[6]} - {"rten"})}
    scripts["rten"] = f"{options.rust}/rten-peer"
    there = [k for k, path in scripts.items() if os.path.exists(path)]
    absent = [k for k in scripts if k not in there]
    print(f"peers in {options.peers} (PEERS=folder): {', '.join(there) or 'none'}"
          + (f"; not there, so not measured: {', '.join(absent)}" if absent else ""), flush=True)

    best = {}
    rows = [row for row in RATIOS if options.only in row[0]]
    for _ in range(options.rounds):
        for name, _, storages, net, batch, threads, peers in rows:
            contestants = [(f"ours/{s}", net) for s in storages] + [(p, PEER_NAMES[p].format(net)) for p in peers]
            random.shuffle(contestants)
            for key, spec in contestants:
                answer = ask(key, threads, spec, batch, options.seconds)
                if answer:
                    best.setdefault((name, key), []).append((answer["min"], answer["med"]))
    short = False

    def bar(name, value, limit, note=""):
        nonlocal short
        ok = value is not None and value <= limit
        short |= not ok
        text = "-" if value is None else f"{value:.3g}"
        print(f"bar {name} {text} {limit:g} {'ok' if ok else 'short'}{note and '  # ' + note}", flush=True)

    def smallest(name, keys):
        times = [(min(v)[0], min(m for _, m in v), k) for k in keys if (v := best.get((name, k)))]
        return min(times) if times else None

    for name, limit, storages, net, batch, threads, peers in rows:
        ours, theirs = smallest(name, [f"ours/{s}" for s in storages]), smallest(name, peers)
        if ours and theirs:
            note = (f"{ours[2]} {ours[0] / 1e3:.2f} us (median {ours[1] / 1e3:.2f}), "
                    f"{theirs[2]} {theirs[0] / 1e3:.2f} us (median {theirs[1] / 1e3:.2f})")
            bar(name, ours[0] / theirs[0], limit, note)
        else:
            bar(name, None, limit, "nothing to measure against")
    for name, limit, storage, nets in ERRORS:
        if options.only in name:
            errors = [ask(f"ours/{storage}", 1, f"accuracy/{net}", 400, 0) for net in nets]
            bar(name, max((e["error"] for e in errors if e), default=None), limit, "relative, seconds = exp(output)")
    for name, limit, spec in CALLS:
        if options.only in name:
            answers = [ask("ours/f32", 1, spec, 1, options.seconds) for _ in range(options.rounds)]
            answers = [a for a in answers if a]
            value = min((a["med"] for a in answers), default=None)
            note = f"median of a window; smallest call {min(a['min'] for a in answers) / 1e3:.3f} us" if answers else ""
            bar(name, value and value / 1e3, limit, note)
    for name, limit, edge, threads in READS:
        if options.only in name:
            # Windows long enough for the pages to settle: one call takes milliseconds.
            answers = [ask("ours/f32", threads, f"resample/{edge}", 1, 5 * options.seconds) for _ in range(options.rounds)]
            answers = [a for a in answers if a]
            ours, read = min((a["min"] for a in answers), default=None), min((a["read"] for a in answers), default=None)
            note = f"{ours / 1e6:.2f} ms, reading {read / 1e6:.2f} ms" if answers else "no answer"
            bar(name, ours / read if answers else None, limit, note)
    for program in options.also:
        result = subprocess.run(program, shell=True, stdout=subprocess.PIPE, text=True)
        lines = [line for line in result.stdout.splitlines() if line.startswith("bar ")]
        print("\n".join(lines), flush=True)
        short |= any(" short" in line for line in lines) or not lines or result.returncode not in (0, 1)
    for key, why in missing.items():
        print(f"skipped {key}: {why}")
    print(f"load {os.getloadavg()[0]:.1f}, {options.rounds} rounds of {options.seconds} s windows, interleaved")
    for server in servers.values():
        server.process.stdin.close()
        server.process.wait()
    sys.exit(1 if short else 0)


main()
