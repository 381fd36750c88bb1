"""Pins, hinges and driven ends, against closed forms and the balance of energy."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.effects.ends import Held
from jaxrod.effects.supports import Pin, own_couple
from jaxrod.methods.planar import Planar
from jaxrod.rods.motion import Loads, motion_of

N, LENGTH, RADIUS, DENSITY, MODULUS = 24, 1.0, 0.01, 1000.0, 1e8
AREA = np.pi * RADIUS**2
BENDING = MODULUS * np.pi * RADIUS**4 / 4


def along_x(n=N, modulus=MODULUS):
    return jaxrod.straight_rod(
        n,
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=modulus,
        direction=(1.0, 0.0, 0.0),
        normal=(0.0, 0.0, 1.0),
    )


class Twisted:
    """Couples on the elements of a rod, in their own frames."""

    couples = np.arange(12.0).reshape(3, 4)

    def loads(self, rod, motion):
        return Loads(couples=tuple(jnp.asarray(self.couples)))


@pytest.mark.parametrize(("end", "index"), [("base", 0), ("tip", -1)])
def test_the_own_couple_of_a_support_is_that_of_the_element_it_holds(end, index):
    rod, state = along_x(4)
    found = own_couple(Twisted(), rod, motion_of(state), end)
    frame = np.asarray(state.directors)[:, :, index]
    wanted = frame.T @ Twisted.couples[:, index]
    np.testing.assert_allclose(np.stack(found), wanted, atol=1e-6)


@pytest.mark.slow
def test_a_simply_supported_beam_sags_as_it_should():
    rod, state = along_x()
    load = 0.05
    scene = jaxrod.make_scene(
        rod,
        jaxrod.pin_support(state),
        jaxrod.pin_support(state, "tip", axes="yz"),
        jaxrod.uniform_load((0.0, 0.0, -load)),
    )
    found = jaxrod.equilibrium(scene, state)
    assert found.converged
    sag = -float(found.state.positions[2, N // 2])
    assert sag == pytest.approx(5 * load * LENGTH**4 / (384 * BENDING), rel=3e-3)
    # Each end carries half of the weight.
    for reaction in jaxrod.reactions(scene, found.state)[:2]:
        np.testing.assert_allclose(
            reaction.force, [0, 0, load * LENGTH / 2], atol=1e-6 * load
        )
        assert float(reaction.power) == 0


@pytest.mark.slow
def test_a_simply_supported_beam_vibrates_as_it_should():
    rod, state = along_x()
    scene = jaxrod.make_scene(
        rod, jaxrod.pin_support(state), jaxrod.pin_support(state, "tip", axes="yz")
    )
    exact = np.pi**2 * np.sqrt(BENDING / (DENSITY * AREA)) / LENGTH**2
    found = np.asarray(jaxrod.natural_frequencies(scene, state))
    # Turning about its own axis is free; bending in two planes.
    lowest = found[found > 0.01 * exact][:2]
    np.testing.assert_allclose(lowest, exact, rtol=3e-3)


@pytest.mark.slow
def test_a_pin_in_the_middle_carries_what_it_should():
    """Two equal spans under a uniform load: the middle carries 5/8 of it."""
    rod, state = along_x()
    load = 0.05
    scene = jaxrod.make_scene(
        rod,
        jaxrod.pin_support(state),
        jaxrod.pin_support(state, N // 2, axes="yz"),
        jaxrod.pin_support(state, "tip", axes="yz"),
        jaxrod.uniform_load((0.0, 0.0, -load)),
    )
    found = jaxrod.equilibrium(scene, state)
    middle = jaxrod.reactions(scene, found.state)[1].force
    assert float(middle[2]) == pytest.approx(5 / 8 * load * LENGTH, rel=5e-3)


@pytest.mark.slow
def test_a_cantilever_is_held_by_its_weight_and_its_moment():
    rod, state = along_x()
    scene = jaxrod.make_scene(
        rod,
        jaxrod.clamp(state),
        jaxrod.gravity((0.0, 0.0, -1e-2)),
        jaxrod.end_load(couple=(0.0, 2e-4, 0.0)),
    )
    found = jaxrod.equilibrium(scene, state)
    reaction, nothing, nor_this = jaxrod.reactions(scene, found.state)
    assert nothing is None and nor_this is None
    weight = 1e-2 * float(jnp.sum(rod.node_masses))
    np.testing.assert_allclose(reaction.force, [0, 0, weight], atol=1e-9)
    # About the end node, exactly, however few elements there are.
    arm = float(jnp.sum(rod.node_masses * found.state.positions[0])) * 1e-2
    assert float(reaction.couple[1]) == pytest.approx(-arm - 2e-4, rel=1e-6)


@pytest.mark.slow
def test_a_stiff_rod_on_a_hinge_is_a_compound_pendulum():
    rod, state = along_x(4)
    gravity = 9.81
    scene = jaxrod.make_scene(
        rod,
        jaxrod.hinge_support(state, (0.0, 2.0, 0.0)),
        jaxrod.gravity((gravity, 0.0, 0.0)),
    )
    exact = np.sqrt(1.5 * gravity / LENGTH)
    hanging = jaxrod.equilibrium(scene, state)
    assert hanging.stable
    found = np.asarray(jaxrod.natural_frequencies(scene, hanging.state))
    lowest = found[found > 0.1]
    # Four elements weigh their ends: the inertia is that of their nodes.
    inertia = float(jnp.sum(rod.node_masses * state.positions[0] ** 2))
    inertia += float(jnp.sum(rod.inertias[0]))
    moment = gravity * float(jnp.sum(rod.node_masses * state.positions[0]))
    assert lowest[0] == pytest.approx(np.sqrt(moment / inertia), rel=5e-3)
    assert lowest[0] == pytest.approx(exact, rel=0.05)
    # Across the hinge it is stiff, and twisting is too: nothing else is as slow.
    assert lowest[1] > 1.5 * exact


@pytest.mark.slow
def test_a_hinge_lets_a_rod_go_round_and_round():
    rod, state = along_x(3, 1e7)
    omega = np.zeros((3, 3))
    frame = np.asarray(state.directors)
    omega[:] = np.einsum("ijn,j->in", frame, [0.0, 20.0, 0.0])
    spinning = jaxrod.with_angular_velocities(rod, state, omega)
    x = np.asarray(state.positions[0])
    velocities = np.stack([0 * x, 0 * x, -20.0 * x])
    spinning = jax.tree.map(jnp.asarray, spinning)
    spinning = replace(spinning, velocities=jnp.asarray(velocities))
    scene = jaxrod.make_scene(rod, jaxrod.hinge_support(state, (0.0, 1.0, 0.0)))
    dt = float(jaxrod.stable_dt(scene, 0.4).dt)
    steps = int(1.0 / dt)
    records = jaxrod.rollout(scene, spinning, dt, steps - steps % 20, steps // 20)
    tips = np.asarray(records.tip)
    assert np.max(np.abs(tips[:, 1])) < 1e-9
    before, after = (
        float(scene.total_energy(jax.tree.map(lambda a, k=k: a[k], records)))
        for k in (0, -1)
    )
    assert after == pytest.approx(before, rel=1e-3)
    # Three times round in a second.
    angles = np.unwrap(np.arctan2(-tips[:, 2], tips[:, 0]))
    assert abs(angles[-1]) == pytest.approx(
        20 * dt * (len(tips) - 1) * (steps // 20), rel=0.05
    )


def pendulum(method, turn="joint"):
    """A soft pendulum whose upper end is shaken, and turned by a wall.

    By a joint to it, or with the element held fast, or not turned at all.
    """
    rod, state = jaxrod.straight_rod(
        3, length=0.5, radius=0.02, density=1000.0, youngs_modulus=2e5
    )
    shake = jaxrod.schedules.sine(
        (0.01, 0.0, 0.0), 0.3, phase=0.25, mean=(-0.01, 0.0, 0.0)
    )
    wall = {"free_to_turn": True}
    if turn:
        angle = jaxrod.schedules.sine(0.3, 0.2, phase=0.25, mean=-0.3)
        wall = {"axis": (0.0, 1.0, 0.0), "angle": angle}
        wall["holds_element"] = turn == "element"
    planar = isinstance(method, Planar)
    driven = jaxrod.driven(
        state, displacement=shake, axes="xz" if planar else "xyz", **wall
    )
    scene = jaxrod.make_scene(rod, driven, jaxrod.gravity(), method=method)
    return scene, state


@pytest.mark.parametrize(
    ("method", "turn"),
    [
        pytest.param(jaxrod.consistent(), "joint", marks=pytest.mark.slow),
        pytest.param(jaxrod.planar("zx"), "joint", marks=pytest.mark.slow),
        pytest.param(jaxrod.implicit(1.0), "joint", marks=pytest.mark.slow),
        pytest.param(jaxrod.consistent(), None, marks=pytest.mark.slow),
        pytest.param(jaxrod.consistent(), "element", marks=pytest.mark.slow),
        pytest.param(jaxrod.planar("zx"), "element", marks=pytest.mark.slow),
    ],
    ids=[
        "consistent",
        "planar",
        "implicit",
        "free to turn",
        "held element",
        "held element, planar",
    ],
)
def test_the_work_of_a_driven_end_is_what_the_energy_grows_by(method, turn):
    scene, state = pendulum(method, turn)
    gaps = []
    for n in (300, 600):
        h = 0.2 / n
        records = jaxrod.rollout(scene, state, h, n)
        times = jnp.arange(n + 1) * h

        def measured(state, time):
            now = scene.at(time)
            power = jaxrod.reactions(now, state)[0].power
            return now.total_energy(state), power

        energies, powers = map(np.asarray, jax.vmap(measured)(records, times))
        work = h * np.sum(0.5 * (powers[1:] + powers[:-1]))
        grown = energies[-1] - energies[0]
        assert abs(grown) > 1e-4
        gaps.append(abs(work - grown) / abs(grown))
    assert gaps[1] < 1e-3
    assert gaps[0] / gaps[1] > 3


@pytest.mark.slow
def test_a_driven_end_is_where_it_is_driven():
    scene, state = pendulum(jaxrod.consistent(), "element")
    after = jaxrod.advance(scene, state, 5e-4, 101)
    driven = scene.at(101 * 5e-4).effects[0]
    there, turned = driven.place.position, driven.turn
    np.testing.assert_allclose(after.positions[:, 0], there, rtol=0, atol=1e-15)
    np.testing.assert_allclose(after.orientations[:, 0], turned.orientation, atol=1e-15)
    turning = jaxrod.angular_velocities(scene.rod, after)[:, 0]
    local = np.asarray(after.directors[..., 0]) @ np.asarray(turned.angular_velocity)
    assert np.max(np.abs(local)) > 0.1
    np.testing.assert_allclose(turning, local, atol=1e-12)
    assert not jaxrod.health(scene.at(101 * 5e-4), after, 5e-4).flagged
    assert jaxrod.health(scene.at(0.0), after, 5e-4).largest_violation > 0.1


@jaxrod.extend.pytree
class Dashpot(jaxrod.extend.Effect):
    """Between the first two nodes: nothing in a rod that moves as a whole."""

    drag: jax.Array

    def loads(self, rod, motion):
        pulls = [self.drag * (v[1] - v[0]) for v in motion.velocity]
        none = jnp.zeros_like(motion.position[0])
        forces = tuple(none.at[0].set(pull).at[1].set(-pull) for pull in pulls)
        return jaxrod.extend.Loads(forces=forces)


@pytest.mark.slow
def test_loads_of_implicit_steps_see_how_fast_an_end_is_driven():
    """A rod that is towed as fast as it moves stays as it is."""
    rod, state = along_x(3, 1e5)
    pace, end = 0.5, 0.1
    moving = replace(state, velocities=state.velocities.at[1].set(pace))
    path = jaxrod.schedules.ramp((0.0, 0.0, 0.0), (0.0, pace, 0.0), 1.0)
    scene = jaxrod.make_scene(
        rod,
        jaxrod.driven(state, displacement=path, free_to_turn=True),
        Dashpot(0.1),
        method=jaxrod.implicit(),
    )
    after = jaxrod.advance(scene, moving, end / 10, 10)
    there = state.positions.at[1].add(pace * end)
    np.testing.assert_allclose(after.positions, there, rtol=0, atol=1e-12)


def test_bad_supports_are_refused_in_words():
    rod, state = along_x(4)
    shake = jaxrod.schedules.sine((0.0, 0.0, 0.01), 0.3)
    for make, words in (
        (lambda: jaxrod.pin_support(state, 7), "node must be from 0 to 4"),
        (lambda: jaxrod.pin_support(state, "middle"), 'end must be "base" or "tip"'),
        (lambda: jaxrod.pin_support(state, axes="xw"), 'axes must be some of "xyz"'),
        (
            lambda: jaxrod.hinge_support(state, (0.0, 0.0, 0.0)),
            "axis must not be the zero vector",
        ),
        (
            lambda: jaxrod.driven(
                state, displacement=jaxrod.schedules.ramp(0.0, 1.0, 1.0)
            ),
            "displacement must have values of shape",
        ),
        (
            lambda: jaxrod.driven(state, free_to_turn=True, holds_element=True),
            "both held and free to turn",
        ),
        (
            lambda: jaxrod.driven(state, angle=jaxrod.schedules.ramp(0.0, 1.0, 1.0)),
            "axis must be given with angle",
        ),
        (
            lambda: jaxrod.make_scene(
                rod,
                jaxrod.driven(state, displacement=shake),
                method=jaxrod.planar("zx"),
            ),
            "needs driven ends that are free along its normal",
        ),
        (
            lambda: jaxrod.make_scene(
                rod,
                jaxrod.driven(state, displacement=shake),
                method=jaxrod.torsion_free(),
            ),
            "a wall that is driven",
        ),
    ):
        with pytest.raises(ValueError, match=words):
            make()


@jaxrod.extend.pytree
class Glue(jaxrod.extend.Effect):
    """Holds the last node and says so, or stops it and says nothing."""

    says: bool = jaxrod.extend.static(default=True)

    def held(self, rod):
        return (Held(node=-1),) if self.says else ()


@jaxrod.extend.pytree
class Loose(Pin):
    """Replaces what it inherits, and so does not say what a pin says."""

    def constrain_rates(self, rod, motion):
        return motion


def test_two_supports_of_one_freedom_are_refused_by_their_names():
    rod, state = along_x(4)
    shake = jaxrod.schedules.sine((0.0, 0.0, 0.01), 0.3)
    pin, hinge = jaxrod.pin_support, jaxrod.hinge_support(state, (0.0, 1.0, 0.0))
    clamp, fixed = jaxrod.clamp(state), jaxrod.fixed_end(state)

    def driven(axes="xyz", **options):
        return jaxrod.driven(state, displacement=shake, axes=axes, **options)

    for one, other, words in (
        (pin(state), pin(state, axes="zx"), "Pin and Pin both hold node 0 along x, z:"),
        (pin(state, 2, axes="yz"), pin(state, 2, axes="xy"), "node 2 along y:"),
        (pin(state), driven("z"), "Pin and Driven both hold node 0 along z:"),
        (clamp, pin(state, axes="x"), "Clamp and Pin both hold node 0 along x:"),
        (hinge, pin(state), "Hinge and Pin both hold node 0 along x, y, z:"),
        (fixed, clamp, "FixedEnd and Clamp both hold node 0 along x, y, z:"),
        (hinge, driven("x", free_to_turn=True), "Hinge and Driven both hold node 0"),
        (driven("x"), driven("yz"), "Driven and Driven .* orientation of element 0:"),
        (pin(state, "tip"), Glue(), "Pin and Glue both hold node 4 along x, y, z:"),
    ):
        for pair in ((one, other), (one, jaxrod.gravity(), other)):
            with pytest.raises(ValueError, match=words):
                jaxrod.make_scene(rod, *pair)
    finish = jaxrod.hinge_support(state, (0.0, 1.0, 0.0), "tip")
    loose = Loose(state.positions[:, 0])
    for legal in (
        (clamp, pin(state, "tip")),
        (clamp, jaxrod.clamp(state, "tip")),
        (hinge, finish),
        (pin(state, axes="x"), pin(state, axes="y"), pin(state, axes="z")),
        (driven("xy"), pin(state, axes="z")),
        (driven("x"), driven("yz", free_to_turn=True)),
        (pin(state, 3), Glue()),
        (pin(state, "tip"), Glue(says=False)),
        (pin(state), loose),
    ):
        jaxrod.make_scene(rod, *legal)


def test_batches_are_refused_with_the_word_vmap():
    rod, state = along_x(3)
    scene = jaxrod.make_scene(rod, jaxrod.gravity())
    scenes, states = jax.tree.map(lambda a: jnp.stack([a, a]), (scene, state))
    for ask in (
        lambda: jaxrod.stable_dt(scenes),
        lambda: jaxrod.advance(scenes, states, 1e-4, 1),
        lambda: jaxrod.advance(scene, states, 1e-4, 1),
        lambda: scenes.total_energy(states),
        lambda: jaxrod.health(scenes, states, 1e-4),
        lambda: rod.momentum(states),
        lambda: jaxrod.clamp(states),
        lambda: jaxrod.pin_support(states),
    ):
        with pytest.raises(ValueError, match=r"use jax\.vmap"):
            ask()
    assert jax.vmap(jaxrod.stable_dt)(scenes).dt.shape == (2,)


@pytest.mark.slow
def test_supports_that_leave_the_plane_only_later_are_refused():
    rod, state = along_x(4)
    turning = jaxrod.driven(
        state,
        axes="xy",
        axis=(1, 0, 0),
        angle=jaxrod.schedules.ramp(0.0, 2 * np.pi, 1.0),
    )
    for effect in (turning, jaxrod.hinge_support(state, (1.0, 0.0, 1.0))):
        scene = jaxrod.make_scene(rod, effect, method=jaxrod.planar("xy"))
        with pytest.raises(ValueError, match="couples of effects"):
            jaxrod.advance(scene, state, 1e-5, 1)
    upright = jaxrod.make_scene(
        rod, jaxrod.hinge_support(state, (0.0, 0.0, 1.0)), method=jaxrod.planar("xy")
    )
    jaxrod.advance(upright, state, 1e-5, 1)


@pytest.mark.slow
def test_neither_origin_nor_order_matters_to_what_supports_do():
    shift = jnp.asarray([30.0, -20.0, 50.0])
    shake = jaxrod.schedules.sine((0.0, 0.0, 0.01), 0.1, phase=0.25)
    rod, state = along_x(3, 1e6)

    def run(state, order):
        effects = [
            jaxrod.driven(state, displacement=shake, free_to_turn=True),
            jaxrod.pin_support(state, "tip", axes="yz"),
            jaxrod.gravity(),
        ]
        scene = jaxrod.make_scene(rod, *effects[::order])
        after = jaxrod.advance(scene, state, 2e-4, 300)
        return after, jaxrod.reactions(scene.at(300 * 2e-4), after)[::order]

    here, held = run(state, 1)
    moved = replace(state, positions=state.positions + shift[:, None])
    for start, order, offset in ((moved, 1, shift), (state, -1, 0 * shift)):
        there, also_held = run(start, order)
        back = there.positions - offset[:, None]
        np.testing.assert_allclose(back, here.positions, rtol=0, atol=1e-9)
        for one, other in zip(held[:2], also_held[:2], strict=True):
            np.testing.assert_allclose(one.force, other.force, rtol=0, atol=1e-4)


@pytest.mark.parametrize("end", ["base", "tip"])
def test_a_pin_at_an_end_stays_at_that_end_of_a_finer_rod(end):
    rod, state = along_x(6)
    finer, _ = along_x(12)
    pin = jaxrod.pin_support(state, end)
    assert pin.resampled(rod, finer).node == {"base": 0, "tip": 12}[end]
