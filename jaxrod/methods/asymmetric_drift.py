r"""Free turning of elements whose second moments about d1 and d2 differ.

With the angular momentum $P$ constant in the world frame and $P_i = d_i\cdot P$,

$$H = \frac{|P|^2}{2 J_3} + \frac{c_1 P_1^2}{2} + \frac{c_2 P_2^2}{2},
  \qquad c_i = \frac1{J_i} - \frac1{J_3}.$$

The first term turns everything about $P$, exactly and whatever else happens. Each of
the others turns the element about its own $d_i$ at the rate $c_i P_i$, which it leaves
alone: also exactly. Half of the first, the second, half of the first is symmetric in
time, symplectic and of second order, with $|P|$ untouched. Of a thin strip one of the
two is small, and the splitting nearly exact.
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
    """Orientations after a time of free turning.

    Args:
        q: Orientations.
        momentum: Angular momentum, world frame [kg m^2/s].
        inverse_polar: One over the inertia about d3 [1/(kg m^2)].
        contrasts: One over the inertia about d1, and d2, less that [1/(kg m^2)].
        dt: Time [s].
    """
    zero, one = (jnp.full((), x, q[0].dtype) for x in (0, 1))
    parts = ((contrasts[0], (one, zero, zero)), (contrasts[1], (zero, one, zero)))
    return freely_turned(q, momentum, inverse_polar, parts, dt)
