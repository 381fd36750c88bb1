"""Two ropes that cross and rest on each other: the system, and two elasticae."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_bvp

import jaxrod

LENGTH, SPAN, LOWER, THICK, G = 1.0, 0.8, 0.05, 0.005, 9.81
STIFFNESS, APART = 1e3, 0.01
MATERIAL = {
    "radius": THICK,
    "density": 1000.0,
    "youngs_modulus": 1e6,
    "shear_modulus": 1e6 / 3,
    "dtype": jnp.float64,
}


def two_elasticae(lower=LOWER):
    """Half of each rope at rest: places x, z, angle and moment, tension and push.

    The rope below comes first; the ends of the other one are lower by `lower` [m].
    """
    rod, _ = jaxrod.straight_rod(4, length=LENGTH, **MATERIAL)
    shear, _, stretch = np.asarray(rod.shear_stretch_stiffness[:, 0])
    bending = float(rod.bend_twist_stiffness[0, 0])
    weight = float(rod.linear_density[0]) * G
    half = 0.5 * LENGTH

    def slopes(s, y, numbers):
        rates = []
        for k, sign in ((0, -1), (4, 1)):
            angle, moment, across = y[k + 2], y[k + 3], numbers[k // 4]
            up = sign * 0.5 * numbers[2] + weight * (s - half)
            c, d = np.cos(angle), np.sin(angle)
            along = 1 + (across * c + up * d) / stretch
            aside = (up * c - across * d) / shear
            x, z = along * c - aside * d, along * d + aside * c
            rates += [x, z, moment / bending, across * z - up * x]
        return np.stack(rates)

    def ends(touching):
        def found(a, b, numbers):
            held = [a[0], a[1], a[3], b[0] - SPAN / 2, b[2]]
            held += [a[4], a[5] + lower, a[7], b[4] - SPAN / 2, b[6]]
            gap = 2 * THICK - numbers[2] / STIFFNESS
            return np.array([*held, b[5] - b[1] - gap if touching else numbers[2]])

        return found

    s = np.linspace(0, half, 400)
    guess = np.zeros((8, s.size))
    guess[0] = guess[4] = 0.8 * s
    guess[1] = -0.3 * np.sin(np.pi * s)
    guess[5] = -lower - 0.25 * np.sin(np.pi * s)
    guess[2] = guess[6] = -np.cos(np.pi * s)
    how = {"max_nodes": 99999}
    free = solve_bvp(slopes, ends(False), s, guess, [0.4, 0.4, 0.0], tol=1e-6, **how)
    start = [*free.p[:2], 0.1]
    found = solve_bvp(slopes, ends(True), free.x, free.y, start, tol=1e-9, **how)
    assert free.success and found.success and found.p[2] > 0.01
    return found, free


def nodes_of(found, n):
    """Nodes of both ropes at rest, of n elements [m]."""
    s = np.linspace(0, LENGTH, n + 1)
    y = found.sol(np.minimum(s, LENGTH - s))
    nodes = {}
    for k, name in enumerate(("below", "above")):
        x = y[4 * k] - SPAN / 2
        nodes[name] = np.zeros((3, n + 1))
        nodes[name][k] = np.where(s > LENGTH / 2, -x, x)
        nodes[name][2] = y[4 * k + 1]
    return nodes


def resting_ropes(n, rest, contact):
    """A system of both ropes, farther apart by `APART` than they rest; its state."""
    members, state = {}, {}
    lift = 0.5 * APART * np.sin(np.pi * np.linspace(0, 1, n + 1)) ** 2
    for name, sign in (("below", -1), ("above", 1)):
        nodes = rest[name] + np.array((0.0, 0.0, sign))[:, None] * lift
        rod, straight = jaxrod.straight_rod(n, length=LENGTH, **MATERIAL)
        _, bent = jaxrod.rod_along(nodes, **MATERIAL)
        state[name] = replace(
            straight, positions=bent.positions, orientations=bent.orientations
        )
        members[name] = jaxrod.make_scene(
            rod,
            jaxrod.driven(state[name], "base", free_to_turn=True),
            jaxrod.driven(state[name], "tip", free_to_turn=True),
            jaxrod.gravity(),
            jaxrod.exponential_damping(5.0),
        )
    return jaxrod.make_system(members, contact, state=state), state
