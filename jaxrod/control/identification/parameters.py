"""Named parameters, and their conversion to and from search variables."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.structure import pytree, static
from jaxrod.validation import as_array, is_traced

FARTHEST = 1e3
"""Factor between a parameter's initial value and its default bounds, if it is found by
its logarithm: bounds are start / FARTHEST and start * FARTHEST [1]."""


@pytree
class Parameters:
    r"""Names, initial values and scales of parameters to be found by a search.

    Search variables are logarithms relative to the initial value,
    $z = \log(p / p_0)$, or scaled deviations from it, $z = (p - p_0) / s$.

    Example:
        >>> sought = control.make_parameters({"modulus": 1e6, "angles": jnp.ones(2)})
        >>> sought.names
        ('angles[0]', 'angles[1]', 'modulus')
    """

    start: dict[str, Any]
    """Values at which a search begins, $p_0$."""
    scales: dict[str, Any]
    """Scales $s$ of all parameters, used for those that are not in `logarithmic`."""
    shapes: tuple[tuple[str, tuple[int, ...]], ...] = static()
    """Pairs of name and shape, in alphabetical order of names."""
    logarithmic: tuple[str, ...] = static()
    """Names of the parameters whose search variable is a logarithm."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all scalars in the order of `flat`, such as "angles[1]"."""
        return tuple(
            name + ("[" + ",".join(map(str, place)) + "]" if shape else "")
            for name, shape in self.shapes
            for place in np.ndindex(shape)
        )

    @property
    def by_log(self) -> tuple[bool, ...]:
        """Whether each scalar, in the order of `flat`, is found by its logarithm."""
        return tuple(
            name in self.logarithmic
            for name, shape in self.shapes
            for _ in np.ndindex(shape)
        )

    @property
    def _forms(self) -> tuple[Array, Array, np.ndarray]:
        return self.flat(self.start), self.flat(self.scales), np.asarray(self.by_log)

    def flat(self, values: Mapping[str, Any]) -> Float[Array, " p"]:
        """Flattens and concatenates all parameters, in the order of `shapes`.

        Example:
            >>> sought = control.make_parameters({"modulus": 1e6, "tilts": jnp.ones(2)})
            >>> sought.flat({"modulus": 2e6, "tilts": jnp.zeros(2)}).tolist()
            [2000000.0, 0.0, 0.0]
        """
        return jnp.concatenate([jnp.ravel(values[name]) for name, _ in self.shapes])

    def named(self, flat: Float[Array, " p"]) -> dict[str, Array]:
        """Splits a vector into named parameters: the inverse of `flat`.

        Example:
            >>> sought = control.make_parameters({"modulus": 1e6, "tilts": jnp.ones(2)})
            >>> named = sought.named(jnp.array([3e6, 0.1, 0.2]))
            >>> named["tilts"].shape, float(named["modulus"])
            ((2,), 3000000.0)
        """
        found, at = {}, 0
        for name, shape in self.shapes:
            size = math.prod(shape)
            found[name] = jnp.reshape(flat[at : at + size], shape)
            at += size
        return found

    def searched(self, values: Mapping[str, Any]) -> Float[Array, " p"]:
        r"""Converts to search variables $z$: $\log(p / p_0)$ or $(p - p_0) / s$.

        Example:
            >>> sought = control.make_parameters({"modulus": 1e6, "tilts": jnp.ones(2)})
            >>> z = sought.searched({"modulus": 2e6, "tilts": jnp.ones(2)})
            >>> print(z.round(3))  # log 2 of the modulus
            [0.693 0.    0.   ]
        """
        (first, scale, log), value = self._forms, self.flat(values)
        # Both branches must be finite, so that derivatives are finite too.
        ratio = jnp.where(log, value, 1) / jnp.where(log, first, 1)
        return jnp.where(log, jnp.log(ratio), (value - first) / scale)

    def values(self, point: Float[Array, " p"]) -> dict[str, Array]:
        """Converts search variables to parameters: $p_0 e^z$ or $p_0 + s z$.

        Example:
            >>> sought = control.make_parameters({"modulus": 1e6, "tilts": jnp.ones(2)})
            >>> float(sought.values(jnp.zeros(3))["modulus"])  # where a search begins
            1000000.0
        """
        first, scale, log = self._forms
        factor = jnp.exp(jnp.where(log, point, 0))
        return self.named(jnp.where(log, first * factor, first + scale * point))

    def slopes(self, point: Float[Array, " p"]) -> Float[Array, " p"]:
        """Derivative $dp/dz$ of each parameter, for its search variable: $p$ or $s$."""
        first, scale, log = self._forms
        return jnp.where(log, first * jnp.exp(jnp.where(log, point, 0)), scale)

    def bound(self, given: Mapping[str, Any] | None, sign: int) -> Float[Array, " p"]:
        """Converts bounds of parameters to search variables, with defaults.

        Parameters found by their logarithm have the default bounds start / FARTHEST and
        start * FARTHEST, which keep them away from zero, where derivatives with respect
        to the logarithm vanish. Others have none. `sign` is -1 for lower, 1 for upper
        bounds.
        """
        far = dict(given or {})
        for name, shape in self.shapes:
            log = name in self.logarithmic
            none = self.start[name] * FARTHEST**sign if log else sign * jnp.inf
            far[name] = jnp.broadcast_to(far.get(name, none), shape)
        return self.searched(far)


