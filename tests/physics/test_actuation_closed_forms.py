"""Closed forms of actuators: what bends, twists and shortens a rod by how much."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, fsolve

import jaxrod
from jaxrod.rods.motion import motion_of
from physics.actuators import at_once, strained
from physics.rods import (
    AREA,
    BENDING,
    LENGTH,
    RADIUS,
    SECOND_MOMENT,
    YOUNG,
    arm,
    loads,
    no_moves,
    perturb,
)

N = 5
PULL = 0.02 * YOUNG * AREA
OFFSET = 0.6 * RADIUS
SQUARE = OFFSET * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
TWISTING = 2 / 3 * YOUNG * SECOND_MOMENT  # 2 G I [N m^2]


@pytest.fixture(scope="module")
def bar():
    return arm(N)


@jax.jit
def unbalanced(scene, state):
    """The largest force over EA, and the largest couple over EI/L, out of balance."""
    forces, couples = loads(scene, state)
    return jnp.maximum(
        jnp.max(jnp.abs(forces)) / (YOUNG * AREA), jnp.max(jnp.abs(couples)) / BENDING
    )


def balance(rod, effect, curvature, strain):
    """What is out of balance in a free rod that is strained evenly."""
    state = strained(rod, curvature, strain)
    return float(unbalanced(jaxrod.make_scene(rod, at_once(effect)), state))


@pytest.mark.slow
def test_one_longitudinal_muscle_bends_and_shortens(bar, record):
    rod, _ = bar
    muscle = jaxrod.actuation.muscle(
        rod, PULL, offsets=(OFFSET, 0.0), curve=jaxrod.actuation.constant_force()
    )
    bent = (0.0, PULL * OFFSET / BENDING, 0.0)
    record(
        "One longitudinal muscle in a free rod: loads at the curvature N x/EI and "
        "the strain -N/EA",
        "zero, relative to EA and EI/L",
        balance(rod, muscle, bent, -PULL / (YOUNG * AREA)),
        at_most=1e-12,
    )
    assert balance(rod, muscle, np.multiply(bent, 1.01), 0.0) > 1e-4


@pytest.mark.slow
def test_antagonists_shorten_a_rod_and_do_not_bend_it(bar, record):
    rod, _ = bar
    muscles = jaxrod.actuation.muscle(rod, PULL, 0.8, offsets=SQUARE)
    cubic = np.polynomial.Polynomial([-6.44, 18.01, -13.64, 3.06])
    strain = brentq(
        lambda s: YOUNG * AREA * s + 4 * 0.8 * PULL * cubic(1 + s),
        -0.3,
        0.0,
        xtol=1e-16,
    )
    assert strain < -0.05
    record(
        "Four longitudinal muscles with the octopus' force curve: loads at the "
        "strain s",
        "EA s + 4 a N f(1 + s) = 0",
        balance(rod, muscles, (0.0, 0.0, 0.0), strain),
        at_most=1e-12,
    )


@pytest.mark.slow
def test_a_muscle_across_lengthens_a_rod(bar):
    rod, _ = bar
    muscle = jaxrod.actuation.muscle(
        rod, PULL, across=True, curve=jaxrod.actuation.constant_force()
    )
    strain = brentq(
        lambda s: YOUNG * AREA * s - PULL * (1 + s) ** -1.5, 0, 1, xtol=1e-16
    )
    assert balance(rod, muscle, (0.0, 0.0, 0.0), strain) < 1e-12


def test_a_chamber_bends_and_lengthens(bar, record):
    rod, _ = bar
    pressure, area = 2e5, 0.1 * AREA
    chamber = jaxrod.actuation.chamber(rod, pressure, area, offsets=(0.0, OFFSET))
    bent = (pressure * area * OFFSET / BENDING, 0.0, 0.0)
    record(
        "A chamber in a free rod: loads at the curvature p A x/EI and the strain p "
        "A/EA",
        "zero, relative to EA and EI/L",
        balance(rod, chamber, bent, pressure * area / (YOUNG * AREA)),
        at_most=1e-12,
    )


@pytest.mark.fast_sets(2)
@pytest.mark.parametrize("degrees", [30.0, 54.7356, -70.0])
def test_a_wound_chamber_pushes_and_unwinds(bar, degrees, record):
    rod, state = bar
    pressure, radius, angle = 1e5, 0.02, np.deg2rad(degrees)
    chamber = jaxrod.actuation.wound_chamber(rod, pressure, radius, angle)
    strains, _ = chamber._strains(motion_of(state))
    stress = chamber.stress(rod, strains)
    cot = 1 / np.tan(angle)
    push = pressure * np.pi * radius**2 * (1 - 2 * cot**2)
    moment = 2 * pressure * np.pi * radius**3 * cot
    gaps = [
        np.max(np.abs(stress.force[2] + push)) / (pressure * radius**2),
        np.max(np.abs(stress.moment[2][1:-1] - moment)) / (pressure * radius**3),
    ]
    record(
        f"Push and moment of a chamber wound at {degrees:g} degrees",
        "p pi r^2 (1 - 2 cot^2 a), 2 p pi r^3 cot a",
        max(gaps),
        at_most=1e-12,
    )


def test_a_wound_chamber_counts_twist_from_that_of_the_unstressed_rod(bar):
    """In a rod that is twisted without stress it pushes and unwinds as in another."""
    twist, pressure, radius, angle = 0.8, 1e5, 0.02, 1.0
    rod = replace(bar[0], rest_curvatures=bar[0].rest_curvatures.at[2].set(twist))
    chamber = jaxrod.actuation.wound_chamber(rod, pressure, radius, angle)
    strains, _ = chamber._strains(motion_of(strained(rod, (0.0, 0.0, twist), 0.0)))
    stress = chamber.stress(rod, strains)
    cot, load = 1 / np.tan(angle), pressure * np.pi * radius**2
    np.testing.assert_allclose(
        stress.force[2], -load * (1 - 2 * cot**2), rtol=0, atol=1e-9 * load
    )
    np.testing.assert_allclose(
        stress.moment[2][1:-1], 2 * load * radius * cot, rtol=1e-9
    )
    assert abs(float(chamber.stored(rod, strains))) < 1e-9 * load * radius


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("anchored", [False, True])
def test_a_tendons_friction_is_by_how_fast_it_slips_at_each_eyelet(anchored):
    """T_j = T_(j-1) exp(-mu theta_j tanh(v_j / v_s)), by loops over the eyelets.

    The cable slips towards its base as fast as what is beyond the eyelet gets shorter.
    """
    pull, friction, slow = 7.0, 2.0, 0.02
    rod, state = arm(N)
    random = np.random.default_rng(6)
    positions = np.asarray(state.positions) + 0.05 * random.normal(size=(3, N + 1))
    velocities = 0.03 * random.normal(size=(3, N + 1))
    moving = replace(
        state, positions=jnp.asarray(positions), velocities=jnp.asarray(velocities)
    )
    base = (0.1, -0.2, -0.3)
    cable = jaxrod.actuation.tendon(
        rod,
        (0.0, 0.0),
        tension=pull,
        friction=friction,
        slip_speed=slow,
        anchor=base if anchored else None,
    )
    found = np.stack(cable.loads(rod, motion_of(moving)).forces)
    points, speeds = (0.5 * (a[:, 1:] + a[:, :-1]).T for a in (positions, velocities))
    if anchored:
        points, speeds = np.vstack([base, points]), np.vstack([np.zeros(3), speeds])
    pieces = np.diff(points, axis=0)
    along = pieces / np.linalg.norm(pieces, axis=1)[:, None]
    growing = np.sum(along * np.diff(speeds, axis=0), axis=1)
    tensions = [pull]
    for j in range(1, len(pieces)):
        theta = np.arccos(along[j - 1] @ along[j])
        slip = -sum(growing[j:])
        tensions.append(tensions[-1] * np.exp(-friction * theta * np.tanh(slip / slow)))
    assert np.ptp(tensions) > 0.05 * pull
    forces = np.zeros((N + 1, 3))
    for j, tension in enumerate(tensions):
        for point, sign in ((j, 1), (j + 1, -1)):
            element = point - anchored
            if element >= 0:
                forces[element : element + 2] += 0.5 * sign * tension * along[j]
    np.testing.assert_allclose(found, forces.T, atol=1e-10 * pull)


@pytest.mark.parametrize("share", [1.0, -1.0, 0.6])
def test_a_cable_at_rest_keeps_the_share_of_its_friction_that_is_asked_for(share):
    """T = T_0 exp(-s mu theta) along a ring; shares add as velocities do."""
    pull, friction = 7.0, 0.4
    rod, _ = arm(24)
    ring = strained(rod, (0.0, 1.5 * np.pi / LENGTH, 0.0), 0.0)
    cable = jaxrod.actuation.tendon(
        rod, (0.0, 0.0), tension=pull, friction=friction, friction_at_rest=share
    )
    # The last eyelet's element carries the tension that is left, half at each node.
    last = np.stack(cable.loads(rod, motion_of(ring)).forces)[:, -1]
    turned = 1.5 * np.pi * 22 / 24
    left = 2 * np.linalg.norm(last) / pull
    np.testing.assert_allclose(left, np.exp(-share * friction * turned), 1e-12)
    for slip in (-50.0, -1.0, 0.0, 0.3, 50.0):
        t = np.tanh(slip)
        expected = share if abs(share) == 1 else (share + t) / (1 + share * t)
        found = cable._slip_share(jnp.full((1, 3), slip))
        np.testing.assert_allclose(found, expected, rtol=1e-9)
    # One share for each cable.
    both = replace(cable, friction_at_rest=jnp.asarray([share, 0.0]))
    found = both._slip_share(jnp.zeros((2, 3)))
    np.testing.assert_array_equal(found, [[share] * 3, [0.0] * 3])


@pytest.mark.slow
def test_a_pose_that_friction_holds_stays_when_it_is_advanced():
    rod, state = arm(8, radius=0.03, youngs_modulus=1e6)
    poses = []
    for share in (1.0, -1.0):
        cable = jaxrod.actuation.tendon(
            rod, (0.02, 0.0), tension=20.0, friction=0.2, friction_at_rest=share
        )
        scene = jaxrod.make_scene(rod, jaxrod.clamp(state), cable)
        rest = jaxrod.equilibrium(scene, state)
        assert bool(rest.converged)
        later = jaxrod.advance(scene, rest.state, jaxrod.stable_dt(scene).dt, 500)
        assert float(jnp.max(jnp.abs(later.positions - rest.state.positions))) < 1e-9
        poses.append(rest.state.positions)
    assert float(jnp.max(jnp.abs(poses[0] - poses[1]))) > 1e-3


@pytest.mark.slow
def test_the_bound_of_a_tendon_is_above_all_that_its_energy_is_curved_by():
    """On the elements that have its eyelets, the last of them included."""
    n, held = 3, (1, 2)
    rod, state = arm(n)
    cable = jaxrod.actuation.tendon(
        rod, (0.6 * RADIUS, 0.0), tension=50.0, elements=held
    )
    bound = cable.stability_bound(rod)
    np.testing.assert_array_equal(bound.nodes > 0, [False, True, True, True])
    np.testing.assert_array_equal(bound.elements > 0, [False, True, True])
    left = above_curvature(rod, state, cable)
    # Nothing outside of the eyelets, where both are zero.
    assert min(left) > -1e-8 * max(left)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("across", [False, True])
def test_the_bound_of_a_muscle_is_above_all_that_its_energy_is_curved_by(across):
    """A constant pull on the axis. Only stiffness counts, and no lack of it."""
    rod, state = arm(3)
    muscle = jaxrod.actuation.muscle(
        rod, 50.0, curve=jaxrod.actuation.constant_force(), across=across
    )
    left = above_curvature(rod, state, muscle)[4 * 3 + 3 * 3 :]
    assert min(left) > -1e-8 * max(left)


def above_curvature(rod, state, effect):
    """Eigenvalues of an effect's bound with and without the curvature of its energy."""
    none, back = ravel_pytree(no_moves(state))

    @jax.jit
    @jax.vmap
    @jax.grad
    def slope(moves):
        return effect.energy(rod, perturb(state, back(moves)))

    steps = 1e-5 * jnp.eye(none.size)
    found = np.asarray(slope(steps) - slope(-steps)) / 2e-5
    bound = effect.stability_bound(rod)
    most = jnp.concatenate([jnp.tile(bound.nodes, 3), jnp.tile(bound.elements, 3)])
    signs = (1, -1)
    return [x for s in signs for x in np.linalg.eigvalsh(np.diag(most) + s * found)]


