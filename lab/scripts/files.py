#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""The bars of files: volume files as users have them, and results that commands keep.

    files.py [--seconds 600] [--neighbors 2000] [--only NAME...]

Prints `bar NAME VALUE LIMIT ok|short`; exit status 1 when one is short. Runs tests by their names (a name that no test has
counts as failed), the differential test of readers (lab/scripts/readers/differential.py), the check of options
(lab/scripts/house.py), and the fuzz targets of all readers for `--seconds` in all. Needs Python 3.9 and cargo; the
differential test needs the Python packages that it names.
"""
import argparse
import os
import re
import subprocess
import sys
from pathlib import Path

from bar_lines import Bars

ROOT = Path(__file__).resolve().parents[2]
READERS = "nrrd metaimage vti nifti json raw table manifest path tasks trace"
# The test of every file in cli/tests/fixtures.
FIXTURES = "every_fixture_is_read_as_independent_readers_read_it"
# Situations that users reported, each with the tests that check the right result.
SITUATIONS = {
    "a farm's input is written anew": ["a_resumed_database_shows_what_its_files_are_now"],
    "a time step is inserted or removed": ["a_resumed_database_shows_what_its_files_are_now",
                                             "the_order_of_volumes_is_listed_and_nothing_is_rendered"],
    "a table's volume is written anew": ["a_table_is_not_gone_on_with_after_its_volume_was_written_anew"],
    "reserved arrays of VTK": ["the_active_scalars_are_read_and_arrays_of_vtk_itself_never",
                               "arrays_are_read_by_name_and_chosen_in_the_order_of_the_file", FIXTURES],
    "cell scalars beside point vectors": ["the_active_scalars_are_read_and_arrays_of_vtk_itself_never", FIXTURES],
    "byte order marks": ["byte_order_marks_are_no_part_of_the_text", FIXTURES],
    "negative byte skips": ["voxels_stand_before_the_end_where_the_byte_skip_is_negative", FIXTURES],
    "directions that say nothing": ["spacings_count_where_directions_say_nothing", FIXTURES],
    "fill values": ["fill_values_do_not_decide_the_range", "fill_values_are_drawn_as_the_low_end"],
    "bytes behind the voxels": ["bytes_behind_the_voxels_follow_one_rule_in_all_formats", FIXTURES],
    "names, lists, several files, compressors": [
        "names_in_capitals_are_known", "voxels_in_several_files_are_read_in_their_order",
        "pieces_of_vtk_are_read", "lists_of_spreadsheets_are_read", FIXTURES],
    "bytes of a narrow range": ["bytes_of_a_narrow_range_are_said_and_can_be_spanned"],
}
# Commands that keep results, each with the tests that change an input (content, name, order, settings and so on) and
# expect new results.
KEPT = {
    "farm": ["a_resumed_database_shows_what_its_files_are_now", "a_resumed_database_follows_the_settings",
             "data_files_of_headers_count_too", "programs_that_are_told_times_draw_them_anew",
             "a_file_that_changes_while_it_is_drawn_gives_no_picture"],
    "collect": ["a_table_is_not_gone_on_with_after_its_volume_was_written_anew", "tables_keep_how_volumes_are_read"],
    "features": ["a_table_is_not_gone_on_with_after_its_volume_was_written_anew"],
    "record": ["a_recording_is_not_gone_on_with_after_a_volume_was_written_anew"],
    "calibrate": ["a_machines_model_is_made_found_and_says_its_clock"],
}
BARS = {"situations-right": len(SITUATIONS), "stale-results": 0, "files-read-alike": 100, "options-in-no-document": 0,
        "fuzz-crashes": 0, "fuzz-slowest-seconds": 1, "fuzz-peak-megabytes": 1024}


def run(*command, **options):
    return subprocess.run(command, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **options)


def passed_tests():
    """Runs the tests that SITUATIONS and KEPT name; returns the names of those that pass."""
    names = sorted({name for tests in [*SITUATIONS.values(), *KEPT.values()] for name in tests})
    found = run("cargo", "test", "--workspace", "--features", "entire-cli/explore", "--lib", "--test", "suite", "--no-fail-fast",
                "--", *names, env={**os.environ, "CARGO_INCREMENTAL": "0"})
    return set(re.findall(r"^test (?:\S*::)?(\w+) \.\.\. ok$", found.stdout, re.M))


def fuzz(bars, seconds):
    targets = READERS.split()
    found = run("bash", "scripts/fuzz.sh", "keep", str(seconds), *targets)
    print(found.stdout, end="")
    crashes = found.stdout.count("FAILED: fuzz target")
    if "fuzz-smoke: skipped: " in found.stdout or found.returncode and not crashes:
        bars.lacking("the fuzz targets did not run; see above")
        return
    slowest, peak = 0, 0
    for target in targets:
        log = (ROOT / f"out/fuzz/{target}.log").read_text(errors="replace")
        slowest = max([slowest, *map(int, re.findall(r"slowest_unit_time_sec:\s*(\d+)", log))])
        peak = max([peak, *map(int, re.findall(r"peak_rss_mb:\s*(\d+)", log))])
    bars.found("fuzz-crashes", crashes)
    bars.found("fuzz-slowest-seconds", slowest, "of one input, whole seconds, with the address sanitizer")
    bars.found("fuzz-peak-megabytes", peak, "of a target, with the address sanitizer")


def bar_of(text, name):
    """Returns the value of a bar in the output of another command; None if there is none."""
    found = re.search(rf"^bar {name} (\S+) ", text, re.M)
    return float(found[1].rstrip("%")) if found and found[1] != "-" else None


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--seconds", type=int, default=600, help="seconds of fuzzing, all targets together")
    arguments.add_argument("--neighbors", type=int, default=2000, help="mutated fixtures that all readers read")
    arguments.add_argument("--only", nargs="+", choices=BARS, default=list(BARS), help="bars to measure")
    options = arguments.parse_args()
    asked = {name: BARS[name] for name in options.only}
    with Bars(asked, at_least={"situations-right", "files-read-alike"}) as bars:
        if {"situations-right", "stale-results"} & asked.keys():
            passed = passed_tests()
            wrong = [what for what, tests in SITUATIONS.items() if not passed.issuperset(tests)]
            stale = [what for what, tests in KEPT.items() if not passed.issuperset(tests)]
            if "situations-right" in asked:
                bars.found("situations-right", len(SITUATIONS) - len(wrong), ", ".join(wrong))
            if "stale-results" in asked:
                bars.found("stale-results", len(stale), ", ".join(stale) or "of " + ", ".join(KEPT))
        if "files-read-alike" in asked:
            found = run(sys.executable, "lab/scripts/readers/differential.py", "--neighbors", str(options.neighbors))
            print(re.sub(r"(?m)^bar .*\n", "", found.stdout), end="")
            # The printed percentage is rounded; the numbers of reads after it are not.
            reads = re.search(r"^bar files-read-alike .*# (\d+) of (\d+) reads", found.stdout, re.M)
            bars.found("files-read-alike", 100 * int(reads[1]) / int(reads[2]) if reads else None, "percent")
        if "options-in-no-document" in asked:
            built = os.path.join(os.environ.get("CARGO_TARGET_DIR") or "target", "debug")
            found = run(sys.executable, "lab/scripts/house.py", "--quick", "--bin-dir", built)
            bars.found("options-in-no-document", bar_of(found.stdout, "options-in-no-document"))
        if any(name.startswith("fuzz") for name in asked):
            fuzz(bars, options.seconds)


if __name__ == "__main__":
    main()
