# SPDX-License-Identifier: MIT OR Apache-2.0
"""Mutated fixtures (*neighbors*): copies with a few changed header fields or bytes, reproducible by seed.

differential.py reads them. Each lies in a folder of its own. The folder of a header (such as .nhdr) also has links to
the other files of the fixture's folder.
"""
import gzip
import os
import random
import re
import shutil
import struct

import peers

NUMBERS = ["0", "1", "2", "3", "-1", "0.5", "1e3", "-2.5", "nan", "NaN", "inf", "1e-3", "007", "+3", "3.0", "1.", ".5",
           "1e400", "4294967297", "65536", "0x10", "1,5", ""]
WORDS = [
    ["little", "big", "LITTLE", "Big"],
    ["raw", "gzip", "gz", "ascii", "text", "txt", "hex", "bzip2", "bz2", "Raw"],
    ["True", "False", "true", "FALSE", "1", "0", "T"],
    ["LittleEndian", "BigEndian"],
    ["UInt32", "UInt64", "Int32"],
    ["UInt8", "Int8", "UInt16", "Int16", "UInt32", "Int32", "UInt64", "Int64", "Float32", "Float64"],
    ["ascii", "binary", "appended"],
    ["raw", "base64"],
    ["vtkZLibDataCompressor", "vtkLZ4DataCompressor", "vtkLZMADataCompressor", ""],
    ["MET_CHAR", "MET_UCHAR", "MET_SHORT", "MET_USHORT", "MET_INT", "MET_UINT", "MET_LONG", "MET_ULONG", "MET_LONG_LONG",
     "MET_ULONG_LONG", "MET_FLOAT", "MET_DOUBLE", "MET_SHORT_ARRAY", "MET_OTHER"],
    ["uint8", "uchar", "unsigned char", "int8", "signed char", "char", "short", "int16", "unsigned short", "uint16", "ushort",
     "int", "int32", "uint", "unsigned int", "uint32", "longlong", "int64", "unsigned long long", "uint64", "float", "double",
     "float32", "block"],
    ["LOCAL", "Local", "local"],
    ["NRRD0001", "NRRD0002", "NRRD0003", "NRRD0004", "NRRD0005", "NRRD0006"],
    ["domain", "space", "time", "vector", "none", "scalar", "list", "RGB-color"],
    ["Image", "image", "Scene"],
    ["density", "velocity", "gone"],
    ["Scalars", "Vectors", "scalars"],
    ["PointData", "CellData"],
    ["WholeExtent", "Extent", "Spacing", "Origin", "Direction"],
    ["ElementSpacing", "ElementSize", "Spacing"],
    ["spacings", "thicknesses", "axis mins"],
]
LINES = {
    "nrrd": ["# a comment", "key:=value", "key: value", "content: some: thing", "byte skip: 0", "byte skip: -1", "byte skip: 1",
             "line skip: 0", "line skip: 1", "spacings: 1 2 3", "spacings: nan nan nan", "space directions: (2,0,0) (0,3,0) (0,0,4)",
             "space directions: none (0,3,0) (0,0,4)", "kinds: domain domain domain", "kinds: space space space",
             "kinds: vector domain domain", "kinds: domain domain time", "space: left-posterior-superior", "space dimension: 3",
             "thicknesses: 1 2 3", "axis mins: 0 0 0", "centers: cell cell cell", "min: 0", "old max: 5", "number: 385",
             "block size: 2", "sample units: HU", "endian: big", "endian: little", "sizes: 11 7 5", "units: \"mm\" \"mm\" \"mm\"",
             "measurement frame: (1,0,0) (0,1,0) (0,0,1)", "labels: \"x\" \"y\" \"z\"", "space origin: (0,0,0)",
             "space units: \"mm\" \"mm\" \"mm\"", " ", "data file: LOCAL"],
    "metaimage": ["Comment = x", "HeaderSize = -1", "HeaderSize = 0", "HeaderSize = 2", "ElementSize = 1 2 3",
                  "ElementSpacing = 1 2 3", "Offset = 0 0 0", "TransformMatrix = 1 0 0 0 1 0 0 0 1", "CompressedDataSize = 100",
                  "ElementMin = 0", "ElementMax = 5", "ElementNumberOfChannels = 1", "ElementNumberOfChannels = 3",
                  "AnatomicalOrientation = RAI", "ElementToIntensityFunctionSlope = 2", "ElementToIntensityFunctionOffset = 3",
                  "BinaryDataByteOrderMSB = True", "ElementByteOrderMSB = True", "ElementByteOrderMSB = False",
                  "CompressedData = True", "BinaryData = True", "Modality = MET_MOD_CT", "DimSize = 11 7 5", "", "Unknown = 5",
                  "Spacing = 4 5 6", "ObjectSubType = x", "NDims = 3", "SequenceID = 0 0 0"],
    "vti": ["<!-- a comment -->", "<FieldData></FieldData>", "<PointData></PointData>", "<CellData></CellData>",
            '<DataArray type="UInt8" Name="other" format="ascii">1 2 3</DataArray>', "<Unknown/>"],
}
# Fields of NIfTI-1 and -2 headers: offset, format, values.
FIELDS = (
    [(40, "h", (1, 2, 3, 4, 5, 7, 8, 0))] + [(42 + 2 * i, "h", (0, 1, 2, 5, 7, 11, -1, 77)) for i in range(7)]
    + [(70, "h", (2, 4, 8, 16, 64, 256, 512, 768, 1024, 1280, 128, 32, 0, 1)), (72, "h", (8, 16, 32, 64, 0, 7))]
    + [(76 + 4 * i, "f", (0.0, 1.0, -1.0, 2.5, -0.5, float("nan"), float("inf"), 1e-9)) for i in range(8)]
    + [(108, "f", (0.0, 348.0, 352.0, 353.0, 368.0, 352.5, -1.0, float("nan"))),
       (112, "f", (0.0, 1.0, 2.0, -1.0, 0.3, float("nan"), float("inf"), 1e-8, 1e30)),
       (116, "f", (0.0, 1.0, -3.0, 0.1, float("nan"), float("inf"), 1e8)), (123, "B", (0, 1, 2, 3, 10, 255)),
       (252, "h", (0, 1, 2, -1)), (254, "h", (0, 1, 2, -1)), (124, "f", (1.0, 100.0)), (128, "f", (1.0, -100.0)),
       (344, "4s", (b"n+1\0", b"ni1\0", b"n+1 ", b"n+2\0", b"\0\0\0\0")), (348, "B", (0, 1, 255)), (0, "i", (348, 540, 0)),
       (256, "f", (0.0, 0.5, 2.0)), (280, "f", (0.0, 2.0, -3.0)), (300, "f", (0.0, 5.0))],
    [(16, "q", (1, 2, 3, 4, 5, 7, 8, 0))] + [(24 + 8 * i, "q", (0, 1, 2, 5, 7, 11, -1, 77)) for i in range(7)]
    + [(12, "h", (2, 4, 8, 16, 64, 256, 512, 768, 1024, 1280, 128, 32, 0)), (14, "h", (8, 16, 32, 64, 0))]
    + [(104 + 8 * i, "d", (0.0, 1.0, -1.0, 2.5, float("nan"), float("inf"), 1e-9)) for i in range(8)]
    + [(168, "q", (0, 540, 544, 545, 560, -1)), (176, "d", (0.0, 1.0, 2.0, -1.0, 0.3, float("nan"))),
       (184, "d", (0.0, 1.0, -3.0, 0.1, float("nan"))), (4, "8s", (b"n+2\0\r\n\x1a\n", b"n+1\0\r\n\x1a\n", b"n+2\0\0\0\0\0")),
       (344, "i", (0, 1)), (348, "i", (0, 1))],
)


