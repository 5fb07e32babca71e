# SPDX-License-Identifier: MIT OR Apache-2.0
"""The independent readers that differential.py compares with. Every file is read in a child process with limits of
memory and processor time.

`pip install pynrrd SimpleITK nibabel vtk numpy` brings all of them. Voxels are converted to the types of the
command's readers (table at the top of io/src/volume/mod.rs), so that checksums can be compared.
"""
import importlib
import json
import os
import re
import resource
import select
import time
import zlib
from pathlib import Path
from typing import NamedTuple, Optional, Tuple

# The libraries run on one thread, since a forked child has none of its parent's threads.
os.environ.setdefault("VTK_SMP_BACKEND_IN_USE", "Sequential")
os.environ.setdefault("ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

LIMIT_BYTES = 6 << 30
LIMIT_SECONDS = 10
IN_MEMORY = {"uint8": "uint8", "int8": "int16", "uint16": "uint16", "int16": "int16", "int32": "float32",
             "uint32": "float32", "int64": "float32", "uint64": "float32", "float32": "float32", "float64": "float32"}
INSTALLED = {}


class Reading(NamedTuple):
    """A volume that was read; `dims` has other than three entries for several components or time steps, or a flat
    image."""

    dims: Tuple[int, ...]
    type: str
    spacing: Tuple[float, ...]
    range: Optional[Tuple[float, float]]
    crc32: str


class Refusal(Exception):
    """A reader's refusal of a file."""


def load():
    """Imports the libraries; returns the names of missing ones, as pip knows them."""
    missing = []
    for name, module in (("numpy", "numpy"), ("pynrrd", "nrrd"), ("SimpleITK", "SimpleITK"), ("nibabel", "nibabel"),
                         ("vtk", "vtkmodules.all")):
        try:
            INSTALLED[name] = importlib.import_module(module)
        except ImportError:
            missing.append(name)
    if "vtk" in INSTALLED:
        INSTALLED["vtk_to_numpy"] = importlib.import_module("vtkmodules.util.numpy_support").vtk_to_numpy
    return missing


def reading(array, dims, spacing):
    """A reading of an array whose flattened elements run fastest along x."""
    np = INSTALLED["numpy"]
    dims, spacing = [int(n) for n in dims], [float(s) for s in spacing]
    # Axes of one element are removed, from the last on, until three axes are left.
    while len(dims) > 3 and 1 in dims:
        at = len(dims) - 1 - dims[::-1].index(1)
        del dims[at], spacing[at]
    if array.dtype.name not in IN_MEMORY:
        raise Refusal(f"voxels of type {array.dtype.name}")
    if not array.size:
        raise Refusal(f"no voxels: sizes {dims}")
    kind = IN_MEMORY[array.dtype.name]
    with np.errstate(over="ignore"):
        values = array.reshape(-1).astype(np.dtype(kind).newbyteorder("<"))
    span = None
    if kind == "float32":
        values[np.isnan(values)] = np.uint32(0x7FC00000).view(np.float32)
        finite = values[np.isfinite(values)]
    else:
        finite = values
    if finite.size:
        span = (float(finite.min()), float(finite.max()))
    return Reading(tuple(dims), kind, tuple(spacing), span, f"{zlib.crc32(values.tobytes()):08x}")


def with_pynrrd(path):
    np = INSTALLED["numpy"]
    array, header = INSTALLED["pynrrd"].read(str(path), index_order="F")
    # pynrrd returns the raw fields: an axis's spacing is the length of its space direction, else its `spacings`, else
    # 1.
    spacing = [float("nan")] * array.ndim
    for field in ("spacings", "space directions"):
        for axis, value in enumerate(header.get(field) if header.get(field) is not None else ()):
            length = float("nan") if value is None or not np.size(value) else float(np.linalg.norm(value))
            spacing[axis] = spacing[axis] if np.isnan(length) else length
    spacing = [1.0 if np.isnan(s) else s for s in spacing]
    return reading(array.ravel(order="F"), array.shape, spacing)


def with_simpleitk(path):
    itk = INSTALLED["SimpleITK"]
    kind = {"nrrd": "NrrdImageIO", "metaimage": "MetaImageIO", "nifti": "NiftiImageIO"}[format_of(path)]
    image = itk.ReadImage(str(path), imageIO=kind)
    array = itk.GetArrayViewFromImage(image)
    dims, spacing = list(image.GetSize()), list(image.GetSpacing())
    if image.GetNumberOfComponentsPerPixel() != 1:
        dims, spacing = [image.GetNumberOfComponentsPerPixel(), *dims], [1.0, *spacing]
    return reading(array, dims, spacing)


def with_nibabel(path):
    np = INSTALLED["numpy"]
    image = INSTALLED["nibabel"].load(path)
    if not isinstance(image, (INSTALLED["nibabel"].Nifti1Image, INSTALLED["nibabel"].Nifti2Image)):
        raise Refusal(f"a file of type {type(image).__name__}")
    if (image.dataobj.slope, image.dataobj.inter) == (1.0, 0.0):
        array = np.asanyarray(image.dataobj.get_unscaled())
    else:
        # nibabel does not add an intercept of 0, so that 0 times a negative slope is -0. Adding 0 makes it 0.
        array = np.asanyarray(image.get_fdata(dtype=np.float64)) + 0.0
    return reading(array.ravel(order="F"), array.shape, [float(z) for z in image.header.get_zooms()])


# Names of VTK's own arrays. Such an array is the volume only if the file names it as its scalars.
VTK_OWN = re.compile(r"vtk[A-Z]")


def with_vtk(path):
    vtk = INSTALLED["vtk"]
    log = vtk.vtkStringOutputWindow()
    vtk.vtkOutputWindow.SetInstance(log)
    reader = vtk.vtkXMLImageDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    # The reader reports an error, and returns an image nevertheless.
    if "ERROR" in log.GetOutput().upper() or reader.GetErrorCode():
        said = re.findall(r"\): ([^\n]+)", log.GetOutput()) or [f"error {reader.GetErrorCode()}"]
        raise Refusal(said[0])
    image = reader.GetOutput()
    sections = [(image.GetPointData(), False), (image.GetCellData(), True)]
    active = [(s.GetScalars(), cells, s) for s, cells in sections if s.GetScalars() is not None]
    usable = [(a, cells, s) for a, cells, s in active if a.GetNumberOfComponents() == 1 and a.GetName() != "vtkGhostType"]
    if not usable and not any(a.GetNumberOfComponents() != 1 for a, _, _ in active):
        for section, cells in sections:
            ids = (section.GetGlobalIds(), section.GetPedigreeIds(), section.GetProcessIds())
            for at in range(section.GetNumberOfArrays()):
                array = section.GetArray(at)
                if array is not None and array.GetNumberOfComponents() == 1 and not any(array is own for own in ids) \
                        and not VTK_OWN.match(array.GetName() or ""):
                    usable.append((array, cells, section))
    chosen = (usable or active)[:1]
    if not chosen:
        raise Refusal("no array of scalars")
    array, cells, _ = chosen[0]
    dims = [n - 1 if cells else n for n in image.GetDimensions()]
    spacing = list(image.GetSpacing())
    if array.GetNumberOfComponents() != 1:
        dims, spacing = [array.GetNumberOfComponents(), *dims], [1.0, *spacing]
    return reading(INSTALLED["vtk_to_numpy"](array), dims, spacing)


RAW_TYPES = {"i8": "int8", "char": "int8", "u8": "uint8", "uchar": "uint8", "byte": "uint8", "i16": "int16",
             "short": "int16", "u16": "uint16", "ushort": "uint16", "i32": "int32", "int": "int32", "u32": "uint32",
             "uint": "uint32", "i64": "int64", "u64": "uint64", "f32": "float32", "float": "float32", "f64": "float64",
             "double": "float64"}


def with_numpy(path):
    """Raw voxels by their description in JSON, or by their name."""
    np = INSTALLED["numpy"]
    named = re.fullmatch(r"(.+)_(\d+)x(\d+)x(\d+)_(\w+)\.raw", path.name)
    if path.suffix == ".json":
        described, raw = path, None
    else:
        names = [path.with_suffix(".json")] + ([path.with_name(named[1] + ".json")] if named else [])
        described, raw = next((p for p in names if p.exists()), None), path
    if described is None and named is None:
        raise Refusal("no description")
    if described is None:
        text = {"size": [int(named[n]) for n in (2, 3, 4)], "type": named[5]}
    else:
        text = json.loads(described.read_text("utf-8-sig"))
    dims = text["size"]
    if raw is None:
        names = [text.get("file"), Path(text.get("url", "")).name, path.stem + ".raw"]
        raw = next(path.with_name(n) for n in names if n and path.with_name(n).exists())
    mark = {"little": "<", "big": ">"}[text.get("endian", "little")]
    kind = np.dtype(RAW_TYPES.get(text["type"], text["type"])).newbyteorder(mark)
    count = int(np.prod([int(n) for n in dims], dtype=object))
    array = np.frombuffer(raw.read_bytes(), dtype=np.uint8)
    if len(array) < count * kind.itemsize:
        raise Refusal("fewer bytes than the sizes call for")
    array = array[:count * kind.itemsize].view(kind)
    return reading(array, dims, text.get("spacing", [1.0] * len(dims)))


READERS = {"nibabel": with_nibabel, "pynrrd": with_pynrrd, "vtk": with_vtk, "SimpleITK": with_simpleitk,
           "numpy": with_numpy}
OF_FORMAT = {"nrrd": ("pynrrd", "SimpleITK"), "metaimage": ("SimpleITK",), "nifti": ("nibabel", "SimpleITK"),
             "vti": ("vtk",), "raw": ("numpy",)}
ENDINGS = {".nrrd": "nrrd", ".nhdr": "nrrd", ".mha": "metaimage", ".mhd": "metaimage", ".nii": "nifti",
           ".nii.gz": "nifti", ".vti": "vti", ".json": "raw", ".raw": "raw"}


def format_of(path):
    """The format of a file name's ending, or None."""
    return next((kind for ending, kind in ENDINGS.items() if path.name.lower().endswith(ending)), None)


def in_child(reader, path):
    """Output of the child: a reading, or the reason why there is none."""
    resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (LIMIT_SECONDS, LIMIT_SECONDS))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    try:
        return READERS[reader](path)._asdict()
    except BaseException as error:
        # ITK's messages begin with their place in ITK's source.
        text = re.sub(r".*(ITK ERROR: |nrrdLoad: )", "", " ".join(str(error).split()))
        return {"refused": f"{type(error).__name__}: {text[:300]}"}


def read(reader, path):
    """A Reading, or the reason of the refusal."""
    out, into = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.write(into, json.dumps(in_child(reader, path)).encode())
        finally:
            os._exit(0)
    os.close(into)
    parts, end = [], time.monotonic() + 6 * LIMIT_SECONDS
    while True:
        ready, _, _ = select.select([out], [], [], max(0.0, end - time.monotonic()))
        part = os.read(out, 1 << 16) if ready else b""
        if not ready:
            os.kill(child, 9)
        if not part:
            break
        parts.append(part)
    os.close(out)
    _, status = os.waitpid(child, 0)
    if not parts:
        return f"the reader ended with {os.waitstatus_to_exitcode(status)}"
    answer = json.loads(b"".join(parts))
    if "refused" in answer:
        return answer["refused"]
    for key in ("dims", "spacing", "range"):
        answer[key] = answer[key] and tuple(answer[key])
    return Reading(**answer)
