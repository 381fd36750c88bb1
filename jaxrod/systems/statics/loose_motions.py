r"""Loose motions of a system: motions that no load resists in statics.

A ball on a smooth floor can slide, and a round rod between two pins can turn about its
axis. The stiffness $K$ is then singular: the balance of loads does not determine the
position along such a motion $m$. Suppose that the loads do not drive it. Then a spring
against its momentum $u = M m$ only selects this position. For any stiffness of the
spring the step $r$ has exactly no momentum along the motion:

$$(K + \sigma\,u u^T)\,r = g, \quad m\cdot g = 0 \quad\Rightarrow\quad
  u\cdot r = 0, \quad K r = g.$$

The candidates are the rigid motions of each rod and body, the rotation of all elements
of a rod about their own axes, and all linear combinations of these.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxrod.lanes.steps import by_kernel
from jaxrod.systems.statics.problem import Linear, StaticProblem

_ROUNDINGS = 64
"""Multiple of the machine epsilon up to which a resistance counts as zero."""

_SLIGHT = 1e-9
"""Largest tolerance for round-off that adds up like a random walk over all unknowns
[1]. Slender rods resist bending by more. In single precision `_ROUNDINGS` alone gives a
larger tolerance."""

_DRIVEN = 1024
"""Multiple of the machine epsilon up to which loads along a loose motion count as zero.
It is larger because these loads sum up the round-off of all elements."""

_LEAST = 0.01
"""Largest relative singular value at which a combination of motions counts as zero [1].
"""


def loose_motions(problem: StaticProblem, here: Linear) -> Float[Array, "modes m"]:
    """Independent loose motions in scaled rates, each of length one.

    Returns:
        As many rows as there are candidates; rows that are not needed are zero.
    """
    whole = by_kernel(problem, "motions_of_the_whole", here.motions)
    resisted = here.stiffness @ whole.T
    # Size of the rows if nothing cancelled.
    sizes = jnp.max(jnp.abs(here.stiffness) @ jnp.abs(whole.T), axis=1, keepdims=True)
    resisted = resisted / jnp.where(sizes > 0, sizes, 1)
    barred = whole.T - here.projection @ whole.T
    both = jnp.concatenate([resisted, barred])
    _, resistance, mixtures = jnp.linalg.svd(both, full_matrices=False)
    least = _ROUNDINGS * problem.rounding(here.motions)
    walk = len(here.loads) ** 0.5
    none = resistance <= jnp.maximum(least, jnp.minimum(walk * least, _SLIGHT))
    found = jnp.where(none[:, None], mixtures, 0) @ whole
    # Candidates may be dependent: the rotation of a straight rod about its axis minus
    # the rotation of all its elements about theirs is nothing but round-off.
    _, sizes, independent = jnp.linalg.svd(found, full_matrices=False)
    return jnp.where((sizes > _LEAST)[:, None], independent, 0)


def are_driven(
    problem: StaticProblem, here: Linear, motions: Float[Array, "modes m"]
) -> Bool[Array, ""]:
    """Whether loads act along loose motions by more than their round-off."""
    work = jnp.abs(motions @ here.loads)
    sizes = jnp.sum(jnp.abs(here.stiffness), axis=1)
    rounding = _DRIVEN * problem.rounding(here.motions)
    return jnp.any(work > rounding * (jnp.abs(motions) @ sizes))


def held(
    problem: StaticProblem, here: Linear, motions: Float[Array, "modes m"]
) -> Float[Array, "m m"]:
    """Stiffness matrix plus springs against loose motions and barred rates [J]."""
    momenta = motions @ here.mass
    inertia = jnp.sum(momenta * motions, axis=1)
    free = inertia > 0
    weight = jnp.where(free, jnp.sum(motions**2, axis=1), 0)
    weight = weight / jnp.where(free, inertia, 1) ** 2
    springs = momenta.T @ (weight[:, None] * momenta)
    return here.stiffness + problem.scales.energy * (springs + here.barred)
