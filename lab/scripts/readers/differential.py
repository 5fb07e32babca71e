#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Compares the command's readers of volumes with independent ones, file by file and value by value.

    pip install pynrrd SimpleITK nibabel vtk numpy
    differential.py                    every file of cli/tests/fixtures/volumes and reports
    differential.py --write            also writes cli/tests/fixtures/right-values.csv anew
    differential.py --neighbors N      also N changed fixtures (--seed S, --from K: from the K-th on); --keep DIR keeps
                                       those that two readers read differently

Compared are sizes (x fastest), the voxels' type in memory, the spacing (to a relative 1e-5), the range of the finite
voxels, and a CRC-32 of the voxels. Prints `bar files-read-alike`: of the reads that both sides accept, the percentage on
which they agree. Files that only one side reads are listed by reason. The command's readers are built from
lab/scripts/readers/Cargo.toml (--target-dir DIR: folder of the build). Needs Python 3.9, and cargo.
"""
import argparse
import csv
import gzip
import json
import math
import os
import re
import struct
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from pathlib import Path

import neighbors
import peers

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from bar_lines import Bars  # noqa: E402

HERE = Path(__file__).resolve().parent
FIXTURES = HERE.parents[2] / "cli/tests/fixtures"
TABLE = FIXTURES / "right-values.csv"
FIELDS = ("dims", "type", "spacing", "range", "crc32")
COLUMNS = ("file", "readers", "dims", "type", "spacing", "min", "max", "crc32", "refusal")
BAR = "files-read-alike"


class Ours:
    """The command's readers in a separate process, which answers one path after another."""

    def __init__(self, target):
        manifest = HERE / "Cargo.toml"
        subprocess.run([os.environ.get("CARGO") or "cargo", "build", "--quiet", "--manifest-path", manifest,
                        "--target-dir", target], check=True)
        self.program = Path(target) / "debug/readers"
        self.start()

    def start(self):
        self.child = subprocess.Popen([self.program], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                                      stderr=subprocess.DEVNULL, text=True, encoding="utf-8")

    def read(self, path):
        """Returns a reading, or the reason of the refusal without the file's name."""
        self.child.stdin.write(f"{path}\n")
        self.child.stdin.flush()
        line = self.child.stdout.readline()
        if not line:
            self.start()
            raise RuntimeError(f"{path}: the reading has ended the process")
        answer = json.loads(line)
        if "panic" in answer:
            raise RuntimeError(f"{path}: the reader has panicked")
        if "refused" in answer:
            return answer["refused"].replace(f"{path.parent}/", "").removeprefix(f"{path.name}: ")
        answer.pop("notes")
        return peers.Reading(tuple(answer["dims"]), answer["type"], tuple(answer["spacing"]),
                             answer["range"] and tuple(answer["range"]), answer["crc32"])


def close(a, b):
    return a == b or math.isfinite(a) and math.isfinite(b) and abs(a - b) <= 1e-5 * max(abs(a), abs(b))


def differences(a, b):
    """Names of the fields in which two readings differ."""
    same = {
        "dims": a.dims == b.dims,
        "type": a.type == b.type,
        "spacing": len(a.spacing) == len(b.spacing) and all(map(close, a.spacing, b.spacing)),
        "range": a.range == b.range,
        "crc32": a.crc32 == b.crc32,
    }
    return [name for name in FIELDS if not same[name]]


def shape(reason):
    """Returns a reason without its numbers and names, so that files with the same reason can be counted."""
    reason = re.sub(r"[^\x20-\x7e]", "?", reason)
    reason = re.sub(r'"[^"]*"|\'[^\']*\'', '"…"', reason)
    reason = re.sub(r"/\S+", "PATH", re.sub(r"\(?\b0x[0-9a-f]+\)?", "", reason))
    return re.sub(r"[-+]?\d+(\.\d+)?([eE][-+]?\d+)?", "N", reason)[:150]


