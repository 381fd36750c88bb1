"""A force and couple on one end that turn with the end element."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxrod
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    directors,
    join_quaternion,
    multiply_quaternions,
    rotation_exp,
    split_quaternion,
    to_world,
)
from jaxrod.methods.consistent import consistent
from jaxrod.rods.motion import motion_of
from lanes.test_runs import apart, both
from physics.rods import arm, deformed, difference, random_rod

HURRY = {"xla_backend_optimization_level": 0}
ENDS = ("base", "tip")


def elastica_tip(load):
    """Tip of an inextensible cantilever whose end force stays normal to it, over L.

    Along the wall's normal and across. The end section sees one and the same force
    whatever its angle, so the shape is found from there, and turned.
    """

    def slope(_, y):
        angle = y[0]
        return y[1], -load * np.cos(angle), np.cos(angle), np.sin(angle)

    tight = {"rtol": 1e-12, "atol": 1e-12}
    angle, _, x, y = solve_ivp(slope, (1, 0), np.zeros(4), **tight).y[:, -1]
    c, s = np.cos(angle), np.sin(angle)
    return np.array([-(c * x + s * y), s * x - c * y])


def pushed(load, n=40, *, end="tip", along=0.0, method=None, effects=(), **changes):
    """An arm along x with a force on an end across it and along it, over EI / L^2."""
    lying = {"direction": (1.0, 0.0, 0.0), "normal": (0.0, 1.0, 0.0)}
    rod, state = arm(n, **{"radius": 0.01} | lying | changes)
    stiffness = float(rod.joint_stiffness[0, 0])
    wall = jaxrod.clamp(state, "base" if end == "tip" else "tip")
    force = (load * stiffness, 0.0, along * stiffness)
    follower = jaxrod.end_load(force, end=end, follower=True)
    return jaxrod.make_scene(rod, wall, follower, *effects, method=method), state


@pytest.mark.parametrize("end", ENDS)
def test_the_force_turns_with_the_end_element_and_the_couple_too(end):
    rod, _ = random_rod(2, 5)
    state = deformed(rod, 1)
    load = jaxrod.end_load((1.0, -2.0, 3.0), (0.1, 0.2, -0.3), end=end, follower=True)
    turn = rotation_exp(tuple(jnp.asarray(c) for c in (0.4, -0.9, 0.3)))
    frames = multiply_quaternions(turn, split_quaternion(state.orientations))
    turned = replace(state, orientations=join_quaternion(frames))
    loads = jax.jit(lambda at: load.loads(rod, motion_of(at)))
    before, after = loads(state), loads(turned)
    assert difference(after.forces, to_world(directors(turn), before.forces)) < 1e-13
    assert difference(after.couples, before.couples) < 1e-15
    index = 0 if end == "base" else -1
    force = np.array([1.0, -2.0, 3.0]) @ np.asarray(state.directors[..., index])
    on_nodes = vectors.join(before.forces)
    np.testing.assert_allclose(on_nodes[:, index], force, atol=1e-14)
    assert np.count_nonzero(on_nodes) == np.count_nonzero(before.couples) == 3


@pytest.mark.slow
@pytest.mark.parametrize("end", [pytest.param("base", marks=pytest.mark.slow), "tip"])
def test_the_elastica_under_a_force_that_stays_normal_to_its_end(end, record):
    worst = 0.0
    find = jax.jit(jaxrod.equilibrium, compiler_options=HURRY)
    for load in (1.0, 3.0):
        scene, state = pushed(load, end=end)
        found = find(scene, state)
        assert found.converged
        tip = found.state.positions[:2, 0 if end == "base" else -1]
        if end == "base":
            tip = jnp.stack([1.0 - tip[0], tip[1]])
        worst = max(worst, float(np.max(np.abs(tip - elastica_tip(load)))))
    record(
        f"Tip under a force that stays normal to the end ({end}), "
        "P L^2 / EI up to 3, n = 40 [lengths]",
        "inextensible rod, by shooting",
        worst,
        at_most=1e-3,
    )


@pytest.mark.slow
def test_damped_motion_comes_to_rest_on_the_elastica(record):
    damping = jaxrod.exponential_damping(4.0)
    scene, state = pushed(3.0, 20, radius=0.05, effects=(damping,))
    scene = replace(scene, method=jaxrod.planar("xy"))
    dt = jaxrod.stable_dt(scene).dt
    found = jaxrod.advance(scene, state, dt, int(8.0 / float(dt)))
    gap = np.max(np.abs(found.tip[:2] - elastica_tip(3.0)))
    record(
        "Damped motion under a force of 3 EI / L^2 that stays normal to the end, after "
        "8 s, n = 20, radius 0.05 [lengths]",
        "inextensible rod without shear, by shooting",
        float(gap),
        at_most=1e-2,
    )


@pytest.mark.slow
def test_a_rotated_scene_rests_rotated():
    turn = rotation_exp(tuple(jnp.asarray(c) for c in (0.7, -0.4, 1.1)))
    rotation = np.stack([np.asarray(column) for column in directors(turn)])
    scene, state = pushed(2.0, 8, along=-0.5)
    other, elsewhere = pushed(
        2.0, 8, along=-0.5, direction=rotation.T[:, 0], normal=rotation.T[:, 1]
    )
    find = jax.jit(jaxrod.equilibrium, compiler_options=HURRY)
    one, two = find(scene, state), find(other, elsewhere)
    assert one.converged and two.converged
    assert float(one.state.tip[1]) > 0.3
    assert difference(rotation.T @ one.state.positions, two.state.positions) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("way", ["equilibrium", "advance", "implicit"])
def test_gradients_are_central_differences(way, record):
    scene, state = pushed(2.0, 6, along=0.7, radius=0.05)
    dt = float(jaxrod.stable_dt(scene).dt)

    def tip(force):
        load = replace(scene.effects[1], force=force)
        here = replace(scene, effects=(scene.effects[0], load))
        if way == "equilibrium":
            found = jaxrod.equilibrium(here, state).state
        elif way == "advance":
            found = jaxrod.advance(here, state, dt, 200)
        else:
            here = replace(here, method=jaxrod.implicit())
            found = jaxrod.advance(here, state, 20 * dt, 10)
        return found.tip[0] + 2 * found.tip[1]

    force = scene.effects[1].force
    direction = jnp.asarray([0.3, 0.0, -1.0]) * jnp.max(force)
    value = jax.jit(tip, compiler_options=HURRY)
    if way == "implicit":
        # Forwards: the reverse of an implicit run takes minutes to compile.
        along = jax.jit(lambda at: jax.jvp(tip, (at,), (direction,))[1])
        slope = float(along(force))
    else:
        gradient = jax.jit(jax.grad(tip), compiler_options=HURRY)(force)
        slope = float(jnp.vdot(gradient, direction))
    step = 1e-4
    up, down = (float(value(force + way * direction)) for way in (step, -step))
    record(
        f"Derivative of the tip by a force that turns with the end ({way})",
        "central differences",
        abs(slope - (up - down) / (2 * step)) / abs(slope),
        at_most=1e-6,
    )


@pytest.mark.slow
@pytest.mark.parametrize("law", [consistent, jaxrod.pyelastica])
def test_the_planar_method_is_the_one_in_space(law):
    swing = jaxrod.schedules.sine((0.4, 0.0, -2.0), 0.05)
    effects = (
        jaxrod.end_load(swing, end="base", follower=True),
        jaxrod.exponential_damping(1.0),
    )
    flat, state = pushed(3.0, 6, radius=0.05, effects=effects, method=planar(law()))
    space = replace(flat, method=law())
    dt = 0.5 * float(jaxrod.stable_dt(space).dt)
    one, two = (jaxrod.advance(scene, state, dt, 300) for scene in (flat, space))
    assert abs(float(two.tip[1])) > 1e-3
    assert difference(one.positions, two.positions) < 1e-12


def planar(law):
    return jaxrod.planar("xy", law)


@pytest.mark.slow
@pytest.mark.parametrize("end", ENDS)
def test_lanes_are_xla(end):
    scene, state = pushed(3.0, 4, end=end, along=0.4, radius=0.05)
    dt = 0.5 * jaxrod.stable_dt(scene).dt
    sizes = jnp.linspace(0.5, 1.5, 5)

    def run(size):
        load = replace(scene.effects[1], force=size * scene.effects[1].force)
        here = replace(scene, effects=(scene.effects[0], load))
        return jaxrod.advance(here, state, dt, 50)

    taken, expected = both(jax.vmap(run), sizes)
    assert apart(taken, expected) < 1e-11


@pytest.mark.parametrize("end", ENDS)
def test_the_bound_is_that_of_the_force_between_end_node_and_end_element(end):
    """The largest singular value of the loads' derivative, scaled by masses."""
    rod, _ = random_rod(3, 5)
    load = jaxrod.end_load((3.0, -4.0, 12.0), end=end, follower=True)
    bound = load.stability_bound(rod)
    index = 0 if end == "base" else -1
    mass, least = rod.node_masses[index], jnp.min(rod.inertias[:, index])
    exact = 13.0 / float(jnp.sqrt(mass * least))
    assert float(bound.nodes[index] / mass) == pytest.approx(exact)
    assert float(bound.elements[index] / least) == pytest.approx(exact)
    assert np.count_nonzero(bound.nodes) == np.count_nonzero(bound.elements) == 1


