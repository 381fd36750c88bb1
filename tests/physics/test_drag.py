"""Drag of fluids against closed forms, whatever the step."""

from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.rods.motion import motion_of
from physics.rods import arm, deformed, difference, random_rod

N, RADIUS, WATER = 3, 0.02, 1000.0
G, ALONG, ACROSS = 9.81, 300.0, 600.0
ROD, STATE = arm(N, radius=RADIUS)
LINE = float(ROD.linear_density[0])
PER_SPEED = WATER * RADIUS / LINE  # times the coefficient [1/m]


@jax.jit
def falling(scene, velocity, dt, n_steps):
    """Velocity of a straight rod along z after steps that leave it straight."""
    start = replace(STATE, velocities=jnp.tile(velocity[:, None], N + 1))
    after = jaxrod.advance(scene, start, dt, n_steps)
    return after.velocities


def fallen(drag, velocity=(0.0, 0.0, 0.0), pull=(0.0, 0.0, 0.0), dt=1e-4, steps=7):
    scene = jaxrod.make_scene(ROD, jaxrod.gravity(pull), drag)
    found = np.asarray(falling(scene, jnp.asarray(velocity), dt, steps))
    assert np.ptp(found, axis=1).max() < 1e-12 * (1 + np.abs(found).max())
    return found[:, 0]


@pytest.mark.parametrize("dt", [1e-4, 3e-4])
def test_drag_that_grows_with_speed_is_exact_along_and_across(dt, record):
    drag = jaxrod.fluids.quadratic_drag(WATER, across=1.2, along=0.1)
    across, along = 1.2 * PER_SPEED, np.pi * 0.1 * PER_SPEED
    for direction, rate in (((0.6, 0.8, 0.0), across), ((0.0, 0.0, -1.0), along)):
        towards, speed = np.array(direction), 40.0
        left = fallen(drag, velocity=speed * towards, dt=dt)
        exact = speed / (1 + rate * speed * 7 * dt) * towards
        np.testing.assert_allclose(left, exact, atol=1e-12 * speed)
        terminal = np.sqrt(G / rate)
        for start in (terminal, 0.0):
            fell = fallen(drag, start * towards, G * towards, dt, 40)
            turn = np.sqrt(G * rate) * 40 * dt
            exact = terminal * (1 if start else np.tanh(turn))
            error = np.max(np.abs(fell - exact * towards)) / terminal
            record(
                f"Fall through water, {'along' if direction[2] else 'across'}, from "
                f"{'terminal speed' if start else 'rest'}, step {dt:g} s",
                "sqrt(a/q) tanh(t sqrt(a q))",
                error,
                at_most=1e-12,
            )


@pytest.mark.parametrize("dt", [1e-4, 4e-4])
def test_sedimentation_is_exact_and_twice_as_fast_along(dt, record):
    wind = np.array([0.3, -0.2, 0.5])
    drag = jaxrod.fluids.stokes_drag(ALONG, ACROSS, flow=wind)
    speeds = []
    for direction, zeta in (((0.6, 0.8, 0.0), ACROSS), ((0.0, 0.0, 1.0), ALONG)):
        towards = np.array(direction)
        fell = fallen(drag, pull=G * towards, dt=dt, steps=400) - wind
        # Exact on the way too: 400 steps are a few times the time of relaxation.
        late = 1 - np.exp(-zeta / LINE * 400 * dt)
        slow = -wind * np.exp(-np.array([ACROSS, ACROSS, ALONG]) / LINE * 400 * dt)
        speed = LINE * G / zeta
        error = np.max(np.abs(fell - speed * late * towards - slow)) / speed
        speeds.append(speed)
        record(
            f"Sedimentation {'along' if direction[2] else 'across'} a rod, step {dt:g}",
            "F / (zeta L)",
            error,
            at_most=1e-10,
        )
    assert speeds[1] / speeds[0] == 2.0


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    "section",
    [
        jaxrod.circle(RADIUS),
        jaxrod.rectangle(width=0.04, height=0.01),
        jaxrod.rectangle(width=0.01, height=0.04),
        jaxrod.ellipse(0.03, 0.01),
    ],
)
def test_a_rod_of_any_section_stops_turning_by_its_polar_inertia(section):
    rod, state = arm(N, radius=None, section=section)
    dt, steps, rate = 5e-5, 50, 400.0
    polar = jnp.sum(rod.principal_inertias[:2], axis=0) / rod.rest_lengths
    np.testing.assert_allclose(rod.rotary_inertia[-1], polar, rtol=1e-12)
    turning = rate * float(polar[0])
    spinning = jaxrod.with_angular_velocities(
        rod, state, jnp.zeros((3, N)).at[2].set(2.0)
    )
    drag = jaxrod.fluids.stokes_drag(0.0, 0.0, turning)
    couple = drag.loads(rod, motion_of(spinning)).couples[2]
    np.testing.assert_allclose(couple, -2.0 * turning * rod.rest_lengths, rtol=1e-12)
    after = jaxrod.advance(jaxrod.make_scene(rod, drag), spinning, dt, steps)
    left = motion_of(after).angular_velocities(rod)[2]
    np.testing.assert_allclose(left, 2.0 * np.exp(-rate * dt * steps), rtol=1e-10)


