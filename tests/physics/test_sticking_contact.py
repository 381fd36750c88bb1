"""Static friction: rods hold, slip and roll as closed forms say."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import shapes
from jaxrod.rods.motion import motion_of

RADIUS, DENSITY, SLOPE = 0.02, 1000.0, 0.3
WEIGHT = 9.81 * DENSITY * np.pi * RADIUS**2  # per length [N/m]
STIFFNESS = WEIGHT / (0.01 * RADIUS)
CRITICAL = np.sqrt(STIFFNESS * WEIGHT / 9.81)
FALL = 9.81 * np.sin(SLOPE)
GRAVITY = (FALL, 0.0, -9.81 * np.cos(SLOPE))


def lying(friction, *effects, direction=(1.0, 0.0, 0.0), method=None, points=1):
    """A straight rod on a slope, given in the frame of the slope, at its rest depth."""
    rod, state = jaxrod.straight_rod(
        6,
        length=0.5,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=1e6,
        direction=direction,
        normal=(0.0, 0.0, 1.0),
        dtype=jnp.float64,
    )
    deep = 0.01 * RADIUS * np.cos(SLOPE)
    ground = jaxrod.contact(
        shapes.plane((0.0, 0.0, deep - RADIUS)),
        stiffness=STIFFNESS,
        damping=0.5 * CRITICAL,
        friction=friction,
        points_per_element=points,
    )
    holds = jaxrod.sticking_contact(ground, rod, state)
    given = {} if method is None else {"method": method}
    pull = jaxrod.gravity(GRAVITY)
    return jaxrod.make_scene(rod, pull, holds, *effects, **given), state


def run(scene, state, seconds, dt=5e-4):
    return jaxrod.advance(scene, state, dt, round(seconds / dt))


def place(state):
    return float(state.positions[0].mean())


METHODS = {
    "consistent": None,
    "pyelastica": jaxrod.pyelastica(),
    "planar": jaxrod.planar("zx"),
    "implicit": jaxrod.implicit(1.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_rod_on_a_slope_holds_by_the_elongation_of_its_springs(method, record):
    scene, state = lying(0.5, method=METHODS[method], points=2)
    first = run(scene, state, 1.5)
    second = run(scene, first, 0.5)
    moved = float(jnp.max(jnp.abs(second.positions - first.positions)))
    record(f"{method}: creep within half a second [m]", "0", moved, at_most=1e-9)
    needed = WEIGHT * np.sin(SLOPE) / (0.5 * STIFFNESS)
    inner = second.memory[1]["elongations"][0][0, 0, 1:-1]
    record(
        f"{method}: elongation of springs, compared with load per length / stiffness",
        "equal",
        abs(float(jnp.mean(inner)) / needed - 1),
        at_most=0.1,
    )


@pytest.mark.slow
def test_a_rod_in_float32_creeps_by_rounding_alone(record):
    rod, state = jaxrod.straight_rod(
        6,
        length=0.5,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=1e6,
        direction=(0.6, 0.8, 0.0),
        start=(0.0, 0.0, 0.995 * RADIUS),
        dtype=jnp.float32,
    )
    rough = jaxrod.contact(shapes.plane(), friction=0.5)
    holds = jaxrod.sticking_contact(rough, rod, state)
    scene = jaxrod.make_scene(rod, jaxrod.gravity((1.2, 1.6, -9.81)), holds)
    first = run(scene, state, 2.0, dt=4e-4)
    moved = jnp.abs(run(scene, first, 4.0, dt=4e-4).positions - first.positions)
    record("float32: creep [m/s]", "0", float(jnp.max(moved)) / 4, at_most=2e-7)


@pytest.mark.slow
def test_a_rod_on_a_steep_slope_slides_by_coulombs_law(record):
    scene, state = lying(0.2)
    first = run(scene, state, 0.5)
    second = run(scene, first, 0.5)
    change = float((second.velocities - first.velocities)[0].mean()) / 0.5
    record(
        "A rod along a slope beyond the limit of friction: acceleration [m/s^2]",
        "g (sin a - mu cos a)",
        abs(change / (FALL - 0.2 * 9.81 * np.cos(SLOPE)) - 1),
        at_most=1e-4,
    )


def test_a_rod_across_a_slope_rolls_without_slipping(record):
    scene, state = lying(0.5, direction=(0.0, 1.0, 0.0))
    first = run(scene, state, 0.5)
    second = run(scene, first, 0.5)
    change = float((second.velocities - first.velocities)[0].mean()) / 0.5
    deep = 0.01 * np.cos(SLOPE)
    record(
        "A rod across a slope: acceleration [m/s^2]",
        "2/3 g sin a",
        abs(change / (FALL * 2 / 3) - 1),
        at_most=2 * deep,
    )
    spins = jaxrod.angular_velocities(scene.rod, second)
    slip = second.velocities[0].mean() - RADIUS * jnp.abs(spins).max()
    record(
        "Its slip, relative to its speed",
        "0",
        abs(slip / second.velocities[0].mean()),
        at_most=2 * deep,
    )


@pytest.mark.slow
def test_springs_that_hold_keep_energy_and_springs_that_slip_lose_it(record):
    scene, state = lying(0.5)
    holds = replace(
        scene.effects[1], damping=None, friction_drag=jnp.asarray(1e-9), friction=9.0
    )
    scene = replace(scene, effects=(scene.effects[0], holds))
    start = replace(state, velocities=state.velocities.at[0].add(0.01))
    energies = []
    for dt in (2e-4, 1e-4):
        energy = jax.vmap(lambda s: scene.total_energy(s))(
            jaxrod.rollout(scene, start, dt, round(0.05 / dt), 10)
        )
        energies.append(float(jnp.ptp(energy)))
    kinetic = float(scene.kinetic_energy(start))
    record(
        "Range of the energy of a rod that swings on its springs, at half the step",
        "a quarter",
        energies[1] / energies[0],
        at_most=0.3,
    )
    assert energies[0] < 0.05 * kinetic
    slips = replace(scene, effects=(scene.effects[0], replace(holds, friction=0.01)))
    after = run(slips, start, 0.1, 1e-4)
    lost = slips.total_energy(start) - slips.total_energy(after)
    way = place(after) - place(start)
    needed = 0.01 * WEIGHT * np.cos(SLOPE) * 0.5 * way
    record(
        "Energy lost by slipping",
        "friction times distance",
        abs(lost / needed - 1),
        at_most=0.02,
    )


def test_runs_in_two_calls_are_one_run():
    scene, state = lying(0.32)
    one = jaxrod.advance(scene, state, 5e-4, 200)
    two = jaxrod.advance(scene, state, 5e-4, 77)
    two = jaxrod.advance(scene, two, 5e-4, 123, first=77)
    np.testing.assert_allclose(one.positions, two.positions, atol=1e-14)
    for name, kept in one.memory[1].items():
        for a, b in zip(
            jax.tree.leaves(kept), jax.tree.leaves(two.memory[1][name]), strict=True
        ):
            np.testing.assert_allclose(a, b, atol=1e-14)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("friction", [0.5, 0.2])
def test_gradients_agree_with_differences(friction):
    scene, state = lying(friction)

    def way(numbers):
        of_friction, slope = numbers
        pull = jnp.stack([jnp.sin(slope), 0 * slope, -jnp.cos(slope)]) * 9.81
        gravity = replace(scene.effects[0], acceleration=pull)
        holds = replace(scene.effects[1], friction=of_friction)
        end = run(replace(scene, effects=(gravity, holds)), state, 0.04)
        return end.positions[0].mean()

    at, h = jnp.array([friction, SLOPE]), 1e-6
    way = jax.jit(way)
    slopes = [(way(at + h * e) - way(at - h * e)) / (2 * h) for e in np.eye(2)]
    np.testing.assert_allclose(jax.grad(way)(at), slopes, rtol=1e-5, atol=1e-9)


@pytest.mark.slow
def test_a_rod_at_rest_is_the_equilibrium_with_friction(record):
    state = lying(0.5)[1]
    wall, force = jaxrod.clamp(state), np.array([0.0, 0.02 * WEIGHT, 0.0])
    load = jaxrod.end_load(force)
    scene, state = lying(0.5, wall, load)
    rest = jaxrod.equilibrium(scene, state)
    assert rest.converged
    assert rest.stable
    slippery = replace(
        scene,
        effects=(
            scene.effects[0],
            replace(scene.effects[1], friction=1e-6),
            wall,
            load,
        ),
    )
    sideways = [
        float(found.state.tip[1] - state.tip[1])
        for found in (rest, jaxrod.equilibrium(slippery, state))
    ]
    assert sideways[0] < 0.1 * sideways[1]
    slowly = jaxrod.end_load(jaxrod.schedules.ramp(0 * force, force, 1.0))
    moving = run(lying(0.5, wall, slowly)[0], state, 1.5)
    apart = float(jnp.max(jnp.abs(moving.positions - rest.state.positions)))
    record(
        "A rod pushed sideways on the ground: end of a run, compared with "
        "`equilibrium`",
        "equal, relative to the displacement",
        apart / sideways[0],
        at_most=0.05,
    )


POST, ROPE, MODULUS, LEG = 0.05, 0.001, 3e5, 0.15
LINE = DENSITY * np.pi * ROPE**2
AROUND = POST + ROPE


def tension_at(path, light, wrap):
    """Tension of a rope at rest over a cylinder, along its path from the light end."""
    ends = np.array([-LEG, 0.0, np.pi * AROUND])
    if path < ends[1]:
        return 9.81 * LINE * (LEG + path)
    if path > ends[2]:
        return max(9.81 * LINE * (light + ends[2] - path), 0.0)
    return wrap(path / AROUND)


def around(friction):
    """Tension over a half turn where friction is at a constant share `friction`.

    It solves dT/da = m T + w R (cos a + m sin a) for the angle a from the light side.
    """
    m, weight = friction, 9.81 * LINE * AROUND

    def at(angle):
        own = weight / (1 + m * m)
        sine, cosine = (1 - m * m) * np.sin(angle), -2 * m * np.cos(angle)
        start = 9.81 * LINE * LEG + 2 * m * own
        return start * np.exp(m * angle) + own * (sine + cosine)

    return at


def hanging_rope(friction, share, n=100):
    """A rope over a cylinder, stretched as it would hang there, and its state.

    Its heavy side is a `share` of the longest that friction holds.
    """
    most = around(friction)(np.pi) / (9.81 * LINE)
    heavy = share * most
    low, high = -friction, friction
    for _ in range(60):
        middle = 0.5 * (low + high)
        short = around(middle)(np.pi) < 9.81 * LINE * heavy
        low, high = (middle, high) if short else (low, middle)
    path = np.linspace(-LEG, np.pi * AROUND + heavy, 4001)
    stiff = MODULUS * np.pi * ROPE**2
    tension = np.array([tension_at(q, heavy, around(low)) for q in path])
    rest = np.diff(path) / (1 + 0.5 * (tension[1:] + tension[:-1]) / stiff)
    rest = np.concatenate([[0.0], np.cumsum(rest)])
    nodes = np.interp(np.linspace(0, rest[-1], n + 1), rest, path)
    angle = np.clip(nodes / AROUND, 0, np.pi)
    below = np.minimum(nodes, 0) - np.maximum(nodes - np.pi * AROUND, 0)
    places = np.stack(
        [-AROUND * np.cos(angle), 0 * nodes, AROUND * np.sin(angle) + below]
    )
    material = {"radius": ROPE, "density": DENSITY, "youngs_modulus": MODULUS}
    material |= {"poisson_ratio": 0.5, "normal": (0.0, 1.0, 0.0), "dtype": jnp.float64}
    rod, straight = jaxrod.straight_rod(
        n, length=rest[-1], direction=(0.0, 0.0, 1.0), **material
    )
    _, bent = jaxrod.rod_along(places, **material)
    state = replace(straight, positions=bent.positions, orientations=bent.orientations)
    post = shapes.cylinder((0.0, -0.1, 0.0), (0.0, 0.1, 0.0), POST)
    rough = jaxrod.contact(post, friction=friction)
    scene = jaxrod.make_scene(
        rod,
        jaxrod.gravity(),
        jaxrod.sticking_contact(rough, rod, state),
        jaxrod.exponential_damping(2.0, 2.0),
    )
    return scene, state


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.1, 0.3, 0.6])
@pytest.mark.parametrize("share", [0.5, 0.8, 0.95, 1.1, 1.5])
def test_a_rope_over_a_cylinder_holds_up_to_the_capstan_limit(friction, share, record):
    scene, state = hanging_rope(friction, share)
    dt = jaxrod.stable_dt(scene, state=state).dt
    first = jaxrod.advance(scene, state, dt, int(2 / dt))
    risen = float(first.positions[2, 0] - state.positions[2, 0])
    if share > 1:
        assert risen < -0.5  # the light end has gone over and fallen
        return
    record(
        f"Heavy rope, friction {friction}, {share} of the longest: sliding in 2 s [m]",
        "0",
        abs(risen),
        at_most=1e-3 if (friction, share) != (0.6, 0.95) else 1.6e-3,
    )
    second = jaxrod.advance(scene, first, dt, int(10 / dt), first=int(2 / dt))
    crept = float(second.positions[2, 0] - first.positions[2, 0])
    record(
        "Motion of its light end in the next 10 s [m]", "0", abs(crept), at_most=5e-5
    )


@pytest.mark.parametrize("given", [None, 3e3])
def test_numbers_that_are_left_out_halve_the_step_at_most(given):
    scene, state = lying(0.5)
    rough = jaxrod.contact(shapes.plane(), friction=0.5)
    bare = jaxrod.sticking_contact(rough, scene.rod, state, stick_stiffness=given)
    assert bare.lacks_numbers
    whole = jaxrod.make_scene(scene.rod, jaxrod.gravity(), bare)
    found = whole.effects[-1]
    assert not found.lacks_numbers
    assert found.damping > 0 and found.friction_drag > 0
    stick = 0.5 * found.stiffness if given is None else given
    np.testing.assert_allclose(found.stick_stiffness, stick, rtol=1e-12)
    free = jaxrod.stable_dt(jaxrod.make_scene(scene.rod)).dt
    assert 0.5 - 1e-6 < jaxrod.stable_dt(whole).dt / free < 0.7


@pytest.mark.slow
def test_springs_shorten_the_step_a_little_or_make_contact_softer(record):
    shorter, softer = [], []
    for n, length, radius in ((6, 0.5, 0.02), (50, 0.5, 0.005), (100, 1.0, 0.002)):
        rod, state = jaxrod.straight_rod(
            n, length=length, radius=radius, density=1000.0, youngs_modulus=1e6
        )
        plain = jaxrod.make_scene(rod, jaxrod.contact(shapes.plane(), friction=0.5))
        (touch,) = plain.effects
        springs = jaxrod.make_scene(rod, jaxrod.sticking_contact(touch, rod, state))
        shorter.append(1 - jaxrod.stable_dt(springs).dt / jaxrod.stable_dt(plain).dt)
        bare = jaxrod.sticking_contact(
            jaxrod.contact(shapes.plane(), friction=0.5), rod, state
        )
        (found,) = jaxrod.make_scene(rod, bare).effects
        softer.append(touch.stiffness / found.stiffness)
    record("Springs shorten the step by", "", float(max(shorter)), at_most=0.2)
    record("Default contact is softer by", "", float(max(softer)), at_most=2.5)


def test_softer_contact_has_softer_springs():
    scene, _ = lying(0.5)
    hard, soft = scene.effects[1], scene.softened(0.25).effects[1]
    assert float(soft.stick_stiffness / hard.stick_stiffness) == 0.25
    assert float(soft.stiffness / hard.stiffness) == 0.25


def test_each_point_keeps_its_spring():
    scene, state = lying(0.5, points=2)
    thin = scene.thinned(0.5)
    assert jnp.all(run(thin, state, 0.001).tip == run(scene, state, 0.001).tip)


def test_what_leaves_the_ground_forgets():
    scene, state = lying(0.5)
    held = run(scene, state, 0.2)
    assert float(jnp.max(jnp.abs(held.memory[1]["elongations"][0]))) > 1e-5
    thrown = replace(held, positions=held.positions.at[2].add(0.01))
    after = jaxrod.advance(scene, thrown, 5e-4, 1)
    assert float(jnp.max(jnp.abs(after.memory[1]["elongations"][0]))) == 0.0


def test_bad_input():
    scene, state = lying(0.5)
    rod, holds = scene.rod, scene.effects[1]
    plane = shapes.plane((0.0, 0.0, 0.0))
    plain = jaxrod.contact(plane, stiffness=1.0)
    with pytest.raises(ValueError, match="friction, got none"):
        jaxrod.sticking_contact(plain, rod, state)
    scales = jaxrod.contact(plane, stiffness=1.0, damping=1.0, friction=(0.1, 0.2, 0.3))
    with pytest.raises(ValueError, match="friction with directions"):
        jaxrod.sticking_contact(scales, rod, state)
    rough = jaxrod.contact(plane, stiffness=1.0, damping=1.0, friction=0.1)
    with pytest.raises(ValueError, match="stick_stiffness must be positive"):
        jaxrod.sticking_contact(rough, rod, state, stick_stiffness=-1.0)
    with pytest.raises(TypeError, match="contact must be"):
        jaxrod.sticking_contact(jaxrod.gravity(), rod, state)
    short, _ = jaxrod.straight_rod(
        3, length=0.5, radius=0.02, density=1e3, youngs_modulus=1e6
    )
    with pytest.raises(ValueError, match="made for 6 elements, got a rod of 3"):
        jaxrod.make_scene(short, holds)
    balls = jax.vmap(lambda x: shapes.sphere(jnp.stack([x, 0.0, -1.0]), 0.1))
    many = jaxrod.contact(
        balls(jnp.arange(3.0)), stiffness=1.0, damping=1.0, friction=0.1
    )
    near = jaxrod.near_contact(many, rod, state, 2)
    with pytest.raises(ValueError, match="got a near_contact"):
        jaxrod.sticking_contact(near, rod, state)
    sticking = jaxrod.sticking_contact(many, rod, state)
    with pytest.raises(ValueError, match="cannot have it"):
        jaxrod.make_scene(rod, jaxrod.near_contact(sticking, rod, state, 2))


def test_springs_beyond_their_limit_hold_without_slip():
    rod, state = jaxrod.straight_rod(
        2, length=0.2, radius=0.01, density=1e3, youngs_modulus=1e6, dtype=jnp.float64
    )
    floor = shapes.plane((0.0, 0.0, -0.0099), (0.0, 0.0, 1.0))
    touch = jaxrod.contact(floor, stiffness=1e4, damping=1.0, friction=0.3)
    contact = jaxrod.sticking_contact(touch, rod, state)
    aside = tuple(e.at[..., 0, :].set(0.01) for e in contact.elongations)
    contact = replace(contact, elongations=aside)

    def sideways(contact):
        x, _, z = contact.loads(rod, motion_of(state)).forces
        return float(jnp.sum(x)), float(jnp.sum(z))

    slips, push = sideways(contact)
    holds, same = sideways(contact.without_slip)
    assert push == same > 0
    assert abs(slips) == pytest.approx(0.3 * push, rel=2e-3)
    assert abs(holds) > 100 * abs(slips)