@pytest.mark.slow
@pytest.mark.parametrize("along", [-10.0, 1.0, 100.0])
def test_a_run_at_the_stable_step_stays_bounded(along):
    """A pull, and a push of half the one at which the column would flutter."""
    scene, state = pushed(0.0, 6, along=along, radius=0.05)
    there = jaxrod.equilibrium(scene, state).state
    noise = 1e-8 * jax.random.normal(jax.random.key(0), state.positions.shape)
    disturbed = replace(there, positions=there.positions + noise.at[:, 0].set(0))
    # The push compresses the rod by 0.6 %, and its bound with it.
    dt = 0.99 * jaxrod.stable_dt(scene, 1.0).dt
    after = jaxrod.advance(scene, disturbed, dt, 5000)
    assert difference(after.positions, there.positions) < 1e-5


def test_the_stable_step_falls_with_the_force():
    steps = []
    for load in (0.0, 1e6):
        scene, _ = pushed(load, 6, radius=0.05)
        steps.append(float(jaxrod.stable_dt(scene, 1.0).dt))
    assert steps[1] < 0.9 * steps[0]


def test_a_schedule_of_time_scales_the_force():
    rod, state = arm(4, radius=0.05)
    ramp = jaxrod.schedules.ramp((0.0, 0.0, 0.0), (0.2, 0.1, 0.3), 1.0)
    scene = jaxrod.make_scene(rod, jaxrod.end_load(ramp, follower=True))
    (load,) = scene.at(0.5).effects
    still = jaxrod.end_load(load.force, follower=True)
    assert 0 < float(jnp.max(load.force)) < 0.3
    one, two = (e.loads(rod, motion_of(state)) for e in (load, still))
    assert difference(vectors.join(one.forces), vectors.join(two.forces)) < 1e-15


def test_a_couple_alone_is_as_it_was():
    """The couple in the frame of the end element, and no force."""
    rod, _ = random_rod(2, 5)
    state = deformed(rod, 1)
    loads = jaxrod.end_load(couple=(0.1, 0.2, -0.3), follower=True).loads(
        rod, motion_of(state)
    )
    np.testing.assert_array_equal(
        vectors.join(loads.couples)[:, -1], jnp.asarray([0.1, 0.2, -0.3])
    )
    assert not np.any(vectors.join(loads.forces))


def test_there_is_no_potential_and_torsion_free_refuses_it():
    rod, state = arm(3)
    load = jaxrod.end_load((1.0, 0.0, 0.0), follower=True)
    assert load.energy(rod, state) == 0.0
    with pytest.raises(ValueError, match="follower=True"):
        jaxrod.make_scene(rod, load, method=jaxrod.torsion_free())
