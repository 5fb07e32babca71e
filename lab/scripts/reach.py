#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""The versions of VTK and ParaView that the adapters are tested with, and the rehearsal of a release: results, bars, and
the table in the book.

    reach.py record ...                writes the results of scripts/matrix.sh into a file
    reach.py python ...                writes the results of plugins/python/run.sh
    reach.py value NAME VALUE [NOTE]   writes the value of one bar, for the scripts that measure it
    reach.py bars                      prints `bar NAME VALUE LIMIT ok|short` for the last runs here, and for the kept results
                                       of all that did not run here; exit status 1 when one is short
    reach.py keep                      keeps the results of the last runs, and updates the tables in the documents
    reach.py check                     prints the documents that differ from the kept results

Results have a row for each suite of tests on each system: the number of passed tests and of all tests, the names of tests
that were skipped because this version lacks what they test, the number of compiler warnings, and wall seconds. Needs
Python 3.9; CMake to count the tests of the VTK class, and zizmor for the bar of its findings.
"""
import argparse
import csv
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from bar_lines import Bars

ROOT = Path(__file__).resolve().parents[2]
KEPT = ROOT / ".ci/matrix.csv"
LAST = ROOT / "out/matrix/results.csv"
FIELDS = ("system", "program", "version", "suite", "passed", "tests", "skipped", "warnings", "wall_s")
# Values of single bars. The note of a value names the machine or the tested parts.
VALUES, LAST_VALUES = ROOT / ".ci/reach.csv", ROOT / "out/reach/values.csv"
VALUE_FIELDS = ("name", "value", "note")
TARGET = ROOT / os.environ.get("CARGO_TARGET_DIR", "target")
# Programs in which the plugin is checked, in the order of check.sh.
SUITES = ("pvbatch", "pvpython", "two-ranks", "pvserver", "gui")
PYTHON = "Python package"
# Packages of the table of versions, and their names.
PACKAGES = {
    "slicer-core": "3D Slicer (slicer-core)", "trame-slicer": "trame-slicer", "vtk": "VTK", "pyvista": "PyVista", "trame": "trame",
    "napari": "napari", "vispy": "vispy", "yt": "yt",
}  # fmt: skip

VERSIONS = {"VTK": ("9.1", "9.3", "9.6"), "ParaView": ("5.11", "5.13", "6.1")}
WARNINGS = 0
MINUTES_FROM_NOTHING, MINUTES_KEPT = 40, 12
# Results while presets of Slicer are switched; upper limit of the percentage of frames over 1.25 times the target;
# lower limit of that percentage with Slicer's own rule, divided by ours.
SLICER, LAST_SLICER = ROOT / ".ci/slicer.csv", ROOT / "out/python/slicer.csv"
SLICER_OVER, SLICER_RATIO = 2, 2
SLICER_CLOCKS = ("wall", "cpu")
SLICER_KEY = ("machine", "clock", "volume", "size", "rule")
# Upper limit of the mean of |frame time - target| / target in the newest version of VTK, divided by that in the oldest one.
VTK_RATIO = 1.1
VTK_RATIOS = {f"vtk-9.6-over-9.1-{mapper}-{name}": (mapper, name) for mapper in ("fixed", "gpu") for name in ("calibrated", "cold")}
# Minutes of the rehearsal of a release; commands that each user needs to try the staged files.
REHEARSAL_MINUTES, USER_COMMANDS = 15, 3
USERS = ("cargo", "pip", "c")


# ------------------------------------------------------------------------------------------------------------ results


def read(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write(path, rows, fields=FIELDS):
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="", encoding="utf-8") as file:
        out = csv.DictWriter(file, fields, lineterminator="\n")
        out.writeheader()
        out.writerows(rows)


def key(row):
    return row["system"], row["program"], row["suite"]


def ordered(rows):
    return sorted(rows, key=lambda r: (r["system"] == "all", r["system"], r["program"] != "VTK"))


def results(path):
    """The kept rows, replaced by those of the last runs here."""
    last = {key(row): row for row in read(path)} if path.exists() else {}
    kept = {key(row): row for row in read(KEPT)}
    return ordered((kept | last).values())


def values():
    """Returns {name: (value, note)}: the kept values, replaced by those of the last runs here."""
    rows = [row for path in (VALUES, LAST_VALUES) if path.exists() for row in read(path)]
    return {row["name"]: (float(row["value"]), row["note"]) for row in rows} | vtk_ratios()


def store(path, found):
    write(path, [{"name": name, "value": f"{value:.4g}", "note": note} for name, (value, note) in sorted(found.items())], VALUE_FIELDS)


def value(options):
    """Adds one value to those of the last runs here."""
    rows = read(LAST_VALUES) if LAST_VALUES.exists() else []
    found = {row["name"]: (float(row["value"]), row["note"]) for row in rows}
    store(LAST_VALUES, found | {options.name: (float(options.number), options.note)})


def vtk_ratios():
    """Ratios of the comparisons that both versions of VTK made here (lab/scripts/vtk/bars.sh)."""
    folders = [TARGET / "vtk/bars", *TARGET.glob("matrix/*/build/vtk/bars")]
    out = {}
    for bar, (mapper, name) in VTK_RATIOS.items():
        off = {}
        for version in ("9.6", "9.1"):
            for path in (path for folder in folders for path in folder.glob(f"{version}.*/{mapper}.json")):
                repeats = json.loads(path.read_text(encoding="utf-8"))["repeats"]
                if repeats and all(name in r for r in repeats):
                    off[version] = statistics.median(r[name]["cpu"]["off"] for r in repeats)
        if len(off) == 2:
            out[bar] = off["9.6"] / off["9.1"], "this machine"
    return out


# Replaces the commands of plugins/vtk/Testing/CMakeLists.txt that CMake has only in projects, and prints the names of all tests.
COUNT_TESTS = """
foreach(command IN ITEMS find_package find_program add_executable target_include_directories target_link_libraries
    vtk_module_autoinit set_tests_properties set_property)
  cmake_language(EVAL CODE "function(${command})\nendfunction()")
