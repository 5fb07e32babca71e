#!/usr/bin/env python3
"""Times our Vulkan raycaster beside VTK's two volume mappers: same volume, transfer function, camera, ray step (one
voxel) and image size, each with its own early termination and space leaping. Frames are interleaved in one run; times
are medians.

usage: render_bars.py --server FRAME_SERVER [--out FOLDER] [--scans FOLDER] [--rounds N] [--size PIXELS] [--bars]

Prints a line per contestant and scene, how well the pictures agree, the time of a change of the transfer function, and with
--bars one line `bar NAME VALUE LIMIT ok|short` per bar (exit status 1 when a bar is short; without VTK or a scan, its
bars are short). The pictures go to FOLDER as PNG. VTK runs under VTK_PYTHON (default: the first of /usr/bin/python3 and
python3 that can import vtkmodules); it needs an X server, which xvfb-run provides.

A frame's cost is the CPU time that the contestant's process spends on it, all threads. Ours includes reading the picture
back; VTK's includes the cost of its window, which is less than a millisecond without a volume.
"""
import argparse
import gzip
import json
import math
import os
import pathlib
import random
import shutil
import statistics
import struct
import subprocess
import sys
import zlib

from bar_lines import Bars
from servers import Server

HERE = pathlib.Path(__file__).resolve().parent
MODES = ["none", "blocks", "distance"]
PEERS = {"fixed": "vtkFixedPointVolumeRayCastMapper", "gpu": "vtkGPUVolumeRayCastMapper"}
PACKAGES = "apt-get install python3-vtk9 python3-numpy xvfb, or point VTK_PYTHON at a Python that has them"
# Name, volume, transfer function, limits of the ratio to the fixed-point mapper and to the GPU mapper.
SCENES = [
    ("transparent", "noise", "transparent", 0.8, 0.6),
    ("medium", "noise", "medium", 0.8, 0.6),
    ("opaque", "noise", "opaque", 0.8, 0.6),
    ("sparse", "vessels", "opaque", 0.5, 0.6),
]
# Sparse scans: file, transfer function, limits as above.
SCANS = [("xa_aneurism.nrrd", "scan", 0.5, 0.6), ("mr_angio_head.nrrd", "scan", 0.5, 0.6)]
PICTURE_LIMIT = 1.0
CAMERA = "20 30 3.8637"


class Contestant(Server):
    """A server whose first answer describes the renderer."""

    def __init__(self, command):
        super().__init__(command)
        self.about = self.checked(self.answer(), command)

    def ask(self, line):
        return self.checked(super().ask(line), line)

    @staticmethod
    def checked(answer, asked):
        if "err" in answer:
            raise SystemExit(f"render_bars: {asked}: {answer['err']}")
        return answer


def vtk_command():
    """Command that starts the VTK peer, or the reason why there is none."""
    named = os.environ.get("VTK_PYTHON")
    check = "import vtkmodules.vtkRenderingVolumeOpenGL2, vtkmodules.util.numpy_support"
    reasons = []
    for python in [named] if named else ["/usr/bin/python3", "python3"]:
        found = shutil.which(python)
        if not found:
            reasons.append(f"{python} is no program")
            continue
        done = subprocess.run([found, "-c", check], capture_output=True, text=True)
        if done.returncode == 0:
            break
        # The last line of the traceback names the module that is missing: VTK's, or numpy.
        said = done.stderr.strip().splitlines()
        reasons.append(f"{found}: {said[-1] if said else f'exit status {done.returncode}'}")
    else:
        return None, f"{'; '.join(dict.fromkeys(reasons))}. Remedy: {PACKAGES}"
    start = [found, str(HERE / "vtk_peer.py")]
    if os.environ.get("DISPLAY"):
        return start, None
    if not shutil.which("xvfb-run"):
        return None, f"VTK needs an X server and there is no xvfb-run: {PACKAGES}"
    return ["xvfb-run", "-a", *start], None


def read_nrrd(path):
    """Voxels, dims and spacing of a file of unsigned bytes."""
    head, body = path.read_bytes().split(b"\n\n", 1)
    field = dict(line.split(": ", 1) for line in head.decode("latin-1").splitlines() if ": " in line and line[0] != "#")
    if field["type"] not in ("uint8", "unsigned char", "uchar"):
        raise SystemExit(f"render_bars: {path}: voxels are {field['type']}, unsigned bytes are expected")
    if field["encoding"] in ("gzip", "gz"):
        body = gzip.decompress(body)
    dims = [int(n) for n in field["sizes"].split()]
    spacing = [float(s) for s in field.get("spacings", "1 1 1").split()]
    return body[: math.prod(dims)], dims, spacing


