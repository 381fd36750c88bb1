"""Friction that has directions, against the closed forms of sliding and rolling."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.contacts.contact_law import (
    along_surface,
    directional_friction_force,
    friction_force,
)
from physics.rods import arm, difference
from physics.touching import contact_loads, moving_arm, rubbing

MASS, LENGTH, RADIUS, G, RATE = 1.0, 1.0, 0.025, 9.80665, 5000.0
DENSITY = MASS / (np.pi * RADIUS**2 * LENGTH)
STATIC, KINETIC = 0.4, 0.2
ROD, STATE = arm(3, radius=RADIUS, density=DENSITY, youngs_modulus=1e6)
DT = 1e-4


@jax.jit
def energies(scene, state, n_steps):
    """Energies of translation and rotation of a rod that moves as a whole [J]."""
    after = jaxrod.advance(scene, state, DT, n_steps)
    speeds = jnp.sum(after.velocities**2, axis=0)
    spins = jnp.sum(after.angular_momenta**2, axis=0)
    return (
        0.5 * jnp.sum(ROD.node_masses * speeds),
        0.5 * jnp.sum(spins / ROD.inertias[1]),
    )


def on_ground(
    duration, friction, *, stick=1.0, force=0.0, couple=0.0, speed=0.0, slope=0.0
):
    """Energies of a rod along z on a plane, pushed along itself, turned, thrown."""
    normal, down = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    pull = G * (np.sin(slope) * down - np.cos(slope) * normal)
    line = MASS / LENGTH
    depth = 0.02 * RADIUS
    ground = jaxrod.contact(
        jaxrod.shapes.plane(-RADIUS * normal, normal),
        stiffness=line * G * np.cos(slope) / depth,
        damping=200.0 * line,
        friction=friction,
        friction_drag=RATE * line,
    )
    scene = jaxrod.make_scene(
        ROD,
        jaxrod.gravity(pull),
        jaxrod.uniform_load((0, 0, force / LENGTH), (0, 0, couple / LENGTH)),
        replace(ground, stick_ratio=jnp.asarray(stick)),
    )
    resting = STATE.positions - depth * normal[:, None]
    thrown = jnp.zeros_like(STATE.velocities).at[0].set(speed)
    start = replace(STATE, positions=resting, velocities=thrown)
    return [float(e) for e in energies(scene, start, round(duration / DT))]


def slid(duration, force, friction):
    return duration**2 / (2 * MASS) * (abs(force) - friction * MASS * G) ** 2


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(("force", "friction"), [(10.0, 0.4), (-10.0, 0.2)])
def test_a_rod_slides_along_itself_forward_and_backward(force, friction, record):
    moved, turned = on_ground(0.25, (0.4, 0.2, 1.0), force=force)
    exact = slid(0.25, force, friction)
    assert exact == pytest.approx({10: 1.15419, -10: 2.01938}[force], rel=1e-4)
    record(
        f"Energy of a rod pushed along itself on the ground, {force:g} N",
        "T^2/2m (F - mu m g)^2",
        abs(moved / exact - 1),
        at_most=5e-3,
    )
    # Friction acts below the rod's axis, and tilts it a little.
    assert turned < 1e-6


def test_a_rod_pushed_too_gently_stays(record):
    moved, _ = on_ground(0.25, (0.4, 0.2, 1.0), force=1.0)
    record("Energy of a rod that friction holds [J]", "0", moved, at_most=1e-6)


def test_a_thrown_rod_rolls_on(record):
    moved, turned = on_ground(1.0, (0.4, 0.2, 0.4), speed=1.0)
    for name, found, exact in (
        ("translation", moved, 0.5 * MASS / 1.5**2),
        ("rotation", turned, 0.25 * MASS / 1.5**2),
    ):
        record(
            f"Energy of {name} of a thrown rod that rolls on",
            "m V^2 / 2 (1 + c)^2, times c, c = 1/2",
            abs(found / exact - 1),
            at_most=5e-3,
        )


@pytest.mark.parametrize(
    ("slope", "translation", "rotation"),
    [(0.1 * np.pi, 0.51019, 0.25510), (0.4 * np.pi, 9.5061, 0.091835)],
)
def test_a_rod_rolls_down_a_slope_or_slips(slope, translation, rotation, record):
    """It sticks up to tan(slope) = 3 STATIC, and slips with KINETIC beyond."""
    friction = (1.0, 1.0, KINETIC)
    found = on_ground(0.5, friction, stick=STATIC / KINETIC, slope=slope)
    for name, energy, exact in zip(
        ("translation", "rotation"), found, (translation, rotation), strict=True
    ):
        record(
            f"Energy of {name} of a rod on a slope of {slope / np.pi:.1f} pi",
            "rolling within the cone of friction, slipping beyond",
            abs(energy / exact - 1),
            at_most=5e-3,
        )


@pytest.mark.parametrize("share", [0.5, 3.0])
def test_a_rod_that_is_turned_rolls_or_spins(share, record):
    largest = 1.5 * STATIC * MASS * G * RADIUS
    friction = (1.0, 1.0, KINETIC)
    moved, _ = on_ground(0.5, friction, stick=STATIC / KINETIC, couple=share * largest)
    rolling = 2 / MASS * (0.5 * share * largest / (3 * RADIUS)) ** 2
    spinning = 0.5 * MASS * (KINETIC * G * 0.5) ** 2
    record(
        f"Energy of a rod turned by {share:g} of the couple that rolls it",
        "2/m (T C / 3 r)^2 or m (mu g T)^2 / 2",
        abs(moved / (rolling if share < 1 else spinning) - 1),
        at_most=5e-3,
    )


def any_slips(count=300):
    random = np.random.default_rng(0)
    sizes = 10 ** random.uniform(-3, 1, count)
    slips = random.normal(size=(3, count)) * sizes
    slips[1] = 0.0
    return jnp.asarray(slips)


PUSH, DRAG = jnp.asarray(3.0), jnp.asarray(7.0)
AXIS = tuple(jnp.asarray(c) for c in (0.6, 0.0, 0.8))


@jax.jit
def pushed(slips, numbers, stick):
    """Friction under a slip, and its slope, of every row."""

    def force(slip):
        found = directional_friction_force(
            PUSH, tuple(slip), AXIS, numbers, DRAG, stick
        )
        return jnp.stack(found)

    return jax.vmap(lambda slip: (force(slip), jax.jacfwd(force)(slip)))(slips)


def test_friction_alike_in_all_directions_is_that_without():
    same, _ = pushed(any_slips().T, 0.3 * jnp.ones(3), jnp.asarray(1.0))
    plain = friction_force(PUSH, tuple(any_slips()), jnp.asarray(0.3), DRAG)
    assert difference(same.T, jnp.stack(plain)) < 1e-15


@pytest.mark.parametrize("stick", [1.0, 2.0])
@pytest.mark.parametrize("friction", [(0.1, 0.15, 0.2), (0.4, 0.0, 0.1), (0, 1, 0)])
def test_directional_friction_is_no_steeper_than_its_drag(friction, stick):
    """Nor larger than its limit, and it takes energy."""
    slips, numbers = any_slips().T, jnp.asarray(friction, float)
    forces, slopes = pushed(slips, numbers, jnp.asarray(stick))
    steepest = np.linalg.norm(slopes, ord=2, axis=(1, 2)).max()
    assert 0.5 * DRAG < steepest <= 1.05 * DRAG
    limit = max(friction) * PUSH * stick
    assert np.linalg.norm(forces, axis=1).max() <= limit
    assert np.all(np.sum(np.multiply(forces, slips), axis=1) <= 0)


@pytest.mark.parametrize(("stick", "holds"), [(1.5, 1.181), (2.0, 1.487), (2.802, 2.0)])
def test_what_a_stick_ratio_holds(stick, holds, record):
    """Sticking grows as slip vanishes, and all friction vanishes with it."""
    slips = np.zeros((2000, 3))
    slips[:, 0] = np.linspace(0.01, 10.0, 2000)
    forces, _ = pushed(jnp.asarray(slips), 0.3 * jnp.ones(3), jnp.asarray(stick))
    record(
        f"Largest friction with a stick ratio of {stick:g}, divided by sliding "
        "friction",
        f"{holds:g}",
        float(jnp.max(jnp.abs(forces)) / (0.3 * PUSH)),
        between=(holds - 1e-3, holds + 1e-3),
    )


def test_an_axis_along_the_normal_has_no_direction():
    up = tuple(jnp.asarray(c) for c in (0.0, 1.0, 0.0))

    @jax.jit
    def flat(axis):
        return jnp.stack(along_surface(tuple(axis), up))

    assert difference(flat(jnp.asarray([0.0, 1.0, 0.0])), jnp.zeros(3)) == 0
    oblique = flat(jnp.asarray([0.6, 0.8, 0.0]))
    assert difference(oblique, jnp.asarray([1.0, 0.0, 0.0])) < 1e-11
    assert np.all(np.isfinite(jax.jacfwd(flat)(jnp.asarray([0.0, 1.0, 0.0]))))


BAD = {
    "friction must have shape": {"friction": (0.1, 0.2)},
    "friction must be non-negative": {"friction": (0.1, -0.2, 0.3)},
    "stick_ratio must be at least 1": {"friction": 0.1, "stick_ratio": 0.5},
    "friction needs friction_drag": {"friction": (0.1, 0.2, 0.3)},
}


@pytest.mark.parametrize("words", BAD)
def test_bad_friction_is_refused_in_words(words):
    body = jaxrod.shapes.plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    numbers = {"stiffness": 1.0, "damping": float("needs" not in words)} | BAD[words]
    with pytest.raises(ValueError, match=words):
        jaxrod.contact(body, **numbers)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.0, 0.5])
def test_gradients_through_directional_friction(speed, record):
    rod, state = moving_arm(speed=speed)
    middle = state.positions[:, 3]

    def moved(numbers):
        # Some nodes are at the onset, some deep inside, some outside.
        body = jaxrod.shapes.plane(middle, (0.1, 1.0, 0.2))
        touch = rubbing(body, friction=numbers[:3], stick_ratio=numbers[3])
        scene = jaxrod.make_scene(rod, touch, jaxrod.gravity((0.0, -9.0, 1.0)))
        end = jaxrod.advance(scene, state, 1e-5, 6)
        weights = jnp.cos(jnp.arange(end.velocities.size)).reshape(3, -1)
        return jnp.sum(weights * end.velocities)

    numbers = jnp.asarray([0.3, 0.5, 0.8, 1.4])
    value, slope = jax.jit(moved), jax.jit(jax.grad(moved))(numbers)
    step = 1e-4
    differences = [
        (value(numbers + step * e) - value(numbers - step * e)) / (2 * step)
        for e in np.eye(4)
    ]
    error = np.max(np.abs(slope - np.stack(differences))) / np.max(np.abs(slope))
    record(
        f"Gradient through directional friction at {speed:g} m/s",
        "central differences",
        error,
        at_most=1e-6,
    )
    batch = jnp.stack([numbers, 0.5 * numbers + 0.6])
    together = jax.jit(jax.vmap(moved))(batch)
    assert difference(together, jnp.stack([value(each) for each in batch])) < 1e-13


@pytest.mark.slow
def test_directional_friction_of_a_bent_rod_on_a_ball_is_finite():
    rod, state = moving_arm()
    ball = jaxrod.shapes.sphere(state.positions[:, 3], 0.1)
    forces, couples = contact_loads(rubbing(ball, friction=(0.1, 0.5, 1.0)), rod, state)
    assert np.all(np.isfinite(forces)) and np.any(couples)
