# SPDX-License-Identifier: MIT OR Apache-2.0
"""Lists cycles of dependencies between files of a crate (circles): sets of files that use each other, directly or through
others, by paths of modules that begin with `crate` or `super`. Tests, lib.rs and main.rs are left out. A name that a module
re-exports does not count as a use of the file that defines the name.
"""
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CRATES = ("core", "steer", "io", "train", "report", "farm", "ffi", "vk-raycaster", "explore", "cli", "lab", "plugins/python")
# Each cycle, with its reason: the files in alphabetical order.
REASONS = {
    ("core/src/model/file.rs", "core/src/model/read.rs"):
        "a file converts itself into a checked model, and reading a model takes the file's tensors",
    ("farm/src/engine/mod.rs", "farm/src/spool.rs"):
        "an engine makes the files to which workers append, and reading these files gives the engine's events",
    ("steer/src/features/probe/march.rs", "steer/src/features/probe/packet.rs"):
        "march.rs marches rays in packets if it can, and a packet stores the fields of rays that march.rs defines",
}
START = re.compile(r"\b(crate|super)((?:::super)*)::")
NAME = re.compile(r"\s*([a-z_0-9]+)\s*(::)?")


def file_of(source, parts):
    """Returns the file of the longest prefix of a module path for which a file exists; None if there is no such
    file."""
    for n in range(len(parts), 0, -1):
        place = source.joinpath(*parts[:n])
        for found in (place.with_suffix(".rs"), place / "mod.rs"):
            if found.exists():
                return found
    return None


def branches(text, at, before=()):
    """Returns the module paths that begin at index `at` of the text (several for a group in braces), and the index
    behind them."""
    while text[at:at + 1].isspace():
        at += 1
    if text[at:at + 1] == "{":
        found, at = [], at + 1
        while text[at:at + 1] not in ("}", ""):
            more, at = branches(text, at, before)
            found += more
            while text[at:at + 1] not in (",", "}", ""):
                at += 1
            at += text[at:at + 1] == ","
            while text[at:at + 1].isspace():
                at += 1
        return found, at + 1
    name = NAME.match(text, at)
    if not name:
        return ([before] if before else []), at
    if not name[2]:
        return [(*before, name[1])], name.end()
    return branches(text, name.end(), (*before, name[1]))


def uses(source):
    """Returns a map from each file of a crate to the files that it uses."""
    graph = {}
    for path in sorted(source.rglob("*.rs")):
        if path.stem in ("lib", "main") or path.stem.endswith("tests"):
            continue
        text = path.read_text(encoding="utf-8").split("\n#[cfg(test)]\nmod tests")[0]
        module = [part for part in path.relative_to(source).with_suffix("").parts if part != "mod"]
        found = graph.setdefault(path, set())
        for start in START.finditer(text):
            up = 1 + start[2].count("super")
            base = [] if start[1] == "crate" else module[: len(module) - up]
            for parts in branches(text, start.end())[0]:
                other = file_of(source, [*base, *parts])
                if other and other != path and other.stem not in ("lib", "main"):
                    found.add(other)
    return graph


def circles(graph):
    """Returns the strongly connected components of more than one file, by Tarjan's algorithm."""
    number, low, stack, found = {}, {}, [], []

    def visit(file):
        number[file] = low[file] = len(number)
        stack.append(file)
        for other in graph.get(file, ()):
            if other not in number:
                visit(other)
            if other in stack:
                low[file] = min(low[file], low[other])
        if low[file] == number[file]:
            at = stack.index(file)
            if len(stack) - at > 1:
                found.append(sorted(stack[at:]))
            del stack[at:]

    for file in graph:
        if file not in number:
            visit(file)
    return found


def all_circles():
    found = [circle for crate in CRATES for circle in circles(uses(ROOT / crate / "src"))]
    return [tuple(str(file.relative_to(ROOT)) for file in circle) for circle in found]


def differences(found):
    """Yields the cycles that have no reason, and the reasons of cycles that do not exist."""
    for circle in found:
        if circle not in REASONS:
            yield f"{' '.join(circle)}: no reason is stated in lab/scripts/circles.py"
    for circle in set(REASONS) - set(found):
        yield f"{' '.join(circle)}: lab/scripts/circles.py states a reason, but these files are no cycle"
