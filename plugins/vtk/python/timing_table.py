# SPDX-License-Identifier: MIT OR Apache-2.0
"""Writes timing tables of any renderer in Python, in the format of `entire collect`.

With the same seed, a volume's frames have the same cameras, image sizes and transfer functions as with `entire collect`,
so that tables of several renderers can be compared frame by frame. The ray step is the same, too, unless the renderer
replaces it, as yt and ParaView do. `entire train` and `entire evaluate` read the tables. A renderer is an object with
`load(volume)` and `prepare(scene)`, which returns a function that draws the scene and returns its wall and processor
seconds, and with a few attributes; see collect_vtk.py.
"""
import argparse
import csv
import datetime
import gzip
import json
import math
import os
import platform
import re
import sys
import time
import zlib

import numpy as np

COLUMNS = (
    "frame,repeat,volume,member,time_step,dims_x,dims_y,dims_z,camera_rx_deg,camera_ry_deg,camera_dz_radii,fov_y_deg,"
    "width_px,height_px,step_ref,shading,skipping,termination,tf,seconds_device,seconds_wall,seconds_cpu,samples,skips,"
    "rays,shaded"
).split(",")
RADII = (1.2, 1.5, 2.0, 2.5, 3.0, 4.0)
WIDTHS = (5e-4, 5e-2)
HEIGHTS = (5e-3, 1.0)
_MASK32, _MASK64 = 0xFFFFFFFF, 0xFFFFFFFFFFFFFFFF


def machine():
    """Describes the machine: processor, its widest vector instructions, logical processors, system, architecture."""
    model = platform.processor()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            lines = file.readlines()
        model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), model)
        flags = next((line.split() for line in lines if line.startswith("flags")), ())
        vectors = next((name for flag, name in (("avx512f", "AVX-512"), ("avx2", "AVX2")) if flag in flags), None)
        model += f" ({vectors})" if vectors else ""
        system = platform.freedesktop_os_release().get("PRETTY_NAME", platform.system())
    except (OSError, AttributeError):
        system = platform.system()
    return f"{model or 'CPU'}, {os.cpu_count()} logical processors, {system}, {platform.machine()}"


def fnv1a(data):
    """64-bit FNV-1a hash of bytes."""
    value = 0xCBF29CE484222325
    for byte in data:
        value = (value ^ byte) * 0x100000001B3 & _MASK64
    return value


class ChaCha8:
    """The ChaCha stream with 8 rounds, seeded as Rust's rand_core::SeedableRng::seed_from_u64 does."""

    def __init__(self, seed, stream):
        key = []
        for _ in range(8):
            seed = (seed * 0x5851F42D4C957F2D + 0xA17654E46FBE17F3) & _MASK64
            shifted = (((seed >> 18) ^ seed) >> 27) & _MASK32
            turn = seed >> 59
            key.append((shifted >> turn | shifted << (32 - turn)) & _MASK32)
        self._key, self._stream, self._block, self._words = key, stream, 0, []

    def _refill(self):
        start = [0x61707865, 0x3320646E, 0x79622D32, 0x6B206574, *self._key]
        for word in (self._block, self._stream):
            start += [word & _MASK32, word >> 32]
        s = list(start)

        def turn(a, b, c, d):
            for x, y, z, by in ((a, b, d, 16), (c, d, b, 12), (a, b, d, 8), (c, d, b, 7)):
                s[x] = (s[x] + s[y]) & _MASK32
                mixed = s[z] ^ s[x]
                s[z] = (mixed << by | mixed >> (32 - by)) & _MASK32

        for _ in range(4):
            for column in range(4):
                turn(column, 4 + column, 8 + column, 12 + column)
            for column in range(4):
                turn(column, 4 + (column + 1) % 4, 8 + (column + 2) % 4, 12 + (column + 3) % 4)
        self._words = [(x + y) & _MASK32 for x, y in zip(s, start)]
        self._block += 1

    def unit(self):
        """Returns the next number of the stream, in [0, 1) with 53 bits."""
        if len(self._words) < 2:
            self._refill()
        low, high = self._words.pop(0), self._words.pop(0)
        return ((high << 32 | low) >> 11) / float(1 << 53)


