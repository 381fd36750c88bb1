"""Writer of programs as ONNX models, with the library `onnx`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxrod.training.exporting.program import (
    OPERATIONS,
    Buffer,
    Each,
    Join,
    Product,
    Program,
    Value,
)

OPSET = 17
"""Version of the ONNX operator set; runtimes support it since 2022."""
IR_VERSION = 8
"""Version of the ONNX file format that belongs to `OPSET`."""


def model(
    act: Program,
    memory_shapes: Sequence[tuple[int, ...]],
    comment: str,
    facts: dict[str, str],
) -> bytes:
    """Bytes of an ONNX model that maps one observation to one action, unbatched.

    Args:
        act: Program from the arrays of the memory and the observation to the action and
            the next memory.
        memory_shapes: Shapes of the arrays of the memory.
        comment: Description of the model.
        facts: Metadata of the model, by name.

    Raises:
        ModuleNotFoundError: `onnx` is not installed.
    """
    try:
        import onnx
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            'ONNX models need onnx; install it with: pip install "jaxrod[onnx]"',
            name=missing.name,
        ) from missing

    graph = _Graph(onnx)
    shapes = [*memory_shapes, (act.inputs[-1].size,)]
    names = [f"memory_{i}" for i in range(len(memory_shapes))]
    inputs, outputs = [], []
    for name, buffer, shape in zip(
        [*names, "observation"], act.inputs, shapes, strict=True
    ):
        inputs.append(graph.described(name, buffer.kind, shape))
        graph.names[buffer] = name if len(shape) == 1 else graph.shaped(name, (-1,))
    for step in act.steps:
        step.write(graph)
    for name, value in zip(
        ["action", *(f"next_{name}" for name in names)], act.results, strict=True
    ):
        kind, shape = value.buffer.kind, value.places.shape
        flat = graph.read(value, spread=True)
        graph.node("Reshape", flat, graph.integers(shape), out=name)
        outputs.append(graph.described(name, kind, shape))
    made = onnx.helper.make_model(
        onnx.helper.make_graph(
            graph.nodes, "policy", inputs, outputs, graph.initializers, comment
        ),
        producer_name="jaxrod",
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
    )
    onnx.helper.set_model_props(made, facts)
    onnx.checker.check_model(made)
    return made.SerializeToString(deterministic=True)


class _Graph:
    """ONNX graph under construction. Arrays are flat and known by name.

    Calling it adds a node and returns the name of the node's result.
    """

    def __init__(self, onnx: Any) -> None:
        self.onnx = onnx
        self.types = {
            "f": onnx.TensorProto.FLOAT,
            "i": onnx.TensorProto.INT32,
            "b": onnx.TensorProto.BOOL,
        }
        self.nodes: list[Any] = []
        self.initializers: list[Any] = []
        self.names: dict[Buffer, str] = {}
        self.known: dict[Any, str] = {}

    def __call__(self, operator: str, *inputs: str) -> str:
        return self.node(operator, *inputs)

    def node(self, operator: str, *inputs: str, out: str = "", **more: Any) -> str:
        """Adds a node; returns the name of its result, which is `out` if given.

        `more` has the attributes of the ONNX operator.
        """
        name = out or f"t{len(self.nodes)}"
        made = self.onnx.helper.make_node(operator, inputs, [name], **more)
        self.nodes.append(made)
        return name

    def each(self, step: Each) -> None:
        """Adds the operators of an elementwise step."""
        operator = OPERATIONS[step.operation].onnx
        # Constants are single numbers; one operand has the shape of the result.
        spread = all(value.uniform for value in step.operands)
        names = [self.read(value, spread) for value in step.operands]
        make = operator if callable(operator) else lambda node, *a: node(operator, *a)
        self.names[step.out] = make(self, *names)

    def product(self, step: Product) -> None:
        """Adds a matrix product."""
        batch, m, k, n = step.sizes
        pairs = zip(step.operands, ((batch, m, k), (batch, k, n)), strict=True)
        factors = [
            self.constant(value.numbers.reshape(shape))
            if value.known
            else self.shaped(self.names[value.buffer], shape)
            for value, shape in pairs
        ]
        self.names[step.out] = self.shaped(self("MatMul", *factors), (-1,))

    def join(self, step: Join) -> None:
        """Adds a concatenation."""
        parts = [self.read(value, spread=True) for value in step.operands]
        self.names[step.out] = self.node("Concat", *parts, axis=0)

    def read(self, value: Value, spread: bool) -> str:
        """Name of a value as a flat array.

        If all numbers are one constant and `spread` is false, the array has one entry,
        which ONNX broadcasts.
        """
        if value.known:
            numbers = value.numbers.ravel()
            return self.constant(
                numbers[:1] if value.uniform and not spread else numbers
            )
        name = self.names[value.buffer]
        if value.whole:
            return name
        return self("Gather", name, self.integers(value.places.ravel()))

    def shaped(self, name: str, shape: Sequence[int]) -> str:
        """Reshapes an array; returns the name of the result."""
        return self("Reshape", name, self.integers(shape))

    def cast(self, name: str, kind: str) -> str:
        """Converts an array to another kind of number; returns the new name."""
        return self.node("Cast", name, to=self.types[kind])

    def number(self, value: float) -> str:
        """Name of a float constant with one entry."""
        return self.constant(np.array([value], np.float32))

    def integers(self, numbers: Any) -> str:
        """Name of a constant of integers, for indices or shapes."""
        return self.constant(np.asarray(numbers, np.int64))

    def constant(self, array: np.ndarray) -> str:
        """Name of a constant; equal constants are stored once."""
        key = str(array.dtype), array.shape, array.tobytes()
        if key not in self.known:
            name = self.known[key] = f"c{len(self.known)}"
            tensor = self.onnx.numpy_helper.from_array(
                np.ascontiguousarray(array), name
            )
            self.initializers.append(tensor)
        return self.known[key]

    def described(self, name: str, kind: str, shape: Sequence[int]) -> Any:
        """ONNX declaration of an input or output: name, type and shape."""
        return self.onnx.helper.make_tensor_value_info(name, self.types[kind], shape)
