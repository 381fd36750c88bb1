r"""Muscles: fibres in a rod that pull, along themselves or across the rod.

A fibre of full force $F_0 = \sigma_\max A_0$ and activation $a$ has around each node
the energy

$$E = a F_0 \Lambda_0\, F(\Lambda/\Lambda_0), \qquad
  E = 2 a F_0 \Lambda_0\, F\big((\Lambda/\Lambda_0)^{-1/2}\big) \text{ across,}$$

of its length $\Lambda$ there (`FibrePath.segments`), at rest $\Lambda_0$, with the
integral $F$ of its force-length curve. So it pulls with $a F_0 f(\Lambda/\Lambda_0)$;
muscles across the rod make it thinner in two directions, hence longer.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.actuation.along_rod import middle_places, resampled_along
from jaxrod.actuation.fibre_path import FibrePath, fibre_path
from jaxrod.actuation.force_length import CubicForce, ForceLength
from jaxrod.actuation.section_load import (
    SectionLoad,
    SectionStrains,
    Walls,
    lengths_at_nodes,
    walls_of,
)
from jaxrod.effects.base import StabilityBound
from jaxrod.effects.clamps import Clamp
from jaxrod.effects.time import Schedule, Timed, as_timed
from jaxrod.geometry import vectors
from jaxrod.rods.rod import Rod
from jaxrod.structure import pytree, static
from jaxrod.validation import Numbers, as_array, check_kind


@pytree
class Muscle(SectionLoad):
    """One or several muscle fibres; see `muscle`."""

    path: FibrePath
    """Where they run."""
    force: Float[Array, "k n"]
    """Full force, per element; or one for the whole rod (n = 1) [N]."""
    activation: Array | Schedule
    """Share of it [1]: one number; one per fibre `(k,)`; per element, too `(k, n)`."""
    curve: ForceLength
    """Share of the full force at a stretch."""
    walls: Walls = ()
    """Walls into which they go on."""
    across: bool = static(default=False)
    """Whether they pull across the rod."""

    def stored(self, rod: Rod, strains: SectionStrains) -> Array:
        """Energy of the fibres [J]."""
        rest = vectors.safe_norm(self.path.rest_segments(rod))
        stretch = vectors.safe_norm(self.path.segments(strains)) / rest
        pull = self._pull(rod)
        if self.across:
            return 2 * jnp.sum(pull * rest * self.curve.energy(stretch**-0.5))
        return jnp.sum(pull * rest * self.curve.energy(stretch))

    def stability_bound(self, rod: Rod) -> StabilityBound:
        """Of forces and their slopes near the unstressed shape."""
        largest, steepest = self.curve.largest, self.curve.steepest
        if self.across:
            steepest = 0.5 * steepest + 1.5 * largest
        pull = jnp.abs(self._pull(rod))
        rest = vectors.safe_norm(self.path.rest_segments(rod))
        slope = steepest * pull / rest
        return self.path.bound(rod, largest * pull, slope, pulls=not self.across)

    def resampled(self, rod: Rod, new_rod: Rod) -> Muscle:
        """The same muscles on a rod with another number of elements."""
        old, new = middle_places(rod), middle_places(new_rod)
        activation = self.activation
        if isinstance(activation, Array) and activation.ndim == 2:
            activation = resampled_along(activation, old, new)
        return replace(
            self,
            path=self.path.resampled(rod, new_rod),
            force=resampled_along(self.force, old, new),
            activation=activation,
        )

    def _pull(self, rod: Rod) -> Array:
        """Force of full length, at the nodes `(k, n + 1)` [N]."""
        assert not isinstance(self.activation, Schedule)
        active = self.activation
        if active.ndim < 2:
            active = active.reshape(-1, 1)
        shape = (self.path.count, rod.n_elements)
        pull = jnp.broadcast_to(active * self.force, shape) * rod.rest_lengths[None, :]
        x = jnp.pad(0.5 * pull, ((0, 0), (0, 1))) + jnp.pad(
            0.5 * pull, ((0, 0), (1, 0))
        )
        return x / lengths_at_nodes(rod)[None, :]


def muscle(
    rod: Rod,
    force: Numbers,
    activation: Timed = 1.0,
    *,
    offsets: Numbers | None = None,
    curve: ForceLength | None = None,
    across: bool = False,
    into: Clamp | tuple[Clamp, ...] | None = None,
) -> Muscle:
    """Muscle fibres in a rod: longitudinal, helical, or across it.

    Args:
        rod: The rod.
        force: Full force, the stress of the muscle times its area at rest, at least 0:
            one number; one per fibre `(k,)`; per element, too `(k, n)` [N].
        activation: Share of it: one number; one per fibre `(k,)`; per element, too
            `(k, n)`; or a schedule of such [1].
        offsets: From the centreline along d1 and d2 `(2,)`; of several fibres
            `(k, 2)`; at every node `(k, 2, n + 1)`, as `helical_offsets` has them [m].
            By default along it.
        curve: Share of the full force at a stretch: `cubic_force()` by default, or
            `gaussian_force()`, `constant_force()`.
        across: Whether they pull across the rod, and make it thinner and longer.
        into: The `clamp` of an end, or a tuple of two, into which they go on.

    Raises:
        ValueError: If an argument is out of range or of the wrong shape.
        TypeError: If `rod`, `curve` or `into` is something else.
    """
    check_kind("rod", rod, Rod)
    path = fibre_path(rod, offsets)
    curve = CubicForce() if curve is None else curve
    if not isinstance(curve, ForceLength):
        raise TypeError(
            "curve must be one such as jaxrod.cubic_force(), got "
            f"{type(curve).__name__}"
        )
    kind = rod.rest_lengths.dtype
    count = path.count
    shapes: list[tuple[int, ...]] = [(), (count,), (count, rod.n_elements)]
    full = as_array("force", force, "N", shapes, non_negative=True, dtype=kind)
    if full.ndim < 2:
        full = jnp.broadcast_to(full, (count,))[:, None]
    return Muscle(
        path=path,
        force=full,
        activation=as_timed("activation", activation, "", *shapes),
        curve=curve,
        walls=walls_of(into),
        across=bool(across),
    )
