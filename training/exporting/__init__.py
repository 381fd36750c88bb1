"""Export of policies as programs for controllers: a C header or an ONNX model.

The deterministic policy is traced once, and its jaxpr is translated (`walk`) into a
short list of steps on arrays (`program`). A writer for each format translates the list.
"""
