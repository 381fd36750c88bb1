r"""Inverse design: a rod whose static equilibrium has a given shape.

It finds rest curvatures $\kappa_0$ of joints, or stiffnesses of elements, so that
markers (nodes) of the equilibrium at $m_k$ reach their targets $\hat m_k$,

$$\min_z \sum_k \Big(\frac{m_k(z) - \hat m_k}{\epsilon}\Big)^2 + |z|^2,$$

with the largest accepted error $\epsilon$. The unknowns $z$ are changes of the rest
curvatures in units of a curvature, or scaled logarithms of stiffness factors. Among the
many designs with the same markers, the second term selects the one nearest to the given
rod. Derivatives are those of `equilibrium`: one linear solve per marker coordinate, or
per unknown if there are fewer unknowns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxrod.control.least_squares import least_squares
from jaxrod.loaded_rod import scene_of
from jaxrod.rods.rod import RodState
from jaxrod.scene import Scene
from jaxrod.statics.equilibrium import Equilibrium, equilibrium
from jaxrod.structure import pytree
from jaxrod.validation import as_array, check_count, is_traced

QUANTITIES = ("rest_curvature", "stiffness")
"""Quantities of the rod that `match_shape` can find."""


@pytree
class ShapeMatch:
    """Result of `match_shape`: the rod, its equilibrium and the remaining error.

    Example:
        >>> thin, start = jaxrod.straight_rod(
        ...     4, length=0.4, radius=0.02, density=1e3, youngs_modulus=1e6
        ... )
        >>> held = jaxrod.make_scene(thin, jaxrod.clamp(start))
        >>> target = start.tip[:, None] + jnp.array([[0.02], [0.0], [0.0]])  # 2 cm
        >>> match = control.match_shape(held, start, target, nodes=[4])
        >>> match.rest_curvature.shape, match.stiffness.tolist()  # not sought
        ((3, 3), [1.0, 1.0, 1.0, 1.0])
    """

    scene: Scene
    """Scene with the designed rod."""
    equilibrium: Equilibrium
    """Equilibrium of `scene`; check `equilibrium.stable` too."""
    error: Float[Array, ""]
    """Largest distance of a marker from its target [m]."""
    rest_curvature: Float[Array, "3 n-1"]
    """Change of the rest curvatures of the joints [1/m]; zero if not free."""
    stiffness: Float[Array, " n"]
    """Factors of the elements' stiffnesses [1]; one if not free."""
    converged: Bool[Array, ""]
    """Whether the error is below `max_error`, in a stable equilibrium."""
    iterations: Int[Array, ""]
    """Number of least-squares iterations made."""


