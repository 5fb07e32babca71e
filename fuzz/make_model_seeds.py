#!/usr/bin/env python3
"""Writes the seed models of corpus/model: small networks in every number format that is read."""

import json
import pathlib
import struct

OUT = pathlib.Path(__file__).parent / "corpus" / "model"


def numbers(count, dtype):
    values = [((i * 37) % 19 - 9) / 16 for i in range(count)]
    if dtype == "F16":
        return struct.pack(f"<{count}e", *values)
    if dtype == "BF16":
        return b"".join(struct.pack("<f", v)[2:] for v in values)
    return struct.pack(f"<{count}f", *values)


def write(name, metadata, tensors):
    header, data = {"__metadata__": metadata}, b""
    for tensor, dtype, shape in tensors:
        count = 1
        for size in shape:
            count *= size
        # Variances and deviations are positive.
        part = struct.pack(f"<{count}f", *[1.5] * count) if tensor.endswith(("var", "std")) else numbers(count, dtype)
        header[tensor] = {"dtype": dtype, "shape": shape, "data_offsets": [len(data), len(data) + len(part)]}
        data += part
    text = json.dumps(header, separators=(",", ":")).encode()
    (OUT / name).write_bytes(struct.pack("<Q", len(text)) + text + data)


def prednet(dtype):
    return [
        ("prednet.0.weight", dtype, [3, 5]), ("prednet.0.bias", "F32", [3]),
        ("prednet.1.weight", dtype, [1, 3]), ("prednet.1.bias", "F32", [1]),
    ]


INPUTS = '[{"name":"camera","size":3},{"name":"resolution","size":2}]'
VOLUMENET = [
    ("volumenet.encoder.0.conv.weight", "F32", [2, 1, 2, 2, 2]), ("volumenet.encoder.0.conv.bias", "F32", [2]),
    ("volumenet.encoder.0.bn.weight", "F32", [2]), ("volumenet.encoder.0.bn.bias", "F32", [2]),
    ("volumenet.encoder.0.bn.running_mean", "F32", [2]), ("volumenet.encoder.0.bn.running_var", "F32", [2]),
    ("volumenet.fc.weight", "F16", [2, 16]), ("volumenet.fc.bias", "F32", [2]),
]

if __name__ == "__main__":
    OUT.mkdir(parents=True, exist_ok=True)
    for dtype in ("F32", "F16", "BF16"):
        metadata = {"entire.format": "1", "entire.inputs": INPUTS, "entire.target": "seconds"}
        write(f"prednet_{dtype.lower()}", metadata, prednet(dtype))
    norm = [(f"prednet.input.{part}", "F32", [5]) for part in ("mean", "std")]
    norm += [(f"prednet.output.{part}", "F32", [1]) for part in ("mean", "std")]
    both = {
        "entire.format": "1", "entire.target": "log_seconds",
        "entire.inputs": '[{"name":"volume_features","size":2},{"name":"scene_features","size":3}]',
        "entire.scene_features": '["a","b","c"]',
        "entire.volumenet": '{"input":4,"blocks":[{"stride":2,"padding":0}]}',
    }
    write("both", both, prednet("F32") + norm + VOLUMENET)