def test_rates_of_drag_and_of_damping_add_up():
    """In still fluid, along a rod and across it."""
    rate, dt, steps = 200.0, 1e-4, 7
    scene = jaxrod.make_scene(
        ROD, jaxrod.fluids.stokes_drag(ALONG, ACROSS), jaxrod.exponential_damping(rate)
    )
    begun = np.array([0.3, -0.2, 0.5])
    found = np.asarray(falling(scene, jnp.asarray(begun), dt, steps))
    slower = np.array([ACROSS, ACROSS, ALONG]) / LINE + rate
    expected = begun * np.exp(-slower * dt * steps)
    np.testing.assert_allclose(found, expected[:, None] + 0 * found, rtol=1e-10)


@pytest.mark.slow
def test_drag_and_damping_together():
    """Damping slows the rod itself, drag what it does relative to the flow."""
    drag = jaxrod.fluids.stokes_drag(ALONG, ACROSS, flow=(1.0, 0.0, 0.0))
    scene = jaxrod.make_scene(
        ROD, jaxrod.gravity((0, 0, 0)), drag, jaxrod.exponential_damping(200.0)
    )
    end = np.asarray(falling(scene, jnp.zeros(3), 4e-4, 400))
    rate = ACROSS / LINE
    np.testing.assert_allclose(end[0], rate / (rate + 200.0), rtol=1e-12)


@jax.jit
def loads(effect, rod, state):
    """Forces on the nodes, world frame [N]."""
    return jnp.stack(effect.loads(rod, motion_of(state)).forces)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("slope", "speed"),
    [(0.1, -0.004944), (0.3, -0.040876), (0.6, -0.128579), (1.0, -0.238752)],
)
def test_a_prescribed_swimmer(slope, speed, record):
    """A sine wave travels along a rod; it swims where no force is left over."""
    n = 300
    x = np.linspace(0.0, 2 * np.pi, n + 1)
    curve = np.stack([x, slope * np.sin(x), 0 * x])
    rod, state = jaxrod.rod_along(
        curve, radius=0.01, density=1.0, youngs_modulus=1.0, normal=(0, 0, 1)
    )
    drag = jaxrod.fluids.stokes_drag(1.0, 2.0)

    def force(velocity):
        moving = replace(state, velocities=jnp.asarray(velocity))
        # The ends are one place of the wave, and have half an element each.
        return float(jnp.sum(loads(drag, rod, moving)[0]))

    wave = force(np.stack([0 * x, -slope * np.cos(x), 0 * x]))
    drift = force(np.stack([1 + 0 * x, 0 * x, 0 * x]))
    record(
        f"Swimming speed over wave speed, amplitude times wave number {slope:g}",
        "resistive-force theory",
        abs(-wave / drift / speed - 1),
        at_most=1e-3,
    )


@pytest.mark.slow
def test_drag_of_a_node_is_no_larger_than_its_bound():
    """And takes energy, however the rod is bent and moves."""
    rod, _ = random_rod(3, 6)
    state = deformed(rod, 1, speed=2.0)
    drag = jaxrod.fluids.stokes_drag(1.0, 3.0, 0.01)
    found = drag.loads(rod, motion_of(state))
    forces = jnp.stack(found.forces)
    power = jnp.sum(forces * state.velocities, axis=0)
    speeds = jnp.sum(state.velocities**2, axis=0)
    bound = drag.stability_bound(rod)
    assert jnp.all(power < 0) and jnp.all(-power <= bound.node_drag * speeds)
    spins = jaxrod.angular_velocities(rod, state)
    assert not jnp.any(jnp.stack(found.couples)[:2])
    np.testing.assert_allclose(found.couples[2], -bound.element_drag * spins[2])