def write_png(path, rgb, width, height):
    rows = b"".join(b"\0" + rgb[3 * width * y: 3 * width * (y + 1)] for y in range(height))

    def chunk(kind, data):
        body = kind + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">2I5B", width, height, 8, 2, 0, 0, 0))
                     + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b""))


def compare(a, b):
    """PSNR in dB, and mean absolute difference in levels of 255, over all channels."""
    square = total = 0
    for x, y in zip(a, b):
        d = x - y
        total += abs(d)
        square += d * d
    mean = square / len(a)
    return (math.inf if mean == 0 else 10 * math.log10(255 * 255 / mean)), total / len(a)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--server", required=True)
    parser.add_argument("--out", default="out/render")
    parser.add_argument("--scans", default="../shared/data/scans")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--edge", type=int, default=256)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--only", default="")
    parser.add_argument("--bars", action="store_true")
    options = parser.parse_args()
    if options.bars:
        with Bars(limits(options.only)) as bars:
            say(bars, *measure(options))
    else:
        measure(options)


def measure(options):
    """Returns the figures by scene, and a text with the reasons for missing figures."""
    out = pathlib.Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    ours = Contestant([options.server])
    command, missing = vtk_command()
    peers = {p: Contestant([*command, p]) for p in PEERS} if command else {}
    print(f"ours: {ours.about['name']}")
    for peer in peers.values():
        print(f"{peer.about['name']}, {peer.about['window']}, {peer.about['gl']}")
    if not peers:
        print(f"VTK is not measured: {missing}", file=sys.stderr)

    scenes = [s for s in SCENES if options.only in s[0]]
    volumes = {}
    for kind in sorted({s[1] for s in scenes}):
        path = out / f"{kind}_{options.edge}.raw"
        if not path.exists():
            ours.ask(f"make {kind} {options.edge} {path}")
        volumes[kind] = (path, [options.edge] * 3, [1.0] * 3)
    found = [scan[0] for scan in SCANS if (pathlib.Path(options.scans) / scan[0]).exists()]
    absent = [scan[0] for scan in SCANS if scan[0] not in found]
    print(f"scans in {options.scans} (SCANS=folder): {', '.join(found) or 'none'}"
          + (f"; not there: {', '.join(absent)}" if absent else ""))
    for name, transfer, fixed_limit, gpu_limit in SCANS:
        path = pathlib.Path(options.scans) / name
        stem = name.split(".")[0]
        if name in found and options.only in stem:
            voxels, dims, spacing = read_nrrd(path)
            raw = out / f"{stem}.raw"
            raw.write_bytes(voxels)
            volumes[stem] = (raw, dims, spacing)
            scenes.append((stem, stem, transfer, fixed_limit, gpu_limit))

    results = {}
    for scene, volume, transfer, *_ in scenes:
        path, dims, spacing = volumes[volume]
        shape = " ".join(map(str, [path, *dims, *spacing]))
        ours.ask(f"volume {shape}")
        table = out / f"{transfer}.table"
        # The time of an edit is measured several times: the first edit of a volume also allocates memory on the device.
        edits = [ours.ask(f"transfer {transfer} {table}") for _ in range(5)]
        edit = {k: statistics.median(e[k] for e in edits) for k in ("wall", "occupancy", "distance_map")}
        camera = ours.ask(f"camera {CAMERA} {options.size} {options.size}")
        contestants = {("ours", m): (ours, f"frame {m}") for m in MODES}
        for name, peer in peers.items():
            peer.ask(f"volume {shape}")
            peer.ask(f"table {table}")
            numbers = [*camera["eye"], *camera["forward"], *camera["up"], camera["fov_y"], options.size, options.size]
            peer.ask("camera " + " ".join(map(str, numbers)))
            contestants["vtk", name] = peer, "frame"
        times = {key: [] for key in contestants}
        shuffler = random.Random(1)
        for turn in range(2 + options.rounds):
            order = list(contestants)
            shuffler.shuffle(order)
            for key in order:
                process, line = contestants[key]
                # The first frame after a frame of another renderer is not counted, since caches are cold.
                process.ask(line)
                answer = process.ask(line)
                if turn >= 2:
                    times[key].append(answer)
        cpu = {key: statistics.median(t["cpu"] for t in v) for key, v in times.items()}
        wall = {key: statistics.median(t["wall"] for t in v) for key, v in times.items()}
        print(f"\n{scene}: {' x '.join(map(str, dims))}, transfer function {transfer}, "
              f"{100 * edits[-1]['occupied']:.1f} % of blocks occupied, {options.size} x {options.size}")
        for key in contestants:
            label = f"ours, skipping {key[1]}" if key[0] == "ours" else PEERS[key[1]]
            print(f"  {label:40} {1e3 * cpu[key]:8.1f} ms CPU {1e3 * wall[key]:8.1f} ms wall")
        for mode in MODES:
            counts = ours.ask(f"counts {mode}")
            print(f"  skipping {mode}: {counts['samples']} samples, {counts['skips']} skips, {counts['rays']} rays")
        print(f"  an edit of the transfer function: {1e3 * edit['wall']:.2f} ms wall with both maps; emptiness of the "
              f"blocks {1e3 * edit['occupancy']:.2f} ms, distance map {1e3 * edit['distance_map']:.2f} ms more")
        size = ours.ask(f"image distance {out / 'ours.rgb'}")
        images = {"ours": (out / "ours.rgb").read_bytes()}
        for name, peer in peers.items():
            peer.ask(f"image {out / 'peer.rgb'}")
            images[name] = (out / "peer.rgb").read_bytes()
            psnr, mean = compare(images["ours"], images[name])
            print(f"  picture against {PEERS[name]}: PSNR {psnr:.1f} dB, mean difference {mean:.2f}/255")
            results[f"{scene}/psnr/{name}"] = psnr
            results[f"{scene}/difference/{name}"] = mean
        for name, rgb in images.items():
            write_png(out / f"{scene}_{name}.png", rgb, size["width"], size["height"])
        results[scene] = {"/".join(k): {"cpu": cpu[k], "wall": wall[k]} for k in contestants}
        results[scene]["edit"] = edit
    for file in ("ours.rgb", "peer.rgb"):
        (out / file).unlink(missing_ok=True)
    (out / "render.json").write_text(json.dumps(results, indent=1))
    print(f"\npictures and render.json: {out}")
    for process in [ours, *peers.values()]:
        process.end()
    lacking = [] if peers else [missing]
    if absent:
        lacking.append(f"{', '.join(absent)} not in {options.scans}: make bars-render SCANS=FOLDER-WITH-THEM")
    return results, "; ".join(lacking) or "a contestant gave no time"


