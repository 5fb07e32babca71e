#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""The versions of VTK and ParaView that the adapters are tested with: results, bars, and the table in the book.

    reach.py record ...      writes the results of scripts/matrix.sh into a file
    reach.py bars            prints `bar NAME VALUE LIMIT ok|short` for the last run here, or for the kept results if there was
                             none; exit status 1 when one is short
    reach.py keep            keeps the results of the last run, and updates the tables in the documents
    reach.py check           prints the documents that differ from the kept results

Results have a row for each suite of tests on each system: the number of passed tests and of all tests, the names of tests
that were skipped because this version lacks what they test, the number of compiler warnings, and wall seconds. Needs
Python 3.9 and nothing else.
"""
import argparse
import csv
import re
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from bar_lines import Bars

ROOT = Path(__file__).resolve().parents[2]
KEPT = ROOT / ".ci/matrix.csv"
LAST = ROOT / "out/matrix/results.csv"
FIELDS = ("system", "program", "version", "suite", "passed", "tests", "skipped", "warnings", "wall_s")
# Programs in which the plugin is checked, in the order of check.sh.
SUITES = ("pvbatch", "pvpython", "two-ranks", "pvserver", "gui")

VERSIONS = {"VTK": ("9.1", "9.3", "9.6"), "ParaView": ("5.11", "5.13", "6.1")}
WARNINGS = 0
MINUTES_FROM_NOTHING, MINUTES_KEPT = 40, 12
# Results while presets of Slicer are switched; upper limit of the percentage of frames over 1.25 times the target;
# lower limit of that percentage with Slicer's own rule, divided by ours.
SLICER = ROOT / "out/python/slicer.csv"
SLICER_OVER, SLICER_RATIO = 2, 2


# ------------------------------------------------------------------------------------------------------------ results


def read(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write(path, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="", encoding="utf-8") as file:
        out = csv.DictWriter(file, FIELDS, lineterminator="\n")
        out.writeheader()
        out.writerows(rows)


def found(path, pattern):
    """Returns the first group of a pattern's first match in a file; an empty text without a match or file."""
    match = re.search(pattern, path.read_text(encoding="utf-8", errors="replace"), re.M) if path.exists() else None
    return match[1] if match else ""


def system_of(folder):
    release = Path(folder) / "etc/os-release"
    return f"{found(release, r'^ID=(.*)').capitalize()} {found(release, r'^VERSION_CODENAME=(.*)')}"


def warnings(path):
    text = path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""
    return len(re.findall(r"warning: |\[-Werror", text))


def ctest(path):
    """Returns {test: "run", "skipped" or "failed"} of a JUnit file; a test that did not start counts as failed."""
    results = {}
    for case in ElementTree.parse(path).getroot().iter("testcase") if path.exists() else ():
        skipped = case.find("skipped")
        asked = skipped is not None and "SKIP_RETURN_CODE" in skipped.get("message", "")
        results[case.get("name")] = "skipped" if asked else case.get("status") if case.get("status") == "run" else "failed"
    return results