def test_the_bound_of_a_magnet_along_a_uniform_field_is_what_turns_it_back():
    """The couple m B sin(angle) of each element, as steep as it gets."""
    rod, _ = arm(3)
    magnet = jaxrod.actuation.magnetisation(rod, (0.0, 0.0, 2.0), (0.0, 0.0, -5.0))
    bound = magnet.stability_bound(rod)
    np.testing.assert_allclose(bound.elements, 2.0 * 5.0 * rod.rest_lengths)
    assert bound.nodes is None


def test_the_bound_of_a_magnet_is_above_all_that_its_energy_is_curved_by():
    """In a field that is zero in the middle of the rod and grows along it.

    Its slope couples moves and turns; the two halves are magnetised against each other,
    so that the field turns both the same way.
    """
    slope, across = 3.0, 0.25
    rod, state = arm(2)
    half = 0.5 * float(rod.length)
    state = replace(state, positions=state.positions - jnp.array([[0], [0], [half]]))
    gradient = np.zeros((3, 3))
    gradient[0, 2] = slope
    moment = np.outer([across, 0.0, np.sqrt(1 - across**2)], [1.0, -1.0])
    field = jaxrod.actuation.linear_field((0.0, 0.0, 0.0), gradient, extent=half)
    magnet = jaxrod.actuation.magnetisation(rod, moment, field)
    assert min(above_curvature(rod, state, magnet)) > 0