class Scene:
    """One frame to draw: angles in degrees, distance in bounding-sphere radii, step in smallest voxel spacings."""

    def __init__(self, rx, ry, dz, width, height, step, lobes, fov_y=45.0):
        self.rx, self.ry, self.dz, self.fov_y = rx, ry, dz, fov_y
        self.width, self.height, self.step, self.lobes = width, height, step, lobes

    def eye(self):
        """Returns two unit vectors: the direction from the volume's center to the eye, and the up direction."""
        x, y = math.radians(self.rx), math.radians(self.ry)
        return (
            (math.sin(y) * math.cos(x), math.sin(x), math.cos(y) * math.cos(x)),
            (-math.sin(y) * math.sin(x), math.cos(x), -math.cos(y) * math.sin(x)),
        )

    def opacity(self, entries=256):
        """The lobes' sum at `entries` values from 0 to 1, as opacity over one reference step."""
        s = np.linspace(0.0, 1.0, entries)
        total = sum((h * np.exp(-((s - c) ** 2) / w) for c, w, h in self.lobes), np.zeros(entries))
        return np.clip(total, 0.0, 1.0)


def _log_uniform(bounds, unit):
    return bounds[0] * (bounds[1] / bounds[0]) ** unit


def draw_scene(seed, volume, index, min_size=32, max_size=1024, steps=(1.0,), lobes=(3, 3), radii=RADII):
    """Returns scene `index` of the volume with this seed name: the same as in `entire collect`."""
    rng = ChaCha8(seed ^ fnv1a(volume.encode()), index)
    unit = rng.unit

    def pick(items):
        return items[min(int(unit() * len(items)), len(items) - 1)]

    def side():
        size = int(_log_uniform((float(min_size), float(max_size) + 1.0), unit()))
        return min(max(size, min_size), max_size)

    single = lambda x: float(np.float32(x))
    dz = single(pick(radii))
    rx = single(math.degrees(math.asin(unit())))
    ry = single(unit() * 360.0 - 180.0)
    square = unit() < 0.5
    width, other = side(), side()
    step = single(pick(steps))
    count = lobes[0] + int(unit() * (lobes[1] - lobes[0] + 1))
    drawn = [
        (single(unit()), single(_log_uniform(WIDTHS, unit())), single(_log_uniform(HEIGHTS, unit())))
        for _ in range(count)
    ]
    return Scene(rx, ry, dz, width, width if square else other, step, drawn)


class Volume:
    """Voxels as [z, y, x] bytes, spacing as (x, y, z)."""

    def __init__(self, name, voxels, spacing):
        self.name, self.voxels, self.spacing = name, voxels, spacing
        self.dims = voxels.shape[::-1]

    @property
    def reference_step(self):
        return min(self.spacing)

    @property
    def radius(self):
        return 0.5 * math.sqrt(sum((n * s) ** 2 for n, s in zip(self.dims, self.spacing)))

    def place(self):
        """Returns ensemble member and time step of names such as castro/m01/t0012.nrrd; empty texts for other names."""
        step = re.fullmatch(r"t([0-9]+)", os.path.basename(self.name).split(".")[0])
        if not step:
            return "", ""
        return os.path.basename(os.path.dirname(os.path.abspath(self.name))), str(int(step.group(1)))

    def seed_name(self):
        """Returns the name that seeds the volume's scenes: the name of the file and, for a time step, of the two
        folders above it. It does not depend on the working folder."""
        return "/".join(os.path.abspath(self.name).split(os.sep)[-3 if self.place()[1] else -1 :])


