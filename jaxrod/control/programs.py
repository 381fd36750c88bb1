"""Programs of solvers, compiled once for every structure of their arguments."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from typing import Any

import jax

from jaxrod.lanes.choice import lane_mode

MOST_PROGRAMS = 64
"""Kept at a time; the one that was not used for longest is forgotten."""

_kept: OrderedDict[Any, Any] = OrderedDict()


def timed(
    function: Callable[..., Any], *arguments: Any, **structure: Any
) -> tuple[Any, float, float]:
    """What a function makes of pytrees of arrays, and what it took.

    Args:
        function: Pure; one of a module, as programs are kept by it.
        *arguments: Traced.
        **structure: Hashable, part of the program.

    Returns:
        The result; seconds of compiling, 0 if the program was there; of running [s].
    """
    began = time.perf_counter()
    leaves, tree = jax.tree.flatten(arguments)
    kinds = tuple(jax.typeof(leaf) for leaf in leaves)
    # What else a program depends on: precision, and what steps are done by.
    setting = (lane_mode(), jax.config.read("jax_enable_x64"))
    key = (function, tuple(sorted(structure.items())), tree, kinds, setting)
    program = _kept.pop(key, None)
    compile_s = 0.0
    if program is None:
        compiled = jax.jit(partial(function, **structure)).lower(*arguments)
        program = compiled.compile()
        compile_s = time.perf_counter() - began
    _kept[key] = program
    while len(_kept) > MOST_PROGRAMS:
        _kept.popitem(last=False)
    ready = time.perf_counter()
    result = jax.block_until_ready(program(*arguments))
    return result, compile_s, time.perf_counter() - ready
