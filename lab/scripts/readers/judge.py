#!/usr/bin/env python3
"""Tests crates that read volumes on the fixtures of cli/tests and on files with hostile headers.

    cargo build --manifest-path lab/scripts/readers/Cargo.toml
    python3 lab/scripts/readers/judge.py [--without CRATE] [HOSTILE]

HOSTILE is a folder of hostile files; without it, mutations of the fixtures take its place. A reader passes a
fixture when it returns the same as the command's own reader (tests/suite/volume_formats.rs compares that with the
writers' voxels). Every read is a process of its own with LIMIT_BYTES of address space and LIMIT_SECONDS of
CPU time. No file has more than 11 KB: a read that takes LARGE_BYTES or more trusts a header over the bytes
that are there.
"""

import argparse
import os
import random
import resource
import signal
import subprocess
import tempfile
from collections import Counter
from pathlib import Path

HERE = Path(__file__).resolve().parent
FIXTURES = HERE.parents[2] / "cli/tests/fixtures/volumes"
BINARY = HERE / "target/debug/readers"
LIMIT_BYTES = 1 << 30
LIMIT_SECONDS = 5
LARGE_BYTES = 128 << 20
FORMATS = {
    "NRRD": ((".nrrd", ".nhdr"), ["bioformats"]),
    "MetaImage": ((".mha", ".mhd"), ["bioformats"]),
    "VTI": ((".vti",), ["vtkio"]),
    "NIfTI": ((".nii", ".nii.gz"), ["nifti", "bioformats"]),
}
MUTATIONS = 150


def limit():
    resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (LIMIT_SECONDS, LIMIT_SECONDS))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def read(reader, path):
    """Result, output, and memory used in bytes."""
    child = subprocess.Popen([BINARY, reader, path], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                             stdin=subprocess.DEVNULL, preexec_fn=limit)
    text = child.stdout.read().decode()
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    memory = usage.ru_maxrss * 1024
    if child.returncode == 0:
        return ("too large" if memory >= LARGE_BYTES else "read"), text, memory
    kinds = {1: "refused", 101: "panic", -signal.SIGABRT: "out of memory", -signal.SIGXCPU: "hangs",
             -signal.SIGKILL: "hangs"}
    kind = kinds.get(child.returncode, f"status {child.returncode}")
    return ("too large" if kind == "refused" and memory >= LARGE_BYTES else kind), text, memory


def same(ours, theirs):
    """True if sizes, spacing (where the crate gives it) and voxels agree."""
    a, b = ours.strip().rsplit("] ", 2), theirs.strip().rsplit("] ", 2)
    return a[0] == b[0] and a[-1] == b[-1] and (b[1] == "[" or a[1] == b[1])


def mutated(fixtures, folder):
    """Fixtures with a few changed bytes or numbers, most of them in the header."""
    source = random.Random(14)
    numbers = [b"0", b"-1", b"65536", b"4294967295", b"9223372036854775807", b"1e309", b"nan"]
    for index in range(MUTATIONS):
        path = source.choice(fixtures)
        data = bytearray(path.read_bytes())
        for _ in range(source.randint(1, 4)):
            at = source.randrange(min(len(data), 600))
            if source.random() < 0.5:
                data[at] = source.randrange(256)
            else:
                while at < len(data) and not chr(data[at]).isdigit():
                    at += 1
                data[at:at + 1] = source.choice(numbers)
        if source.random() < 0.2:
            del data[source.randrange(len(data)):]
        name = "".join(path.suffixes)
        (folder / f"{index}{name}").write_bytes(data)


def ending(path):
    return ".nii.gz" if path.name.endswith(".nii.gz") else path.suffix


def main():
    options = argparse.ArgumentParser(description="Judges crates that read volumes.")
    options.add_argument("--without", action="append", default=[], help="a crate without which `readers` was built")
    options.add_argument("hostile", nargs="?", type=Path, help="a folder of files with hostile headers")
    options = options.parse_args()
    hostile = options.hostile
    for format_name, (endings, crates) in FORMATS.items():
        fixtures = sorted(p for p in FIXTURES.iterdir() if ending(p) in endings)
        with tempfile.TemporaryDirectory() as folder:
            folder = Path(folder)
            mutated(fixtures, folder)
            bad = sorted(p for p in (hostile or folder).iterdir() if ending(p) in endings)
            expected = {path: read("ours", path) for path in fixtures}
            for reader in ["ours", *(c for c in crates if c not in options.without)]:
                outcome = Counter()
                missed = []
                for path in fixtures:
                    kind, text, _ = read(reader, path)
                    if kind == "read":
                        kind = "equal" if same(expected[path][1], text) else "DIFFERENT"
                    if expected[path][0] != "read":
                        kind = f"{kind} (ours {expected[path][0]})"
                    outcome[kind] += 1
                    if kind != "equal":
                        missed.append(f"{path.name}: {kind}")
                on_bad = Counter(read(reader, path)[0] for path in bad)
                counts = f"fixtures {dict(outcome)}  hostile {dict(on_bad)}"
                print(f"{format_name:9} {reader:10} {counts}", flush=True)
                for line in missed:
                    print(f"            {line}")


if __name__ == "__main__":
    main()
