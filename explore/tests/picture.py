"""Draws the book's picture of the window: a volume that turned while its transfer function was switched.

    python3 explore/tests/picture.py ENTIRE VOLUME PICTURE.png

ENTIRE is the command, built with the feature `explore`. Needs Xvfb and xdotool; run it from the project's root, since
it uses the models there.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import window_tools as tools  # noqa: E402

SIZE = (1280, 800)
EVENTS = [
    (0, {"preset": "layers"}),
    (0, {"camera": [25, 30, 1.9]}),
    (0, {"spin": [1.1, 0.15]}),
    (70, {"preset": "haze"}),
    (140, {"shading": "local"}),
    (200, {"preset": "core"}),
    (260, {"preset": "layers"}),
    (330, {"spin": [0, 0]}),
    (331, {"rest": True}),
    # The window stays open until it is ended from outside.
    (10_000_000, {"quit": True}),
]


def main():
    command, volume, picture = sys.argv[1:]
    with tools.Display(*SIZE) as display, tempfile.TemporaryDirectory() as folder:
        script, log = Path(folder) / "events.jsonl", Path(folder) / "frames.csv"
        script.write_text("".join(json.dumps({"frame": frame, **event}) + "\n" for frame, event in EVENTS))
        window = subprocess.Popen(
            [command, "explore", volume, "--target", "80ms", "--size", f"{SIZE[0]}x{SIZE[1]}"]
            + ["--script", str(script), "--log", str(log)],
            env={**display.environment, "XDG_STATE_HOME": folder},
        )
        try:
            display.xdotool("windowmove", "--sync", display.window("entire explore - "), 0, 0)
            end = time.monotonic() + 300
            while not (log.exists() and "rest" in tools.read_log(log)):
                if window.poll() is not None:
                    sys.exit(f"the window ended with {window.returncode}")
                if time.monotonic() > end:
                    sys.exit("the picture does not come to rest within 300 s")
                time.sleep(0.01)
            os.kill(window.pid, signal.SIGSTOP)
            tools.write_png(picture, *display.pixels())
        finally:
            window.kill()
            window.wait()


if __name__ == "__main__":
    main()