endforeach()
function(add_test)
  message("test: ${ARGV1}")
endfunction()
set(VALGRIND yes)
set(Python3_Interpreter_FOUND yes)
set(ENTIRE_PYTHON yes)
include("${LIST}")
"""


def suite_tests():
    """Returns {program: number of tests in this source tree of a suite}; without CMake, ParaView's only."""
    checks = (ROOT / "plugins/paraview/python/check.py").read_text(encoding="utf-8")
    out = {"ParaView": len(re.findall(r"^check\(", checks, re.M))}
    if shutil.which("cmake"):
        with tempfile.TemporaryDirectory() as folder:
            script = Path(folder) / "count.cmake"
            script.write_text(COUNT_TESTS, encoding="utf-8")
            command = ["cmake", f"-DLIST={ROOT / 'plugins/vtk/Testing/CMakeLists.txt'}", "-P", script]
            said = subprocess.run(command, check=True, capture_output=True, text=True).stderr
        out["VTK"] = len(set(re.findall(r"^test: (\S+)", said, re.M)))
    return out


def lacking_tests():
    """Lines that name the suites of which the kept results have fewer tests than this source tree."""
    for program, tests in suite_tests().items():
        for row in read(KEPT):
            if row["program"] == program and int(row["tests"]) < tests:
                yield f"{row['system']}, {program}, {row['suite']}: {row['tests']} of {tests} tests: make test-matrix, make versions"


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
    asked = suite_tests()["ParaView"]
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
    add(options.results, rows)
    print(f"results: {options.results}")
    return whole


def add(path, rows):
    """Adds rows to a file of results; rows of other suites stay."""
    new = {key(row) for row in rows}
    kept = [r for r in read(path) if key(r) not in new] if path.exists() else []
    write(path, ordered(kept + rows))


def python(options):
    """Adds the results of one environment of the Python package's tests."""
    suite, folder = options.suites[0], Path(options.places[0])
    said = (folder / f"{suite}-pytest.log").read_text(encoding="utf-8")
    count = {how: sum(int(n) for n in re.findall(rf"\b(\d+) {how}\b", said)) for how in ("passed", "failed", "error", "errors")}
    installed = dict(re.findall(r"^(\S+)==(\S+)", (folder / f"{suite}-versions.txt").read_text(encoding="utf-8"), re.M))
    versions = [f"{shown} {installed[name]}" for name, shown in PACKAGES.items() if name in installed]
    row = dict.fromkeys(FIELDS, "") | {
        "system": "Python " + ".".join(installed["python"].split(".")[:2]), "program": PYTHON, "suite": suite,
        "version": ", ".join(versions), "passed": count["passed"], "tests": sum(count.values()),
    }  # fmt: skip
    add(options.results, [row])


