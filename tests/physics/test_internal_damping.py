"""Viscosity of the material: what it damps, and what it leaves alone."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.damping.internal_damping import _pairs
from jaxrod.geometry.rotations import (
    conjugate,
    directors,
    multiply_quaternions,
    rotation_exp,
    split_quaternion,
    to_material,
)
from jaxrod.lanes.steps import by_kernel
from jaxrod.loaded_rod import constrain_rates, dissipate, free_velocity_mask
from jaxrod.rods.motion import motion_of, state_of
from jaxrod.structure import pytree
from physics.rods import DENSITY, YOUNG, arm, deformed, difference, largest, random_rod
from physics.torsion_free import free

N = 6
WAVE_SPEED = np.sqrt(YOUNG / DENSITY)


def damped(rod, *effects, time, method=None):
    return jaxrod.make_scene(
        rod, *effects, jaxrod.internal_damping(time), method=method
    )


def rate_of_decay(scene, state, dt, start, end):
    """Decay rate of the total energy between two times [1/s]."""
    steps = round(start / dt), round((end - start) / dt)
    before = jaxrod.advance(scene, state, dt, steps[0])
    after = jaxrod.advance(scene, before, dt, steps[1])
    energies = [float(scene.total_energy(s)) for s in (before, after)]
    return np.log(energies[0] / energies[1]) / (steps[1] * dt)


@pytest.mark.parametrize("share", [0.8, 0.2])
def test_an_axial_mode_decays(share, record):
    """Free ends, second mode, at two step sizes: whole periods of the discrete mode."""
    rod, state = arm(N)
    wave = np.cos(2 * np.pi * np.arange(N + 1) / N)
    state = replace(state, velocities=state.velocities.at[2].set(1e-3 * wave))
    frequency = 2 * WAVE_SPEED * N * np.sin(np.pi / N)
    time = 0.01 / frequency
    scene = damped(rod, time=time)
    dt = share * float(jaxrod.stable_dt(scene, 1.0).dt)
    period = 2 * np.pi / frequency
    measured = rate_of_decay(scene, state, dt, 0.0, 20 * period)
    record(
        f"Decay of an axial mode by internal damping, dt {share} of the limit, off by",
        "relaxation time times frequency^2 / 2",
        abs(measured / (time * frequency**2) - 1),
        at_most=1e-2,
    )


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("end", ["base", "tip"])
def test_a_wall_is_one_more_joint_of_an_element_that_turns(end):
    """Its stiffness times the angular velocity about the element's own axes."""
    rod, state = arm(3)
    wall = jaxrod.clamp(state, end)
    scene = jaxrod.make_scene(rod, wall)
    pairs = jax.jit(_pairs)(scene, motion_of(state), jnp.asarray(2.0))
    index, axes = (0, pairs.axes_after) if end == "base" else (-1, pairs.axes_before)
    own = [[float(c[index]) for c in row] for row in axes]
    np.testing.assert_array_equal(own, np.eye(3))
    drag = [float(c[index]) for c in pairs.joint_drag]
    np.testing.assert_allclose(drag, 2.0 * wall.wall(rod).stiffness)


def dense(scene, motion, duration):
    """Rates after a step: the equation of the module, by a dense solve of NumPy."""
    rod = scene.rod
    n = rod.n_elements
    inertias, masses = np.array(rod.principal_inertias), np.array(rod.node_masses)
    lengths, joint_lengths = np.array(rod.rest_lengths), np.array(rod.joint_lengths)
    shear, bend = np.array(rod.shear_stretch_stiffness), np.array(rod.joint_stiffness)
    frame = np.array(directors(motion.orientation))
    edges = np.array(motion.edges)
    quaternions = np.array(motion.orientation)
    held_nodes, held_elements = (
        np.array(flags) == 0 for flags in free_velocity_mask(scene, motion)
    )
    size = 3 * (n + 1)
    mobility = np.zeros((size + 3 * n, size + 3 * n))
    unit = np.eye(len(mobility))
    at_node = lambda k: unit[3 * k : 3 * k + 3]
    at_element = lambda k: unit[size + 3 * k : size + 3 * k + 3]
    for k in range(n + 1):
        block = np.where(held_nodes[:, k], 0, 1 / masses[k])
        mobility += at_node(k).T @ np.diag(block) @ at_node(k)
    for k in range(n):
        f = frame[:, :, k]
        block = f.T @ np.diag(1 / inertias[:, k]) @ f
        block = np.where(held_elements[:, k].all(), 0, block)
        mobility += at_element(k).T @ block @ at_element(k)
    rows, drag = [], []
    for k in range(n):
        f = frame[:, :, k]
        stretch = at_node(k + 1) - at_node(k)
        rows += list(f @ stretch + np.cross(f, edges[:, k]) @ at_element(k))
        drag += list(shear[:, k] / lengths[k])
    for k in range(n - 1):
        before, after = quaternions[:, k], quaternions[:, k + 1]
        middle = before + after * np.sign(before @ after)
        f = np.array(directors(middle / np.linalg.norm(middle)))
        rows += list(f @ (at_element(k + 1) - at_element(k)))
        drag += list(bend[:, k] / joint_lengths[k])
    for effect in scene.effects:
        wall = effect.wall(rod)
        if wall is not None and wall.stiffness is not None:
            k = 0 if wall.end == "base" else n - 1
            rows += list(frame[:, :, k] @ at_element(k))
            drag += list(wall.stiffness)
    strain, weights = np.array(rows), float(duration) * np.array(drag)
    spin = np.array(motion.angular_velocities(rod))
    rates = np.concatenate([np.ravel(motion.velocity, "F"), spin.ravel("F")])
    matrix = np.eye(len(weights)) + weights[:, None] * (strain @ mobility @ strain.T)
    impulses = strain.T @ np.linalg.solve(matrix, -weights * (strain @ rates))
    pushes = impulses[:size].reshape(-1, 3).T / masses
    return pushes, impulses[size:].reshape(-1, 3).T


