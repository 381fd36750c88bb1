"""Pytrees as few flat arrays, for programs so short that their arguments cost more.

A call of a compiled program pays for every array that goes in and comes out. A control
step of one arm takes some 10 microseconds; its 46 arguments and 11 results took 300.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

Packed = tuple[tuple[Any, ...], tuple[Any, ...]]
"""One flat array for each type, and the leaves that travel as they are."""


@dataclasses.dataclass(frozen=True)
class Place:
    """Where a leaf lies."""

    array: int
    """Number of the flat array."""
    start: int
    """Its first number there."""
    stop: int
    """Behind its last number."""
    shape: tuple[int, ...]
    """Its shape."""
    key: str | None
    """Implementation of the random keys that it holds; `None` for numbers."""


@dataclasses.dataclass(frozen=True)
class Layout:
    """How a pytree of one structure is packed; hashable, equal for equal structures."""

    structure: Any
    """Structure of the tree."""
    dtypes: tuple[np.dtype, ...]
    """Types of the flat arrays."""
    places: tuple[Place | None, ...]
    """Where each leaf lies; `None` for one that travels as it is: a Python number, say,
    whose type is weak and would not be so in an array."""

    def pack(self, tree: PyTree) -> Packed:
        """The arrays.

        Raises:
            ValueError: The tree is not like the one that the layout was made of.
        """
        leaves, structure = jax.tree.flatten(tree)
        if structure != self.structure:
            raise ValueError(f"must be a {self.structure}, got a {structure}")
        parts: list[list[Any]] = [[] for _ in self.dtypes]
        others = []
        for leaf, place in zip(leaves, self.places, strict=True):
            if place is None:
                others.append(leaf)
                continue
            numbers = jnp.asarray(leaf)
            if place.key is not None:
                numbers = jax.random.key_data(numbers)
            if (numbers.shape, numbers.dtype) != (
                place.shape,
                self.dtypes[place.array],
            ):
                raise ValueError(
                    f"must be {self.dtypes[place.array]} of shape {place.shape}, got "
                    f"{numbers.dtype} of shape {numbers.shape}"
                )
            parts[place.array].append(jnp.ravel(numbers))
        return tuple(map(jnp.concatenate, parts)), tuple(others)

    def unpack(self, packed: Packed) -> PyTree:
        """The tree; of NumPy's arrays where the flat ones are."""
        arrays, others = packed
        left = iter(others)
        leaves = []
        for place in self.places:
            if place is None:
                leaves.append(next(left))
                continue
            numbers = arrays[place.array][place.start : place.stop]
            numbers = numbers.reshape(place.shape)
            if place.key is not None:
                numbers = jax.random.wrap_key_data(numbers, impl=place.key)
            leaves.append(numbers)
        return jax.tree.unflatten(self.structure, leaves)


def layout(tree: PyTree) -> Layout:
    """How to pack trees like this one: of arrays, or traced."""
    leaves, structure = jax.tree.flatten(tree)
    found: list[tuple[np.dtype, tuple[int, ...], str | None] | None] = []
    for leaf in leaves:
        if getattr(leaf, "weak_type", not hasattr(leaf, "dtype")):
            found.append(None)
            continue
        numbers, key = jnp.asarray(leaf), None
        if jnp.issubdtype(numbers.dtype, jax.dtypes.prng_key):
            key = str(jax.random.key_impl(numbers))
            numbers = jax.random.key_data(numbers)
        found.append((np.dtype(numbers.dtype), numbers.shape, key))
    dtypes = tuple(sorted({each[0] for each in found if each}, key=str))
    offsets = [0] * len(dtypes)
    places: list[Place | None] = []
    for each in found:
        if each is None:
            places.append(None)
            continue
        dtype, shape, key = each
        array = dtypes.index(dtype)
        start, stop = offsets[array], offsets[array] + math.prod(shape)
        offsets[array] = stop
        places.append(Place(array, start, stop, shape, key))
    return Layout(structure, dtypes, tuple(places))