@pytest.mark.parametrize("radius", [RADIUS, (RADIUS, 0.05 * RADIUS)])
def test_drag_of_slender_bodies_takes_no_more_power_than_its_bound(radius):
    """Its matrix is symmetric only for nodes of equal mass."""
    rod, state = arm(5, radius=radius)
    drag = jaxrod.fluids.slender_body_drag(1.0)

    def across(speeds):
        zero = jnp.zeros_like(speeds)
        moving = replace(motion_of(state), velocity=(speeds, zero, zero))
        return -drag.loads(rod, moving).forces[0]

    matrix = np.asarray(jax.jacfwd(across)(jnp.zeros(6)))
    root = np.sqrt(np.asarray(drag.stability_bound(rod).node_drag))
    power = 0.5 * (matrix + matrix.T) / root[:, None] / root[None, :]
    assert 0.9 < np.linalg.eigvalsh(power)[-1] < 1 + 1e-12


@pytest.mark.slow
def test_solved_drag_does_not_limit_the_step_and_explicit_drag_does():
    drag = jaxrod.fluids.stokes_drag(1e5, 1e5)
    free = jaxrod.stable_dt(jaxrod.make_scene(ROD)).dt
    assert jaxrod.stable_dt(jaxrod.make_scene(ROD, drag)).dt == free
    loaded = jaxrod.make_scene(ROD, drag, method=jaxrod.pyelastica())
    # Twice the mass over the drag, of which a safety factor is left.
    limit = 0.8 * 2 * LINE / 1e5
    np.testing.assert_allclose(jaxrod.stable_dt(loaded).dt, limit, rtol=1e-3)


def test_flows_have_a_place_and_a_time():
    def shear(point, numbers):
        return jnp.stack([numbers["rate"] * point[1], 0 * point[0], numbers["now"]])

    flow = jaxrod.fluids.flow_field(
        shear, {"rate": 3.0, "now": jaxrod.schedules.time()}
    )
    scene = jaxrod.make_scene(ROD, jaxrod.fluids.stokes_drag(1.0, 1.0, flow=flow))
    assert scene.depends_on_time
    (drag,) = scene.at(0.25).effects
    y = np.array([0.1, -2.0, 0.3, 0.5])
    state = replace(STATE, positions=jnp.asarray([0 * y, y, 0 * y]))
    flow = np.stack(drag.drag(ROD, motion_of(state)).flow)
    np.testing.assert_allclose(flow, [3 * y, 0 * y, 0 * y + 0.25], atol=1e-15)


BAD = {
    "across must be non-negative, got -1 kg": lambda: jaxrod.fluids.stokes_drag(
        1.0, -1.0
    ),
    "along must be one number or one per": lambda: jaxrod.fluids.stokes_drag(
        np.ones((2, 2)), 1.0
    ),
    "turning must be non-negative": lambda: jaxrod.fluids.stokes_drag(1.0, 1.0, -1.0),
    "flow must have shape": lambda: jaxrod.fluids.stokes_drag(
        1.0, 1.0, flow=(1.0, 2.0)
    ),
    "density must be positive": lambda: jaxrod.fluids.quadratic_drag(0.0),
    "length must be at least 10 times radius": lambda: jaxrod.fluids.slender_cylinder(
        1, 0.05, 0.02
    ),
    "viscosity must be positive": lambda: jaxrod.fluids.slender_body_drag(-1.0),
    "function must give one velocity": lambda: jaxrod.fluids.flow_field(
        lambda x, _: x[0]
    ),
    "density must be positive, got -1": lambda: jaxrod.fluids.buoyancy(-1.0),
    "coefficient must be non-negative": lambda: jaxrod.fluids.with_added_mass(
        ROD, 1.0, -1.0
    ),
    "at most one effect with drag": lambda: jaxrod.make_scene(
        ROD, jaxrod.fluids.stokes_drag(1.0, 1.0), jaxrod.fluids.quadratic_drag(1.0)
    ),
    "square of the speed has no stable step": lambda: jaxrod.make_scene(
        ROD, jaxrod.fluids.quadratic_drag(1.0), method=jaxrod.pyelastica()
    ),
}


@pytest.mark.parametrize("words", BAD)
def test_bad_input_is_refused_in_words(words):
    with pytest.raises(ValueError, match=words):
        BAD[words]()


