"""A strip pressed on a rough plane: its tip sticks, lets go and comes to rest aside.

Romero et al. (2021) call it the stick-slip test, after Sano, Yamaguchi and Wada (2017).
The upper end is clamped, straight down, and comes down by a strain eps of the length,
which is 1. Forces are in EI/L^2. The reference is the elastica, by collocation.
"""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_bvp
from scipy.optimize import brentq

import jaxrod

GRID = np.linspace(0.0, 1.0, 201)
WIDE, THICK = 0.002, 0.0005
STRIP = {
    "section": jaxrod.rectangle(WIDE, THICK),
    "density": 1000.0,
    "youngs_modulus": 1e7,
    "normal": (0.0, 1.0, 0.0),
    "dtype": jnp.float64,
}
RADIUS = np.sqrt(WIDE * THICK / np.pi)  # Friction acts this far from the axis.
STARTS = {0.1: (0.04, 0.06), 0.2: (0.15, 0.17), 0.3: (0.27, 0.29)}


class Elastica:
    """Rod from the clamp to its tip, and the forces of the plane on the tip.

    theta'' = -H cos(theta) - N sin(theta) for the angle to the vertical, with the
    couple theta'(1) = H r of the friction H on the surface.
    """

    def __init__(self):
        """The mode in which a rod clamped and pinned buckles, of a strain of 0.01."""
        k = 4.493409
        x = np.sin(k * GRID) - k * GRID + k * (1 - np.cos(k * GRID))
        theta = k * np.cos(k * GRID) - k + k * k * np.sin(k * GRID)
        size = np.sqrt(0.02 / np.trapezoid(theta**2, GRID))
        slope = np.gradient(size * theta, GRID)
        self.shape = np.array([size * theta, slope, size * x, -0.99 * GRID])
        self.forces = np.array([k * k, k * k * size])

    def solve(self, strain, tip):
        """The rod at this strain; `tip(end, forces)` vanishes for its tip."""

        def slope(s, y, forces):
            push, rub = forces
            bend = -rub * np.cos(y[0]) - push * np.sin(y[0])
            return np.array([y[1], bend, np.sin(y[0]), -np.cos(y[0])])

        def ends(base, end, forces):
            couple = end[1] - forces[1] * RADIUS
            low = end[3] + 1 - strain
            last = tip(end, forces)
            return np.array([base[0], base[2], base[3], couple, low, last])

        found = solve_bvp(
            slope, ends, GRID, self.shape, p=self.forces, tol=1e-8, max_nodes=20000
        )
        assert found.success
        self.shape, self.forces = found.sol(GRID), found.p
        return found

    def pressed(self, strain):
        """The rod whose tip has not moved: its section has rolled on the plane."""
        now = 1 + self.shape[3, -1]
        for part in np.linspace(now, strain, 2 + int(abs(strain - now) / 0.05))[1:]:
            found = self.solve(part, lambda end, forces: end[2] + RADIUS * end[0])
        return found

    def ratio(self, strain):
        """Friction that the tip needs in order to stick."""
        push, rub = self.pressed(strain).p
        return rub / push

    def slipped(self, strain, friction):
        """Place of the tip where it comes to rest, if it slips slowly at `strain`."""
        self.pressed(strain)

        def at(aside):
            push, rub = self.solve(strain, lambda end, _: end[2] - aside).p
            return rub - friction * push

        # It needs more and more friction, then less.
        aside, rises = 0.0, True
        while rises or at(aside) > 0:
            aside -= 0.01
            rises = rises and at(aside) < at(aside - 0.005)
        return brentq(at, aside, aside + 0.01, xtol=1e-9)