def read_nrrd(path):
    """Reads a three-dimensional NRRD file of bytes, raw or gzip, with `spacings` or `space directions`."""
    with open(path, "rb") as file:
        data = file.read()
    end = data.find(b"\n\n")
    if not data.startswith(b"NRRD") or end < 0:
        raise ValueError(f"{path} is not an NRRD file that contains its data")
    fields = {}
    for line in data[:end].decode("ascii", "replace").splitlines()[1:]:
        if ":" in line and not line.startswith("#"):
            key, value = line.split(":", 1)
            fields[key.strip().lower()] = value.lstrip("=").strip()
    if fields.get("type") not in ("uint8", "uchar", "unsigned char", "uint8_t") or fields.get("dimension") != "3":
        raise ValueError(f"{path} holds {fields.get('type')} in {fields.get('dimension')} dimensions; only uint8 in 3 dimensions is supported")
    body = data[end + 2 :]
    if fields.get("encoding") in ("gzip", "gz"):
        body = zlib.decompress(body, 47)
    elif fields.get("encoding") != "raw":
        raise ValueError(f"{path} has encoding {fields.get('encoding')}; only raw and gzip are read")
    x, y, z = (int(n) for n in fields["sizes"].split())
    # The spacings are the lengths of the directions, such as (0,0,2), if the header has directions.
    directions = re.findall(r"\(([^)]*)\)", fields.get("space directions", ""))
    if directions:
        spacing = tuple(math.hypot(*map(float, direction.split(","))) for direction in directions)
    else:
        spacing = tuple(float(s) for s in fields.get("spacings", "1 1 1").split())
    voxels = np.frombuffer(body, np.uint8)
    if voxels.size != x * y * z:
        raise ValueError(f"{path} holds {voxels.size} voxels, its header says {x} x {y} x {z}")
    return Volume(path, voxels.reshape(z, y, x), spacing)


def resampled(volume, edge):
    """Resamples a volume to `edge` voxels along every axis, trilinearly at the new voxels' centers. The volume's size
    in space stays the same."""
    voxels = volume.voxels.astype(np.float64)
    for axis, size in enumerate(voxels.shape):
        at = np.clip((np.arange(edge) + 0.5) * size / edge - 0.5, 0.0, size - 1.0)
        low = np.minimum(at.astype(int), max(size - 2, 0))
        high = np.minimum(low + 1, size - 1)
        shape = [-1 if a == axis else 1 for a in range(3)]
        part = (at - low).reshape(shape)
        voxels = voxels.take(low, axis) * (1.0 - part) + voxels.take(high, axis) * part
    spacing = tuple(s * n / edge for s, n in zip(volume.spacing, volume.dims))
    return Volume(volume.name, np.clip(np.rint(voxels), 0, 255).astype(np.uint8), spacing)


def write_nrrd(path, voxels, spacing=(1.0, 1.0, 1.0)):
    """Writes [z, y, x] bytes to a gzip-compressed NRRD file."""
    z, y, x = voxels.shape
    header = (
        f"NRRD0004\ntype: uint8\ndimension: 3\nsizes: {x} {y} {z}\nspacings: {' '.join(map(str, spacing))}\n"
        "encoding: gzip\n\n"
    )
    with open(path, "wb") as file:
        file.write(header.encode() + gzip.compress(np.ascontiguousarray(voxels, np.uint8).tobytes(), 3))


def timed(work):
    """Calls `work`; returns its wall and processor seconds."""
    cpu, wall = time.process_time(), time.perf_counter()
    work()
    return time.perf_counter() - wall, time.process_time() - cpu


def single_text(value):
    """The shortest text that reads back as the same single-precision number."""
    return np.format_float_positional(np.float32(value), unique=True, trim="-")