@pytest.mark.slow
def test_helical_muscles_all_around_twist_a_rod(bar, record):
    """At inner joints: n + EA s = 0 and m + C k = 0 with the polyline's own pitch."""
    n, turns = 12, 1.5
    rod, _ = arm(n)
    angles = np.arange(4) * np.pi / 2
    winding = jaxrod.actuation.helical_offsets(rod, OFFSET, turns, angles)
    muscles = jaxrod.actuation.muscle(
        rod, PULL, offsets=winding, curve=jaxrod.actuation.constant_force()
    )
    step = 2 * np.pi * turns / n

    def residual(unknown):
        strain, twist = unknown
        along = np.array([OFFSET * (np.sin(step) + twist), (1 + strain) / n])
        pull = 4 * PULL * along / np.linalg.norm(along)
        return [
            YOUNG * AREA * strain + pull[1],
            TWISTING * twist * n + OFFSET * pull[0],
        ]

    strain, twist = fsolve(residual, [0.0, 0.0], xtol=1e-15)
    assert twist * n < -0.05
    scene = jaxrod.make_scene(rod, muscles)
    state = strained(rod, (0.0, 0.0, twist * n), strain)
    forces, couples = loads(scene, state)
    inner = slice(2, -2)
    record(
        "Helical muscles all around: loads at the computed twist and strain, inner "
        "nodes",
        "zero, relative to EA and EI/L",
        max(
            np.max(np.abs(forces[:, inner])) / (YOUNG * AREA),
            np.max(np.abs(couples[:, inner])) / BENDING,
        ),
        at_most=1e-12,
    )


