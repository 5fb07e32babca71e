#!/usr/bin/env python3
"""Measures the inference bars: one line `bar NAME VALUE LIMIT ok|short` each; exit status 1 when any is short.

usage: bars_inference.py --server PEER_SERVER --peers FOLDER --models FOLDER [--rust FOLDER] [--rounds N] [--seconds S]
                         [--nice N] [--only TEXT]

Every library, ours or another (a peer), is a server process: it reads lines `NAME BATCH SECONDS` and answers
`@@{json}`. Each round visits every bar and times its libraries in random order, each in a window of SECONDS of repeated
calls. A ratio is our smallest time in all windows, divided by the smallest time of the peers. A peer that is missing or
fails is named, and every bar that compares with it is short, since the other peers may not be the fastest.

--only TEXT selects bars whose names contain the text.
"""
import argparse
import os
import random
import sys

from bar_lines import Bars
from servers import Server, raise_priority, thread_counts

# Bars of ratios: name, limit, our storage formats, network, batch, threads, peers. Our fastest format is compared with
# the fastest peer.
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
# Bars of errors: name, limit, storage format, networks. The value is the largest difference from float64 over the
# networks, which the server computes on request `accuracy/NETWORK`.
ERRORS = [("error_f32", 1e-5, "f32", ["pred_0c256", "pred_4c256", "pred_12c256", "pred_12c64"])]
# Bars of resampling: name, limit, edge of the volume in voxels, threads. The limit is a multiple of the time in which
# as many threads read the volume's bytes once.
READS = [("resample_512_u8_2_threads", 1.5, 512, 2)]
# Bars of single calls: name, limit in microseconds, name of the server's measurement.
CALLS = [("2x64_warm_us", 0.5, "small/warm"), ("2x64_cold_us", 2.5, "small/cold")]
# Remedies for missing peers; PYTHON names the Python that has a peer's packages.
REMEDIES = {"ort": "pip install numpy safetensors onnxruntime", "torch": "pip install numpy safetensors torch",
            "ov": "pip install numpy safetensors openvino", "rten": "make bench-rust-peers",
            "ours": "make peer-server; for the networks pip install numpy safetensors onnx"}
PEER_NAMES = {"ort": "bind/{}", "torch": "jitofi/{}", "rten": "{}", "ov": "f32/{}"}


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
    options = parser.parse_args()
    if options.nice:
        raise_priority(options.nice)

    asked = {row[0]: row[1] for row in RATIOS + ERRORS + CALLS + READS if options.only in row[0]}
    with Bars(asked) as bars:
        measure(options, bars)


def measure(options, bars):
    servers, failed = {}, {}

    def command(key):
        kind = key.split("/")
        if kind[0] == "ours":
            return [options.server, "--storage", kind[1], options.models]
        if kind[0] == "rten":
            return [f"{options.rust}/rten-peer", options.models]
        return [sys.executable, f"{options.peers}/{kind[0]}_peer.py", options.models]

    def ask(key, threads, name, batch, seconds):
        case = key, threads, name, batch
        if case in failed:
            return None
        if (key, threads) not in servers:
            argv = command(key)
            program = argv[1] if argv[0] == sys.executable else argv[0]
            if not os.path.exists(program):
                failed[case] = f"{program} does not exist"
                return None
            servers[key, threads] = Server(argv, thread_counts(threads), options.nice)
        answer = servers[key, threads].ask(f"{name} {batch} {seconds}")
        if "err" in answer:
            failed[case] = answer["err"]
            return None
        return answer

    def why(cases):
        """Returns the failures among these cases as text, each with its remedy; None if no case failed."""
        found = [(c[0], failed[c]) for c in cases if c in failed]
        told = (f"{key}: {reason} ({REMEDIES[key.split('/')[0]]})" for key, reason in found)
        return "; ".join(dict.fromkeys(told)) or None

    best = {}
    rows = [row for row in RATIOS if row[0] in bars.asked]
    for _ in range(options.rounds):
        for name, _, storages, net, batch, threads, peers in rows:
            contestants = [(f"ours/{s}", net) for s in storages] + [(p, PEER_NAMES[p].format(net)) for p in peers]
            random.shuffle(contestants)
            for key, spec in contestants:
                answer = ask(key, threads, spec, batch, options.seconds)
                if answer:
                    best.setdefault((name, key), []).append((answer["min"], answer["med"]))

    def smallest(name, keys):
        times = [(min(v)[0], min(m for _, m in v), k) for k in keys if (v := best.get((name, k)))]
        return min(times) if times else None

    for name, _, storages, net, batch, threads, peers in rows:
        ours, theirs = smallest(name, [f"ours/{s}" for s in storages]), smallest(name, peers)
        lacking = why([(f"ours/{s}", threads, net, batch) for s in storages]
                      + [(p, threads, PEER_NAMES[p].format(net), batch) for p in peers])
        if lacking:
            known = f"; our time is {ours[0] / theirs[0]:.3g} of the fastest other peer's" if ours and theirs else ""
            bars.lacking(lacking + known, [name])
        else:
            bars.found(name, ours[0] / theirs[0],
                       f"{ours[2]} {ours[0] / 1e3:.2f} us (median {ours[1] / 1e3:.2f}), "
                       f"{theirs[2]} {theirs[0] / 1e3:.2f} us (median {theirs[1] / 1e3:.2f})")

    def several(name, threads, specs, batch, seconds):
        """Returns our server's answers; if one failed, prints the bar as short with the reason and returns no
        answers."""
        answers = [ask("ours/f32", threads, spec, batch, seconds) for spec in specs]
        if None in answers:
            bars.lacking(why([("ours/f32", threads, spec, batch) for spec in specs]), [name])
            return []
        return answers

    for name, _, storage, nets in ERRORS:
        if name in bars.asked and (answers := several(name, 1, [f"accuracy/{net}" for net in nets], 400, 0)):
            bars.found(name, max(a["error"] for a in answers), "relative, seconds = exp(output)")
    for name, _, spec in CALLS:
        if name in bars.asked and (answers := several(name, 1, options.rounds * [spec], 1, options.seconds)):
            bars.found(name, min(a["med"] for a in answers) / 1e3,
                       f"median of a window; smallest call {min(a['min'] for a in answers) / 1e3:.3f} us")
    for name, _, edge, threads in READS:
        # Windows of five times SECONDS: one call takes milliseconds, and the first calls also wait for memory pages.
        specs = options.rounds * [f"resample/{edge}"]
        if name in bars.asked and (answers := several(name, threads, specs, 1, 5 * options.seconds)):
            ours, read = (min(a[k] for a in answers) for k in ("min", "read"))
            bars.found(name, ours / read, f"{ours / 1e6:.2f} ms, reading {read / 1e6:.2f} ms")
    print(f"load {os.getloadavg()[0]:.1f}, {options.rounds} rounds of {options.seconds} s windows, interleaved")
    for server in servers.values():
        server.end()


if __name__ == "__main__":
    main()