def on_the_plane(n, elastica, deep, stick):
    """Function from strain and friction to a scene and a guess of its state at rest.

    Args:
        n: Number of elements.
        elastica: The shape of the guess, whose tip sticks.
        deep: Depth of the tip in the plane [lengths].
        stick: Stiffness of static friction over that of the contact.
    """
    rod, state = jaxrod.straight_rod(n, length=1.0, direction=(0.0, 0.0, -1.0), **STRIP)
    bending = float(rod.bend_twist_stiffness[0, 0])
    s = np.linspace(0.0, 1.0, n + 1)

    def at(strain, friction):
        _, _, x, z = elastica.pressed(strain).sol(s)
        _, bent = jaxrod.rod_along(np.array([x, 0 * s, z]), **STRIP)
        bent = replace(state, positions=bent.positions, orientations=bent.orientations)
        ground = jaxrod.contact(
            jaxrod.shapes.plane((0.0, 0.0, strain - 1 - RADIUS)),
            stiffness=20 * bending / (2 * RADIUS * deep),
            damping=1e-3,
            friction=friction,
        )
        sticks = jaxrod.sticking_contact(
            ground, rod, bent, stick_stiffness=stick * ground.stiffness
        )
        return jaxrod.make_scene(rod, jaxrod.clamp(state), sticks), bent

    return at


def needed(scene, state):
    """Forces of plane and friction at rest, those of the clamp [EI/L^2]."""
    force = jaxrod.reactions(scene, state)[0].force
    force = np.abs(force) / float(scene.rod.bend_twist_stiffness[0, 0])
    return float(force[2]), float(force[0])


def stuck(at, strain):
    """The strip at rest on a plane so rough that it sticks, and its scene."""
    scene, bent = at(strain, 10.0)
    found = jaxrod.equilibrium(scene, bent)
    assert found.converged and found.stable
    return scene, found.state


def critical_strain(elastica, friction):
    """Strain at which the tip of the elastica needs all of the friction."""
    return brentq(
        lambda strain: elastica.ratio(strain) - friction, *STARTS[friction], xtol=1e-10
    )


@pytest.mark.slow
@pytest.mark.parametrize("friction", STARTS)
def test_a_tip_lets_go_where_the_elastica_needs_all_of_the_friction(friction, record):
    elastica = Elastica()
    exact = critical_strain(elastica, friction)
    errors = []
    for n in (20, 40):
        at = on_the_plane(n, elastica, deep=3e-6, stick=20)
        scene, state = stuck(at, exact)
        push = elastica.pressed(1 + float(state.tip[2])).p[0]
        errors.append(abs(needed(scene, state)[0] / push - 1))
    assert np.log2(errors[0] / errors[1]) > 1.8
    row = f"Strip pressed on a plane, friction {friction}, n = 40: "
    force = row + "force when its tip starts to slip"
    record(force, "elastica by collocation", errors[1], at_most=3e-3)

    def holds(strain):
        _, state = stuck(at, strain)
        after = jaxrod.equilibrium(at(strain, friction)[0], state).state
        return abs(float(after.tip[0] - state.tip[0])) < 1e-6

    low, high = exact - 2e-3, exact + 2e-3
    assert holds(low) and not holds(high)
    for _ in range(10):
        strain = 0.5 * (low + high)
        low, high = (strain, high) if holds(strain) else (low, strain)
    event = row + "strain when its tip starts to slip [lengths]"
    record(event, "elastica by collocation", abs(low - exact), at_most=1e-3)
    push, rub = needed(*stuck(at, low))
    share = row + "friction over normal force then"
    record(share, f"{friction}", abs(rub / push / friction - 1), at_most=3e-3)


@pytest.mark.slow
@pytest.mark.parametrize("friction", STARTS)
def test_a_tip_that_has_slipped_rests_where_it_needs_less_friction(friction, record):
    strain = critical_strain(Elastica(), friction) + 3e-3
    exact = Elastica().slipped(strain, friction)
    at = on_the_plane(40, Elastica(), deep=3e-4, stick=0.5)
    found = jaxrod.equilibrium(at(strain, friction)[0], stuck(at, strain)[1])
    assert found.converged and found.stable
    record(
        f"Strip pressed on a plane, friction {friction}, n = 40: where its tip comes "
        "to rest [lengths]",
        "elastica by collocation",
        abs(float(found.state.tip[0]) - exact),
        # The tip is about 3e-4 deep in the plane.
        at_most=5e-4,
    )