def make_parameters(
    start: Mapping[str, Any],
    logarithmic: bool | Iterable[str] = True,
    scales: Mapping[str, Any] | None = None,
) -> Parameters:
    """Makes named parameters, with validated arguments.

    Args:
        start: Values at which a search begins; numbers or arrays by name.
        logarithmic: Parameters found by their logarithm, so that they stay positive:
            names, or `True` for all, `False` for none.
        scales: Scales $s$ of the search variables $(p - p_0) / s$ of parameters that
            are not found by their logarithm; by default $|p_0|$, and 1 where that is 0.

    Raises:
        ValueError: There is no parameter, `logarithmic` or `scales` has an unknown
            name, a scale is not positive, a logarithmic parameter is not positive, or
            a parameter is not finite.

    Example:
        >>> start = {"modulus": 1e6, "shift": 0.0}
        >>> sought = control.make_parameters(start, logarithmic=["modulus"])
        >>> dict(zip(sought.names, sought.by_log))  # the modulus stays positive
        {'modulus': True, 'shift': False}
    """
    if not start:
        raise ValueError("start must name at least one parameter")
    names = tuple(start) if logarithmic is True else tuple(logarithmic or ())
    strange = [name for name in names if name not in start]
    if strange:
        raise ValueError(
            f"logarithmic names {', '.join(strange)}, which start does not: "
            f"it has {', '.join(start)}"
        )
    dtype = jnp.result_type(1.0, *jax.tree.leaves(dict(start)))
    first = {name: jnp.asarray(value, dtype) for name, value in start.items()}
    for name, value in first.items():
        if is_traced(value):
            continue
        if not np.all(np.isfinite(value)):
            raise ValueError(f"start of {name} must be finite, got {start[name]!r}")
        if name in names and not np.all(np.asarray(value) > 0):
            raise ValueError(
                f"start of {name} must be positive if the search uses its logarithm, "
                f"got {start[name]!r}: leave it out of logarithmic"
            )
    sizes = jax.tree.map(lambda a: jnp.where(a == 0, 1, jnp.abs(a)), first)
    for name, scale in (scales or {}).items():
        if name not in first:
            raise ValueError(
                f"scales names {name}, which start does not: it has {', '.join(start)}"
            )
        given = as_array(f"scale of {name}", scale, "", positive=True, dtype=dtype)
        sizes[name] = jnp.broadcast_to(given, jnp.shape(first[name]))
    shapes = tuple((name, np.shape(first[name])) for name in sorted(first))
    return Parameters(first, sizes, shapes, tuple(sorted(names)))
