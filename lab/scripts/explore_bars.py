"""Measures the bars of the window of `entire explore`: prints `bar NAME VALUE LIMIT ok|short` for each, and ends with
status 1 when one is short.

    python3 lab/scripts/explore_bars.py ENTIRE [--out DIR] [--only NAME,…]

ENTIRE is the command, built with the feature `explore`. Everything runs under Xvfb, with the Vulkan driver of the
machine. The frame logs stay in DIR. A bar that cannot be measured is `-` and short.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median_high
from types import SimpleNamespace

from bar_lines import Bars

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "explore/tests"))
import window_tools as tools  # noqa: E402

VOLUME = ROOT / "data/nyx_cosmology/m01/t0010.nrrd"
PRESETS = ["layers", "core", "haze", "shell", "ramp", "solid"]
FRAMES = 600
SWITCHES = 12
INTERFACE_FRAMES = 120
MANY_FRAMES = 10_000


def at(frame, **action):
    return json.dumps({"frame": frame, **action})


def session():
    """Returns a script of 600 frames: the camera turns, the transfer function switches 12 times, and every third switch
    also moves the camera."""
    lines = [at(0, spin=[1.2, 0.1])]
    for i in range(1, SWITCHES + 1):
        frame = i * FRAMES // (SWITCHES + 1)
        lines.append(at(frame, preset=PRESETS[i % len(PRESETS)]))
        if i % 3 == 0:
            lines.append(at(frame, camera=[10 + 5 * i, 40 * i, 1.6 + 0.1 * i]))
    return lines + [at(FRAMES, quit=True)]


def numbers(rows, column):
    return [float(row[column]) for row in rows if row[column]]


def steering(bars, command, display, folder):
    log = tools.run_script(command, display, session(), folder, [VOLUME])
    rows = log["frame"]
    switched = sum(int(r["switched"]) for r in rows)
    assert len(rows) == FRAMES and switched >= SWITCHES, f"{len(rows)} frames, {switched} switches"
    errors = [float(r["seconds"]) / float(r["target_seconds"]) - 1 for r in rows]
    print(f"     {FRAMES} frames of 1280 x 800, {switched} switches, target {float(rows[0]['target_seconds']) * 1e3:.0f} ms")
    bars.found("explore_missed_share", sum(e > 0.25 for e in errors) / FRAMES)
    bars.found("explore_mean_error", sum(map(abs, errors)) / FRAMES)


def interface(bars, command, display, folder):
    """Measures the processor time of layout, presentation and drawing of the interface. A software device draws on one
    thread here, so that its drawing time is processor time; the drawing time of a GPU is not added."""
    probed = subprocess.run([str(command), "probe", "--device", "vulkan", "--json"], capture_output=True, text=True, check=True)
    software = json.loads(probed.stdout)["limits"]["is_software"]
    single = SimpleNamespace(environment={**display.environment, "LP_NUM_THREADS": "1"})
    lines = [at(0, spin=[1.2, 0.1]), at(INTERFACE_FRAMES, quit=True)]
    rows = tools.run_script(command, single, lines, folder, [VOLUME])["frame"]
    parts = [numbers(rows, f"{n}_seconds") for n in ("interface_cpu", "handing_cpu", "shown")]
    assert [len(part) for part in parts] == 3 * [INTERFACE_FRAMES] and min(parts[0]) > 0, "the log lacks processor times"
    layout, handing, shown = (1e3 * median_high(part) for part in parts)
    print(f"     processor time: layout {layout:.3f} ms, presentation {handing:.3f} ms; from the recording of commands to the end "
          f"of drawing, with presentation: {shown:.1f} ms " + ("of processor time" if software else "of GPU time"))
    # The layout thread records the commands, so that layout time and drawing time both include the recording.
    sums = [l + (max(h, s) if software else h) for l, h, s in zip(*parts)]
    bars.found("explore_interface_ms", 1e3 * median_high(sums), "layout, presentation, drawing")


def latency(bars, command, display, folder):
    log = folder / "frames.csv"
    program = subprocess.Popen(
        list(map(str, [command, "explore", VOLUME, "--log", log])),
        env={**display.environment, "XDG_STATE_HOME": str(folder)},
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        window = display.window("entire explore - ")
        display.xdotool("windowmove", "--sync", window, 0, 0)
        display.xdotool("windowfocus", "--sync", window)
        x = display.xdotool
        for turn in range(6):
            x("mousemove", 200, 300)
            x("mousedown", 1)
            for i in range(25):
                x("mousemove", 200 + 8 * i, 300 + 3 * turn)
                time.sleep(0.015)
            x("mouseup", 1)
        x("key", "ctrl+q")
        _, said = program.communicate(timeout=120)
        assert program.returncode == 0, said
    finally:
        program.kill()
    lags = [int(r["input_frames"]) for r in tools.read_log(log)["frame"] if int(r["input_frames"]) > 0]
    print(f"     {len(lags)} frames drawn for events of the mouse")
    assert len(lags) > 20
    bars.found("explore_input_frames", max(lags))


def opening(bars, command, display, folder):
    volume = folder / "ball-256.nrrd"
    tools.write_volume(volume, 256)
    seconds = []
    for _ in range(5):
        log = tools.run_script(command, display, [at(3, quit=True)], folder, [volume])
        seconds.append(float(log["open"][0]["seconds"]))
    bars.found("explore_open_seconds", median_high(seconds))


def resting(bars, command, display, folder):
    lines = [at(0, preset="layers"), at(0, camera=[20, 30, 2.2])]
    for i in range(5):
        lines += [at(4 + 4 * i, full_frame=True), at(5 + 4 * i, rest=True), at(6 + 4 * i, full_frame=True)]
    log = tools.run_script(command, display, lines + [at(30, quit=True)], folder, [VOLUME])
    rest, full = numbers(log["rest"], "seconds"), numbers(log["full"], "seconds")
    # Time of each refinement divided by the mean of the full frames before and after it, minus 1.
    shares = [2 * r / (full[2 * i] + full[2 * i + 1]) - 1 for i, r in enumerate(rest)]
    print(f"     full frame {median_high(full):.3f} s, refinement to full quality {median_high(rest):.3f} s")
    bars.found("explore_rest_overhead", median_high(shares))
    slices = numbers(log["rest"], "shown_seconds")
    target = float(log["rest"][0]["target_seconds"])
    bars.found("explore_longest_slice_to_target", max(slices) / target)


def screenshot(bars, command, display, folder):
    camera, lobes, size = [20, 35, 2.5], [[0.4, 0.01, 0.6], [0.7, 0.02, 0.2]], [640, 400]
    ours, theirs = folder / "ours.png", folder / "theirs.png"
    lines = [
        at(0, lobes=lobes),
        at(0, camera=camera),
        at(3, screenshot={"file": str(ours), "size": size}),
        at(4, quit=True),
    ]
    tools.run_script(command, display, lines, folder, [VOLUME])
    tf = ",".join(str(v) for lobe in lobes for v in lobe)
    arguments = ["--camera", ",".join(map(str, camera)), "--tf", tf, "--size", "x".join(map(str, size))]
    subprocess.run(
        list(map(str, [command, "render", VOLUME, *arguments, "--device", "vulkan", "--out", theirs])),
        check=True,
        stdout=subprocess.DEVNULL,
    )
    apart = tools.largest_difference(tools.read_png(ours), tools.read_png(theirs))
    bars.found("explore_screenshot_difference", apart)


def memory(bars, command, display, folder):
    lines = [at(0, spin=[1.0, 0.2]), at(0, target=0.008)]
    for i, frame in enumerate(range(50, MANY_FRAMES, 97)):
        lines.append(at(frame, preset=PRESETS[i % len(PRESETS)]))
    lines.append(at(MANY_FRAMES, quit=True))
    arguments = [ROOT / "data/mr_banana.nrrd", "--size", "480x400"]
    log = tools.run_script(command, display, lines, folder, arguments, seconds=1500)
    used = numbers(log["frame"], "resident_bytes")
    assert len(used) == MANY_FRAMES and min(used) > 0, "the log lacks the memory in use"
    # After a tenth of the frames every preset was shown, and the graph is full.
    tenth = MANY_FRAMES // 10
    early, late = max(used[tenth : 2 * tenth]), max(used[-tenth:])
    print(f"     {MANY_FRAMES} frames, {early / 2**20:.1f} MiB in use after the first tenth, {late / 2**20:.1f} at the end")
    bars.found("explore_memory_growth_mib", max(0.0, late - early) / 2**20)


# Measurements, each with its bars and their limits.
BARS = {
    steering: {"explore_missed_share": 0.03, "explore_mean_error": 0.12},
    interface: {"explore_interface_ms": 2.0},
    latency: {"explore_input_frames": 1},
    opening: {"explore_open_seconds": 0.6},
    resting: {"explore_rest_overhead": 0.15, "explore_longest_slice_to_target": 1.0},
    screenshot: {"explore_screenshot_difference": 2},
    memory: {"explore_memory_growth_mib": 4.0},
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("entire")
    parser.add_argument("--out", default="out/explore")
    parser.add_argument("--only", default="", help=", ".join(b.__name__ for b in BARS))
    options = parser.parse_args()
    only = [name for name in options.only.split(",") if name]
    unknown = set(only) - {b.__name__ for b in BARS}
    if unknown:
        parser.error(f"--only names {', '.join(sorted(unknown))}; there are {', '.join(b.__name__ for b in BARS)}")
    measures = {m: limits for m, limits in BARS.items() if not only or m.__name__ in only}
    command, out = Path(options.entire).resolve(), Path(options.out).resolve()
    with Bars({name: limit for limits in measures.values() for name, limit in limits.items()}) as bars:
        why = tools.missing()
        if why is None and not command.is_file():
            why = f"{command} is not there (make explore-build)"
        if why:
            sys.exit(why)
        # The shipped models are found relative to the project's root.
        os.chdir(ROOT)
        out.mkdir(parents=True, exist_ok=True)
        print(f"     load {' '.join(f'{v:.2f}' for v in os.getloadavg())} on {os.cpu_count()} logical processors")
        with tools.Display() as display:
            for measure, limits in measures.items():
                with bars.part(*limits), tempfile.TemporaryDirectory(prefix="entire-explore-") as folder:
                    measure(bars, command, display, Path(folder))
                    if Path(folder, "frames.csv").is_file():
                        shutil.copy(Path(folder, "frames.csv"), out / f"{measure.__name__}.csv")


if __name__ == "__main__":
    main()
