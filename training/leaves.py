"""Leaves of a pytree by name, as arrays that NumPy can write without pickle."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def named_leaves(tree: Any, root: str) -> dict[str, Any]:
    """Leaves of a tree by name: `root` followed by the path of the leaf.

    Leaves without elements, of size zero, are omitted.
    """
    leaves = jax.tree.leaves_with_path(tree)
    return {_name(root, path): leaf for path, leaf in leaves if leaf.size}


def with_leaves(template: Any, root: str, leaves: dict[str, Any]) -> Any:
    """Copy of a tree with the given leaves, which have the names of `named_leaves`.

    Leaves that are not given are those of `template`.
    """
    return jax.tree_util.tree_map_with_path(
        lambda path, leaf: leaves.get(_name(root, path), leaf), template
    )


def described(leaf: Any) -> str:
    """Dtype and shape of a leaf as text, such as "float32[3]"."""
    return f"{leaf.dtype}{list(_numbers(leaf).shape)}"


def to_array(leaf: Any) -> np.ndarray:
    """A leaf as an array that NumPy can write.

    Types that NumPy lacks, such as bfloat16, become unsigned integers with the same
    bits, and random keys their raw integers.
    """
    array = np.asarray(_numbers(leaf))
    return array.view(f"u{array.itemsize}") if array.dtype.kind == "V" else array


def from_array(array: np.ndarray, leaf: Any) -> Any:
    """Converts an array from `to_array` back into a leaf like `leaf`.

    Raises:
        ValueError: The dtype or shape differs from that of `leaf`.
    """
    numbers = _numbers(leaf)
    dtype = np.dtype(numbers.dtype)
    array = array.view(dtype) if dtype.kind == "V" else array
    if (array.dtype, array.shape) != (dtype, numbers.shape):
        raise ValueError(f"an array is {array.dtype}{list(array.shape)} in the file")
    if not is_key(leaf):
        return array
    return jax.random.wrap_key_data(jnp.asarray(array), impl=jax.random.key_impl(leaf))


def differences_of_leaves(wanted: dict[str, str], found: dict[str, str]) -> str:
    """The first three differences between two sets of leaves, as text.

    The text is empty if there are none.

    Args:
        wanted: Required leaves: their descriptions by name, as from `described`.
        found: Leaves that a file holds, in the same form.
    """
    apart = [f"lacks {name}" for name in sorted(wanted.keys() - found.keys())]
    apart += [f"also has {name}" for name in sorted(found.keys() - wanted.keys())]
    apart += [
        f"holds {found[name]} at {name}, this run needs {wanted[name]}"
        for name in sorted(wanted.keys() & found.keys())
        if wanted[name] != found[name]
    ]
    if not apart:
        return ""
    more = f", and {len(apart) - 3} more" if len(apart) > 3 else ""
    return f"{', '.join(apart[:3])}{more}{_hint(apart)}"


def is_key(leaf: Any) -> bool:
    """Whether a leaf is a typed random key."""
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _hint(apart: list[str]) -> str:
    """Hint at JAX_ENABLE_X64 if the first differences are float32 against float64.

    It is an empty text otherwise. `apart` has the differences as text.
    """
    double = all("float32" in one and "float64" in one for one in apart[:3])
    return " (has JAX_ENABLE_X64 changed?)" if double else ""


def _name(root: str, path: Any) -> str:
    return root + jax.tree_util.keystr(path)


def _numbers(leaf: Any) -> Any:
    """The leaf itself, or the raw integers if it is a random key."""
    return jax.random.key_data(leaf) if is_key(leaf) else leaf
