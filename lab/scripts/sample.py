#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Draws comments, sentences of the book and printed texts at random, for a reader who did not write them.

    sample.py [SEED] [--comments 100] [--sentences 40] [--texts 40]

A reader marks each text that needs a second reading: at most 3 comments, 1 sentence and 1 text may be marked
(CONTRIBUTING.md).
"""
import argparse
import random
import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SENTENCE_END = re.compile(r"(?<=[.!?])\s+(?=[A-Z`*])")


def tracked(*patterns):
    listed = subprocess.run(["git", "ls-files", "--", *patterns], cwd=ROOT, text=True, capture_output=True, check=True)
    return [path for path in listed.stdout.splitlines() if (ROOT / path).is_file()]


def comments():
    """Whole comments of Rust files: neighboring lines of one kind are one comment."""
    for path in tracked("*.rs"):
        kind, first, words = None, 0, []
        for number, line in enumerate((ROOT / path).read_text().splitlines() + [""], 1):
            match = re.match(r"\s*(//[/!]?)\s?(.*)", line)
            if kind and (not match or match[1] != kind or not match[2]):
                text = " ".join(words)
                if len(text.split()) > 3 and not text.startswith("SPDX"):
                    yield f"{path}:{first}", text
                kind, words = None, []
            if match and match[2]:
                if kind is None:
                    kind, first = match[1], number
                words.append(match[2])


def sentences():
    """Sentences of README and the book, without tables, code and generated pages of options."""
    for path in ["README.md", *tracked("docs/src/*.md")]:
        if "/options" in path:
            continue
        text = (ROOT / path).read_text()
        text = re.sub(r"```.*?```", "\n\n", text, flags=re.S)
        for block in re.split(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) )", text):
            block = " ".join(line.strip() for line in block.splitlines())
            if block.startswith(("|", "#", "<", "!")):
                continue
            for sentence in SENTENCE_END.split(block.lstrip("-*0123456789. ")):
                if len(sentence.split()) > 4:
                    yield path, sentence


def texts():
    """Texts of five words and more that the programs print."""
    literal = re.compile(r'"((?:[^"\\]|\\.)*)"', re.S)
    for path in tracked("cli/src", "io/src", "farm/src", "train/src", "report/src", "steer/src", "ffi/src", "explore/src",
                        "vk-raycaster/src"):
        if not path.endswith(".rs") or "test" in path:
            continue
        code = (ROOT / path).read_text().split("#[cfg(test)]")[0]
        code = re.sub(r"^\s*//.*$", "", code, flags=re.M)
        for match in literal.finditer(code):
            text = " ".join(re.sub(r"\\\n\s*", "", match[1]).split())
            if len(re.findall(r"[A-Za-z]{2,}", text)) > 4 and "fn " not in text:
                yield f"{path}:{code[:match.start()].count(chr(10)) + 1}", text


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("seed", nargs="?", type=int, default=1)
    arguments.add_argument("--comments", type=int, default=100, metavar="N")
    arguments.add_argument("--sentences", type=int, default=40, metavar="N")
    arguments.add_argument("--texts", type=int, default=40, metavar="N")
    options = arguments.parse_args()
    for name, source in (("comments", comments), ("sentences", sentences), ("texts", texts)):
        found = list(source())
        random.Random(f"{options.seed} {name}").shuffle(found)
        print(f"\n# {name}: {getattr(options, name)} of {len(found)}\n")
        for number, (place, text) in enumerate(found[:getattr(options, name)], 1):
            print(f"{number}. [{place}] {text}")


if __name__ == "__main__":
    main()
