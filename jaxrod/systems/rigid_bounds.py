r"""Stability bounds of contact between rigid bodies.

A spring $k$ along $n$ between places of two bodies changes its length by
$n\cdot(u_a + \theta_a\times p_a - u_b - \theta_b\times p_b)$. By the Cauchy-Schwarz
inequality its energy is at most half of
$\omega^2 (m_a |u_a|^2 + I_a|\theta_a|^2 + \dots)$ with
$\omega^2 = k (1/m_a + |p_a|^2/I_a + 1/m_b + |p_b|^2/I_b)$. This bound is sharp for two
bodies.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.effects.base import StabilityBound
from jaxrod.systems.parties import Party


def contact_bounds(
    moving: Sequence[Party],
    parties: Sequence[Party],
    pairs: Sequence[tuple[int, int, float]],
    stiffness: Array,
    drag: Array | None,
    *,
    rubs: bool,
    partners: int | None,
) -> dict[str, StabilityBound]:
    """Bounds on all bodies, as if the bodies of all pairs touched.

    Args:
        moving: Parties that are members, the first of all parties.
        parties: All parties.
        pairs: Numbers of two parties, and the most balls by which two bodies touch.
        stiffness: Stiffness of a ball [N/m].
        drag: Drag of a ball along the normal or along the surface [kg/s].
        rubs: Whether there is friction: it turns balls too.
        partners: Bodies that may touch one body at a time; `None` for all.
    """
    springs: list[list[Array]] = [[] for _ in moving]
    dashpots: list[list[Array]] = [[] for _ in moving]
    for a, b, contacts in pairs:
        one, two = parties[a], parties[b]
        for columns, turning in ((springs, False), (dashpots, rubs)):
            ease = contacts * (
                _ease(one, turning)[:, None] + _ease(two, turning)[None, :]
            )
            if a == b:
                ease = jnp.where(jnp.eye(one.count, dtype=bool), 0, ease)
            columns[a].append(ease)
            if b != a and b < len(moving):
                columns[b].append(ease.T)
    bounds = {}
    for party, spring, dashpot in zip(moving, springs, dashpots, strict=True):
        if not spring:
            continue
        rate = stiffness * _worst(spring, partners)
        slow = None if drag is None else drag * _worst(dashpot, partners)
        turns, drags = _turns(party, False), _turns(party, rubs)
        bounds[party.member] = StabilityBound(
            nodes=rate * party.masses,
            elements=rate * party.inertias if turns else None,
            node_drag=None if slow is None else slow * party.masses,
            element_drag=None if slow is None or not drags else slow * party.inertias,
        )
    return bounds


def _turns(party: Party, rubs: bool) -> bool:
    """Whether contact turns a body: only friction turns a ball."""
    return rubs or not party.is_ball


def _ease(party: Party, rubs: bool) -> Array:
    """Largest velocity at a place of contact per impulse there [1/kg]."""
    moving = 1 / party.masses
    if not _turns(party, rubs):
        return moving
    return moving + party.reach * party.reach / party.inertias


def _worst(columns: list[Array], partners: int | None) -> Array:
    """Sum over all other bodies, or a bound for the most that touch at a time."""
    every = jnp.concatenate(columns, axis=1)
    total = jnp.sum(every, axis=1)
    if partners is None:
        return total
    return jnp.minimum(total, partners * jnp.max(every, axis=1))
