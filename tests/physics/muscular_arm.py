"""An octopus arm of three kinds of muscles, and where it comes to rest.

The arm is that of COOMM (Chang et al., Proc. R. Soc. A 479 (2023) 20220593): tapered,
with a longitudinal muscle, four oblique ones that wind around it and one across it.
Nothing acts on it from outside, so every section balances its own muscles: six
equations for six strains at each place, which integrated along the arm are its shape.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import jaxrod

LENGTH, BASE, TIP, YOUNG, DENSITY = 0.2, 0.012, 0.0012, 1e4, 1050.0
SHEAR = YOUNG / 1.5
AXON = 0.002  # the middle, without muscles [m]
STRESS = {"across": 15e3, "along": 50e3, "oblique": 50e3}  # [Pa]
RATIO = {
    "across": (0.0045**2 - AXON**2) / BASE**2,
    "along": (0.003 / BASE) ** 2,
    "oblique": (0.00075 / BASE) ** 2,
}
"""Of a muscle's area to the section's [1]."""
OFFSET = {"along": 0.0075 / BASE, "oblique": 0.01125 / BASE}
"""Of a muscle from the centreline, over the radius [1]."""
WINDING = 2 * np.pi * 6 / LENGTH  # of oblique muscles [rad/m]
QUARTERS = np.arange(4) * np.pi / 2
CUBIC = np.polynomial.Polynomial([-6.44, 18.01, -13.64, 3.06])


def radius(s):
    """Of the section at a place [m]."""
    return BASE + (TIP - BASE) * s / LENGTH


def area(s):
    """Of the section at a place [m^2]."""
    return np.pi * radius(s) ** 2


def activations(s):
    """The base lengthens and winds, a stretch behind it bends: a reach."""

    def between(a, b):
        return 0.5 * (np.tanh((s - a) / 0.01) - np.tanh((s - b) / 0.01))

    return {
        "across": 0.6 * between(-0.1, 0.12),
        "along": 0.5 * between(0.05, 0.11),
        "oblique": 0.8 * between(-0.1, 0.15),
    }


def pulls(s, share):
    """Force of each kind, at the length at rest [N]."""
    active = activations(s)
    return {k: share * active[k] * STRESS[k] * RATIO[k] * area(s) for k in STRESS}


@dataclass(frozen=True)
class Fibre:
    """A muscle along the arm, at a place."""

    offset: np.ndarray
    """From the centreline [m]."""
    slope: np.ndarray
    """Of the offset along the arm [1]."""
    pull: float
    """Its force at the length at rest [N]."""


def fibres(s, share):
    """The longitudinal muscle and the four oblique ones."""
    r, narrowing, force = radius(s), (TIP - BASE) / LENGTH, pulls(s, share)
    side = np.array([1.0, 0.0, 0.0])
    lie, wind = OFFSET["along"], OFFSET["oblique"]
    found = [Fibre(lie * r * side, lie * narrowing * side, force["along"])]
    for angle in WINDING * s + QUARTERS:
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        round_it = np.array([-np.sin(angle), np.cos(angle), 0.0])
        slope = wind * (narrowing * out + r * WINDING * round_it)
        found.append(Fibre(wind * r * out, slope, force["oblique"]))
    return found


def stiffness(s):
    """Against shear and stretch [N], and against bending and twist [N m^2]."""
    a = area(s)
    moment = a * radius(s) ** 2 / 4
    return (
        np.array([27 / 28 * SHEAR * a, 27 / 28 * SHEAR * a, YOUNG * a]),
        np.array([YOUNG * moment, YOUNG * moment, 2 * SHEAR * moment]),
    )


def with_energy(nu, curvature, s, share):
    """Force and couple of a section: minus the derivative of a stored energy.

    Args:
        nu: Change of the centreline along the arm, material frame [1].
        curvature: And twist, likewise [1/m].
        s: Place [m].
        share: Of the activations.
    """
    (stiff, bending), stretch = stiffness(s), np.linalg.norm(nu)
    force, couple = stiff * (nu - [0, 0, 1]), bending * curvature
    for fibre in fibres(s, share):
        along = nu + np.cross(curvature, fibre.offset) + fibre.slope
        size = np.linalg.norm(along)
        rest = np.linalg.norm(np.array([0, 0, 1]) + fibre.slope)
        pull = fibre.pull * CUBIC(size / rest) * along / size
        force, couple = force + pull, couple + np.cross(fibre.offset, pull)
    across = pulls(s, share)["across"] * CUBIC(stretch**-0.5) * stretch**-1.5
    return force - across * nu / stretch, couple


def as_coomm(nu, curvature, s, share):
    """The same with COOMM's law, on PyElastica's rod: sections thin out.

    Elastic forces over the stretch, couples over its cube; muscles have less area and
    lie nearer to the centreline. There is no energy.
    """
    (stiff, bending), stretch = stiffness(s), np.linalg.norm(nu)
    force = stiff * (nu - [0, 0, 1]) / stretch
    couple = bending * curvature / stretch**3
    for fibre in fibres(s, share):
        offset = fibre.offset / np.sqrt(stretch)
        slope = fibre.slope / stretch**1.5
        along = nu + np.cross(curvature, offset) + slope
        size = np.linalg.norm(along)
        rest = np.linalg.norm(np.array([0, 0, 1]) + fibre.slope)
        pull = fibre.pull / stretch * CUBIC(size / rest) * along / size
        force, couple = force + pull, couple + np.cross(offset, pull)
    across = pulls(s, share)["across"] / stretch * CUBIC(stretch**-0.5)
    return force - across * nu / stretch, couple


def solved(residual: Callable, guess: np.ndarray) -> np.ndarray:
    """Where six residuals are zero, by Newton's method with differences."""
    steps = 1e-6 * np.eye(6)
    for _ in range(30):
        slopes = [(residual(guess + d) - residual(guess - d)) / 2e-6 for d in steps]
        change = np.linalg.solve(np.array(slopes).T, residual(guess))
        guess = guess - change
        if np.max(np.abs(change)) < 1e-9:
            return guess
    raise AssertionError(f"no balance, {np.max(np.abs(residual(guess))):.1e} off")