def test_a_function_that_is_none_is_refused():
    with pytest.raises(TypeError, match="function must be callable"):
        jaxrod.fluids.flow_field(3.0)


def whirl(point, rate):
    """A flow that turns about the z axis."""
    return rate * jnp.stack([-point[1], point[0], 0 * point[2]])


def bent(speed):
    """A bent rod that moves, but for its first node, and its state."""
    rod, _ = random_rod(3, 4)
    state = deformed(rod, 1, largest_angle=0.3, speed=speed)
    # There the drag has no speed to grow with.
    return rod, replace(state, velocities=jnp.asarray(state.velocities).at[:, 0].set(0))


def dragged(numbers, kind, rod, state):
    """Where a rod is after a few steps in a fluid of given numbers."""
    flow = jaxrod.fluids.flow_field(whirl, numbers[2])
    if kind == "stokes":
        drag = jaxrod.fluids.stokes_drag(
            numbers[0], numbers[1], 1e-3 * numbers[0], flow=flow
        )
    else:
        drag = jaxrod.fluids.quadratic_drag(
            100 * numbers[1], across=1.0, along=numbers[0], flow=flow
        )
    scene = jaxrod.make_scene(rod, drag, jaxrod.gravity((0.0, 0.0, 3.0)))
    end = jaxrod.advance(scene, state, 1e-5, 6)
    weights = jnp.cos(jnp.arange(end.velocities.size)).reshape(3, -1)
    return jnp.sum(weights * end.velocities)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["stokes", "quadratic"])
@pytest.mark.parametrize("speed", [0.0, 2.0])
@pytest.mark.parametrize("whirling", [0.0, 0.7])
def test_gradients_through_drag(kind, speed, whirling, record):
    numbers, there = jnp.asarray([7.0, 20.0, whirling]), bent(speed)
    value = jax.jit(lambda numbers: dragged(numbers, kind, *there))
    slope = jax.jit(jax.grad(lambda numbers: dragged(numbers, kind, *there)))(numbers)

    def central(e, step):
        return (value(numbers + step * e) - value(numbers - step * e)) / (2 * step)

    # Drag of a fluid at rest on a rod at rest has a slope that is not smooth: the
    # error of differences falls as the step alone, and is extrapolated.
    step = 1e-5
    differences = [2 * central(e, step / 2) - central(e, step) for e in np.eye(3)]
    error = np.max(np.abs(slope - np.stack(differences))) / np.max(np.abs(slope))
    record(
        f"Gradient through {kind} drag, rod at {speed:g} m/s, flow {whirling:g} rad/s",
        "central differences",
        error,
        at_most=1e-6,
    )


@pytest.mark.slow
def test_a_batch_of_fluids_is_a_loop():
    numbers = jnp.asarray([[0.7, 2.0, 0.1], [0.1, 5.0, 0.0], [0.0, 0.5, -1.0]])
    there = bent(1.0)
    for kind in ("stokes", "quadratic"):
        one = jax.jit(lambda numbers, kind=kind: dragged(numbers, kind, *there))
        together = jax.jit(jax.vmap(one))(numbers)
        assert difference(together, jnp.stack([one(each) for each in numbers])) < 1e-13


@pytest.mark.slow
def test_drag_across_its_drive_is_of_second_order(record):
    """Gravity turns a throw through water: drive and speed point anywhere."""
    drag = jaxrod.fluids.quadratic_drag(WATER, across=1.0)
    ends = [
        fallen(drag, (30.0, -5.0, 0.0), (10.0, 900.0, 0.0), 4e-3 / k, 5 * k)
        for k in (10, 20, 40, 80)
    ]
    gaps = [np.linalg.norm(a - b) for a, b in pairwise(ends)]
    record(
        "Order in the step of a throw through water",
        "2",
        np.log2(gaps[1] / gaps[2]),
        between=(1.9, 2.1),
    )