class Tally:
    """Results of the reads."""

    def __init__(self, ours):
        self.ours = ours
        self.alike, self.disagreeing, self.excused = 0, [], Counter()
        self.ours_refuses, self.ours_alone = defaultdict(list), defaultdict(list)

    def take(self, path, name):
        """Reads a file with every reader of its format; returns our result and theirs, without results whose difference
        a convention explains."""
        kind = peers.format_of(path)
        mine = self.ours.read(path)
        theirs = {reader: peers.read(reader, path) for reader in peers.OF_FORMAT.get(kind, ())}
        read = {reader: value for reader, value in theirs.items() if isinstance(value, peers.Reading)}
        if isinstance(mine, str):
            if read:
                self.ours_refuses[f"{kind}: {shape(mine)}"].append(f"{name} ({', '.join(read)})")
            return mine, theirs
        if theirs and not read:
            reasons = "; ".join(f"{reader}: {shape(value)}" for reader, value in theirs.items())
            self.ours_alone[f"{kind}: {reasons}"].append(name)
        for reader, value in read.items():
            fields = differences(mine, value)
            rule = fields and convention(kind, reader, path, fields, mine, value, read)
            if rule:
                self.excused[rule] += 1
                del theirs[reader]
            elif fields:
                self.disagreeing.append(path)
                print(f"DISAGREE {name}: {', '.join(fields)}\n  ours      {mine}\n  {reader:9} {value}", flush=True)
            else:
                self.alike += 1
        return mine, theirs

    def report(self):
        for title, groups in (("ours refuses, others read", self.ours_refuses), ("ours reads, others refuse", self.ours_alone)):
            print(f"{title}: {sum(map(len, groups.values()))}")
            for reason, names in sorted(groups.items(), key=lambda group: -len(group[1])):
                print(f"  {len(names):5}  {reason}  [{names[0]}]")
        for rule, count in self.excused.most_common():
            print(f"left out {count}: {rule}")


def scaling(path):
    """Slope and intercept of a NIfTI file."""
    data = path.read_bytes()
    data = gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data
    mark = ">" if data[:1] == b"\0" else "<"
    form, at = ("dd", 176) if 540 in struct.unpack("<i", data[:4]) + struct.unpack(">i", data[:4]) else ("ff", 112)
    return struct.unpack_from(mark + form, data, at)


def compressed_size_is_right(path):
    """True if a MetaImage file is not compressed, or states how many bytes its compressed voxels have."""
    data = path.read_bytes()
    end = neighbors.header_end("metaimage", data)
    entries = dict(re.findall(r"^(\w+) *= *(.*?)\s*$", data[:end].decode("latin-1"), re.M))
    if not entries.get("CompressedData", "F").startswith(("T", "t", "1")):
        return True
    beside = path.with_name(entries.get("ElementDataFile", ""))
    there = len(data) - end
    if beside != path and beside.is_file():
        there = beside.stat().st_size - int(entries.get("HeaderSize", 0))
    return entries.get("CompressedDataSize") == str(there)


def convention(kind, reader, path, fields, mine, theirs, read):
    """The sentence that explains a difference in these fields, or None."""
    values = {"type", "range", "crc32"}
    if kind == "nifti" and reader == "SimpleITK":
        if "spacing" in fields and any(all(close(a * unit, b) for a, b in zip(mine.spacing, theirs.spacing))
                                       for unit in (1000, 0.001)):
            fields = [name for name in fields if name != "spacing"]
            if not fields:
                return "ITK turns NIfTI's spacing into millimeters; here, as in nibabel, it stays in the file's unit"
        slope, intercept = scaling(path)
        if set(fields) <= values and (slope == 0 or not math.isfinite(slope)):
            return "a slope that is 0 or not finite says that nothing is scaled; ITK adds the intercept nevertheless"
        backed = "nibabel" in read and not differences(mine, read["nibabel"])
        if set(fields) <= values and backed and abs(slope - 1) < 1e-6 and abs(intercept) < 1e-30:
            return "ITK ignores a scaling whose effect is below its rounding error; nibabel applies it"
        if mine.type == theirs.type == "float32" and (slope, intercept) != (1, 0) and (
                fields == ["crc32"] or backed and set(fields) <= values):
            return "ITK rounds wide numbers to 32-bit floats before it scales them; here, as in nibabel, they are rounded once"
    if reader == "nibabel" and fields == ["spacing"] and all(
            close(a, b) or a == 1 and not math.isfinite(b) for a, b in zip(mine.spacing, theirs.spacing)):
        return "nibabel returns a pixdim that is not finite; here, as in ITK, such a spacing is unknown and set to 1"
    if reader == "pynrrd" and fields == ["spacing"] and "SimpleITK" in read and not differences(mine, read["SimpleITK"]):
        header = path.read_bytes()[:4096].decode("latin-1")
        if any(name != name.lower() for name in re.findall(r"^(spacings|space directions):", header, re.M | re.I)):
            return "pynrrd knows names of NRRD's fields in lower case alone; here, as in ITK, capitals count as well"
    if kind == "metaimage" and set(fields) <= values and not compressed_size_is_right(path):
        return "without the right CompressedDataSize, ITK inflates other bytes than those behind the header"
    return None


