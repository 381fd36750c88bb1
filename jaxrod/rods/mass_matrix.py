r"""Higher-order mass matrix: swings and waves of stretch with smaller errors.

With lumped masses $m_i$ at the nodes a string of equal elements of length $h$ is too
slow: its squared frequencies are low by the fraction $(k h)^2/12$. With the consistent
matrix of linear elements they are high by as much. The mean of both is

$$M = M_l + C, \qquad v\cdot C v = -\tfrac1{12} \sum_e m_e\, (v_{e+1} - v_e)^2,$$

for which the error is of fourth order. Steps do not solve with $M$: accelerations are
$W f$ with forces $f$ and

$$W = M_l^{-1} - M_l^{-1} C M_l^{-1} .$$

This matrix is symmetric and constant, so that steps stay symplectic with the momenta
$p = W^{-1} v$. As $C$ vanishes for rigid displacements, the linear momentum is $\sum
m_i v_i$. Angular momentum is $\sum x_i\times p_i$, kinetic energy $v\cdot p/2$. Rows
and columns of components that supports hold are left out of $W$.

Sums over nodes with half of an element's mass at either end have errors of second order
at the ends of a rod. So 1/24 of the mass of an end element moves from its end node to
the other: the nodes have 11/24, 25/24, 1, ... of an element's mass. Then mass, centre
of mass, and moment of inertia of a straight rod are right to third order, and so is the
period of a cable that hangs freely from a pin. Between elements with $q = m_e h_e$ and
$q'$, the part of 1/24 is $(q - q')/(q + q')$, which leaves the centre of mass where it
is.

Every element gives parts $a$ and $b = 1 - a$ of its mass to its nodes, so that

$$\frac{m_e}{12} (v_{e+1} - v_e)^2 \le \frac1{12}\Bigl(\frac1a + \frac1b\Bigr)
  (a m_e v_e^2 + b m_e v_{e+1}^2) .$$

The factor, 0.336 for equal elements and never above 0.343, bounds the relative
difference between $W$ and $M_l^{-1}$.

Source: Hughes, *The Finite Element Method* (2000), section 9.1 (higher-order mass).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxrod.geometry import vectors

_MOVED = 1 / 24
"""Part of an end element's mass that moves from its end node to the other [1]."""
_SHARED = 1 / 12
"""Part of an element's mass in the coupling of its nodes [1]."""
_MIDDLE = 1 + 0.17
"""Middle of the eigenvalues of 1 + K [1]."""
_ROUNDS = 20
"""Iterations after which the momenta are exact to round-off; each leaves 0.15."""


def parts_of_elements(masses: Array, lengths: Array) -> tuple[Array, Array]:
    """Parts of each element's mass at its first and at its second node [1].

    Args:
        masses: Masses of the elements [kg].
        lengths: Their rest lengths [m].
    """
    own = masses * lengths
    before = vectors.pad(own, 1, 0)[..., :-1]
    after = vectors.pad(own, 0, 1)[..., 1:]
    moved = _MOVED * ((own - after) / (own + after) - (own - before) / (own + before))
    return 0.5 + moved, 0.5 - moved


def node_masses(masses: Array, lengths: Array) -> Array:
    """Masses of the nodes [kg]; arguments as for `parts_of_elements`."""
    first, second = parts_of_elements(masses, lengths)
    return vectors.pad(first * masses, 0, 1) + vectors.pad(second * masses, 1, 0)


def coupled(masses: Array, rate: Array) -> Array:
    """Forces -C a on the nodes, for one component of their accelerations [N].

    Args:
        masses: Masses of the elements [kg].
        rate: Component of the accelerations [m/s^2]; or velocities, for momenta.
    """
    pull = _SHARED * masses * (rate[..., 1:] - rate[..., :-1])
    return vectors.pad(pull, 1, 0) - vectors.pad(pull, 0, 1)


def momentum_velocities(
    masses: Array,
    lengths: Array,
    velocities: Array,
    free: Array | None = None,
) -> Array:
    """Momenta of the nodes divided by their masses [m/s].

    Args:
        masses: Masses of the elements [kg].
        lengths: Their rest lengths [m].
        velocities: Velocities of the nodes `(3, n + 1)` [m/s].
        free: 1 for components that no support holds, else 0, in the same shape.
    """
    inverse = 1 / node_masses(masses, lengths)

    def one(velocity: Array, keep: Array | None) -> Array:
        def kept(rate: Array) -> Array:
            return rate if keep is None else keep * rate

        def improved(_: Array, found: Array) -> Array:
            image = found + kept(inverse * coupled(masses, kept(found)))
            return found + (velocity - image) / _MIDDLE

        # The number of rounds is fixed, so that the loop has a derivative.
        return lax.fori_loop(0, _ROUNDS, improved, velocity)

    found: Array = jax.vmap(one)(velocities, free)
    return found


def bounds_of_elements(masses: Array, lengths: Array) -> tuple[Array, Array]:
    """Factors by which inverse masses may grow, for bounds on frequencies [1].

    Args:
        masses: Masses of the elements [kg].
        lengths: Their rest lengths [m].

    Returns:
        The bound of W, divided by lumped inverse masses, and for each element the
        mobility of its nodes against each other, divided by 4 over its mass.
    """
    first, second = parts_of_elements(masses, lengths)
    mobility = 1 / first + 1 / second
    whole = 1 + _SHARED * jnp.max(mobility)
    return whole, 0.25 * whole * mobility