@pytest.mark.slow
def test_a_cantilever_relaxes_in_viscous_fluid(record):
    rod, state = arm(40, radius=0.01)
    line, stiffness = float(rod.linear_density[0]), float(rod.joint_stiffness[0, 0])
    first = 1.8751**4 * stiffness / (line * float(rod.length) ** 4)
    rate = 30 * np.sqrt(first)  # of decay: inertia takes a part of 1/900 [1/s]
    drag = jaxrod.fluids.stokes_drag(0.5 * rate * line, rate * line)
    wall = jaxrod.clamp(state)
    loaded = jaxrod.make_scene(rod, wall, jaxrod.end_load((1e-3, 0.0, 0.0)))
    bent = jaxrod.equilibrium(loaded, state).state
    scene = jaxrod.make_scene(rod, wall, drag)
    dt, slow = jaxrod.stable_dt(scene).dt, first / rate
    steps = int(0.5 / slow / float(dt))
    early = jaxrod.advance(scene, bent, dt, steps)
    late = jaxrod.advance(scene, early, dt, steps)
    found = np.log(float(early.tip[0] / late.tip[0])) / (steps * float(dt))
    record(
        "Relaxation rate of a cantilever in viscous fluid, n = 40",
        "EI beta^4 / (zeta L^4), beta = 1.8751",
        abs(found / slow - 1),
        at_most=5e-3,
    )


@pytest.mark.slow
def test_a_thin_rod_turns_in_a_shear_flow(record):
    """Its angle to the flow: cot(angle) grows with the shear rate."""

    def shear(point, rate):
        return jnp.stack([rate * point[2], 0 * point[1], 0 * point[2]])

    rod, state = jaxrod.straight_rod(
        10,
        length=1.0,
        radius=0.01,
        density=1000.0,
        youngs_modulus=1e8,
        start=(-0.35, 0.0, -0.35),
        direction=(1.0, 0.0, 1.0),
        dtype=jnp.float64,
    )
    flow = jaxrod.fluids.flow_field(shear, 2.0)
    scene = jaxrod.make_scene(rod, jaxrod.fluids.stokes_drag(300.0, 600.0, flow=flow))
    dt = jaxrod.stable_dt(scene).dt
    turned = []
    for steps in (2000, 2000):
        state = jaxrod.advance(scene, state, dt, steps)
        across = state.tip - state.positions[:, 0]
        turned.append(float(across[0] / across[2]))
    rate = (turned[1] - turned[0]) / (2000 * float(dt))
    record(
        "Turning of a thin rod in shear flow",
        "Jeffery",
        abs(rate / 2 - 1),
        at_most=5e-3,
    )


@pytest.mark.slow
def test_a_rod_follows_a_flow_that_changes_in_time():
    flow = jaxrod.schedules.ramp((0.0, 0.0, 0.0), (10.0, 0.0, 0.0), 1.0)
    drag = jaxrod.fluids.stokes_drag(ALONG, ACROSS, flow=flow)
    scene = jaxrod.make_scene(ROD, drag)
    dt, steps, rate = 3e-4, 1000, ACROSS / LINE
    end = jaxrod.advance(scene, STATE, dt, steps)
    # Where steps are small, a lag of 10 / rate.
    lag = 10 * 0.5 * dt / np.tanh(0.5 * rate * dt)
    np.testing.assert_allclose(end.velocities[0], 10 * steps * dt - lag, rtol=1e-9)


def test_buoyancy_is_minus_the_gradient_of_its_energy():
    lift = jaxrod.fluids.buoyancy(900.0, (1.0, -2.0, -9.0), added_mass=0.3)

    @jax.jit
    @jax.grad
    def slope(nodes):
        return lift.energy(ROD, replace(STATE, positions=nodes))

    assert difference(loads(lift, ROD, STATE), -slope(STATE.positions)) < 1e-12


def test_a_rod_as_heavy_as_the_fluid_floats_with_added_mass_too():
    heavy = jaxrod.fluids.with_added_mass(ROD, 1000.0, 0.8)
    weight = loads(jaxrod.gravity(), heavy, STATE)
    lift = loads(jaxrod.fluids.buoyancy(1000.0, added_mass=0.8), heavy, STATE)
    assert difference(weight, -lift) < 1e-12 * float(jnp.max(jnp.abs(weight)))


@pytest.mark.slow
def test_added_mass_lowers_frequencies(record):
    rod, state = arm(20, radius=0.005)
    frequencies = []
    for one in (rod, jaxrod.fluids.with_added_mass(rod, 1500.0)):
        scene = jaxrod.make_scene(one, jaxrod.clamp(state))
        frequencies.append(float(jaxrod.natural_frequencies(scene, state)[0]))
    record(
        "First frequency of a cantilever with added mass, divided by the frequency "
        "without",
        "1 / sqrt(1 + rho_f / rho)",
        abs(frequencies[1] / frequencies[0] * np.sqrt(2.5) - 1),
        at_most=1e-3,
    )