def record(options):
    """Writes the rows of the suites that ran here; rows of other systems stay. Returns True if all ran and passed."""
    whole = True
    seconds = {tuple(s.split(",")[:2]): s.split(",")[3] for s in options.suites}
    places = [place.split("=") for place in options.places]
    asked = len(re.findall(r"^check\(", (ROOT / "plugins/paraview/python/check.py").read_text(encoding="utf-8"), re.M))
    tests = {name: ctest(Path(vtk) / "tests.xml") for name, _, vtk, _ in places}
    every = set().union(*tests.values())
    rows = []
    for name, folder, vtk, paraview in places:
        vtk, paraview, system = Path(vtk), Path(paraview), system_of(folder)
        results = tests[name]
        ended = {how: sorted(t for t in results if results[t] == how) for how in ("run", "skipped", "failed")}
        for test in sorted(every - set(results)) + ended["failed"]:
            print(f"{system}: VTK: {test} {'failed' if test in results else 'is missing'}")
        whole &= bool(results) and not ended["failed"] and every == set(results)
        rows.append({
            "system": system, "program": "VTK", "version": found(vtk / "build.configure.log", r"^-- VTK (\S+)"), "suite": "ctest",
            "passed": len(ended["run"]), "tests": len(every), "skipped": " ".join(ended["skipped"]),
            "warnings": warnings(vtk / "build.build.log"), "wall_s": seconds.get((name, "vtk"), ""),
        })  # fmt: skip
        for suite in SUITES:
            said = paraview / "check" / f"{suite}.txt"
            lines = said.read_text(encoding="utf-8").splitlines() if said.exists() else []
            passed = sum(line.startswith("ok: ") for line in lines)
            if f"passed: {suite}" not in lines or passed != asked:
                print(f"{system}: ParaView: {suite}: {passed} of {asked} checks passed")
                whole = False
            version, qt = (found(paraview / "configure.log", rf"^-- ParaView {p}") for p in (r"([^,\s]+)", r"[^,]+, Qt (\d+)"))
            rows.append({
                "system": system, "program": "ParaView", "version": f"{version} (Qt {qt})", "suite": suite, "passed": passed,
                "tests": asked, "skipped": "", "warnings": warnings(paraview / "build.log"),
                "wall_s": seconds.get((name, "paraview"), ""),
            })  # fmt: skip
        if (Path(folder) / "made-in").exists():
            made = (Path(folder) / "made-in").read_text().strip()
            rows.append(dict.fromkeys(FIELDS, "") | {"system": system, "program": "folder", "suite": "made", "wall_s": made})
    if options.library:
        rows.append(dict.fromkeys(FIELDS, "") | {"system": "all", "program": "C library", "suite": "made", "wall_s": options.library})
    new = {(row["system"], row["program"], row["suite"]) for row in rows}
    kept = [r for r in read(options.results) if (r["system"], r["program"], r["suite"]) not in new] if options.results.exists() else []
    write(options.results, sorted(kept + rows, key=lambda r: (r["system"] == "all", r["system"], r["program"] != "VTK")))
    print(f"results: {options.results}")
    return whole


# --------------------------------------------------------------------------------------------------------------- bars


def of_version(rows, program, version):
    return [r for r in rows if r["program"] == program and re.match(rf"{re.escape(version)}\b", r["version"])]


def slicer_bars(out):
    if not SLICER.exists():
        out.lacking("Slicer's rule was not measured: make bars-slicer", ["slicer-frames-over-percent", "slicer-own-rule-over-ours"])
        return
    over = {row["rule"]: float(row["over_percent"]) for row in read(SLICER)}
    out.found("slicer-frames-over-percent", over["entire"], f"Slicer's own rule: {over['slicer']:g} %")
    # If none of our frames is over, the ratio is infinite.
    ratio = over["slicer"] / over["entire"] if over["entire"] else float("inf") if over["slicer"] else 0
    out.found("slicer-own-rule-over-ours", ratio)


def bars(options):
    names = {f"{p.lower()}-{v}-tests": (p, v) for p, versions in VERSIONS.items() for v in versions}
    asked = dict.fromkeys(names, 1) | {
        "compiler-warnings": WARNINGS, "tests-that-no-vtk-ran": 0,
        "matrix-from-nothing-minutes": MINUTES_FROM_NOTHING, "matrix-kept-folders-minutes": MINUTES_KEPT,
        "slicer-frames-over-percent": SLICER_OVER, "slicer-own-rule-over-ours": SLICER_RATIO,
    }  # fmt: skip
    with Bars(asked, at_least={*names, "slicer-own-rule-over-ours"}) as out:
        slicer_bars(out)
        rows = read(options.results if options.results.exists() else KEPT)
        for name, (program, version) in names.items():
            mine = of_version(rows, program, version)
            if not mine:
                out.lacking(f"no {program} {version} was tested: make test-matrix", [name])
                continue
            # The number of tests of a suite is the largest that any version has.
            suites = {r["suite"]: max(int(s["tests"]) for s in rows if s["suite"] == r["suite"] and s["tests"]) for r in mine}
            skipped = sum(len(r["skipped"].split()) for r in mine)
            note = f"{mine[0]['system']}: {program} {mine[0]['version']}" + (f", {skipped} skipped" if skipped else "")
            out.found(name, sum(int(r["passed"]) for r in mine), note, limit=sum(suites.values()) - skipped)
        if any(r["program"] in VERSIONS for r in rows):
            # Several rows belong to one build.
            builds = {(r["system"], r["program"]): int(r["warnings"]) for r in rows if r["program"] in VERSIONS}
            out.found("compiler-warnings", sum(builds.values()))
            skips = [set(r["skipped"].split()) for r in rows if r["program"] == "VTK"]
            out.found("tests-that-no-vtk-ran", len(set.intersection(*skips)))
        # Suites run one after the other. Every row of a program on a system has the seconds of all of its suites.
        seconds = {(r["system"], r["program"]): int(r["wall_s"] or 0) for r in rows}
        tested = sum(s for (_, program), s in seconds.items() if program in VERSIONS)
        if all(of_version(rows, program, version) for program, version in names.values()):
            out.found("matrix-kept-folders-minutes", tested / 60)
            if sum(program == "folder" for _, program in seconds) == 2:
                out.found("matrix-from-nothing-minutes", sum(seconds.values()) / 60)
        out.lacking("not every version was tested: make test-matrix")


