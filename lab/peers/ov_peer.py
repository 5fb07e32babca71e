# SPDX-License-Identifier: MIT OR Apache-2.0
"""OpenVINO as a server (see pycommon.py). Variants: f32, bf16."""
import openvino as ov

from pycommon import FOLDER, THREADS, get_input, serve

core = ov.Core()


def make(variant, name, batch):
    x = get_input(name, batch)
    model = core.read_model(f"{FOLDER}/{name}.onnx")
    model.reshape(list(x.shape))
    settings = {"INFERENCE_NUM_THREADS": THREADS, "NUM_STREAMS": 1, "PERFORMANCE_HINT": "LATENCY",
                "INFERENCE_PRECISION_HINT": variant}
    compiled = core.compile_model(model, "CPU", settings)
    request = compiled.create_infer_request()
    tensor = ov.Tensor(x, shared_memory=True)
    request.set_input_tensor(0, tensor)
    out = request.get_output_tensor(0)
    def call():
        request.infer()
        return out.data

    call.keep = (tensor, compiled)
    return call


serve(make)
