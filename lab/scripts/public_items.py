#!/usr/bin/env python3
"""Counts the public items of a crate in its sources.

An item is a `pub` function or method, struct, enum, trait, constant, type, static, module or macro, outside of tests.
Re-exports, fields and variants are not counted. Every `pub` item in a private module is reachable, since the workspace
denies the lint `unreachable_pub`.

Usage: public_items.py CRATE [--list]     CRATE: the crate's folder, such as core; `house.py` prints the bar
"""

import argparse
import pathlib
import re

ITEM = re.compile(r"\s*pub (?:const |unsafe |async |extern \"C\" )*(fn|struct|enum|trait|const|type|static|mod|macro)\b\s*(\w+)")


def items(folder):
    for path in sorted(folder.rglob("*.rs")):
        if path.name == "tests.rs":
            continue
        lines = path.read_text(encoding="utf-8").split("\n")
        for number, line in enumerate(lines, 1):
            # The module of tests ends a file.
            if line == "#[cfg(test)]" and number < len(lines) and lines[number].startswith("mod tests {"):
                break
            if line.lstrip().startswith("pub const fn"):
                line = line.replace("pub const fn", "pub fn", 1)
            found = ITEM.match(line)
            if found:
                yield path, number, found.group(1), found.group(2)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("crate", help="the crate's folder")
    parser.add_argument("--list", action="store_true", help="print each item")
    options = parser.parse_args()
    root = pathlib.Path(__file__).resolve().parents[2]
    found = list(items(root / options.crate / "src"))
    if options.list:
        for path, number, kind, name in found:
            print(f"{path.relative_to(root)}:{number} {kind} {name}")
    print(f"{len(found)} public items in {options.crate}")


if __name__ == "__main__":
    main()