def test_an_active_curvature_is_taken_as_it_is(bar):
    rod, _ = bar
    bent = (2.0, -1.0, 0.5)
    shape = jaxrod.actuation.active_shape(
        rod,
        curvature=jaxrod.schedules.ramp((0.0, 0.0, 0.0), bent, 0.1),
        strain=(0.0, 0.0, 0.1),
    )
    assert balance(rod, shape, bent, 0.1) < 1e-12


def test_a_still_wave_bends_each_joint_by_its_moment(bar):
    rod, state = bar
    into = jaxrod.clamp(state)
    wave = jaxrod.actuation.travelling_wave(
        rod, 0.3 * BENDING, period=0.8, wavelength=1e9, axis=(0, 1, 0), into=into
    )
    bent = (0.0, 0.3, 0.0)  # A quarter of a period has passed.
    curled = strained(rod, bent, 0.0, into=into)
    scene = jaxrod.make_scene(rod, at_once(wave), into)
    forces, couples = loads(scene, curled)
    assert max(np.max(np.abs(forces)), np.max(np.abs(couples))) < 1e-8 * BENDING


def straight_tendon(n, pull, offset, stretch):
    """Joint angle under a straight tendon, exact for every n."""
    length = 1 / n

    def residual(angle):
        lever = length * stretch / 2 * np.sin(angle / 2) + offset * np.cos(angle / 2)
        return angle / length - pull * lever

    return brentq(residual, 0.0, 2.0, xtol=1e-15) * n


