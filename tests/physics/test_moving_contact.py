"""Bodies that move by a schedule: what rods feel of them, and what they take."""

import itertools
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod import schedules, shapes, viz
from jaxrod.effects.base import memory_of
from jaxrod.extend import Loads
from jaxrod.geometry.rotations import directors, multiply_quaternions
from jaxrod.rods.motion import motion_of

RADIUS, DENSITY, GRAVITY = 0.02, 1000.0, 9.81
WEIGHT = GRAVITY * DENSITY * np.pi * RADIUS**2  # per length [N/m]
STIFFNESS = WEIGHT / (0.01 * RADIUS)
DAMPING = 0.5 * np.sqrt(STIFFNESS * WEIGHT / GRAVITY)
FLOOR = shapes.plane((0.0, 0.0, (0.01 - 1) * RADIUS))
DT = 5e-4
ALONG_Y = np.array([0.0, 0.2, 0.0])


def straight(n=6, **changes):
    """A rod along x, 0.5 m long, that rests on `FLOOR`."""
    given = {
        "length": 0.5,
        "radius": RADIUS,
        "density": DENSITY,
        "youngs_modulus": 1e6,
        "direction": (1.0, 0.0, 0.0),
        "normal": (0.0, 0.0, 1.0),
        "dtype": jnp.float64,
    }
    return jaxrod.straight_rod(n, **given | changes)


def rough(body=FLOOR, friction=0.5, damping=DAMPING, **changes):
    return jaxrod.contact(
        body, stiffness=STIFFNESS, damping=damping, friction=friction, **changes
    )


KINDS = {
    "static friction": lambda rod, state: jaxrod.sticking_contact(rough(), rod, state),
    "friction": lambda rod, state: rough(),
    "friction with directions": lambda rod, state: rough(friction=(0.1, 0.3, 0.4)),
    "nearest of several": lambda rod, state: jaxrod.near_contact(
        rough([FLOOR, shapes.plane((0.0, 0.0, -9.0))]), rod, state, 1
    ),
}
METHODS = {
    "consistent": None,
    "implicit": jaxrod.implicit(1.0),
    "planar": jaxrod.planar("zx"),
    "pyelastica": jaxrod.pyelastica(),
}


def scene_on(rod, ground, *effects, method=None):
    given = {} if method is None else {"method": method}
    return jaxrod.make_scene(rod, jaxrod.gravity(), ground, *effects, **given)


def steady(velocity):
    """A displacement at a constant velocity, from time zero on."""
    way = 10 * np.asarray(velocity)
    return schedules.ramp(-way, way, 20.0, start=-10.0)


def swung(way, period):
    """A displacement or an angle that starts at zero, without a jerk, and returns."""
    way = np.asarray(way)
    return schedules.sine(way, period, mean=way, phase=-0.25)