def at_rest(law: Callable, share: float, n: int) -> np.ndarray:
    """Nodes of the arm at rest [m], its base at the origin, along z there."""
    places = np.linspace(0, LENGTH, 101)
    guess, strains = np.array([0.0, 0, 1, 0, 0, 0]), []
    for s in places:
        scale = YOUNG * area(s)

        def out_of_balance(x, s=s, scale=scale):
            force, couple = law(x[:3], x[3:] / radius(s), s, share)
            return np.concatenate([force / scale, couple / scale / radius(s)])

        guess = solved(out_of_balance, guess)
        strains.append(np.concatenate([guess[:3], guess[3:] / radius(s)]))
    between = CubicSpline(places, np.array(strains))

    def along(s, y):
        x, (a, b, c) = between(s), between(s)[3:]
        frame = y[3:].reshape(3, 3)
        turning = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
        return np.concatenate([frame @ x[:3], (frame @ turning).ravel()])

    found = solve_ivp(
        along,
        (0, LENGTH),
        np.concatenate([np.zeros(3), np.eye(3).ravel()]),
        t_eval=np.linspace(0, LENGTH, n + 1),
        rtol=1e-9,
        atol=1e-12,
        max_step=LENGTH / 200,
    )
    return found.y[:3]


def arm(n: int, share: float, damping: float):
    """The same as a scene, and its straight state."""
    nodes = np.linspace(0, LENGTH, n + 1)
    middles = 0.5 * (nodes[1:] + nodes[:-1])
    rod, state = jaxrod.straight_rod(
        n,
        length=LENGTH,
        radius=radius(middles),
        density=DENSITY,
        youngs_modulus=YOUNG,
        shear_modulus=SHEAR,
        normal=(1.0, 0.0, 0.0),
        dtype=jnp.float64,
    )
    wall, force = jaxrod.clamp(state), pulls(middles, share)
    angles = WINDING * nodes + QUARTERS[:, None]
    beside = np.stack([np.cos(angles), np.sin(angles)], axis=1) * radius(nodes)
    along = np.stack([radius(nodes), 0 * nodes])[None]
    muscles = (
        jaxrod.actuation.muscle(
            rod, force["along"][None], offsets=OFFSET["along"] * along, into=wall
        ),
        jaxrod.actuation.muscle(
            rod,
            np.repeat(force["oblique"][None], 4, axis=0),
            offsets=OFFSET["oblique"] * beside,
            into=wall,
        ),
        jaxrod.actuation.muscle(rod, force["across"][None], across=True),
    )
    damper = jaxrod.exponential_damping(damping)
    return jaxrod.make_scene(rod, wall, *muscles, damper), state