@pytree
class Damper:
    """Internal damping of a scene, as something that kernels can compute."""

    scene: jaxrod.Scene
    dt: jax.Array

    def slowed(self, motion):
        """Motion after a step of the damping alone."""
        return dissipate(self.scene, motion, self.dt)


HELD = {
    "clamped": (13, 1e-1, lambda state: (jaxrod.clamp(state),)),
    "held along axes": (
        6,
        1.0,
        lambda state: (
            jaxrod.pin_support(state, 1, axes="xz"),
            jaxrod.pin_support(state, 2, axes="y"),
        ),
    ),
    "held at both ends": (
        12,
        1e-2,
        lambda state: (jaxrod.fixed_end(state), jaxrod.clamp(state, "tip")),
    ),
    "free": (5, 1e-3, lambda state: ()),
    "short": (2, 1e-1, lambda state: ()),
}


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("held", HELD)
def test_it_is_the_dense_equation(held, record):
    """Odd and even numbers of elements; weights below and above the inertia."""
    n, time, supports = HELD[held]
    rod, _ = random_rod(n, n_elements=n)
    state = deformed(rod, n, largest_angle=0.3, largest_strain=0.05, speed=0.3)
    scene = damped(rod, *supports(state), time=time)
    motion = constrain_rates(scene, motion_of(state))
    after = by_kernel(Damper(scene, jnp.asarray(1e-3)), "slowed", motion)
    worst = 0.0
    for new, old, change in zip(
        (after.velocity, after.spin),
        (motion.velocity, motion.spin),
        dense(scene, motion, 1e-3 * time),
        strict=True,
    ):
        error = np.array(new) - np.array(old) - change
        worst = max(worst, largest(error) / largest(change))
    record(
        f"Internal damping of a rod, {held}: change of the rates in a step, off by",
        "the equation of the module, solved by NumPy",
        worst,
        at_most=1e-12,
    )


@pytest.mark.slow
def test_a_clamped_rod_s_bending_decays(record):
    """The clamp's own joint too, or a tenth would be missing. Faster modes go first."""
    rod, state = arm(N)
    wall = jaxrod.clamp(state)
    (frequency,) = np.asarray(
        jaxrod.natural_frequencies(jaxrod.make_scene(rod, wall), state, 1)
    )
    push = 1e-2 * jnp.linspace(0, 1, N + 1) ** 2
    state = replace(state, velocities=state.velocities.at[0].set(push))
    time = 0.02 / frequency
    scene = damped(rod, wall, time=time)
    dt = float(jaxrod.stable_dt(scene).dt)
    period = 2 * np.pi / frequency
    measured = rate_of_decay(scene, state, dt, 2 * period, 5 * period)
    record(
        "Decay of the first bending mode of a clamped rod by internal damping, off by",
        "relaxation time times frequency^2 / 2",
        abs(measured / (time * frequency**2) - 1),
        at_most=1e-2,
    )


def spinning(rod, state, axis):
    """The rod turning about its middle and moving as a rigid body."""
    axis = jnp.asarray(axis)
    middle = jnp.mean(state.positions, axis=1, keepdims=True)
    around = jnp.cross(axis, state.positions - middle, axisa=0, axisb=0, axisc=0)
    material = jnp.sum(state.directors * axis[None, :, None], axis=1)
    moving = replace(state, velocities=around + jnp.array([[1.0], [-2.0], [0.5]]))
    return jaxrod.with_angular_velocities(rod, moving, material)