TENDON = {5: 0.55467, 10: 0.51265, 20: 0.50310, 40: 0.50077}


@pytest.mark.slow
@pytest.mark.parametrize("n", TENDON)
def test_a_straight_tendon_bends_a_rod(n, record):
    """EI = 1, offset 0.05, tension 10, and a rod that hardly stretches."""
    rod, state = unit_rod(n, 0.02)
    rod = replace(rod, shear_stretch_stiffness=1e9 * rod.shear_stretch_stiffness)
    scene = jaxrod.make_scene(
        rod,
        jaxrod.fixed_end(state),
        jaxrod.actuation.tendon(rod, (0.05, 0.0), tension=10.0),
    )
    found = jaxrod.equilibrium(scene, state)
    curvature = jaxrod.strains(rod, found.state)[1]
    exact = straight_tendon(n, 10.0, 0.05, 1.0)
    assert found.converged
    assert exact == pytest.approx(TENDON[n], abs=1e-5)
    record(
        f"Curvature under a straight tendon, n = {n}",
        f"{exact:.5f}, joint by joint (continuum: T a/EI = 0.5)",
        np.max(np.abs(curvature[1] - exact)),
        at_most=1e-9,
    )


def unit_rod(n, radius, **changes):
    """A rod 1 m long with EI = 1 N m^2."""
    return arm(n, radius=radius, youngs_modulus=4 / (np.pi * radius**4), **changes)


