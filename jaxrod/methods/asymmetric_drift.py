r"""Free rotation of elements whose second moments about d1 and d2 differ.

With the angular momentum $P$ constant in the world frame and $P_i = d_i\cdot P$,

$$H = \frac{|P|^2}{2 J_3} + \frac{c_1 P_1^2}{2} + \frac{c_2 P_2^2}{2},
  \qquad c_i = \frac1{J_i} - \frac1{J_3}.$$

The first term rotates everything about $P$, exactly, and commutes with the others. Each
of the others rotates the element about its own $d_i$ at the rate $c_i P_i$. That leaves
$P_i$ constant, so it is exact, too. Half of the second term, the third, and half of the
second give a splitting that is symmetric in time, symplectic and of second order, with
$|P|$ untouched. For a thin strip one of the two is small, and the splitting is nearly
exact.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.geometry.free_rotation import freely_turned
from jaxrod.geometry.rotations import Quaternion
from jaxrod.geometry.vectors import Vec3


def asymmetric_drift(
    q: Quaternion,
    momentum: Vec3,
    inverse_polar: Array,
    contrasts: tuple[Array, Array],
    dt: Array,
) -> Quaternion:
    """Orientations after a time of free rotation.

    Args:
        q: Orientations.
        momentum: Angular momentum, world frame [kg m^2/s].
        inverse_polar: Inverse of the inertia about d3 [1/(kg m^2)].
        contrasts: Inverse of the inertia about d1, and about d2, minus `inverse_polar`
            [1/(kg m^2)].
        dt: Time [s].
    """
    zero, one = (jnp.full((), x, q[0].dtype) for x in (0, 1))
    parts = ((contrasts[0], (one, zero, zero)), (contrasts[1], (zero, one, zero)))
    return freely_turned(q, momentum, inverse_polar, parts, dt)