def fixtures():
    """Returns (name in the table, path) of every fixture."""
    return sorted((path.relative_to(FIXTURES).as_posix(), path) for folder in ("volumes", "reports")
                  for path in (FIXTURES / folder).rglob("*") if path.is_file())


def row(name, mine, theirs):
    """A row of the table: the result of most independent readers, and the reason if ours refuses the file.

    `readers` is `ours` if no other reader accepts the file, and `none` if no reader does.
    """
    read = [(reader, value) for reader, value in theirs.items() if isinstance(value, peers.Reading)]
    votes = [[other for other, theirs in read if not differences(value, theirs)] for _, value in read]
    cells = dict.fromkeys(COLUMNS, "")
    cells.update(file=name, readers="none" if isinstance(mine, str) else "ours",
                 refusal=mine if isinstance(mine, str) else "")
    right = mine
    if read:
        best = max(range(len(read)), key=lambda at: len(votes[at]))
        right = read[best][1]
        cells["readers"] = " ".join(votes[best])
    if isinstance(right, peers.Reading):
        low, high = right.range or ("", "")
        cells.update(dims=" ".join(map(str, right.dims)), type=right.type, spacing=" ".join(f"{s:.7g}" for s in right.spacing),
                     min=repr(low) if right.range else "", max=repr(high) if right.range else "", crc32=right.crc32)
    return cells


def write(rows):
    with TABLE.open("w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def main():
    options = argparse.ArgumentParser(description="Compares the command's readers with independent ones.")
    options.add_argument("--write", action="store_true", help="write the table of right values anew")
    options.add_argument("--neighbors", type=int, default=0, metavar="N", help="changed fixtures to read")
    options.add_argument("--seed", type=int, default=1, help="seed of the changes")
    options.add_argument("--from", type=int, default=0, dest="first", metavar="K", help="number of the first change")
    options.add_argument("--keep", type=Path, metavar="DIR", help="folder in which changed files that are not read alike are kept")
    options.add_argument("--target-dir", default=str(HERE / "target"), metavar="DIR", help="folder of the build")
    options = options.parse_args()
    with Bars({BAR: 100}, at_least=(BAR,)) as bars:
        missing = peers.load()
        if missing:
            bars.lacking(f"pip install {' '.join(missing)}")
            return
        ours = Ours(options.target_dir)
        tally = Tally(ours)
        rows = [row(name, *tally.take(path, name)) for name, path in fixtures()]
        if options.write:
            if tally.disagreeing:
                print("the written table has rows with which the command's readers disagree")
            write(rows)
        print(f"fixtures: {len(rows)}")
        tally.report()
        reads, disagreeing = tally.alike, len(tally.disagreeing)
        if options.neighbors:
            tally = Tally(ours)
            with tempfile.TemporaryDirectory() as folder:
                files = [(name, path) for name, path in fixtures() if peers.format_of(path)]
                wanted = range(options.first, options.first + options.neighbors)
                for path, name in neighbors.make(files, wanted, options.seed, Path(folder), options.keep):
                    tally.take(path, name)
                    neighbors.clear(path, options.keep if path in tally.disagreeing else None)
            print(f"neighbors: {options.neighbors}")
            tally.report()
            reads, disagreeing = reads + tally.alike, disagreeing + len(tally.disagreeing)
        total = reads + disagreeing
        bars.found(BAR, 100 * reads / total if total else None, f"{reads} of {total} reads that both sides accept")


if __name__ == "__main__":
    main()
