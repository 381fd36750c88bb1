"""Compiled programs of solvers, one for each structure of their arguments."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from typing import Any

import jax

from jaxrod.lanes.choice import lane_mode

MOST_PROGRAMS = 64
"""Largest number of programs kept; the least recently used one is dropped first."""

_kept: OrderedDict[Any, Any] = OrderedDict()


def timed(
    function: Callable[..., Any], *arguments: Any, **structure: Any
) -> tuple[Any, float, float]:
    """Calls a function of pytrees of arrays as a compiled program, and times it.

    Args:
        function: Pure function, defined at module level because it identifies the kept
            program.
        *arguments: Traced arguments.
        **structure: Static, hashable arguments.

    Returns:
        The result; the time of compiling [s], 0 if the program was kept from before;
        and the time of running [s].
    """
    began = time.perf_counter()
    leaves, tree = jax.tree.flatten(arguments)
    kinds = tuple(jax.typeof(leaf) for leaf in leaves)
    # A program also depends on the precision, and on the mode of lanes.
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
