"""Policies as programs for controllers: a C header, an ONNX model.

The deterministic policy is traced once (`walk`) to a short list of steps on arrays
(`program`). Each format is a writer of such a list.
"""