def header_end(kind, data):
    """End of the header's text."""
    if kind == "nrrd":
        found = re.search(rb"\r?\n\r?\n", data)
        return found.start() + 1 if found else len(data)
    if kind == "metaimage":
        found = re.search(rb"ElementDataFile[^\n]*\n", data)
        return found.end() if found else len(data)
    found = data.find(b"<AppendedData")
    return data.find(b"_", found) if found >= 0 else len(data)


def alter_number(source, text):
    spots = list(re.finditer(r"-?\d+(\.\d+)?", text))
    if not spots:
        return text
    spot = source.choice(spots)
    value = source.choice(NUMBERS)
    if "." not in spot[0] and source.random() < 0.4:
        value = str(source.choice([int(spot[0]) + 1, int(spot[0]) - 1, 2 * int(spot[0]), -int(spot[0]), int(spot[0]) // 2]))
    return text[:spot.start()] + value + text[spot.end():]


def swap_numbers(source, text):
    spots = list(re.finditer(r"-?\d+(\.\d+)?", text))
    if len(spots) < 2:
        return text
    a, b = sorted(source.sample(spots, 2), key=lambda spot: spot.start())
    return text[:a.start()] + b[0] + text[a.end():b.start()] + a[0] + text[b.end():]


def replace_word(source, text):
    families = [(family, word) for family in WORDS for word in family if word and re.search(rf"\b{re.escape(word)}\b", text)]
    if not families:
        return text
    family, word = source.choice(families)
    spots = list(re.finditer(rf"\b{re.escape(word)}\b", text))
    spot = source.choice(spots)
    return text[:spot.start()] + source.choice(family) + text[spot.end():]


def change_blanks(source, text):
    how = source.randrange(5)
    if how == 0:
        return text.replace("\n", "\r\n")
    spots = [at for at, letter in enumerate(text) if letter == (" " if how < 3 else "\n")]
    if not spots:
        return text
    at = source.choice(spots)
    if how == 1:
        return text[:at] + "\t" + text[at + 1:]
    return text[:at] + source.choice(["", "  "] if how == 2 else [" \n", "\t\n", "\n ", "\r\n"]) + text[at + 1:]


def change_case(source, text):
    lines = text.split("\n")
    at = source.randrange(len(lines))
    key, mark, value = re.match(r"([^:=]*)([:=]?)(.*)", lines[at], re.S).groups()
    fold = source.choice([str.upper, str.lower, str.title])
    lines[at] = fold(key) + mark + value if source.random() < 0.5 else key + mark + fold(value)
    return "\n".join(lines)


def change_attribute(source, text):
    """Drops or doubles an attribute of XML, or changes its quotation marks or the blanks around its equals sign."""
    spots = list(re.finditer(r' [A-Za-z_]+="[^"]*"', text))
    if not spots:
        return text
    spot = source.choice(spots)
    put = source.choice(["", spot[0] * 2, spot[0].replace('"', "'"), spot[0].replace("=", " = ")])
    return text[:spot.start()] + put + text[spot.end():]


def change_lines(source, text, kind):
    lines = text.split("\n")
    how = source.randrange(4)
    a, b = source.randrange(len(lines)), source.randrange(len(lines))
    if how == 0:
        lines[a], lines[b] = lines[b], lines[a]
    elif how == 1:
        lines.insert(b, lines[a])
    elif how == 2:
        del lines[a]
    else:
        put = source.choice(LINES.get(kind, [""]))
        # The line is put after the first line, and before the last one if there are several.
        lines.insert(source.randrange(1, max(2, len(lines) - 1)), put)
    return "\n".join(lines)


def change_text(source, data, kind):
    end = len(data) if kind == "raw" else header_end(kind, data)
    text, rest = data[:end].decode("latin-1"), data[end:]
    roll = source.random()
    if roll < 0.25:
        text = alter_number(source, text)
    elif roll < 0.33:
        text = swap_numbers(source, text)
    elif roll < 0.55:
        text = replace_word(source, text)
    elif roll < 0.65:
        text = change_blanks(source, text)
    elif roll < 0.7:
        text = change_case(source, text)
    elif roll < 0.8 and kind == "vti":
        text = change_attribute(source, text)
    else:
        text = change_lines(source, text, kind)
    return text.encode("latin-1") + rest


def change_field(source, data, kind):
    """Sets a field of a NIfTI header."""
    if len(data) < 4:
        return data
    big = data[:4] in (b"\0\0\1\x5c", b"\0\0\2\x1c")
    second = data[:4] in (b"\0\0\2\x1c", b"\x1c\2\0\0")
    offset, form, values = source.choice(FIELDS[second])
    packed = struct.pack((">" if big else "<") + form, source.choice(values))
    return data[:offset] + packed + data[offset + len(packed):]


def change_bytes(source, data, kind):
    data = bytearray(data)
    how = source.randrange(5)
    if how < 3 and data:
        for _ in range(source.choice([1, 1, 1, 3])):
            end = min(len(data), 600) if how < 2 else len(data)
            data[source.randrange(end)] = source.choice([source.randrange(256), 32, 48, 10])
    elif how == 3 and len(data) > 1:
        del data[len(data) - source.choice([1, 2, 7, len(data) // 3]):]
    else:
        data += source.choice([b"\n", b"\0", b"\n\n", b"x" * 64])
    return bytes(data)


def changed(source, data, kind):
    for _ in range(source.choice([1, 1, 1, 2, 3])):
        change = change_bytes if source.random() < 0.12 else change_field if kind == "nifti" else change_text
        data = change(source, data, kind)
    return data


def make(files, wanted, seed, folder, keep):
    """Yields each mutated file's path and its name: a number and the name of the fixture."""
    by_kind = {}
    for name, path in files:
        kind = peers.format_of(path)
        if kind != "raw" or path.suffix == ".json":
            by_kind.setdefault(kind, []).append((name, path))
    kinds = [kind for kind in ("nrrd", "nrrd", "metaimage", "metaimage", "vti", "vti", "nifti", "nifti", "raw") if kind in by_kind]
    if keep:
        keep.mkdir(parents=True, exist_ok=True)
    for index in wanted:
        source = random.Random(f"{seed} {index}")
        kind = source.choice(kinds)
        name, path = source.choice(by_kind[kind])
        data = path.read_bytes()
        packed = path.suffix == ".gz"
        data = changed(source, gzip.decompress(data) if packed else data, kind)
        own = folder / f"{index:06}"
        own.mkdir()
        if path.suffix in (".nhdr", ".mhd", ".json"):
            for beside in path.parent.iterdir():
                if beside.is_file() and beside.name != path.name:
                    os.symlink(beside, own / beside.name)
        (own / path.name).write_bytes(gzip.compress(data, mtime=0) if packed else data)
        yield own / path.name, f"{index:06} {name}"


def clear(path, keep):
    """Removes a mutated file and its folder; first copies the file into the folder `keep`, if one is given."""
    if keep:
        shutil.copy(path, keep / f"{path.parent.name}-{path.name}")
    shutil.rmtree(path.parent)
