"""The stable step over decades of drag, damping, stiffness and friction.

A floor pressed on by a rod has them all: its spring and dashpot act across it, friction
drags along it and turns the rod, which is also damped.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.rods import arm
from physics.step_map import measured_limit

RADIUS = 0.02
DECADES = 10.0 ** np.arange(-3, 4)
USUAL = {"stiffness": 0.5, "damping": 0.1, "drag": 0.1, "moving": 1e-3, "turning": 1e-3}
"""In units of the highest frequency of the rod and of its mass per length."""


def pressed(n, method=None, dtype=jnp.float64, faces=True):
    """A rod in equilibrium with a floor, as a function of numbers, and its state.

    Without faces its ends count as if the rod went on there.
    """
    rod, state = arm(n, radius=RADIUS, dtype=dtype)
    bare = jaxrod.make_scene(rod, method=method or jaxrod.consistent())
    frequency = jaxrod.stable_dt(bare, 1.0).angular_frequency
    line, depth = rod.linear_density[0], 0.1 * RADIUS
    floor = jaxrod.shapes.plane((0.0, depth - RADIUS, 0.0), (0.0, 1.0, 0.0))
    contact = jaxrod.contact(floor, stiffness=1, damping=1, friction=0.5)
    contact = contact if faces else contact.with_free_ends(jnp.zeros(2))
    contact = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), contact)
    still = jaxrod.exponential_damping(1.0, 1.0)
    down = jaxrod.uniform_load(jnp.asarray([0.0, -1.0, 0.0], dtype))
    made = jaxrod.make_scene(rod, down, contact, still, method=bare.method)

    def scene(stiffness, damping, drag, moving, turning):
        force = stiffness * frequency**2 * line
        return replace(
            made,
            effects=(
                jaxrod.uniform_load(jnp.asarray([0.0, -depth, 0.0], dtype) * force),
                replace(
                    contact,
                    stiffness=force,
                    damping=damping * frequency * line,
                    friction_drag=drag * frequency * line,
                ),
                jaxrod.exponential_damping(moving * frequency, turning * frequency),
            ),
        )

    return scene, state


def steps_along(name, values, dtype=jnp.float64, method=None, faces=True, **numbers):
    """Steps as one number goes through some values, compiled once for all."""
    scene, _ = pressed(2, method, dtype, faces)

    def step(value):
        given = {k: jnp.asarray(v, dtype) for k, v in (USUAL | numbers).items()}
        return jaxrod.stable_dt(scene(**given | {name: value}), 1.0)

    return jax.jit(jax.vmap(step))(jnp.asarray(values, dtype))


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("name", ["stiffness", "damping", "drag"])
def test_more_stiffness_or_drag_never_allows_a_larger_step(name, dtype):
    values = np.geomspace(1e-3, 1e3, 61)
    found = steps_along(name, values, dtype)
    assert found.dt.dtype == dtype
    rounding = 1e-5 if dtype == jnp.float32 else 1e-12
    assert np.all(np.diff(found.dt) <= rounding * found.dt[1:])
    assert np.max(found.uncertainty) < rounding


@pytest.mark.slow
def test_the_step_has_a_derivative_both_ways():
    """The search is not differentiated: the balance that defines the step is."""
    scene, _ = pressed(4)

    def step(drag):
        return jaxrod.stable_dt(scene(**USUAL | {"drag": drag}), 1.0).dt

    drag, h = jnp.asarray(USUAL["drag"]), 1e-4 * USUAL["drag"]
    expected = (step(drag + h) - step(drag - h)) / (2 * h)
    assert expected < 0
    np.testing.assert_allclose(jax.grad(step)(drag), expected, rtol=1e-6)
    np.testing.assert_allclose(jax.jacfwd(step)(drag), expected, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("method", [jaxrod.consistent(), jaxrod.pyelastica()])
def test_more_damping_never_asks_for_a_smaller_step(method):
    values = np.geomspace(1e-3, 1e3, 61)
    numbers = {"damping": 0.0, "drag": 0.0, "stiffness": 1e-9}
    for name, other in (("moving", "turning"), ("turning", "moving")):
        for rate in (1e-3, 1e3):
            found = steps_along(name, values, method=method, **numbers | {other: rate})
            assert np.all(np.diff(found.dt) >= -1e-12 * found.dt[1:])
            assert np.max(found.uncertainty) < 1e-12


@pytest.mark.slow
def test_what_drag_allows_is_its_quadratic_equation():
    """With all inertia and drag alike: k h^2 + 2 c h = 4 m."""
    drag = np.geomspace(1e-3, 1e3, 13)
    numbers = {"damping": 0.0, "moving": 0.0, "turning": 0.0}
    found = steps_along("drag", drag, faces=False, **numbers)
    # A point's velocity by impulse is five times a node's: it is on a round section.
    rate = 5 * drag * _frequency()
    alone = found.angular_frequency
    expected = 4 / (rate + np.sqrt(rate**2 + 4 * alone**2))
    np.testing.assert_allclose(found.dt, expected, rtol=2e-3)


def _frequency():
    rod, _ = arm(2, radius=RADIUS)
    return float(jaxrod.stable_dt(jaxrod.make_scene(rod), 1.0).angular_frequency)


def shares(n, method, cases):
    """The stable step over the measured limit, for each of some cases."""
    scene, state = pressed(n, method)
    found = []
    for numbers in cases:
        made = scene(**USUAL | numbers)
        bound = float(jaxrod.stable_dt(made, 1.0).dt)
        found.append(bound / measured_limit(made, state, bound))
    return np.asarray(found)


@pytest.mark.slow
def test_the_step_is_safe_and_close_with_much_friction_and_damping():
    cases = [
        {"drag": 1.0},
        {"drag": 100.0},
        {"drag": 0.3, "stiffness": 10.0},
        {"damping": 10.0},
        {"drag": 3.0, "turning": 0.3},
        {"moving": 10.0, "turning": 10.0},
        {"drag": 1.0, "turning": 100.0},
        {"drag": 10.0, "turning": 1000.0},
        {"drag": 10.0, "moving": 100.0},
    ]
    found = shares(2, jaxrod.consistent(), cases)
    assert np.all((found > 0.5) & (found < 1 + 2e-3))


@pytest.mark.slow
@pytest.mark.parametrize("n", [5, 12])
@pytest.mark.parametrize("name", ["stiffness", "damping", "drag", "internal damping"])
@pytest.mark.parametrize("mode", ["consistent", "pyelastica"])
def test_the_step_is_safe_and_close_over_six_decades(mode, name, n, record):
    if name == "internal damping":
        cases = [{"moving": x, "turning": x} for x in DECADES]
    else:
        cases = [{name: x} for x in DECADES]
    found = shares(n, getattr(jaxrod, mode)(), cases)
    # Rates of more than the highest frequency make any step of PyElastica's stable.
    found = found[found > 0]
    feature = (
        f"Stable step divided by the true limit, {mode} mode, {name} over 6 decades"
    )
    reference = f"eigenvalues of a step, touching, n = {n}"
    record(f"{feature}: largest", reference, np.max(found), at_most=1 + 2e-3)
    record(f"{feature}: least", reference, np.min(found), between=(0.5, 1.0))


DRAGS = [1.0, 1.2, 1.5, 2.0, 3.0, 4.0, 6.0]


def hanging_over_a_cylinder(drag, n=100):
    """A rope for a cylinder, with contact as stiff as a quarter of its stretching."""
    radius, modulus, line = 1e-3, 3e5, 1000.0 * np.pi * 1e-6
    rod, _ = jaxrod.straight_rod(
        n,
        length=0.85,
        radius=radius,
        density=1000.0,
        youngs_modulus=modulus,
        shear_modulus=1e5,
        dtype=jnp.float64,
    )
    alone = jaxrod.stable_dt(jaxrod.make_scene(rod), 1.0).dt
    stiffness = line * (0.5 / alone) ** 2
    rub = jnp.sqrt(stiffness * line)
    cylinder = jaxrod.shapes.cylinder((0, 0, -1), (0, 0, 1), 0.05)
    return jaxrod.make_scene(
        rod,
        jaxrod.contact(
            cylinder,
            stiffness=stiffness,
            damping=rub,
            friction=0.3,
            friction_drag=drag * rub,
        ),
    )


@pytest.mark.slow
def test_more_drag_of_a_ropes_friction_asks_for_a_smaller_step_in_proportion(record):
    steps = [
        float(jaxrod.stable_dt(hanging_over_a_cylinder(drag), 1.0).dt) for drag in DRAGS
    ]
    record(
        "Stable step of a rope over a cylinder times the drag of its friction, largest "
        "over least",
        "between those of drag without springs and of springs without drag",
        max(a * b for a, b in zip(DRAGS, steps, strict=True)) / steps[0] / DRAGS[0],
        between=(1.0, 1.62),
    )
    assert np.all(np.diff(steps) < 0)


def _turned(vectors):
    """Vectors turned about an odd axis."""
    axis = np.asarray([0.36, 0.48, 0.8]) * 1.1
    x, y, z = axis
    cross = np.asarray([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.linalg.norm(axis)
    matrix = (
        np.eye(3)
        + np.sin(angle) / angle * cross
        + (1 - np.cos(angle)) / angle**2 * cross.dot(cross)
    )
    return matrix.dot(np.asarray(vectors).T).T


FIELDS = {
    "a ramp": lambda turn: jaxrod.schedules.ramp(
        turn([3.0, 0, 0]), turn([0, 1.0, 2.0]), 1.0
    ),
    "a sine": lambda turn: jaxrod.schedules.sine(
        turn([3.0, 0, 1.0]), 1.0, mean=turn([0, 1.0, 2.0])
    ),
    "a table": lambda turn: jaxrod.schedules.table(
        [0.0, 1.0, 2.0], turn([[3.0, 0, 1.0], [0, -1.0, 2.0], [0, 2.9, 0]])
    ),
}


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("name", FIELDS)
def test_a_step_is_the_same_if_a_scheduled_field_is_turned(name):
    rod, _ = arm(4)
    moment = 1e5 * np.asarray([0.3, 0.0, 1.0])
    made = [
        jaxrod.make_scene(
            rod, jaxrod.actuation.magnetisation(rod, moment, FIELDS[name](turn))
        )
        for turn in (np.asarray, _turned)
    ]
    one, other = (float(jaxrod.stable_dt(scene, 1.0).dt) for scene in made)
    assert abs(one / other - 1) < 1e-12
    bare = float(jaxrod.stable_dt(jaxrod.make_scene(rod), 1.0).dt)
    assert one < 0.999 * bare
    # At no time is the bound below what the values of that time ask for.
    for time in np.linspace(0, 2, 21):
        assert one <= float(jaxrod.stable_dt(made[0].at(time), 1.0).dt) * (1 + 1e-12)
