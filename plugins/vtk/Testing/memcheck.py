# SPDX-License-Identifier: MIT OR Apache-2.0
"""Runs a test of TestEntireSteering under valgrind's memcheck. Only findings with the adapter or the library on
their stack count: invalid accesses, and lost memory at the end. The many findings of OpenGL and VTK do not count.

    memcheck.py TestEntireSteering NAME MAPPER
"""
import os
import subprocess
import sys
import tempfile
import xml.etree.ElementTree

OURS = ("libvtkEntireSteering", "libentire")
LEAKS = ("Leak_DefinitelyLost", "Leak_IndirectlyLost")


def ours(frame):
    return os.path.basename(frame.findtext("obj", "")).startswith(OURS)


def main():
    with tempfile.TemporaryDirectory() as folder:
        log = os.path.join(folder, "memcheck.xml")
        done = subprocess.run(
            ["valgrind", "--quiet", "--leak-check=full", "--show-leak-kinds=definite,indirect", "--num-callers=40",
             "--undef-value-errors=no", "--xml=yes", f"--xml-file={log}", *sys.argv[1:]])
        if done.returncode:
            sys.exit(f"memcheck: {sys.argv[1]} ended with {done.returncode}")
        root = xml.etree.ElementTree.parse(log).getroot()
    others = found = 0
    for error in root.iter("error"):
        kind = error.findtext("kind", "")
        if kind.startswith("Leak_") and kind not in LEAKS:
            continue
        stacks = error.findall("stack")
        if not any(ours(frame) for stack in stacks for frame in stack.findall("frame")):
            others += 1
            continue
        found += 1
        print(f"{kind}: {error.findtext('what') or error.findtext('xwhat/text')}")
        for frame in stacks[0].findall("frame")[:16]:
            print(f"    {frame.findtext('fn', '?')} ({os.path.basename(frame.findtext('obj', '?'))})")
    print(f"memcheck: {found} findings in the adapter or the library, {others} elsewhere")
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