@pytest.mark.slow
def test_a_rigid_motion_is_not_damped(record):
    """Bent rest shape, any axis; one kick with a relaxation time of a whole second."""
    rod, state = random_rod(3, n_elements=N)
    state = spinning(rod, state, [3.0, -1.0, 2.0])
    effect = jaxrod.internal_damping(1.0)
    scene = jaxrod.make_scene(rod, effect)
    slowed = jax.jit(effect.dissipate)(scene, motion_of(state), jnp.asarray(1e-3))
    after = state_of(slowed)
    change = largest(after.velocities - state.velocities) / 3.0
    spin = jaxrod.angular_velocities(rod, after) - jaxrod.angular_velocities(rod, state)
    record(
        "Rigid motion of a bent rod after a step of strong internal damping, change",
        "0",
        max(change, largest(spin) / 3.0),
        at_most=1e-13,
    )


def test_momentum_is_kept_and_energy_lost(record):
    """At the largest safe step, with relaxation times from small to huge."""
    rod, _ = random_rod(5, n_elements=N)
    state = deformed(rod, 5, largest_angle=0.3, largest_strain=0.05, speed=0.3)
    bare = jaxrod.make_scene(rod)
    dt = jaxrod.stable_dt(bare).dt
    worst = 0.0
    for time in (1e-4, 1.0, 1e6):
        scene = damped(rod, time=time)
        assert jaxrod.stable_dt(scene).dt == dt
        after = jaxrod.advance(scene, state, dt, 2000)
        assert scene.total_energy(after) < bare.total_energy(state)
        for quantity in (jaxrod.Rod.momentum, jaxrod.Rod.angular_momentum):
            before = quantity(rod, state)
            change = largest(quantity(rod, after) - before)
            worst = max(worst, change / float(jnp.linalg.norm(before)))
    record(
        "Momentum and angular momentum of a free rod, 2000 steps of internal damping",
        "their initial values",
        worst,
        at_most=1e-12,
    )


@pytest.mark.slow
def test_a_motion_in_a_plane_is_that_in_space():
    rod, state = arm(N, direction=(1.0, 0.0, 0.0))
    ends = []
    for method in (None, jaxrod.planar("xy")):
        scene = damped(
            rod,
            jaxrod.clamp(state),
            jaxrod.gravity((0.0, -9.81, 0.0)),
            time=1e-3,
            method=method,
        )
        ends.append(jaxrod.advance(scene, state, 1e-4, 300))
    assert ends[0].tip[1] < -0.002
    assert difference(*ends) < 1e-12


@pytest.mark.slow
def test_gradients_are_those_of_differences():
    rod, state = arm(3)
    state = deformed(rod, 1, largest_angle=0.4, speed=0.2)

    @jax.jit
    @jax.value_and_grad
    def tip(time):
        scene = damped(rod, jaxrod.clamp(state), time=time)
        return jnp.sum(jaxrod.advance(scene, state, 1e-4, 20).tip)

    _, slope = tip(1e-3)
    numeric = (tip(1.001e-3)[0] - tip(0.999e-3)[0]) / 2e-6
    assert float(slope) == pytest.approx(float(numeric), rel=1e-6)
    assert np.isfinite(tip(0.0)[1])


def test_what_is_no_time_is_refused():
    with pytest.raises(ValueError, match="relaxation_time must be non-negative"):
        jaxrod.internal_damping(-1.0)


@pytest.mark.slow
def test_without_twist_it_is_the_same_from_wherever_it_is_seen(record):
    """Frames that mean nothing but their direction: none of it depends on them."""
    scene, state = free()
    damping = jaxrod.internal_damping(1e-3)
    scene = replace(scene, effects=(damping,))
    turn = rotation_exp(tuple(jnp.array([1.1, -2.0, 0.7])))
    rows = directors(turn)
    turned = lambda vectors: jnp.stack(to_material(rows, tuple(vectors)))
    orientations = multiply_quaternions(
        conjugate(turn), split_quaternion(state.orientations)
    )
    other = replace(
        state,
        positions=turned(state.positions),
        velocities=turned(state.velocities),
        angular_momenta=turned(state.angular_momenta),
        orientations=jnp.stack(orientations),
    )

    @jax.jit
    def damped_once(state):
        integrator = scene.method.stepper(scene, state, jnp.asarray(1e-4))
        return integrator.leave(integrator.dissipate(integrator.enter(state)))

    one, two = damped_once(state), damped_once(other)
    apart = largest(two.angular_momenta - turned(one.angular_momenta))
    record(
        "Internal damping of a rod without twist, turned in space, angular momenta",
        "turned with it, over the largest",
        apart / largest(one.angular_momenta),
        at_most=1e-10,
    )
