"""Kernels on disk, found by the programs they are made from.

A second process then neither unrolls these programs nor writes their LLVM IR. A key
covers everything a kernel depends on: all equations and known numbers, the source of
the package that makes kernels, the processor, and versions. A program with a part that
has no stable description has no key, and its kernel is made again in every process.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path

import jax
import numpy as np

from jaxrod.jax_internals import equations
from jaxrod.lanes.llvm.kernel import Kernel
from jaxrod.lanes.llvm.machine_code import folder_of_kernels, processor, read, write
from jaxrod.lanes.run_spec import RunSpec

Made = tuple[Kernel | None, str]
"""A kernel, or `None` and the reason why there is none."""
_WHAT = "kernel"
_FASTEST = 1
"""Level of compression: LLVM IR shrinks to a tenth in milliseconds."""


def kept(kind: str, name: str, spec: RunSpec, make: Callable[[], Made]) -> Made:
    """Returns a kernel from disk, or makes it and stores it there.

    Args:
        kind: Type of the kernel, with its limits.
        name: Name of the primitive.
        spec: Structure of the operation. Its number of steps is not part of a kernel.
        make: Function that makes the kernel.
    """
    if folder_of_kernels() is None:
        return make()
    key = _key(kind, name, spec)
    if key is None:
        return make()
    found = read(key, _WHAT)
    if found is not None:
        fields = json.loads(zlib.decompress(found))
        words = fields.pop("words")
        return (Kernel(**fields) if fields else None), words
    kernel, words = make()
    fields = {} if kernel is None else dataclasses.asdict(kernel)
    text = json.dumps({**fields, "words": words})
    write(key, zlib.compress(text.encode(), _FASTEST), _WHAT)
    return kernel, words


def _key(kind: str, name: str, spec: RunSpec) -> str | None:
    """Text that determines a kernel; `None` if its program has no description."""
    body, ends = spec.body, spec.ends
    programs = [body.closed]
    if ends is not None:
        programs += [ends.begin, ends.end]
    described = hashlib.sha256()
    for program in programs:
        try:
            description = equations.description(program, rules="adjoint" in name)
        except equations.NoDescriptionError:
            return None
        described.update(description.encode())
    rows = None if spec.batch is None else spec.batch.rows[: body.n_constants]
    facts = (kind, name, body.n_constants, rows, spec.moving, spec.keeps)
    return f"{_maker()} {facts} {described.hexdigest()}"


@cache
def _maker() -> str:
    """Digest of the source that makes kernels, and versions of what it uses."""
    root = Path(__file__).parents[1]
    source = hashlib.sha256()
    for folder in ("lanes", "jax_internals"):
        for file in sorted((root / folder).rglob("*.py")):
            source.update(file.read_bytes())
    return f"{source.hexdigest()} {jax.__version__} {np.__version__} {processor()}"
