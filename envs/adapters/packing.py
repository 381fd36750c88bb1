"""Pytrees packed into few flat arrays, for programs with costly arguments.

A call of a compiled program has a cost for every array that goes in and comes out. A
control step of one arm takes some 10 microseconds; its 46 arguments and 11 results took
300.
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
"""One flat array per dtype, and the leaves that stay unpacked."""


@dataclasses.dataclass(frozen=True)
class Place:
    """Position of a leaf in the flat arrays."""

    array: int
    """Index of the flat array."""
    start: int
    """Index of its first number."""
    stop: int
    """Index after its last number."""
    shape: tuple[int, ...]
    """Shape of the leaf."""
    key: str | None
    """Implementation of the random keys that it holds; `None` for numbers."""


@dataclasses.dataclass(frozen=True)
class Layout:
    """Packing of a pytree of one structure; hashable, equal for equal structures."""

    structure: Any
    """Structure of the tree."""
    dtypes: tuple[np.dtype, ...]
    """Dtypes of the flat arrays."""
    places: tuple[Place | None, ...]
    """Position of each leaf. `None` for a leaf that stays unpacked: for example a
    Python number, whose weak type an array would not keep."""

    def pack(self, tree: PyTree) -> Packed:
        """The packed arrays.

        Raises:
            ValueError: The tree does not match the one from which the layout was made.
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
        """The tree; its leaves are NumPy arrays if the flat arrays are."""
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
    """Layout for packing trees like this one, of arrays or traced."""
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
