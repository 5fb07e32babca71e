# SPDX-License-Identifier: MIT OR Apache-2.0
"""ONNX Runtime as a server (see pycommon.py). Variants: bind, run, int8."""
import numpy as np
import onnxruntime as ort

from pycommon import FOLDER, THREADS, get_input, serve


def make(variant, name, batch):
    options = ort.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = THREADS, 1
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    suffix = "_int8" if variant == "int8" else ""
    session = ort.InferenceSession(f"{FOLDER}/{name}{suffix}.onnx", options, providers=["CPUExecutionProvider"])
    x = get_input(name, batch)
    if "run" in variant:
        return lambda: session.run(None, {"x": x})[0]
    # Input and output are bound once, so that a call copies no data.
    binding = session.io_binding()
    y = np.zeros((x.shape[0], 2 if name.startswith("vol") else 1), np.float32)
    binding.bind_input("x", "cpu", 0, np.float32, x.shape, x.ctypes.data)
    binding.bind_output("y", "cpu", 0, np.float32, y.shape, y.ctypes.data)
    raw = session._sess

    def call():
        raw.run_with_iobinding(binding._iobinding, None)
        return y

    call.keep = (x, session)
    return call


serve(make)