@pytest.mark.slow
@pytest.mark.parametrize(("method", "kind"), list(itertools.product(METHODS, KINDS)))
def test_a_rod_that_moves_with_a_plate_feels_nothing_of_it(method, kind):
    rod, state = straight()
    thrown = replace(state, velocities=state.velocities + jnp.array([[0.2], [0], [0]]))
    thrown = replace(thrown, positions=thrown.positions.at[2, -1].add(0.01))
    velocity = np.array([0.7, 0.0, 0.3])
    fixed = KINDS[kind](rod, thrown)
    moving = jaxrod.moving_contact(fixed, displacement=steady(velocity))
    one, two = (
        scene_on(rod, ground, method=METHODS[method]) for ground in (fixed, moving)
    )
    carried = replace(thrown, velocities=thrown.velocities + velocity[:, None])
    one = jaxrod.advance(one, thrown, DT, 200)
    two = jaxrod.advance(two, carried, DT, 200)
    way = (200 * DT * velocity)[:, None]
    np.testing.assert_allclose(two.positions, one.positions + way, atol=1e-10)
    np.testing.assert_allclose(two.angular_momenta, one.angular_momenta, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_schedule_that_stands_still_is_a_fixed_body(kind):
    rod, state = straight()
    thrown = replace(state, velocities=state.velocities.at[0].add(0.2))
    fixed = KINDS[kind](rod, thrown)
    still = jaxrod.moving_contact(
        fixed,
        displacement=schedules.ramp(np.zeros(3), np.zeros(3), 1.0),
        axis=(0.0, 1.0, 0.2),
        angle=schedules.ramp(0.0, 0.0, 1.0),
        about=(0.1, 0.2, 0.3),
    )
    one, two = (
        jaxrod.advance(scene_on(rod, ground), thrown, DT, 100)
        for ground in (fixed, still)
    )
    np.testing.assert_allclose(two.positions, one.positions, atol=1e-13)
    np.testing.assert_allclose(two.velocities, one.velocities, atol=1e-11)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("method", [jaxrod.consistent(), jaxrod.pyelastica()])
def test_a_floor_that_turns_pushes_like_a_rod_that_turns_the_other_way(method):
    rod, state = straight()
    way = np.array([0.5, 0.3, 1.0])
    rate = 3.0 * way / np.linalg.norm(way)
    floor = jaxrod.moving_contact(
        rough(), axis=way, angle=schedules.ramp(-3.0, 3.0, 2.0, start=-1.0)
    )
    frames = np.asarray(state.directors)
    along = np.einsum("ijn,j->in", frames, rate)
    momenta = np.einsum(
        "ijn,in->jn", frames, np.asarray(rod.principal_inertias) * along
    )
    turns = replace(
        state,
        velocities=-jnp.cross(jnp.asarray(rate), state.positions.T).T,
        angular_momenta=-jnp.asarray(momenta),
    )
    one = jaxrod.step(jaxrod.make_scene(rod, floor, method=method), state, 1e-6)
    two = jaxrod.step(jaxrod.make_scene(rod, rough(), method=method), turns, 1e-6)
    pushed = one.velocities - state.velocities
    turned = one.angular_momenta - state.angular_momenta
    assert np.abs(pushed).max() > 1e-6
    assert np.abs(turned).max() > 1e-11
    np.testing.assert_allclose(pushed, two.velocities - turns.velocities, atol=1e-9)
    np.testing.assert_allclose(
        turned, two.angular_momenta - turns.angular_momenta, atol=1e-13
    )


def test_a_rod_that_moves_with_its_body_feels_what_it_felt_before():
    """Forces turn with the body; their power is that on its moving surface."""
    rod, state = straight(3)
    random = np.random.default_rng(1)
    nodes = state.positions + 1e-3 * random.normal(size=(3, 4))
    state = replace(
        state,
        positions=nodes.at[2].add(-0.1 * RADIUS),
        velocities=jnp.asarray(random.normal(size=(3, 4))),
        angular_momenta=jnp.asarray(1e-4 * random.normal(size=(3, 3))),
    )
    fixed = jaxrod.sticking_contact(rough(), rod, state)
    about, axis = np.array([0.3, -0.2, 0.1]), np.array([2.0, -1.0, 2.0]) / 3
    speed, rate, time = np.array([0.5, 0.1, -0.2]), 2.0, 0.3
    moving = jaxrod.moving_contact(
        fixed,
        displacement=steady(speed),
        axis=axis,
        angle=schedules.ramp(-10 * rate, 10 * rate, 20.0, start=-10.0),
        about=about,
    )
    half = 0.5 * rate * time
    quaternion = np.concatenate([[np.cos(half)], np.sin(half) * axis])
    turn = np.stack(directors(tuple(quaternion)), axis=1)
    centre = about + time * speed
    arms = turn @ (np.asarray(state.positions) - about[:, None])
    surface = speed[:, None] + np.cross(rate * axis, arms.T).T
    frames = multiply_quaternions(quaternion, tuple(np.asarray(state.orientations)))
    carried = replace(
        state,
        positions=jnp.asarray(centre[:, None] + arms),
        orientations=jnp.asarray(np.stack(frames)),
        velocities=jnp.asarray(turn @ np.asarray(state.velocities) + surface),
    )
    axes = np.asarray(carried.directors)
    own = np.asarray(rod.principal_inertias) * np.einsum("ijn,j->in", axes, rate * axis)
    momenta = turn @ np.asarray(state.angular_momenta)
    momenta = momenta + np.einsum("ijn,in->jn", axes, own)
    carried = replace(carried, angular_momenta=jnp.asarray(momenta))
    effect = jaxrod.make_scene(rod, moving).at(time).effects[0]

    @partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    def felt(contact, state):
        motion = motion_of(state)
        kept = memory_of((contact.after_step(rod, motion, jnp.asarray(DT)),))
        loads, energy = contact.loads(rod, motion), contact.energy(rod, state)
        return loads, contact.reaction(rod, motion, Loads()), energy, kept

    then, now = felt(fixed, state), felt(effect, carried)
    forces, couples = np.stack(now[0].forces), np.stack(now[0].couples)
    assert np.abs(forces).min() > 1e-3
    np.testing.assert_allclose(forces, turn @ np.stack(then[0].forces), atol=1e-10)
    np.testing.assert_allclose(couples, np.stack(then[0].couples), atol=1e-12)
    couple = np.einsum("ijn,in->j", axes, couples)
    moment = np.sum(np.cross(arms.T, forces.T), axis=0) + couple
    np.testing.assert_allclose(now[1].couple, moment, atol=1e-10)
    power = np.sum(forces * surface) + couple @ (rate * axis)
    np.testing.assert_allclose(now[1].power, power, atol=1e-10)
    pairs = (jax.tree.leaves(felt[2:]) for felt in (then, now))
    for one, other in zip(*pairs, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_drums_that_turn_drag_a_rod_at_the_speed_of_their_surface(record):
    rate, drum = 0.2, 0.1
    rod, state = straight(20, length=1.0, youngs_modulus=1e9, start=(-0.5, 0.0, 0.0))
    effects = []
    for x in (-0.2, 0.2):
        place = np.array([x, 0.0, -drum - 0.99 * RADIUS])
        ground = jaxrod.contact(
            shapes.cylinder(place - ALONG_Y, place + ALONG_Y, drum),
            stiffness=3e5,
            damping=60.0,
            friction=0.6,
            points_per_element=5,
        )
        turns = jaxrod.moving_contact(
            jaxrod.sticking_contact(ground, rod, state),
            axis=(0.0, 1.0, 0.0),
            angle=schedules.ramp(0.0, 10 * rate, 10.0),
            about=place,
        )
        effects.append(turns)
    scene = jaxrod.make_scene(
        rod, jaxrod.gravity(), jaxrod.internal_damping(5e-3), *effects
    )
    dt = jaxrod.stable_dt(scene).dt
    n = int(1.0 / dt)
    after = jaxrod.advance(scene, state, dt, n)
    later = jaxrod.advance(scene, after, dt, n, first=n)
    way = float(jnp.mean((later.positions - after.positions)[0]))
    record(
        "A rod on drums that turn, with static friction: its speed",
        "angular velocity times radius",
        abs(way / (n * float(dt)) / (rate * drum) - 1),
        at_most=5e-3,
    )


def tilting(ground):
    """The ground swings up and down and tilts."""
    return jaxrod.moving_contact(
        ground,
        displacement=swung((1e-3, 0.0, 2e-3), 0.25),
        axis=(0.0, 1.0, 0.0),
        angle=swung(0.02, 0.3),
        about=(0.3, 0.1, -0.1),
    )


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_energy_grows_by_the_work_of_the_ground(friction, record):
    rod, state = straight()
    ground = rough(friction=friction, damping=1e-9, friction_drag=1e-9)
    if friction:
        ground = jaxrod.sticking_contact(ground, rod, state)
    scene = scene_on(rod, tilting(ground))
    gaps, grown = [], []
    for dt in (2e-4, 1e-4):
        n = round(0.06 / dt)

        @jax.jit
        def measured(first, dt=dt, n=n):
            def one(carry, k):
                now = scene.at(k * dt)
                power = jaxrod.reactions(now, carry)[1].power
                energy = now.total_energy(carry)
                return jaxrod.advance(scene, carry, dt, 1, first=k), (power, energy)

            return jax.lax.scan(one, first, jnp.arange(n + 1))[1]

        first = jaxrod.advance(scene, state, dt, 0)
        power, energy = measured(first)
        work = dt * jnp.cumsum(0.5 * (power[1:] + power[:-1]))
        gaps.append(float(jnp.max(jnp.abs(energy[1:] - energy[0] - work))))
        grown.append(float(jnp.max(jnp.abs(work))))
    record(
        f"Energy of a rod on ground that swings, friction {friction}: error",
        "work of the ground",
        gaps[1] / grown[1],
        at_most=1e-4,
    )
    assert gaps[1] < 0.35 * gaps[0]


@pytest.mark.slow
def test_a_plate_carries_a_rod_along_and_rolls_it_sideways():
    rod, start = straight()
    way = np.array([0.05, 0.03, 0.0])
    ground = jaxrod.sticking_contact(rough(), rod, start)
    carried = jaxrod.moving_contact(ground, displacement=swung(way, 1.0))
    scene = scene_on(rod, carried)
    half = jaxrod.advance(scene, start, DT, 1000)
    moved = np.asarray(half.positions - start.positions)
    # The springs of friction give way by the acceleration over g, times twice the depth
    # under the weight.
    most = 0.02 * RADIUS * 0.05 * (2 * np.pi) ** 2 / GRAVITY
    np.testing.assert_allclose(moved[0], 2 * way[0], atol=1.2 * most)
    # A cylinder that rolls on a plate follows it by its inertia over that about the
    # line of contact: 1/2 over 3/2.
    np.testing.assert_allclose(moved[1], 2 * way[1] / 3, rtol=0.01)
    back = jaxrod.advance(scene, half, DT, 1000, first=1000)
    moved = np.asarray(back.positions - start.positions)
    np.testing.assert_allclose(moved[:2], 0, atol=1.2 * most)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["consistent", "implicit"])
def test_gradients_with_respect_to_the_path_agree_with_differences(method):
    rod, state = straight()
    ground = jaxrod.sticking_contact(rough(), rod, state)

    def far(numbers):
        carried = jaxrod.moving_contact(
            ground,
            displacement=schedules.ramp(jnp.zeros(3), numbers[:3], 0.05),
            axis=(0.0, 0.2, 1.0),
            angle=schedules.sine(numbers[3], 0.2),
            about=numbers[4:],
        )
        scene = scene_on(rod, carried, method=METHODS[method])
        end = jaxrod.advance(scene, state, DT, 60)
        return end.positions.sum() + end.positions[0, 0] * end.positions[1, 3]

    at, h = jnp.array([0.02, 0.01, 0.001, 0.05, 0.1, 0.2, 0.0]), 1e-6
    far = jax.jit(far)
    slopes = [(far(at + h * e) - far(at - h * e)) / (2 * h) for e in np.eye(7)]
    np.testing.assert_allclose(jax.grad(far)(at), slopes, rtol=1e-5, atol=1e-8)


@pytest.mark.slow
def test_a_belt_pulls_a_held_rod_by_its_friction():
    rod, state = straight()
    belt = jaxrod.moving_contact(rough(), displacement=steady((30.0, 0.0, 0.0)))
    scene = scene_on(rod, belt, jaxrod.clamp(state))
    rest = jaxrod.equilibrium(scene.at(0.0), state)
    assert rest.converged
    held = jaxrod.reactions(scene.at(0.0), rest.state)[2]
    pulls = jaxrod.reactions(scene.at(0.0), rest.state)[1]
    np.testing.assert_allclose(held.force[0], -pulls.force[0], rtol=1e-6)
    np.testing.assert_allclose(pulls.force[0], 0.5 * pulls.force[2], rtol=1e-3)
    np.testing.assert_allclose(pulls.power, 30 * pulls.force[0], rtol=1e-12)


def test_softer_and_thinner_contact_moves_as_before():
    ground = rough(points_per_element=4)
    way = schedules.ramp((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), 0.5)
    moving = jaxrod.moving_contact(ground, displacement=way)
    softer, thinner = moving.softened(0.25), moving.thinned(0.5)
    assert softer.contact.stiffness == ground.stiffness / 4
    assert thinner.contact.points_per_element == 2
    assert softer.place is thinner.place is moving.place


@pytest.mark.slow
def test_a_system_and_a_scene_are_the_same():
    rod, state = straight()
    ground = jaxrod.sticking_contact(rough(), rod, state)
    way = schedules.ramp((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), 0.5)
    scene = scene_on(rod, jaxrod.moving_contact(ground, displacement=way))
    system = jaxrod.make_system({"rod": scene})
    alone = jaxrod.advance(scene, state, DT, 50)
    among = jaxrod.advance(system, {"rod": state}, DT, 50)["rod"]
    np.testing.assert_allclose(among.positions, alone.positions, atol=1e-14)


@pytest.mark.slow
def test_methods_refuse_bodies_that_would_move_the_rod_out_of_their_motion():
    rod, state = straight()

    def refused(method, friction=0.5, **motion):
        moving = jaxrod.moving_contact(rough(friction=friction), **motion)
        scene = scene_on(rod, moving, method=method)
        return jaxrod.advance(scene, state, DT, 1)

    aside = schedules.ramp((0.0, 0.0, 0.0), (0.0, 0.1, 0.0), 0.5)
    plane = jaxrod.planar("zx")
    with pytest.raises(ValueError, match="in that plane"):
        refused(plane, displacement=aside)
    with pytest.raises(ValueError, match="in that plane"):
        refused(plane, axis=(0, 0, 1), angle=schedules.ramp(0.0, 1.0, 1.0))
    refused(plane, axis=(0, 1, 0), angle=schedules.ramp(0.0, 1.0, 1.0))
    refused(plane, friction=0.0, displacement=aside)
    with pytest.raises(ValueError, match="friction"):
        refused(jaxrod.torsion_free(), displacement=aside)
    refused(jaxrod.torsion_free(), friction=0.0, displacement=aside)


@pytest.mark.slow
def test_a_replay_shows_bodies_where_they_are():
    rod, state = straight()
    jaw = shapes.box((0.3, 0.0, -0.3), (0.1, 0.2, 0.08))
    moving = jaxrod.moving_contact(
        rough(jaw),
        displacement=swung((0.0, 0.1, 0.05), 0.2),
        axis=(1.0, 2.0, 0.5),
        angle=swung(0.4, 0.2),
        about=(0.3, 0.1, 0.0),
    )
    scene = jaxrod.make_scene(rod, moving)
    times = [0.0, 0.05, 0.1]
    states = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), state)
    (mesh,) = viz.Replay.from_states(scene, states, times).meshes
    for frame, time in enumerate(times):
        corners = jnp.asarray(mesh.placed(frame, 0)).T
        none = (jnp.zeros(8),) * 4
        effect = scene.at(time).effects[0]
        seen, _ = effect.seen_configuration(tuple(corners), none)
        np.testing.assert_allclose(jaw.surface(seen)[0], 0, atol=1e-6)


def test_bad_input():
    with pytest.raises(TypeError, match="contact must be"):
        jaxrod.moving_contact(FLOOR)
    with pytest.raises(ValueError, match="axis must be given with angle"):
        jaxrod.moving_contact(rough(), angle=schedules.ramp(0.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="displacement"):
        jaxrod.moving_contact(rough(), displacement=schedules.ramp(0.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="about"):
        jaxrod.moving_contact(rough(), about=(0.0, 1.0))
    with pytest.raises(ValueError, match="zero vector"):
        jaxrod.moving_contact(rough(), axis=(0, 0, 0), angle=0.1)