# --------------------------------------------------------------------------------------------------------------- bars


def of_version(rows, program, version):
    return [r for r in rows if r["program"] == program and re.match(rf"{re.escape(version)}\b", r["version"])]


def slicer_rows():
    """Rows of the comparison with Slicer's rule: the kept ones, replaced by those of the last runs here with the same
    machine, clock, volume and size. Rows of an older format are left out."""
    rows = [row for path in (SLICER, LAST_SLICER) if path.exists() for row in read(path)]
    return list({tuple(row[k] for k in SLICER_KEY): row for row in rows if row.keys() >= set(SLICER_KEY)}.values())


def slicer_bars(out):
    for clock in SLICER_CLOCKS:
        over = {}
        for row in slicer_rows():
            if row["clock"] == clock:
                scene = f"{row['machine']}: {row['volume']}, {row['size']} x {row['size']} pixels"
                over.setdefault(scene, {})[row["rule"]] = float(row["over_percent"])
        names = [f"slicer-frames-over-percent-{clock}", f"slicer-own-rule-over-ours-{clock}"]
        if not over:
            out.lacking(f'Slicer\'s rule was not measured: make bars-slicer SLICER_FLAGS="--clock {clock}"', names)
            continue
        # Of several machines, the one with most of our frames over the target counts.
        scene = max(over, key=lambda s: over[s]["entire"])
        ours, theirs = over[scene]["entire"], over[scene]["slicer"]
        out.found(names[0], ours, f"{scene}; Slicer's own rule: {theirs:g} %")
        # If none of our frames is over, the ratio is infinite.
        out.found(names[1], theirs / ours if ours else float("inf") if theirs else 0, scene)


def workflow_bars(out):
    program = shutil.which("zizmor", path=os.pathsep.join([os.environ.get("PATH", ""), str(TARGET / "tools/bin")]))
    if not program:
        out.lacking("zizmor is not installed (pip install zizmor)", ["zizmor-findings"])
        return
    done = subprocess.run([program, "--offline", "--quiet", "--format", "json", ".github"], cwd=ROOT, capture_output=True, text=True)
    with out.part("zizmor-findings"):
        findings = [f"{f['ident']}: {f['desc']}" for f in json.loads(done.stdout)]
        out.count("zizmor-findings", findings)


def bars(options):
    names = {f"{p.lower()}-{v}-tests": (p, v) for p, versions in VERSIONS.items() for v in versions}
    asked = dict.fromkeys(names, 1) | {
        "compiler-warnings": WARNINGS, "tests-that-no-vtk-ran": 0,
        "matrix-from-nothing-minutes": MINUTES_FROM_NOTHING, "matrix-kept-folders-minutes": MINUTES_KEPT,
    }  # fmt: skip
    for clock in SLICER_CLOCKS:
        asked |= {f"slicer-frames-over-percent-{clock}": SLICER_OVER, f"slicer-own-rule-over-ours-{clock}": SLICER_RATIO}
    single = dict.fromkeys(VTK_RATIOS, VTK_RATIO) | {"release-rehearsal-minutes": REHEARSAL_MINUTES}
    single |= {f"release-user-{user}-commands": USER_COMMANDS for user in USERS} | {"oldest-rust-tests-failed": 0}
    asked |= single | {"zizmor-findings": 0}
    with Bars(asked, at_least={*names, *(f"slicer-own-rule-over-ours-{clock}" for clock in SLICER_CLOCKS)}) as out:
        slicer_bars(out)
        found = values()
        for name in single:
            if name in found:
                out.found(name, *found[name])
        workflow_bars(out)
        rows = results(options.results)
        newest = suite_tests()
        for name, (program, version) in names.items():
            mine = of_version(rows, program, version)
            if not mine:
                out.lacking(f"no {program} {version} was tested: make test-matrix", [name])
                continue
            # The number of tests of a suite is the largest that any version or this source tree has.
            suites = {
                r["suite"]: max(newest.get(program, 0), *(int(s["tests"]) for s in rows if s["suite"] == r["suite"] and s["tests"]))
                for r in mine
            }
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
                made = sum(s for (_, program), s in seconds.items() if program in ("folder", "C library"))
                out.found("matrix-from-nothing-minutes", (tested + made) / 60)
        out.lacking("the rehearsal of a release did not run: make release-rehearsal", [n for n in single if n.startswith("release")])
        out.lacking("the tests did not run with the oldest Rust: make test-all", ["oldest-rust-tests-failed"])
        out.lacking("both versions of VTK were not compared: lab/scripts/vtk/bars.sh compare, without and with VTK_DEBIAN=testing", list(VTK_RATIOS))
        out.lacking("not every version was tested: make test-matrix")


