r"""Inertia scaling: larger steps for slender rods.

If a rod is much thinner than its elements are long, its fastest motion is the rocking
of elements against the axis, at $\sqrt{\alpha_c G A/\rho I}$ with the shear factor
$\alpha_c$. This physically irrelevant mode then limits the step. Increasing only the
transverse rotary inertia slows it; mass and polar inertia, which carry axial and
torsional waves, do not change.
The change of bending frequencies grows with the square of the radius of gyration. It
stays within the discretisation error while the enlarged radius of gyration is below
half the length of the element.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxrod.analysis.frequency import natural_frequencies, no_damping
from jaxrod.analysis.stability import frequency_bounds, scene_stable_step
from jaxrod.loaded_rod import LoadedRod, check_scene
from jaxrod.model import TimeStep
from jaxrod.rods.rod import Rod, RodState
from jaxrod.structure import pytree
from jaxrod.validation import as_time_step, check_count, check_kind, is_traced

SHARE_OF_OTHER_LIMITS = 0.9
"""Automatic step as a fraction of the limit set by stretch and twist [1]."""
_ROUNDS = 200


@pytree
class InertiaScaling:
    """A scene with enlarged transverse inertia, and the resulting changes."""

    scene: Any
    """The scene with enlarged transverse rotary inertia of its rod."""
    factors: Float[Array, " n"]
    """Ratio of enlarged to true transverse rotary inertia, per element [1]."""
    dt_before: Float[Array, ""]
    """Stability limit of the original scene [s]."""
    dt: Float[Array, ""]
    """Stability limit of the new scene [s]."""

    @property
    def gain(self) -> Float[Array, ""]:
        """Ratio of the new to the original stability limit [1]."""
        return self.dt / self.dt_before


def scale_inertia(scene: LoadedRod, dt: TimeStep | None = None) -> InertiaScaling:
    """Enlarges the transverse rotary inertia of a scene's rod for larger steps.

    Without `dt` the inertia is enlarged until stretch or twist limits the step, but
    never beyond a radius of gyration of half the element's length. A round rod whose
    radius exceeds the length of its elements is not changed. With `dt` it is enlarged
    as far as that step requires, without regard to the frequencies; `frequency_changes`
    gives their changes. Rates of rotational damping act on the enlarged inertia: the
    couples that they represent grow with it.

    Args:
        scene: The scene; effects and damping do not change. A schedule counts with the
            bound on its magnitude.
        dt: Step size to be made stable [s], or a result of `stable_dt`.

    Returns:
        The new scene, with the factors and both stability limits.

    Raises:
        ValueError: If `dt` is larger than stretch and twist allow.

    Example:
        >>> scaling = jaxrod.scale_inertia(scene)
        >>> faster = jaxrod.advance(scaling.scene, state, 0.9 * scaling.dt, 10)
        >>> round(float(scaling.gain), 1)  # largest step, over that of the scene itself
        2.7
    """
    check_scene(scene)
    given, scene = scene, scene.at_largest
    step = None
    if dt is not None:
        dtype = scene.rod.rest_lengths.dtype
        step = as_time_step(dt, dtype)
        largest = _other_limit(scene)
        if not is_traced(step, largest) and step >= largest:
            raise ValueError(
                f"dt must be below {float(largest):.3g} s, the limit from stretch and "
                "twist, which transverse inertia does not change, got "
                f"{float(step):.3g} s"
            )
    rod, factors, before, now = _enlarged(scene, step)
    return InertiaScaling(replace(given, rod=rod), factors, before, now)


@jax.jit
def _enlarged(scene: LoadedRod, step: Array | None) -> tuple[Rod, Array, Array, Array]:
    """Rod with enlarged inertia, the factors, and the limits before and after.

    `step` is the step size to be made stable; `None` chooses it automatically.
    Everything is one program, because otherwise each operation would be compiled by
    itself.
    """
    if step is None:
        others = SHARE_OF_OTHER_LIMITS * _other_limit(scene)
        factors = _factors(scene, others, _reasonable(scene.rod))
    else:
        factors = _factors(scene, step, jnp.full_like(scene.rod.rest_lengths, jnp.inf))
    scaled = _scaled(scene, factors)
    before, now = (scene_stable_step(one, 1.0).dt for one in (scene, scaled))
    return scaled.rod, factors, before, now


def frequency_changes(
    scaling: InertiaScaling, state: RodState, n_modes: int = 8
) -> np.ndarray:
    """Relative changes of the lowest natural frequencies due to the enlarged inertia.

    Args:
        scaling: Result of `scale_inertia`.
        state: The configuration about which the rod vibrates.
        n_modes: Number of nonzero frequencies to compare.

    Returns:
        Relative change of each frequency [1], the lowest first.

    Raises:
        TypeError: If `scaling` or `state` has the wrong type.

    Example:
        >>> scaling = jaxrod.scale_inertia(scene)
        >>> changes = jaxrod.frequency_changes(scaling, state, 4)
        >>> bool((abs(changes) < 0.05).all())  # below five per cent
        True
    """
    check_kind("scaling", scaling, InertiaScaling)
    n_modes = check_count("n_modes", n_modes, 1)
    scene: Any = scaling.scene
    true: Any = _scaled(scene, 1 / scaling.factors)
    before = natural_frequencies(true, state)
    after = natural_frequencies(scene, state)
    # Rigid motions have frequencies of the size of round-off.
    eps = float(jnp.finfo(state.positions.dtype).eps)
    moving = before > 10 * np.sqrt(eps) * before[-1]
    return (after[moving] / before[moving] - 1)[:n_modes]


def _scaled(scene: LoadedRod, factors: Array) -> LoadedRod:
    *transverse, polar = scene.rod.rotary_inertia
    inertia = jnp.stack([*(factors * row for row in transverse), polar])
    return replace(scene, rod=replace(scene.rod, rotary_inertia=inertia))


def _reasonable(rod: Rod) -> Array:
    """Factors on the transverse rotary inertia, at least 1.

    They raise the larger radius of gyration of each element to half its length.
    """
    largest = rod.linear_density * rod.rest_lengths**2 / 4
    return jnp.maximum(largest / jnp.max(rod.rotary_inertia[:-1], axis=0), 1)


@jax.jit
def _other_limit(scene: LoadedRod) -> Array:
    """Largest step that is stable for stretch and twist [s]."""
    bounds = frequency_bounds(scene, no_damping(scene.rod))
    return 2 / jnp.max(bounds[1:])


@jax.jit
def _factors(scene: LoadedRod, dt: Array, largest: Array) -> Array:
    """Smallest inertia factors with which `dt` is stable, limited to `largest` [1]."""
    eps = jnp.finfo(dt.dtype).eps
    budget = 2 / dt * (1 - 100 * eps)

    def excess(factors: Array) -> Array:
        bounds = frequency_bounds(_scaled(scene, factors), no_damping(scene.rod))
        return jnp.maximum(bounds[0] / budget, 1)

    def enlarge(_: int, factors: Array) -> Array:
        return jnp.minimum(factors * excess(factors) ** 2, largest)

    # Every round removes the part of the excess that is due to the element itself.
    return lax.fori_loop(0, _ROUNDS, enlarge, jnp.ones_like(largest))
