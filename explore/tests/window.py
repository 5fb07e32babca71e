"""The window under Xvfb, used through xdotool: open, drag, edit, switch, resize, screenshot, close.

    python3 explore/tests/window.py ENTIRE [TEST…]
    python3 explore/tests/window.py --can

ENTIRE is the command, built with the feature `explore`. Prints skipped tests with the reason; fails if a test fails.
With --can it runs nothing: the exit status is 0 if the tests can run here.
"""

import csv
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import window_tools as tools  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
BANANA = ROOT / "data/mr_banana.nrrd"
LOBES = [[0.55, 0.01, 0.3]]


def skip(name, reason):
    print(f"{name}: skipped: {reason}")
    if os.environ.get("ENTIRE_SKIPPED"):
        with open(os.environ["ENTIRE_SKIPPED"], "a") as file:
            file.write(f"{name}: {reason}\n")


def at(frame, **action):
    return json.dumps({"frame": frame, **action})


# A point outside every window. With the pointer there, no picture contains the pointer (Xvfb draws it into its frame
# buffer) or a hint.
AWAY = (1390, 940)

# Number of equal pictures in a row, 0.3 s apart, after which the view counts as still: on a busy machine a slice of the
# refinement takes long.
STILL = 7


class Person:
    """A window with a simulated user."""

    # Programs of the windows that this test has opened.
    programs = []

    def __init__(self, command, display, folder, *volumes):
        self.display, self.folder = display, folder
        self.log = folder / "frames.csv"
        environment = {**display.environment, "XDG_STATE_HOME": str(folder / "state")}
        if tools.has_validation():
            environment["ENTIRE_VALIDATION"] = "1"
        arguments = ["--target", "60ms", "--size", "1000x760", "--log", self.log]
        self.program = subprocess.Popen(
            list(map(str, [command, "explore", *volumes, *arguments])),
            env=environment,
            cwd=folder,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.programs.append(self.program)
        self.id = display.window("entire explore - ")
        display.xdotool("windowmove", "--sync", self.id, 0, 0)
        display.xdotool("windowfocus", "--sync", self.id)
        self.settle()

    def view(self):
        """The pixels of a part of the view."""
        return self.display.pixels((100, 120, 420, 320))

    def rests(self):
        """True if, according to the log, the last frame is at full quality or was refined to full quality."""
        rows = list(csv.DictReader(self.log.read_text().splitlines())) if self.log.exists() else []
        last = next((row for row in reversed(rows) if row["kind"] in ("frame", "rest")), None)
        if last is None or last["kind"] == "rest":
            return last is not None
        return float(last["step"]) <= 1 and float(last["image_sample_distance"]) <= 1

    def settle(self, seconds=40):
        """Moves the pointer away and waits until the picture is still and, if time suffices, at full quality."""
        self.display.xdotool("mousemove", *AWAY)
        end = time.monotonic() + seconds
        before = self.view()
        still = 0
        while time.monotonic() < end and not (still >= STILL and self.rests()):
            time.sleep(0.3)
            now = self.view()
            still = still + 1 if now == before else 0
            before = now
        assert still >= STILL, "the picture does not come to rest"
        return before

    def differs(self, picture, seconds=0.5):
        """True if the view changes from a picture within some time."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if tools.mean_difference(picture, self.view()) > 0.2:
                return True
            time.sleep(0.05)
        return False

    def drag(self, start, end, button=1, steps=8):
        x = self.display.xdotool
        x("mousemove", *start)
        x("mousedown", button)
        for i in range(1, steps + 1):
            x("mousemove", *[round(a + (b - a) * i / steps) for a, b in zip(start, end)])
            time.sleep(0.03)
        x("mouseup", button)

    def key(self, name):
        self.display.xdotool("key", name)

    def close(self):
        self.key("ctrl+q")
        _, said = self.program.communicate(timeout=60)
        assert self.program.returncode == 0, f"the window ended with {self.program.returncode}: {said}"
        return tools.read_log(self.log)


def a_person_explores(command, display, folder):
    """Open, turn, zoom, edit, undo, switch, resize, screenshot, close, without a message of the validation layer."""
    person = Person(command, display, folder, BANANA)
    first = person.view()
    assert len(set(first[2])) > 20, "the view is empty"

    person.drag((250, 300), (400, 340))
    turned = person.settle()
    assert tools.mean_difference(first, turned) > 1, "dragging did not turn the view"

    display.xdotool("mousemove", 300, 300)
    for _ in range(4):
        display.xdotool("click", 4)
        time.sleep(0.05)
    zoomed = person.settle()
    assert tools.mean_difference(turned, zoomed) > 1, "scrolling did not zoom the view"

    person.key("r")
    start = person.settle()
    # The editor is in the upper right corner, 340 points wide. At least one of the drags catches an opacity handle, and
    # one edit is enough. Before the check, the pointer leaves the editor, whose hint overlaps the view, and the camera
    # is reset: with slow frames a whole drag falls into one frame and goes to the widget at its end, which may be the
    # view.
    def changed():
        person.key("r")
        return tools.mean_difference(start, person.settle()) > 0.2

    for x in range(680, 985, 6):
        person.drag((x, 70), (x, 170), steps=3)
        if person.differs(start) and changed():
            break
    else:
        # No drag caught a handle: a double click adds one.
        display.xdotool("mousemove", 900, 80, "click", "--repeat", 2, "--delay", 60, 1)
        assert changed(), "editing changed nothing"
    # There is one edit to undo, or a few if the picture came after the next drag or a drag counted as a double click.
    for _ in range(12):
        person.key("ctrl+z")
        back = person.settle()
        if tools.largest_difference(start, back) <= 2:
            break
    apart = tools.largest_difference(start, back)
    where = tools.where_different(start, back)
    assert apart <= 2, f"undo does not restore the colors: {apart} of 255 {where}, at rest: {person.rests()}"

    for key in "123":
        person.key(key)
        time.sleep(0.2)
    top = person.settle()
    assert tools.mean_difference(back, top) > 1, "keys switched nothing"
    # From above, a slab differs between the projections only in size, so a small difference is enough.
    person.key("5")
    parallel = person.settle()
    assert tools.mean_difference(top, parallel) > 0.1, "the orthographic view is the perspective one"
    person.key("ctrl+2")
    left = person.settle()
    assert tools.mean_difference(parallel, left) > 1, "Ctrl+2 does not look from the left"
    display.xdotool("mousemove", 300, 300, "click", "--repeat", 4, "--delay", 60, 4)
    zoomed = person.settle()
    assert tools.mean_difference(left, zoomed) > 1, "scrolling did not zoom the orthographic view"
    for key in ("5", "3", "r"):
        person.key(key)
    person.settle()

    person.key("ctrl+p")
    shot = folder / "screenshot.png"
    end = time.monotonic() + 120
    while not shot.exists() and time.monotonic() < end:
        time.sleep(0.2)
    time.sleep(0.5)
    assert tools.read_png(shot)[:2] == (1280, 720)

    display.xdotool("windowsize", "--sync", person.id, 1200, 880)
    time.sleep(1.0)
    person.settle()
    for size in ((640, 480), (900, 700), (1000, 760)):
        display.xdotool("windowsize", person.id, *size)
        time.sleep(0.15)
    person.settle()
    log = person.close()
    frames = log["frame"]
    widths = {int(float(f["width"]) * float(f["image_sample_distance"]) + 0.5) // 20 for f in frames}
    assert len(widths) > 2, f"the picture did not change its size with the window: {widths}"
    late = max(int(f["input_frames"]) for f in frames)
    assert late <= 1, f"an event's picture came {late} frames late"
    assert any(int(f["input_frames"]) == 1 for f in frames), "no frame reports an input event"
    assert "rest" in log, "the picture was never refined"


def screenshots_are_those_of_render(command, display, folder):
    """Screenshots have the same pixels as pictures of `entire render`, independent of the window."""
    camera, size = [20, 35, 2.5], [333, 257]
    for shading, parallel in (("none", False), ("local", False), ("scatter", False), ("none", True), ("local", True)):
        name = f"{shading}-{'parallel' if parallel else 'perspective'}"
        ours, theirs = folder / f"{name}.png", folder / f"{name}-render.png"
        lines = [
            at(0, lobes=LOBES),
            at(0, camera=camera),
            at(0, orthographic=parallel),
            at(0, shading=shading),
            at(4, screenshot={"file": str(ours), "size": size}),
            at(5, quit=True),
        ]
        tools.run_script(command, display, lines, folder, [BANANA, "--size", "800x600"])
        tf = ",".join(str(v) for lobe in LOBES for v in lobe)
        arguments = ["--camera", ",".join(map(str, camera)), "--tf", tf, "--size", "x".join(map(str, size))]
        if parallel:
            # Half of the height that the window's field of view of 45° shows at this distance. A parallel projection
            # does not depend on the distance itself, so another distance is passed.
            scale = camera[2] * math.tan(math.radians(22.5))
            arguments[1] = "20,35,3.7"
            arguments += ["--parallel-scale", repr(scale)]
        subprocess.run(
            [command, "render", BANANA, *arguments, "--shade", shading, "--device", "vulkan", "--out", theirs],
            check=True,
            stdout=subprocess.DEVNULL,
        )
        apart = tools.largest_difference(tools.read_png(ours), tools.read_png(theirs))
        assert apart <= 2, f"{name}: {apart} of 255"


def a_script_switches_everything(command, display, folder):
    """Controllers, modes, sizes, parts, files, a lost device: every frame is drawn, without a validation message."""
    transfer, path = folder / "transfer.json", folder / "path.json"
    lines = [at(0, record=True), at(0, spin=[1.5, 0.3])]
    for i, name in enumerate(["hybrid", "olp", "algorithm1", "pid", "hybrid"]):
        lines.append(at(4 * i, controller=name))
    lines += [
        at(20, shading="local"),
        at(23, skipping="distance"),
        at(26, shading="none"),
        at(28, preset="core"),
        at(29, drag=[0.002, 0.001]),
        at(34, drag=[0, 0]),
        at(35, save_transfer=str(transfer)),
        at(36, preset="haze"),
        at(37, undo=True),
        at(38, load_transfer=str(transfer)),
        at(39, orthographic=True),
        at(39, zoom=0.9),
        at(40, size=[700, 500]),
        at(44, steering=False),
        at(46, steering=True),
        at(46, view="left"),
        at(46, orthographic=False),
        at(47, save_recording=str(path)),
        at(48, crop=[[40, 200], [40, 200], [2, 14]]),
        at(52, map=True),
        at(53, rest=True),
        at(54, crop=None),
        at(56, lose_device=True),
        at(60, rest=True),
        at(64, quit=True),
    ]
    validation = tools.has_validation()
    log = tools.run_script(
        command, display, lines, folder, [BANANA, "--size", "900x650", "--target", "50ms"], validation=validation
    )
    assert len(log["frame"]) >= 64 and len(log["rest"]) == 2
    said = {f["controller"] for f in log["frame"]}
    assert said == {"hybrid", "olp", "algorithm1", "pid"}, said
    assert "off" in {f["reason"] for f in log["frame"]}
    recorded = json.loads(path.read_text())
    assert recorded["frames"] == 47 and len(recorded["keyframes"]) > 30
    parallel = {k["frame"] for k in recorded["keyframes"] if "parallel_scale" in k.get("camera", {})}
    assert parallel == set(range(39, 46)), f"orthographic in {parallel}"
    arguments = ["--target", "50ms", "--scenes", "4", "--size", "48x48", "--controllers", "hybrid"]
    subprocess.run(
        [command, "steer", BANANA, "--path", path, *arguments, "--out", folder / "steer"],
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    assert (folder / "steer/report.html").is_file()


def a_device_lost_in_the_first_load_is_opened_again(command, display, folder):
    """A loss of the device before the first volume is shown begins the load again."""
    lines = [at(0, lose_device=True), at(0, spin=[1, 0]), at(4, quit=True)]
    log = tools.run_script(command, display, lines, folder, [BANANA, "--size", "640x480"], seconds=120)
    assert len(log["open"]) == 1 and len(log["frame"]) >= 4, {kind: len(rows) for kind, rows in log.items()}


def a_series_plays_in_the_background(command, display, folder):
    """The next step of a series is loaded while the previous step is shown."""
    steps = sorted((ROOT / "data/nyx_cosmology/m01").glob("*.nrrd"))[:2]
    if len(steps) < 2:
        steps = [BANANA, BANANA]
    lines = [at(0, spin=[1, 0]), at(5, open=str(steps[1])), at(10, open=str(steps[0])), at(15, quit=True)]
    log = tools.run_script(command, display, lines, folder, [*steps, "--size", "700x500"])
    assert len(log["open"]) == 3 and len(log["frame"]) >= 15


def a_screenshot_is_written_while_the_next_volume_loads(command, display, folder):
    """A volume that is loaded during a screenshot is shown after the picture is written, and logged with its first
    frame."""
    ball, shot = folder / "ball.nrrd", folder / "screenshot.png"
    tools.write_volume(ball, 320)
    person = Person(command, display, folder, BANANA, ball)
    person.key("space")
    person.key("ctrl+p")
    # Frames of the first volume, while the second one loads.
    person.drag((250, 300), (400, 340))
    end = time.monotonic() + 120
    while not shot.exists() and time.monotonic() < end:
        time.sleep(0.2)
    assert tools.read_png(shot)[:2] == (1280, 720)
    while len(tools.read_log(person.log)["open"]) < 2 and time.monotonic() < end:
        time.sleep(0.2)
    person.key("space")
    person.settle()
    assert len(person.close()["open"]) >= 2, "the series does not play on"
    rows = list(csv.DictReader(person.log.read_text().splitlines()))
    recent = json.loads((folder / "state/entire/recent.json").read_text())
    assert recent == [str(BANANA)], f"not only the opened file is recent: {recent}"
    # The first frame of a volume counts as a switch.
    first = [rows[i + 1] for i, row in enumerate(rows) if row["kind"] == "open"]
    assert all(row["kind"] == "frame" and row["switched"] == "1" for row in first), first


def a_minimized_window_rests(command, display, folder):
    """A minimized window draws nothing and keeps no processor busy; shown again, it continues."""
    script, log = folder / "events.jsonl", folder / "frames.csv"
    script.write_text(at(0, spin=[1, 0]) + "\n" + at(1_000_000, quit=True) + "\n")
    program = subprocess.Popen(
        list(map(str, [command, "explore", BANANA, "--size", "640x480", "--script", script, "--log", log])),
        env={**display.environment, "XDG_STATE_HOME": str(folder / "state")},
        cwd=folder,
    )

    def processor_seconds():
        fields = Path(f"/proc/{program.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def within(seconds, happens):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if happens():
                return True
        return False

    def grows():
        before = log.stat().st_size
        time.sleep(0.2)
        return log.stat().st_size > before

    def rests():
        before = processor_seconds()
        time.sleep(1)
        return processor_seconds() - before < 0.1

    try:
        window = display.window("entire explore - ")
        assert within(60, grows), "no frame was drawn"
        display.minimize(window, True)
        assert within(30, rests), "the minimized window keeps a processor busy"
        assert not grows(), "the minimized window draws frames"
        display.minimize(window, False)
        display.xdotool("mousemove", "--window", window, 100, 200, "mousemove", "--window", window, 120, 220)
        assert within(30, grows), "the window that is shown again draws no frame"
    finally:
        program.kill()
        program.wait()


def without_a_display_it_says_so(command, display, folder):
    """Without a display, the command prints one line with the remedy."""
    environment = {k: v for k, v in display.environment.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    done = subprocess.run([command, "explore", BANANA], env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and "xvfb-run" in done.stderr and done.stderr.count("\n") == 1, done.stderr


def what_is_wrong_is_said(command, display, folder):
    """A missing file and a wrong script end a scripted window with one line."""
    for volume, line, says in (
        (folder / "none.nrrd", at(0, quit=True), "no such file"),
        (BANANA, '{"frame": 0, "dance": true}', "line 1"),
        (BANANA, at(0, preset="nothing"), 'no preset "nothing"; there are ramp'),
        (BANANA, at(0, view="sideways"), 'no view "sideways"; there are front'),
        (BANANA, at(0, controller="nobody"), 'no controller "nobody"; there are '),
    ):
        try:
            tools.run_script(command, display, [line], folder, [volume, "--size", "640x480"])
        except AssertionError as error:
            assert says in str(error), error
        else:
            raise AssertionError(f"{says}: nothing was said")


TESTS = [
    without_a_display_it_says_so,
    what_is_wrong_is_said,
    screenshots_are_those_of_render,
    a_script_switches_everything,
    a_device_lost_in_the_first_load_is_opened_again,
    a_series_plays_in_the_background,
    a_screenshot_is_written_while_the_next_volume_loads,
    a_minimized_window_rests,
    a_person_explores,
]


def main():
    if sys.argv[1:] == ["--can"]:
        return 1 if tools.missing() else 0
    command = Path(sys.argv[1]).resolve()
    wanted = sys.argv[2:]
    unknown = set(wanted) - {test.__name__ for test in TESTS}
    if unknown:
        print(f"window.py: there is no test {', '.join(sorted(unknown))}", file=sys.stderr)
        return 2
    why = tools.missing()
    if why:
        skip("test-explore", why)
        return 0
    if not tools.has_validation():
        skip("test-explore, validation", "the layer is not installed (apt-get install vulkan-validationlayers)")
    failed = 0
    with tools.Display() as display:
        for test in TESTS:
            if wanted and test.__name__ not in wanted:
                continue
            folder = Path(tempfile.mkdtemp(prefix="entire-explore-"))
            begin = time.monotonic()
            try:
                test(command, display, folder)
            except Exception as error:  # noqa: BLE001: every failure is reported, and the next test runs
                failed += 1
                print(f"test {test.__name__} ... FAILED: {type(error).__name__}: {error}", flush=True)
            else:
                print(f"test {test.__name__} ... ok ({time.monotonic() - begin:.1f} s)", flush=True)
            finally:
                # A failed test leaves its window open, which the next test would take for its own.
                while Person.programs:
                    program = Person.programs.pop()
                    program.kill()
                    program.wait()
                shutil.rmtree(folder, ignore_errors=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
