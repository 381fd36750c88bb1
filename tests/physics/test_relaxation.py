"""The standard linear solid: its moduli, its creep, its energy, and its order."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

import jaxrod
from physics.bending import arc, moments_along, straight

RATIO, TIME = 1.5, 0.2


def solid(rod, ratio=RATIO, time=TIME, into=None):
    return jaxrod.materials.standard_linear_solid(
        rod, stiffness_ratio=ratio, relaxation_time=time, into=into
    )


def test_a_held_bend_relaxes_exponentially(record):
    """Both ends of an arc are held: its moment is the relaxation modulus."""
    rod, state = straight(4)
    bent = arc(rod, state, (0.0, 0.5))
    ends = jaxrod.fixed_end(bent), jaxrod.fixed_end(bent, "tip")
    scene = jaxrod.make_scene(rod, *ends, solid(rod))
    dt = jaxrod.stable_dt(scene).dt
    scene = replace(scene, effects=(*ends, solid(rod, time=200 * dt)))
    states = jaxrod.rollout(scene, bent, dt, 600, 100)
    couples = jax.vmap(lambda s: jaxrod.reactions(scene, s)[1].couple[1])(states)
    moment = 0.5 * float(rod.bend_twist_stiffness[0, 0])
    t = 0.5 * np.arange(7)
    exact = moment * (1 + RATIO * np.exp(-t))
    error = np.max(np.abs(np.abs(couples) / exact - 1))
    record("Moment at a constant curvature", "1 + r exp(-t/tau)", error, at_most=1e-9)


def chain(ratio=RATIO, time=TIME, method=None):
    """Two elements that swing along their axis in their first mode, and its frequency.

    One end is held; the mode is the same for every stiffness.
    """
    rod, state = straight(2, radius=0.1)
    scene = jaxrod.make_scene(
        rod, jaxrod.fixed_end(state), solid(rod, ratio, time), method=method
    )
    shape = jnp.asarray([0.0, 1.0, 2**0.5])
    begun = replace(state, velocities=state.velocities.at[0].set(0.01 * shape))
    squared = rod.shear_stretch_stiffness[2, 0] / (0.5 * rod.element_masses[0])
    return scene, begun, (2 - 2**0.5) * float(squared)


def exact_swing(squared, ratio, time, t):
    """Displacement, velocity and strain of the dashpot in the first mode, at time t."""
    both = (1 + ratio) * squared
    law = [[0, 1, 0], [-both, 0, ratio * squared], [1 / time, 0, -1 / time]]
    return expm(np.array(law) * t) @ [0, 0.01, 0]


@pytest.mark.parametrize(
    "method", ["explicit", pytest.param("implicit", marks=pytest.mark.slow)]
)
def test_steps_are_of_second_order(method, record):
    way = jaxrod.implicit() if method == "implicit" else None
    scene, state, squared = chain(time=0.02, method=way)
    end, errors = 0.08, []
    exact = exact_swing(squared, RATIO, 0.02, end)
    for steps in (80, 160):
        after = jaxrod.advance(scene, state, end / steps, steps)
        moved = float(after.positions[0, 1] - state.positions[0, 1])
        relaxed = 0.5 * float(after.memory[1]["strain"][2, 0])
        errors.append(max(abs(moved - exact[0]), abs(relaxed - exact[2])))
    order = np.log2(errors[0] / errors[1])
    assert errors[1] < 1e-2 * abs(exact[0])
    record(f"Order of {method} steps of a relaxing rod", "2", order, between=(1.9, 2.1))


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("turns", [0.3, 1.0, 4.0])
def test_cycles_have_the_storage_and_loss_moduli(turns, record):
    """A bend that oscillates, with `turns` radians in a relaxation time."""
    rod, state = straight(3)
    steps = 100
    dt = 2 * np.pi / turns * TIME / steps
    phase = 2 * np.pi * (np.arange(8 * steps) + 0.5) / steps
    curvatures = np.stack([0 * phase, 0.3 * np.sin(phase)], axis=1)
    moments, _ = moments_along(solid(rod), rod, state, jnp.asarray(curvatures), dt)
    last = slice(7 * steps, None)
    wave = np.exp(-1j * phase[last]) * 2j / steps
    found = np.sum(np.asarray(moments)[last, 1] * wave) / 0.3
    exact = (
        RATIO * 1j * turns / (1 + 1j * turns) * float(rod.bend_twist_stiffness[1, 0])
    )
    for name, part in (("Storage", np.real), ("Loss", np.imag)):
        record(
            f"{name} modulus of a branch at omega tau = {turns:g}",
            "r K (omega tau)^2 or r K omega tau, over 1 + (omega tau)^2",
            abs(part(found) / part(exact) - 1),
            at_most=0.01,
        )


@pytest.mark.slow
def test_a_cantilever_creeps(record):
    """The deflection under a load that comes at once and stays."""
    rod, state = straight(4, radius=0.1)
    wall, load = jaxrod.clamp(state), jaxrod.end_load((0.0, 0.0, -0.1))
    effects = (
        wall,
        load,
        jaxrod.exponential_damping(2.0),
        solid(rod, time=8.0, into=wall),
    )
    scene = jaxrod.make_scene(rod, *effects)
    every = 2000
    dt = jaxrod.stable_dt(scene).dt
    tips = jaxrod.rollout(scene, state, dt, 6 * every, every).tip[2:, 2]
    t = float(dt) * every * np.arange(2, 7)
    bending, shearing = (
        float(stiffness[1, 0])
        for stiffness in (rod.bend_twist_stiffness, rod.shear_stretch_stiffness)
    )
    # Joints of a discrete cantilever are at the nodes; half an element at the wall.
    arms = np.array([1.0, 0.75, 0.5, 0.25]) - np.array([0.0, 0.0, 0.0, 0.0])
    lengths = np.array([0.125, 0.25, 0.25, 0.25])
    static = -0.1 * (np.sum(arms**2 * lengths) / bending + 1 / shearing)
    creep = 1 - RATIO / (1 + RATIO) * np.exp(-t / (8.0 * (1 + RATIO)))
    error = np.max(np.abs(tips / (static * creep) - 1))
    record(
        "Creep of a cantilever", "1 - r/(1 + r) exp(-t/(1 + r)tau)", error, at_most=0.01
    )


def energies(scene, state, dt, steps):
    """Total energy, and power lost in the dashpots, after each step."""
    states = jaxrod.rollout(scene, state, dt, steps, 1)

    def one(state):
        now = scene.recalling(state)
        (branch,) = (e for e in now.effects if hasattr(e, "relaxation_time"))
        stored = branch.energy(scene.rod, state)
        return scene.total_energy(state), 2 * stored / branch.relaxation_time

    return jax.jit(jax.vmap(one))(states)


@pytest.mark.slow
def test_energy_lost_is_that_of_the_dashpots(record):
    rod, state = straight(3)
    wall = jaxrod.clamp(state)
    scene = jaxrod.make_scene(rod, wall, solid(rod, time=0.02, into=wall))
    kick = jnp.asarray([[0.3, 0.1, 0.5]]).T * jnp.linspace(0, 1, 4)[None, :] ** 2
    dt = 0.2 * jaxrod.stable_dt(scene).dt
    begun = jaxrod.with_memory(scene, replace(state, velocities=kick))
    total, power = energies(scene, begun, dt, 800)
    lost = float(dt) * np.sum(0.5 * (power[1:] + power[:-1]))
    assert lost > 0.3 * total[0]
    error = abs(total[0] - total[-1] - lost) / lost
    record(
        "Energy lost, compared with the work of the dashpots",
        "their power",
        error,
        at_most=2e-3,
    )


@pytest.mark.slow
def test_any_relaxation_time_is_stable():
    """The stable step does not depend on it, and no energy appears."""
    rod, state = straight(3)
    wall = jaxrod.clamp(state)
    kick = jnp.asarray([[0.1, 0.2, 0.3]]).T * jnp.linspace(0, 1, 4)[None, :]
    begun = replace(state, velocities=kick)
    dt = jaxrod.stable_dt(jaxrod.make_scene(rod, wall, solid(rod, into=wall))).dt

    @jax.vmap
    def largest(time):
        scene = jaxrod.make_scene(rod, wall, solid(rod, time=time, into=wall))
        states = jaxrod.rollout(scene, begun, dt, 400, 10)
        return jnp.max(jax.vmap(scene.total_energy)(states)) / scene.total_energy(begun)

    found = largest(dt * jnp.asarray([1e-6, 1e-2, 0.3, 1.0, 10.0, 1e3, 1e9]))
    assert np.all(found < 1.5), found


def test_branches_add_up():
    """Two equal branches are one of twice the stiffness: a Prony series adds terms."""
    rod, state = straight(3)
    curvatures = jnp.asarray(np.random.default_rng(0).normal(size=(20, 2)))
    half, _ = moments_along(solid(rod, 0.5), rod, state, curvatures)
    whole, _ = moments_along(solid(rod, 1.0), rod, state, curvatures)
    np.testing.assert_allclose(2 * half, whole, rtol=1e-12)


@pytest.mark.slow
def test_an_equilibrium_takes_no_time():
    """Dashpots stay as they are, so the first one is that of both springs."""
    rod, state = straight(3)
    wall, load = jaxrod.clamp(state), jaxrod.end_load((0.0, 0.0, -0.01))
    effects = wall, load, solid(rod, into=wall)
    found = jaxrod.equilibrium(jaxrod.make_scene(rod, *effects), state)
    assert found.converged
    moved = {name: np.ptp(leaf) for name, leaf in found.state.memory[2].items()}
    assert moved == {"curvature": 0, "strain": 0}
    stiff = replace(
        rod,
        bend_twist_stiffness=(1 + RATIO) * rod.bend_twist_stiffness,
        shear_stretch_stiffness=(1 + RATIO) * rod.shear_stretch_stiffness,
    )
    other = jaxrod.equilibrium(jaxrod.make_scene(stiff, wall, load), state)
    np.testing.assert_allclose(found.state.positions, other.state.positions, atol=1e-9)