def arguments(description):
    """Returns a parser with the options of every collector, which have the same meaning as in `entire collect`."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("volumes", nargs="+", metavar="VOLUME", help="NRRD files of bytes")
    parser.add_argument("--out", required=True, metavar="FILE.csv")
    parser.add_argument("--frames", type=int, default=100, help="frames per volume")
    parser.add_argument("--repeats", type=int, default=5, help="measured drawings of each frame")
    parser.add_argument(
        "--passes", type=int, default=1,
        help="passes through all volumes: repeats that are minutes apart show the machine's drift",
    )
    parser.add_argument("--warm-up", type=int, default=2, help="frames drawn but not recorded after a volume is loaded")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--min-size", type=int, default=32, help="shortest image side, pixels")
    parser.add_argument("--max-size", type=int, default=1024, help="longest image side, pixels")
    parser.add_argument(
        "--steps", default="1", help="ray steps to pick from, comma-separated, as multiples of the smallest voxel spacing"
    )
    parser.add_argument("--shade", choices=("none", "local"), default="none")
    parser.add_argument(
        "--proxy", type=int, metavar="EDGE", help="draw every volume resampled to this many voxels along each axis"
    )
    return parser


def collect(options, renderer):
    """Draws every frame of every volume and writes the table and its manifest."""
    stem, ending = os.path.splitext(options.out)
    if ending == ".gz":
        sys.exit(f"{options.out}: tables are written without compression; leave .gz out of the name")
    # Tables whose names differ only in .csv and .gz have one manifest.
    stem = stem if ending == ".csv" else options.out
    for taken in (options.out, f"{stem}.csv", f"{stem}.csv.gz", f"{stem}.gz"):
        if os.path.exists(taken):
            sys.exit(f"{taken} exists already; remove it or choose another name")
    steps = tuple(float(s) for s in options.steps.split(","))
    # The manifest is written first, so that an interrupted table can be used.
    manifest = {
        "format": "entire-timings-1",
        "created": datetime.datetime.now(datetime.timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "machine": machine(),
        "renderer": renderer.name,
        "device": renderer.device,
        "driver": renderer.driver,
        "commit": "",
        "seed": options.seed,
        "repeats": options.repeats * options.passes,
        "step_reference": "smallest voxel spacing",
        "settings": {k: v for k, v in vars(options).items() if k not in ("volumes", "out")},
    }
    with open(f"{stem}.manifest.json", "w") as file:
        json.dump(manifest, file, indent=2)
        file.write("\n")
    with open(options.out, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for turn in range(options.passes):
            for place, path in enumerate(options.volumes):
                frames = volume_frames(options, renderer, path, steps, place * options.frames, turn * options.repeats)
                for rows in frames:
                    writer.writerows(rows)
                    file.flush()
                of = f", pass {turn + 1} of {options.passes}" if options.passes > 1 else ""
                print(f"{path}: {options.frames} frames{of}", file=sys.stderr)


def drawn_volume(options, path):
    """Reads a volume and resamples it if --proxy is given."""
    volume = read_nrrd(path)
    return resampled(volume, options.proxy) if options.proxy else volume


def volume_frames(options, renderer, path, steps, number, repeat):
    """Draws a volume's frames and yields the rows of each. `number` and `repeat` are the numbers of frame and repeat
    in the first row."""
    volume = drawn_volume(options, path)
    member, time_step = volume.place()
    renderer.load(volume)
    for index in range(options.frames):
        scene = draw_scene(options.seed, volume.seed_name(), index, options.min_size, options.max_size, steps)
        draw = renderer.prepare(scene)
        # The first frame with a new image size or transfer function includes one-time work.
        for _ in range(options.warm_up if index == 0 else renderer.warm_up):
            draw()
        rows = []
        for again in range(options.repeats):
            wall, cpu = draw()
            rows.append(
                [number + index, repeat + again, path, member, time_step, *volume.dims]
                + [single_text(v) for v in (scene.rx, scene.ry, scene.dz, scene.fov_y)]
                + [scene.width, scene.height, single_text(scene.step), options.shade, renderer.skipping]
                + [single_text(renderer.termination)]
                + [";".join(" ".join(single_text(v) for v in lobe) for lobe in scene.lobes)]
                + ["", repr(wall), repr(cpu), "", "", "", ""]
            )
        yield rows
