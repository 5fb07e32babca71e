"""Tools of the window's tests and bars: a virtual display, its pixels, PNG files, volumes, the frame log.

Only the standard library: the tests run wherever Xvfb, xdotool and a Vulkan driver are.
"""

import csv
import ctypes
import os
import shutil
import struct
import subprocess
import tempfile
import time
import zlib
from pathlib import Path


def missing():
    """Returns the reason why the window cannot be tested here, with the remedy; None if it can be tested."""
    packages = [name.lower() for name in ("Xvfb", "xdotool") if not shutil.which(name)]
    if packages:
        return f"{' and '.join(packages)} not installed (apt-get install xvfb xdotool)"
    named = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES")
    folders = ["/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d"]
    if not named and not any(Path(f).glob("*.json") for f in folders if Path(f).is_dir()):
        return "no Vulkan driver (apt-get install mesa-vulkan-drivers libvulkan1)"
    return None


def has_validation():
    """True if the Khronos validation layer is installed."""
    return Path("/usr/share/vulkan/explicit_layer.d/VkLayer_khronos_validation.json").is_file()


class Display:
    """An X server without a screen, as a context."""

    def __init__(self, width=1400, height=950):
        self.folder = tempfile.mkdtemp(prefix="entire-display-")
        read, write = os.pipe()
        size = f"{width}x{height}x24"
        command = ["Xvfb", "-displayfd", str(write), "-screen", "0", size, "-noreset", "-nolisten", "tcp"]
        self.server = subprocess.Popen(
            command + ["-fbdir", self.folder], pass_fds=[write], stderr=subprocess.DEVNULL
        )
        os.close(write)
        with os.fdopen(read) as pipe:
            number = pipe.readline().strip()
        if not number:
            raise RuntimeError("Xvfb did not start")
        self.name = f":{number}"
        self.environment = {**os.environ, "DISPLAY": self.name}
        self.environment.pop("WAYLAND_DISPLAY", None)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.server.terminate()
        self.server.wait()
        shutil.rmtree(self.folder, ignore_errors=True)

    def xdotool(self, *arguments):
        """Runs xdotool and returns its output."""
        command = ["xdotool", *map(str, arguments)]
        done = subprocess.run(command, env=self.environment, capture_output=True, text=True, timeout=30)
        return done.stdout.strip()

    def minimize(self, window, minimized):
        """Marks a window as minimized or not, as window managers do; this display has none."""
        x = ctypes.CDLL("libX11.so.6")
        x.XOpenDisplay.restype, x.XInternAtom.restype = ctypes.c_void_p, ctypes.c_ulong
        server = ctypes.c_void_p(x.XOpenDisplay(self.name.encode()))
        state, hidden = (
            ctypes.c_ulong(x.XInternAtom(server, name, 0)) for name in (b"_NET_WM_STATE", b"_NET_WM_STATE_HIDDEN")
        )
        # The property is an array of atoms (type 4) of 32 bits; mode 0 replaces it.
        x.XChangeProperty(
            server, ctypes.c_ulong(int(window)), state, ctypes.c_ulong(4), 32, 0, ctypes.byref(hidden), int(minimized)
        )
        x.XCloseDisplay(server)

    def window(self, title, seconds=60):
        """Waits for a window with this title and returns its id."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            found = self.xdotool("search", "--name", title).split()
            if found:
                return found[-1]
            time.sleep(0.1)
        raise RuntimeError(f"no window {title!r} within {seconds} s")

    def pixels(self, box=None):
        """Returns width, height and RGB bytes of the screen, or of a box (x, y, width, height) of it."""
        data = (Path(self.folder) / "Xvfb_screen0").read_bytes()
        header = struct.unpack(">25I", data[:100])
        start = header[0] + 12 * header[19]
        width, height, row = header[4], header[5], header[12]
        x, y, w, h = box or (0, 0, width, height)
        rows = []
        for line in range(y, y + h):
            bgrx = data[start + line * row + 4 * x : start + line * row + 4 * (x + w)]
            rgb = bytearray(3 * w)
            rgb[0::3], rgb[1::3], rgb[2::3] = bgrx[2::4], bgrx[1::4], bgrx[0::4]
            rows.append(bytes(rgb))
        return w, h, b"".join(rows)


def write_png(path, width, height, rgb):
    """Writes a PNG file of 8-bit RGB."""

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    rows = []
    before = bytes(3 * width)
    for y in range(height):
        row = rgb[3 * width * y : 3 * width * (y + 1)]
        # Filter 2: differences from the row above.
        rows.append(b"\x02" + bytes((a - b) & 255 for a, b in zip(row, before)))
        before = row
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"".join(rows), 9)) + chunk(b"IEND", b"")
    Path(path).write_bytes(b"\x89PNG\r\n\x1a\n" + body)


def read_png(path):
    """Reads a PNG file of 8-bit RGB or RGBA without interlacing; returns width, height, RGB bytes."""
    data = Path(path).read_bytes()
    at, body, head = 8, b"", None
    while at < len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        kind, content = data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        if kind == b"IHDR":
            head = struct.unpack(">IIBBBBB", content)
        if kind == b"IDAT":
            body += content
        at += 12 + length
    width, height, depth, color, _, _, interlace = head
    if depth != 8 or color not in (2, 6) or interlace:
        raise ValueError(f"{path}: only 8-bit RGB and RGBA without interlacing is read")
    n = 3 if color == 2 else 4
    raw, out, before = zlib.decompress(body), [], bytearray(n * width)
    for y in range(height):
        start = y * (n * width + 1)
        kind, row = raw[start], bytearray(raw[start + 1 : start + 1 + n * width])
        for i in range(len(row)):
            left = row[i - n] if i >= n else 0
            up, corner = before[i], before[i - n] if i >= n else 0
            if kind == 1:
                add = left
            elif kind == 2:
                add = up
            elif kind == 3:
                add = (left + up) // 2
            elif kind == 4:
                guess = left + up - corner
                far = [abs(guess - left), abs(guess - up), abs(guess - corner)]
                add = (left, up, corner)[far.index(min(far))]
            else:
                add = 0
            row[i] = (row[i] + add) & 255
        before = row
        if n == 4:
            rgb = bytearray(3 * width)
            rgb[0::3], rgb[1::3], rgb[2::3] = row[0::4], row[1::4], row[2::4]
            row = rgb
        out.append(bytes(row))
    return width, height, b"".join(out)


def largest_difference(a, b):
    """Largest difference of the color values of two pictures (width, height, RGB)."""
    if a[:2] != b[:2]:
        raise ValueError(f"the pictures have {a[:2]} and {b[:2]} pixels")
    return max((abs(x - y) for x, y in zip(a[2], b[2])), default=0)


def mean_difference(a, b):
    """Mean absolute difference of the color values of two pictures (width, height, RGB)."""
    return sum(abs(x - y) for x, y in zip(a[2], b[2])) / max(1, len(a[2]))


def where_different(a, b):
    """Returns a text: the number of pixels in which two pictures differ by more than 2, and their bounding box."""
    width = a[0]
    places = [i // 3 for i, (x, y) in enumerate(zip(a[2], b[2])) if abs(x - y) > 2]
    if not places:
        return "nowhere"
    across, down = [p % width for p in places], [p // width for p in places]
    box = f"{min(across)}-{max(across)}, {min(down)}-{max(down)}"
    return f"in {len(set(places))} pixels within {box}"


def write_volume(path, edge):
    """Writes a cubic volume of bytes with some structure: a ball with rings in it."""
    low, high = edge // 2, edge
    def bump(i):
        return 90 * (1 - ((i - low) / low) ** 2) + (20 if i % 37 < 9 else 0)

    base = bytes(max(0, min(255, round(bump(i)))) for i in range(high))
    add = [bytes(min(255, v + k) for v in range(256)) for k in range(256)]
    with open(path, "wb") as out:
        out.write(f"NRRD0004\ntype: uint8\ndimension: 3\nsizes: {edge} {edge} {edge}\nencoding: raw\n\n".encode())
        for z in range(edge):
            for y in range(edge):
                out.write(base.translate(add[min(255, base[y] + base[z])]))


def read_log(path):
    """Returns the rows of a frame log, by kind."""
    rows = {}
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            rows.setdefault(row["kind"], []).append(row)
    return rows


def run_script(command, display, lines, folder, arguments=(), seconds=600, validation=False):
    """Plays a script in a window; returns the rows of its log, by kind. `command`: path of the program `entire`."""
    script, log = Path(folder) / "events.jsonl", Path(folder) / "frames.csv"
    script.write_text("\n".join(lines) + "\n")
    environment = {**display.environment, "XDG_STATE_HOME": str(Path(folder) / "state")}
    if validation:
        environment["ENTIRE_VALIDATION"] = "1"
    done = subprocess.run(
        [str(command), "explore", *map(str, arguments), "--script", str(script), "--log", str(log)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=seconds,
    )
    if done.returncode != 0:
        raise AssertionError(f"entire explore ended with {done.returncode}: {done.stderr.strip()}")
    return read_log(log)