# ---------------------------------------------------------------------------------------------------------- documents


def table(rows):
    """The rows of two Markdown tables: one row for each system, and one for each environment of Python."""
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
    mine = [r for r in rows if r["program"] == PYTHON]
    if mine:
        yield from ("", "| Python package with | Python | tests passed |", "|---|---|---|")
    for row in mine:
        yield f"| {row['version']} | {row['system'].split()[-1]} | {row['passed']} of {row['tests']} |"


def phrase(rows, program):
    """Returns a phrase such as "VTK 9.1, 9.3 and 9.6": the versions of which no test failed."""
    whole = []
    for row in rows:
        mine = [r for r in rows if r["program"] == program and r["version"] == row["version"]]
        if mine and all(int(r["passed"]) + len(r["skipped"].split()) == int(r["tests"]) for r in mine):
            whole.append(".".join(row["version"].split(".")[:2]))
    whole = sorted(set(whole), key=lambda v: [int(n) for n in v.split(".")])
    return f"{program} " + (" and ".join([", ".join(whole[:-1]), whole[-1]]) if len(whole) > 1 else "".join(whole))


def tested(rows):
    """Lines of a name and of the versions with which all tests passed, for `entire doctor`."""
    versions = {program: [] for program in VERSIONS} | {name: [] for name in PACKAGES}
    named = {shown: name for name, shown in PACKAGES.items()}
    for program in VERSIONS:
        versions[program] += re.findall(r"\d+\.\d+", phrase(rows, program))
    for row in rows:
        if row["program"] == PYTHON and row["passed"] == row["tests"]:
            for part in row["version"].split(", "):
                shown, _, version = part.rpartition(" ")
                versions[named[shown]].append(".".join(version.split(".")[:2]))
    for name, mine in versions.items():
        if mine:
            yield f"{name}: {' '.join(sorted(set(mine), key=lambda v: [int(n) for n in v.split('.')]))}\n"


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
    path = ROOT / "cli/src/commands/tested-versions.txt"
    yield path, path.read_text(encoding="utf-8") if path.exists() else "", "".join(tested(rows))


def stale():
    """Lines that name the documents that differ from the kept results."""
    rows = read(KEPT)
    return [f"{path.relative_to(ROOT)} names other versions than {KEPT.relative_to(ROOT)}: make versions"
            for path, text, must in documents(rows) if text != must]  # fmt: skip


def keep(options):
    write(KEPT, results(options.results))
    store(VALUES, values())
    rows = slicer_rows()
    if rows:
        write(SLICER, sorted(rows, key=lambda r: (r["clock"], r["machine"], r["rule"])), list(rows[0]))
    for path, text, must in documents(read(KEPT)):
        if text != must:
            path.write_text(must, encoding="utf-8")
            print(f"wrote {path.relative_to(ROOT)}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("record", "python", "value", "bars", "keep", "check"))
    parser.add_argument("name", nargs="?", help="the bar of a value")
    parser.add_argument("number", nargs="?", help="the value")
    parser.add_argument("note", nargs="?", default="", help="the machine, or the tested parts")
    parser.add_argument("--results", type=Path, default=LAST, help="the file of results (default out/matrix/results.csv)")
    parser.add_argument("--library", type=int, default=0, help="wall seconds of building the C library")
    parser.add_argument("--suites", nargs="*", default=(), help="NAME,PROGRAM,ENDED,SECONDS")
    parser.add_argument("--places", nargs="*", default=(), help="NAME=ROOT=VTK'S RESULTS=PARAVIEW'S RESULTS")
    options = parser.parse_args()
    if options.what == "record":
        return int(not record(options))
    if options.what == "python":
        return python(options)
    if options.what == "value":
        return value(options)
    if options.what == "bars":
        return bars(options)
    if options.what == "keep":
        return keep(options)
    lines = stale()
    print("\n".join(lines))
    return int(bool(lines))


if __name__ == "__main__":
    sys.exit(main())