def limits(only):
    """Limits of the bars of the scenes whose names contain a text."""
    scenes = [scene for scene in SCENES + [(s[0].split(".")[0], *s) for s in SCANS] if only in scene[0]]
    out = {}
    for scene, _, _, fixed_limit, gpu_limit in scenes:
        out |= {ratio_name(scene, "fixed"): fixed_limit, ratio_name(scene, "gpu"): gpu_limit}
    out |= {f"render_{scene[0]}_picture_difference_{peer}": PICTURE_LIMIT for scene in scenes for peer in PEERS}
    return out | {f"render_{scene[0]}_distance_vs_blocks": 1.0 for scene in scenes if scene[1] != "noise"}


def ratio_name(scene, peer):
    return f"render_{scene}_vs_{'fixed_point' if peer == 'fixed' else 'gpu'}_mapper"


def say(bars, results, lacking):
    """Prints the bars: `results` has the times of a scene under its name."""
    for scene in [key for key in results if "/" not in key]:
        times = results[scene]
        # In every scene, our time is the time with skipping by distance map.
        own, blocks = (times[f"ours/{mode}"]["cpu"] for mode in ("distance", "blocks"))
        for peer in PEERS:
            if f"vtk/{peer}" in times:
                theirs = times[f"vtk/{peer}"]["cpu"]
                note = f"{1e3 * own:.1f} ms CPU, skipping distance; {1e3 * theirs:.1f} ms CPU"
                bars.found(ratio_name(scene, peer), own / theirs, note)
                # Times are comparable only if the pictures agree. This bar is the mean difference of a channel, in
                # levels of 255.
                name = f"render_{scene}_picture_difference_{peer}"
                bars.found(name, results[f"{scene}/difference/{peer}"], "levels of 255, mean")
        if f"render_{scene}_distance_vs_blocks" in bars.asked:
            bars.found(f"render_{scene}_distance_vs_blocks", own / blocks)
    bars.lacking(lacking)


if __name__ == "__main__":
    main()
