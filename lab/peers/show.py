#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Prints the results of run.py as Markdown tables: minimum and median time per case over all runs.

usage: show.py A.json [B.json ...]
"""
import collections
import json
import pathlib
import statistics
import sys


def shown(nanoseconds):
    for limit, unit, name in ((1e3, 1, "ns"), (1e6, 1e3, "µs"), (1e9, 1e6, "ms"), (float("inf"), 1e9, "s")):
        if nanoseconds < limit:
            return f"{nanoseconds / unit:.3g} {name}"
    return "-"


def row(peer, windows):
    """Sort key (the smallest time) and line of a table; None for a peer without a time."""
    cells, key = [], None
    for threads in (1, 2):
        found = windows.get((peer, threads), [])
        if not found:
            cells += ["–"] * (3 if threads == 1 else 2)
            continue
        least = min(w[1] for w in found)
        key = least if key is None else key
        cells += [shown(least), shown(statistics.median(w[2] for w in found))]
        if threads == 1:
            runs = sorted({w[0] for w in found})
            cells.append(" / ".join(shown(min(w[1] for w in found if w[0] == run)) for run in runs))
    return None if key is None else (key, f"| {peer} | " + " | ".join(cells) + " |")


def main():
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    runs = [json.loads(pathlib.Path(name).read_text()) for name in sys.argv[1:]]
    cases = collections.defaultdict(lambda: collections.defaultdict(list))
    failures = collections.defaultdict(set)
    for run, results in enumerate(runs):
        for r in results:
            case = cases[r["name"], r["batch"]]
            if "err" in r:
                failures[r["peer"], r["err"].split("\n")[0][:70]].add(r["name"])
            else:
                case[r["peer"], r["threads"]].append((run, r["min"], r["med"]))
    for (name, batch), windows in cases.items():
        print(f"\n### {name}, batch {batch}\n")
        print("| peer | 1 thread min | 1 thread median | minimum of each run (1 thread) | 2 threads min | 2 threads median |")
        print("|---|---|---|---|---|---|")
        peers = dict.fromkeys(peer for peer, _ in windows)
        for _, line in sorted(filter(None, (row(peer, windows) for peer in peers))):
            print(line)
    if failures:
        told = (f"{peer} ({', '.join(sorted(names))}): {why}" for (peer, why), names in failures.items())
        print("\nNot run: " + "; ".join(told))


if __name__ == "__main__":
    main()