# ---------------------------------------------------------------------------------------------------------- documents


def table(rows):
    """The rows of a Markdown table, one for each system."""
    yield "| system | VTK | tests passed | ParaView | checks passed |"
    yield "|---|---|---|---|---|"
    versions = {r["system"]: [int(n) for n in r["version"].split(".")] for r in rows if r["program"] == "VTK"}
    for system in sorted(versions, key=versions.get):
        cells = [system]
        for program in VERSIONS:
            mine = [r for r in rows if r["system"] == system and r["program"] == program]
            skipped = sum(len(r["skipped"].split()) for r in mine)
            passed, tests = (sum(int(r[k]) for r in mine) for k in ("passed", "tests"))
            cells += [mine[0]["version"], f"{passed} of {tests - skipped}"] if mine else ["-", "-"]
        yield f"| {' | '.join(cells)} |"


def phrase(rows, program):
    """Returns a phrase such as "VTK 9.1, 9.3 and 9.6": the versions of which no test failed."""
    whole = []
    for row in rows:
        mine = [r for r in rows if r["program"] == program and r["version"] == row["version"]]
        if mine and all(int(r["passed"]) + len(r["skipped"].split()) == int(r["tests"]) for r in mine):
            whole.append(".".join(row["version"].split(".")[:2]))
    whole = sorted(set(whole), key=lambda v: [int(n) for n in v.split(".")])
    return f"{program} " + (" and ".join([", ".join(whole[:-1]), whole[-1]]) if len(whole) > 1 else "".join(whole))


MARKS = "<!-- Tested versions: make versions -->", "<!-- /Tested versions -->"


def documents(rows):
    """Yields (path, present text, right text) of the documents that name versions."""
    path = ROOT / "docs/src/vtk.md"
    text = path.read_text(encoding="utf-8")
    before, _, rest = text.partition(MARKS[0])
    _, _, after = rest.partition(MARKS[1])
    yield path, text, "\n".join([f"{before}{MARKS[0]}", "", *table(rows), "", f"{MARKS[1]}{after}"])
    path = ROOT / "README.md"
    text = path.read_text(encoding="utf-8")
    versions = r" \d+\.\d+(?:(?:, | and )\d+\.\d+)*"
    must = text
    for program in VERSIONS:
        must = re.sub(rf"(?<=[\n ]){program}{versions}(?= \(|,)", lambda _, p=program: phrase(rows, p), must, count=1)
    yield path, text, must


def stale():
    """Lines that name the documents that differ from the kept results."""
    rows = read(KEPT)
    return [f"{path.relative_to(ROOT)} names other versions than {KEPT.relative_to(ROOT)}: make versions"
            for path, text, must in documents(rows) if text != must]  # fmt: skip


def keep(options):
    if options.results.exists():
        write(KEPT, read(options.results))
    for path, text, must in documents(read(KEPT)):
        if text != must:
            path.write_text(must, encoding="utf-8")
            print(f"wrote {path.relative_to(ROOT)}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("record", "bars", "keep", "check"))
    parser.add_argument("--results", type=Path, default=LAST, help="the file of results (default out/matrix/results.csv)")
    parser.add_argument("--library", type=int, default=0, help="wall seconds of building the C library")
    parser.add_argument("--suites", nargs="*", default=(), help="NAME,PROGRAM,ENDED,SECONDS")
    parser.add_argument("--places", nargs="*", default=(), help="NAME=ROOT=VTK'S RESULTS=PARAVIEW'S RESULTS")
    options = parser.parse_args()
    if options.what == "record":
        return int(not record(options))
    if options.what == "bars":
        return bars(options)
    if options.what == "keep":
        return keep(options)
    lines = stale()
    print("\n".join(lines))
    return int(bool(lines))


if __name__ == "__main__":
    sys.exit(main())