@pytest.mark.slow
def test_a_helical_tendon_follows_the_coupled_ode(record):
    """The base is clamped; section strains and the tendon's force in balance."""
    n, pull, offset, turns, radius = 40, 12.0, 0.05, 0.75, 0.02
    rod, state = unit_rod(n, radius)
    middles = (np.arange(n) + 0.5) / n
    angles = 2 * np.pi * turns * middles
    eyelets = offset * np.stack([np.cos(angles), np.sin(angles)])[None]
    cable = jaxrod.actuation.tendon(rod, eyelets, tension=pull)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), cable)
    found = jaxrod.equilibrium(scene, state)
    assert found.converged
    stiff = np.asarray(rod.shear_stretch_stiffness[:, 0])
    bend = np.asarray(rod.bend_twist_stiffness[:, 0])

    def section(s):
        """Strains at which the section is in balance with the tendon alone."""
        a = 2 * np.pi * turns * s
        p = offset * np.array([np.cos(a), np.sin(a), 0.0])
        slope = 2 * np.pi * turns * offset * np.array([-np.sin(a), np.cos(a), 0.0])

        def residual(unknown):
            strain, bent = unknown[:3], unknown[3:]
            along = np.array([0, 0, 1]) + strain + np.cross(bent, p) + slope
            force = pull * along / np.linalg.norm(along)
            return np.concatenate(
                [stiff * strain + force, bend * bent + np.cross(p, force)]
            )

        return fsolve(residual, np.zeros(6), xtol=1e-12)

    def slope(s, y):
        frame = y[3:].reshape(3, 3)
        strain, bent = np.split(section(s), 2)
        skew = np.cross(np.eye(3), bent)
        return np.append(frame @ np.add(strain, (0, 0, 1)), frame @ skew)

    # From the first eyelet to the last; before and after the rod is straight.
    half = 0.5 / n
    frame = np.asarray(state.directors[:, :, 0]).T
    start = np.append(half * frame[:, 2], frame)
    end = solve_ivp(slope, (half, 1 - half), start, rtol=1e-8, atol=1e-10).y[:, -1]
    tip = end[:3] + half * end[3:].reshape(3, 3)[:, 2]
    moved = np.linalg.norm(tip - np.asarray(state.tip))
    assert moved > 0.1
    record(
        "Tip of a rod with a helical tendon, n = 40, relative to its displacement",
        "coupled ODE of section and tendon, integrated",
        np.linalg.norm(np.asarray(found.state.tip) - tip) / moved,
        at_most=1e-2,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("load", "degrees", "angle", "across", "along"),
    [
        (1.0, 90, 0.461352, 0.301720, None),
        (2.0, 90, 0.781750, 0.493457, None),
        (5.0, 120, 1.590078, 0.807769, 0.390919),
    ],
)
def test_a_magnet_bends_as_under_a_dead_force_at_its_tip(
    load, degrees, angle, across, along, record
):
    rod, state = unit_rod(40, 0.005)
    turn = np.deg2rad(degrees)
    pull = load * np.array([np.sin(turn), 0.0, np.cos(turn)])
    wall = jaxrod.clamp(state)
    stiff = replace(rod, shear_stretch_stiffness=1e5 * rod.shear_stretch_stiffness)
    found = state, state
    for share in (0.3, 0.6, 1.0):
        magnet = jaxrod.actuation.magnetisation(
            stiff, (0.0, 0.0, 4.0), share * pull / 4
        )
        force = jaxrod.end_load(share * pull)
        one, other = (
            jaxrod.equilibrium(jaxrod.make_scene(stiff, wall, load), start)
            for load, start in zip((magnet, force), found, strict=True)
        )
        found = one.state, other.state
    assert one.converged and other.converged
    where = f"q = {load:g}, {degrees} degrees"
    record(
        f"Magnet along the rod against a dead force M A B at its tip, {where} [m]",
        "the same equilibrium of an inextensible rod",
        np.max(np.abs(one.state.positions - other.state.positions)),
        at_most=1e-8,
    )
    tip = np.asarray(one.state.tip)
    tangents = one.state.directors[2]
    bent = np.unwrap(np.arctan2(tangents[0], tangents[2]))
    # The slope at the tip, where it does not bend: from the last two middles.
    last = bent[-1] + 0.25 * (bent[-1] - bent[-2]) * 0.5
    gaps = [tip[0] - across]
    gaps += [] if along is None else [tip[2] - along]
    name = f"Magnet along the rod, n = 40, {where}"
    record(
        f"{name}: tip [lengths]",
        "elastica, by shooting",
        np.max(np.abs(gaps)),
        at_most=1e-3,
    )
    record(
        f"{name}: angle of the tip [rad]",
        "elastica, by shooting",
        abs(last - angle),
        at_most=2e-3,
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["muscle", "chamber", "active shape"])
def test_what_goes_into_the_wall_bends_a_clamped_rod_evenly(name, record):
    rod, state = arm(8)
    into = jaxrod.clamp(state)
    bent = PULL * OFFSET / BENDING
    effect = {
        "muscle": jaxrod.actuation.muscle(
            rod,
            PULL,
            offsets=(OFFSET, 0),
            curve=jaxrod.actuation.constant_force(),
            into=into,
        ),
        "chamber": jaxrod.actuation.chamber(
            rod, PULL / 1e-3, 1e-3, offsets=(-OFFSET, 0), into=into
        ),
        "active shape": jaxrod.actuation.active_shape(
            rod, curvature=(0, bent, 0), into=into
        ),
    }[name]
    # From nearly its length: pushed by the chamber alone it would buckle at first.
    stretch = PULL / (YOUNG * AREA) if name == "chamber" else 0.0
    start = strained(rod, (0.0, 0.0, 0.0), stretch)
    found = jaxrod.equilibrium(jaxrod.make_scene(rod, into, effect), start)
    assert found.converged and found.stable
    tangents = found.state.directors[2]
    angles = jnp.arctan2(tangents[0], tangents[2])
    record(
        f"Directions of a clamped rod, {name} that goes on into the wall [rad]",
        "N x s/EI at every element",
        np.max(np.abs(angles - bent * rod.arc_length_midpoints)),
        at_most=1e-9,
    )
