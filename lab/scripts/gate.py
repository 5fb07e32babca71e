#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""The bars of the gates (sets of tests and checks): duration, skipped tests, removed tests, tests of VTK and ParaView that
the kept results lack.

    gate.py [--before REVISION]         prints `bar NAME VALUE LIMIT ok|short`; exit status 1 when one is short
    gate.py --measure [demo test change nightly]
                                        first runs these gates in a clone of HEAD, each with nothing built (change takes
                                        half an hour, nightly hours), and keeps their logs and seconds in out/test

Seconds come from out/test/steps.csv, which every gate writes. Of a step, the processor time is compared with the
committed .ci/steps.csv, since other programs on the machine change it little. Needs Python 3.9 and git, and nothing
else.
"""
import argparse
import csv
import os
import re
import resource
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import reach
from bar_lines import Bars

ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "out/test"
# Limits in wall seconds on two processors, with all crates downloaded and nothing built.
WALL_SECONDS = {"demo": 140, "test": 900, "change": 2100}
COMMANDS = {"demo": ["make", "demo"], "test": ["make", "test"], "change": [".ci/run"], "nightly": [".ci/nightly"]}
# The gates that list their skips.
SKIPPING = ("change", "nightly")
# A step counts as doubled if its processor time is over twice the committed time, and over the committed time plus this
# many seconds.
NOISE_SECONDS = 20
# Renamed and divided tests: old name, and the new name, or several new names separated by blanks.
RENAMED = {
    "a_ladder_climbs_no_further_than_the_plan_needs": "an_adaptive_probe_is_refined_no_further_than_the_plan_needs",
    "frames_of_the_training_paths_change_no_faster_than_the_ladder_takes_for_granted":
        "frames_of_the_training_paths_change_no_faster_than_the_adaptive_probe_assumes",
    "the_committed_header_is_that_of_the_source": "the_committed_headers_are_those_of_the_source",
    "arrows_between_the_rooms_of_core_never_point_back": "arrows_between_the_rooms_of_a_crate_never_point_back",
    "arrows_between_the_rooms_of_command_and_laboratory_never_point_back":
        "arrows_between_the_rooms_of_a_crate_never_point_back the_product_knows_nothing_of_the_laboratory",
    "the_analytic_model_is_one_layer_with_costs_that_are_not_negative": "unit_costs_are_one_layer_and_not_negative",
    "demo_goes_from_a_volume_to_a_report_and_its_model_steers": "demo_calibrates_on_other_volumes_and_its_model_steers",
    "calibration_recovers_the_factor_of_another_machine": "three_frames_set_the_speed_alone",
    "few_or_broken_frames_change_nothing_and_factors_are_bounded": "broken_measurements_are_left_out_and_all_broken_is_an_error",
    "a_log_of_observations_fine_tunes_a_network_for_another_machine":
        "sixty_observed_frames_bring_an_unknown_renderer_within_ten_percent",
    "changes_that_prove_true_are_taken_and_jitter_is_not":
        "a_jump_of_the_machine_is_followed_within_twenty_frames_both_ways single_spikes_barely_move_it",
    "exact_non_negative_solutions_are_found": "exact_times_give_back_their_costs",
    "every_scene_but_one_fails_for_a_rival": "every_scene_fails_for_a_rival",
    "zero_and_duplicate_columns_are_harmless": "a_handful_of_equal_frames_is_enough_to_set_the_scale",
    "solutions_meet_the_optimality_conditions": "a_calibration_finds_another_machines_unit_costs",
    "grahams_worst_case_is_met_exactly": "exchanges_repair_grahams_worst_case",
    "nonsense_is_refused_with_the_culprit_named": "nonsense_is_refused",
    "no_assignment_beats_the_bound": "longest_first_is_within_grahams_bound_of_the_optimum",
    "the_counter_counts": "an_allocation_aborts_the_process",
    "a_recording_and_its_predictor_keep_to_one_probe": "a_recording_starts_from_unit_costs_alone",
    "every_prediction_is_a_positive_number_of_seconds": "no_more_predictions_than_are_known_had_to_be_made_positive",
    "rules_can_fail": "every_scene_fails_for_a_rival",
    "a_posterior_finds_another_machines_unit_costs_and_keeps_the_rest": "a_calibration_finds_another_machines_unit_costs",
    "ten_frames_set_the_speed_and_no_model_but_a_residual_one_is_a_prior": "three_frames_set_the_speed_alone",
    "the_model_of_the_nearest_machine_is_started_from": "all_makes_of_machine_are_started_from",
    "a_draw_judges_by_other_members_than_it_calibrates_to": "a_draw_takes_one_member_of_each_ensemble_and_its_volumes_in_turn",
    "the_rule_takes_the_quickest_of_the_good_ones_and_looks_at_no_test_frame":
        "the_rule_takes_the_smallest_of_the_good_ones_and_looks_at_no_test_frame",
    "the_quickest_of_the_good_ones_is_chosen_and_a_latency_that_is_too_long_never":
        "the_smallest_is_chosen_that_none_beats_on_every_machine",
    "bars_are_about_the_selected_predictor_where_the_study_has_one":
        "bars_are_about_the_selected_predictor_where_the_rule_selects_one",
    "slabs_and_threads_change_no_bit": "threads_change_no_bit",
    "a_table_has_one_writer": "a_table_has_one_writer_at_a_time",
    "a_helper_changes_no_bit": "parts_of_a_batch_change_no_bit",
    "pools_change_no_bit": "threads_change_no_bit",
    "a_scratch_of_equal_sizes_and_other_borders_is_made_to_fit": "another_networks_scratch_is_made_to_fit",
    "closed_loop_table": "ours_passes_every_scene",
    "prediction_with_feedback_beats_reaction_at_switches_and_in_calm": "ours_passes_every_scene",
    "files_of_other_writers_come_back_voxel_for_voxel": "every_fixture_is_read_as_independent_readers_read_it",
    "blocks_of_any_edge_draw_the_same_picture_with_other_work":
        "render_skips_without_changing_the_picture_and_range_changes_it",
    "edges_are_checked_and_followed": "blocks_hold_their_voxels_and_one_layer_more",
    "affinity_saves_loads": "every_plan_counts_the_loading_times",
    "lobe_numbers_are_one_or_two_numbers": "wrong_ranges_are_named",
    "a_session_that_records_what_it_observes_allocates_nothing": "plan_choose_predict_and_observe_never_allocate",
    "the_page_holds_every_chart_and_fetches_nothing": "a_page_fetches_nothing",
    "broken_values_break_the_line_and_never_reach_the_file": "every_kind_of_chart_is_drawn",
    "empty_and_constant_data_have_a_span": "every_finite_span_has_few_ticks_and_places_that_fit_a_coordinate",
    "files_round_trip": "parallel_cameras_are_interpolated_in_their_scale_and_switch_to_others",
    "seconds_that_no_frame_takes_are_refused": "the_writer_refuses_what_could_not_be_read_back",
    "geometry_holds_in_any_unit_of_length": "geometry_is_that_of_the_spacing_in_any_unit_of_length",
    "geometry_is_spacing_aware": "geometry_is_that_of_the_spacing_in_any_unit_of_length",
    "a_volume_of_voxels_costs_the_same_in_any_unit": "any_other_unit_changes_rounding_alone",
    "a_volume_of_bricks_costs_the_same_in_any_unit": "any_other_unit_changes_rounding_alone",
    "cell_bounds_are_those_of_their_voxels_and_the_next":
        "every_type_range_and_layout_is_summarized_as_defined",
    "commands_of_other_programs_never_see_a_panic":
        "arbitrary_bytes_never_panic_and_never_take_more_memory_than_they_call_for",
    "two_drivers_do_not_work_on_one_database": "whole_lines_are_read_back_and_a_torn_one_is_cut_off",
    "warm_up_repeats_are_rendered_before_every_frame_and_not_timed":
        "ctrl_c_keeps_finished_frames_and_resuming_completes_them",
    "hostile_models_predict_positive_seconds_or_are_refused":
        "times_that_are_not_positive_are_the_shortest_one_and_not_trusted",
    "a_second_writer_of_a_table_is_refused_and_ruins_nothing": "a_table_has_one_writer_at_a_time",
    "any_bytes_are_an_error_and_never_a_panic":
        "arbitrary_bytes_never_panic_and_never_take_more_memory_than_they_call_for",
    "sizes_are_checked_in_wide_arithmetic": "lies_are_named_with_what_was_expected_and_found",
    "likeness_is_one_for_equal_pictures_and_falls": "sizes_and_likeness_are_those_of_the_image_crates",
    "below_a_file": "files_that_cannot_be_written_are_named",
    "in_a_read_only_folder": "files_that_cannot_be_written_are_named",
    "times_that_no_frame_takes_are_refused": "bad_input_is_refused_with_a_reason",
    "several_components_and_missing_files_are_refused":
        "missing_files_and_folders_are_refused every_fixture_is_read_as_independent_readers_read_it",
    "changing_calls_forget_the_last_error_and_reading_ones_do_not": "every_successful_call_forgets_the_last_error",
    "text_is_cut_at_a_character_and_the_length_is_that_of_the_whole":
        "a_text_is_cut_at_a_character_and_ends_with_its_nul",
    "a_system_call_is_noticed": "no_syscall::a_system_call_is_noticed",
}
# Tests of parts that were removed.
REMOVED = {
    "a mean of several fits, and a solver for non-negative costs": [
        "the_mean_of_fits_adds_up_their_estimates",
        "beliefs_count_by_their_errors_and_speed_alone_wins_where_nothing_is_better",
        "a_negative_pull_ends_at_zero",
    ],
    "selection of predictors by nested cross-validation": [
        "neither_choice_nor_bound_sees_predictions_of_models_that_saw_the_outer_part",
        "a_candidate_that_suits_one_member_gains_nothing_from_it",
        "what_is_made_without_parts_holds_no_frame_of_theirs",
        "pairs_are_fitted_once_and_give_the_same_on_any_number_of_threads",
        "a_grid_holds_every_combination_once_and_shares_what_does_not_differ",
        "what_a_grid_may_not_say_is_refused",
        "recipes_are_the_same_that_make_the_same_and_of_one_shape_that_are_equally_quick",
        "select_says_what_it_cannot_do_before_any_candidate_is_made",
    ],
    "a second thread for predictions": [
        "several_callers_share_one_helper",
        "work_that_unwinds_is_reported_and_frees_the_helper",
        "work_is_done_with_and_without_a_thread",
    ],
    "farms that draw one picture from parts of a volume, and factors by direction": [
        "compositing_is_counted_and_found_again",
        "boxes_cover_the_volume_once",
        "parts_take_the_samples_of_the_whole_and_are_predicted",
        "a_cost_that_depends_on_the_direction_is_found_and_holds_for_other_poses",
    ],
    "a limit on the change of a prediction": ["a_scene_begins_with_its_own_prediction_and_nothing_unbounds_it"],
    "volumes given slab by slab, and a chosen number of cells": [
        "options_out_of_range_are_refused",
        "slabs_that_do_not_fit_are_refused_and_leave_no_trace",
    ],
    "training losses": ["a_high_quantile_lies_above_that_share_of_frames"],
}
# Patterns of test names in source files: of Rust, libtest-mimic, Python and CMake.
NAMES = {
    ".rs": [r"#\[test\](?:\s*#\[[^\]]*\])*\s*(?:pub\s+)?fn\s+(\w+)", r"Trial::test\(\s*\"([^\"]+)\""],
    ".py": [r"^\s*def (test_\w+)"],
    "CMakeLists.txt": [r"add_test\(NAME (\S+)", r"^\s{6}([A-Z]\w+(?: [A-Z]\w+)*)\)?$", r"IN ITEMS ([A-Z]\w+(?: [A-Z]\w+)+)"],
}


def steps(path):
    """Returns {gate: {step: (wall seconds, processor seconds)}} of a steps.csv."""
    found = {}
    if path.is_file():
        for row in csv.DictReader(path.read_text(encoding="utf-8").splitlines()):
            numbers = tuple(float(row[c]) if row[c] else None for c in ("wall_s", "cpu_s"))
            found.setdefault(row["gate"], {})[row["step"]] = numbers
    return found


def test_names(tree):
    """Returns the names of all tests in a source tree, without modules; names with blanks are split into words."""
    found = set()
    for path in tree.rglob("*"):
        if any(part in ("target", "out", ".git") for part in path.parts) or not path.is_file():
            continue
        patterns = NAMES.get(path.name) or NAMES.get(path.suffix)
        if patterns:
            text = path.read_text(encoding="utf-8", errors="replace")
            for pattern in patterns:
                for match in re.findall(pattern, text, re.MULTILINE):
                    found.update(match.split())
    return found


def names_at(revision):
    with tempfile.TemporaryDirectory(prefix="gate-") as folder:
        archive = subprocess.run(["git", "archive", revision], cwd=ROOT, check=True, capture_output=True).stdout
        subprocess.run(["tar", "x", "-C", folder], input=archive, check=True)
        return test_names(Path(folder))


def measure(gates):
    """Runs gates in a clone of HEAD with an empty target folder, and adds their rows to out/test/steps.csv."""
    OUT.mkdir(parents=True, exist_ok=True)
    rows = steps(OUT / "steps.csv")
    with tempfile.TemporaryDirectory(prefix="gate-") as folder:
        tree = Path(folder) / "tree"
        subprocess.run(["git", "clone", "--quiet", "--no-hardlinks", ROOT, tree], check=True)
        kept = {name: value for name, value in os.environ.items() if name not in ("CARGO_TARGET_DIR", "MAKEFLAGS")}
        for gate in gates:
            for built in ("target", "fuzz/target"):
                shutil.rmtree(tree / built, ignore_errors=True)
            begin, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
            with open(OUT / f"{gate}.log", "w", encoding="utf-8") as log:
                done = subprocess.run(COMMANDS[gate], cwd=tree, env=kept, stdout=log, stderr=subprocess.STDOUT)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            wall = time.monotonic() - begin
            cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            load = " ".join(f"{x:.1f}" for x in os.getloadavg())
            print(f"{gate}: {wall:.0f} s, processor {cpu:.0f} s, exit status {done.returncode}, load {load}; out/test/{gate}.log", flush=True)
            rows[gate] = steps(tree / "out/test/steps.csv").get(gate, {})
            rows[gate].pop("total", None)
            if done.returncode == 0:
                rows[gate]["total"] = (round(wall), round(cpu))
            if (tree / f"out/test/skipped-{gate}").is_file():
                shutil.copy(tree / f"out/test/skipped-{gate}", OUT)
            with open(OUT / "steps.csv", "w", encoding="utf-8") as file:
                print("gate,step,wall_s,cpu_s", file=file)
                for name, parts in rows.items():
                    for step, (w, c) in parts.items():
                        print(f"{name},{step},{w:.0f},{'' if c is None else f'{c:.0f}'}", file=file)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--measure", nargs="*", choices=COMMANDS, metavar="GATE", help="first run these gates in a clone (default demo test change)")
    parser.add_argument("--before", default="5c08403", help="revision whose tests must all still exist (default %(default)s)")
    options = parser.parse_args()
    if options.measure is not None:
        measure(options.measure or ["demo", "test", "change"])

    asked = {f"gate/{gate}-wall-s": limit for gate, limit in WALL_SECONDS.items()}
    asked |= dict.fromkeys(("gate/nightly-failed", *(f"gate/{g}-skips-not-as-expected" for g in SKIPPING)), 0)
    asked |= {"gate/steps-doubled": 0, "gate/tests-lost": 0, "gate/suites-that-the-matrix-lacks": 0}
    with Bars(asked) as bars:
        judge(bars, options.before)


def judge(bars, before):
    found, committed = steps(OUT / "steps.csv"), steps(ROOT / ".ci/steps.csv")
    for gate in WALL_SECONDS:
        total = found.get(gate, {}).get("total")
        if total:
            bars.found(f"gate/{gate}-wall-s", total[0])
    if "total" in found.get("nightly", {}):
        bars.found("gate/nightly-failed", 0)
    for gate in SKIPPING:
        # A failed gate has not reached all of its skips.
        if "total" in found.get(gate, {}) and (OUT / f"skipped-{gate}").is_file():
            compared = subprocess.run([".ci/compare-skips", gate], cwd=ROOT, text=True, capture_output=True)
            bars.count(f"gate/{gate}-skips-not-as-expected", compared.stdout.splitlines())
    doubled = []
    for gate, parts in committed.items():
        for step, (_, once) in parts.items():
            cpu = found.get(gate, {}).get(step, (None, None))[1]
            if step != "total" and None not in (cpu, once) and cpu > 2 * once and cpu > once + NOISE_SECONDS:
                doubled.append(f"{gate}, {step}: processor {cpu:.0f} s, committed {once:.0f} s")
    # A failed gate has no times of the steps after its failure, and the bar then has no value.
    if committed and all("total" in found.get(gate, {}) for gate in committed):
        bars.count("gate/steps-doubled", doubled)
    now = test_names(ROOT)
    removed = {name for names in REMOVED.values() for name in names}
    lost = (name for name in names_at(before) - removed if not now.issuperset(RENAMED.get(name, name).split()))
    bars.count("gate/tests-lost", sorted(lost))
    if "VTK" in reach.suite_tests():
        bars.count("gate/suites-that-the-matrix-lacks", list(reach.lacking_tests()))
    else:
        bars.lacking("CMake is not installed (apt-get install cmake)", ["gate/suites-that-the-matrix-lacks"])
    bars.lacking('a gate was not run here: make bars-gate GATES="demo test change nightly"')


if __name__ == "__main__":
    main()