def match_shape(
    scene: Scene,
    state: RodState,
    markers: Any,
    nodes: Sequence[int],
    *,
    free: Sequence[str] = ("rest_curvature",),
    max_error: float = 1e-3,
    curvature: float | None = None,
    stiffness: float = 1.0,
    twist: bool = False,
    iterations: int = 30,
) -> ShapeMatch:
    """Finds a rod that has a given shape in equilibrium. Pure; works under `vmap`.

    Args:
        scene: The scene; the rod must be supported.
        state: Initial guess for the equilibria, as for `equilibrium`.
        markers: Target positions of the nodes `(3, markers)` [m].
        nodes: Indices of the nodes that have targets, in increasing order.
        free: Quantities to find: `"rest_curvature"`, `"stiffness"` or both.
        max_error: Largest accepted distance of a marker from its target [m].
        curvature: Change of a rest curvature that costs as much as a marker error of
            `max_error` [1/m]; by default 30 radians divided by the rod's length.
        stiffness: Logarithm of a stiffness factor that costs as much as a marker error
            of `max_error` [1].
        twist: Whether the rest twist is also sought with `"rest_curvature"`.
        iterations: Largest number of iterations.

    Raises:
        ValueError: An argument is out of range or has the wrong shape, or `equilibrium`
            raises it.
        TypeError: `scene` or `state` has the wrong type.

    Example:
        >>> thin, start = jaxrod.straight_rod(
        ...     4, length=0.4, radius=0.02, density=1e3, youngs_modulus=1e6
        ... )
        >>> held = jaxrod.make_scene(thin, jaxrod.clamp(start))
        >>> target = start.tip[:, None] + jnp.array([[0.02], [0.0], [0.0]])  # 2 cm
        >>> match = control.match_shape(held, start, target, nodes=[4])
        >>> bool(match.converged), bool(match.error < 1e-3)
        (True, True)
    """
    scene = scene_of(scene, state)
    rod = scene.rod
    dtype, n = rod.rest_lengths.dtype, rod.n_elements
    at = _checked_nodes(nodes, n)
    if not free or any(word not in QUANTITIES for word in free):
        raise ValueError(
            f"free must name some of {', '.join(QUANTITIES)}, got {free!r}"
        )
    for name, value in (("max_error", max_error), ("stiffness", stiffness)):
        as_array(name, value, "", positive=True, dtype=dtype)
    target = jnp.asarray(markers, dtype)
    if target.shape != (3, len(at)):
        raise ValueError(
            f"markers must have shape {(3, len(at))}, one column for each of nodes, "
            f"got {target.shape}"
        )
    iterations = check_count("iterations", iterations, 1)
    unit = 30 / jnp.sum(rod.rest_lengths) if curvature is None else curvature
    unit = jnp.asarray(unit, dtype)
    unknowns: dict[str, Array] = {}
    if "rest_curvature" in free:
        unknowns["rest_curvature"] = jnp.zeros((3 if twist else 2, n - 1), dtype)
    if "stiffness" in free:
        unknowns["stiffness"] = jnp.zeros((n,), dtype)

    def designed(z: dict[str, Array]) -> tuple[Array, Array, Scene]:
        bent = jnp.zeros((3, n - 1), dtype)
        if "rest_curvature" in z:
            rows = unit * z["rest_curvature"]
            bent = jnp.concatenate([rows, bent[len(rows) :]])
        factor = jnp.exp(stiffness * z.get("stiffness", jnp.zeros((n,), dtype)))
        made = replace(
            rod,
            rest_curvatures=rod.rest_curvatures + bent,
            shear_stretch_stiffness=rod.shear_stretch_stiffness * factor[None],
            bend_twist_stiffness=rod.bend_twist_stiffness * factor[None],
        )
        return bent, factor, replace(scene, rod=made)

    def found(z: dict[str, Array]) -> Equilibrium:
        return equilibrium(designed(z)[2], state)

    def away(z: dict[str, Array]) -> Array:
        rest = found(z)
        gap = _columns(rest.state.positions, at) - target
        # A point without an equilibrium is rejected.
        return jnp.where(rest.converged, gap, jnp.inf) / max_error

    best = least_squares(away, unknowns, ridge=1.0, iterations=iterations)
    bent, factor, made = designed(best.solution)
    rest = found(best.solution)
    gap = _columns(rest.state.positions, at) - target
    error = jnp.max(jnp.sqrt(jnp.sum(gap**2, axis=0)))
    return ShapeMatch(
        scene=made,
        equilibrium=rest,
        error=error,
        rest_curvature=bent,
        stiffness=factor,
        converged=(error < max_error) & rest.stable,
        iterations=best.iterations,
    )


def _checked_nodes(nodes: Sequence[int], n: int) -> tuple[int, ...]:
    if is_traced(nodes):
        raise ValueError("nodes must be integers known when the program is traced")
    at = tuple(check_count("nodes", int(k), 0, n) for k in np.asarray(nodes).ravel())
    if not at or list(at) != sorted(set(at)):
        raise ValueError(f"nodes must be different and in order, got {nodes!r}")
    return at


def _columns(positions: Array, at: tuple[int, ...]) -> Array:
    """Returns the columns `at` of `positions`, by slices instead of a gather."""
    columns = [jax.lax.slice_in_dim(positions, k, k + 1, axis=1) for k in at]
    return jnp.concatenate(columns, axis=1)
