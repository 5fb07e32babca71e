# SPDX-License-Identifier: MIT OR Apache-2.0
"""Lists cycles of dependencies between files of a crate (circles): sets of files that use each other, directly or through
others, by paths that begin with `crate` or `super`. Tests and lib.rs, main.rs and mod.rs are left out.
"""
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CRATES = ("core", "steer", "io", "train", "report", "farm", "ffi", "vk-raycaster", "explore", "cli", "lab", "plugins/python")
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
        if path.stem in ("lib", "main", "mod") or path.stem.endswith("tests"):
            continue
        text = path.read_text(encoding="utf-8").split("\n#[cfg(test)]\nmod tests")[0]
        module = list(path.relative_to(source).with_suffix("").parts)
        found = graph.setdefault(path, set())
        for start in START.finditer(text):
            up = 1 + start[2].count("super")
            base = [] if start[1] == "crate" else module[: len(module) - up]
            for parts in branches(text, start.end())[0]:
                other = file_of(source, [*base, *parts])
                if other and other != path and other.stem not in ("lib", "main", "mod"):
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
    return [[str(file.relative_to(ROOT)) for file in circle] for crate in CRATES for circle in circles(uses(ROOT / crate / "src"))]
