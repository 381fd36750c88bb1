"""JAX's own switches, and scenes that are made inside its transformations."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod

DT = 1e-4
MATERIAL = {"radius": 0.01, "density": 1000.0, "youngs_modulus": 1e6}


def rod(n=2, **changes):
    return jaxrod.straight_rod(n, length=0.3, **{**MATERIAL, **changes})


def hanging(push=1.0):
    made, state = rod()
    held = jaxrod.clamp(state)
    return jaxrod.make_scene(made, held, jaxrod.gravity((push, 0.0, 0.0))), state


def tip_after(steps):
    """A loss: where the tip is after some steps, of the push."""

    def tip(push):
        scene, state = hanging(push)
        return jaxrod.advance(scene, state, DT, steps).tip[0]

    return tip


def twice(state):
    return jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)


def batch(steps):
    scene, state = hanging()
    many = twice(state)
    return jax.vmap(lambda one: jaxrod.advance(scene, one, DT, steps))(many)


def pair():
    """Two rods that touch, a spring between them, and a ball that is attached."""
    one, of_one = rod()
    two, of_two = rod(start=(0.0, 0.018, 0.0))
    ball, still = jaxrod.systems.rigid_body(
        jaxrod.shapes.sphere((0.0, 0.018, 0.31), 0.01), density=1000.0
    )
    state = {"one": of_one, "two": of_two, "ball": still}
    system = jaxrod.make_system(
        {
            "one": jaxrod.make_scene(one, jaxrod.clamp(of_one)),
            "two": jaxrod.make_scene(two, jaxrod.gravity()),
            "ball": ball,
        },
        jaxrod.systems.rod_contact(
            "one", "two", stiffness=100.0, damping=0.1, friction=0.3
        ),
        jaxrod.systems.spring(("one", "tip"), ("two", "tip"), state, stiffness=10.0),
        jaxrod.systems.attach(("two", "tip"), ("ball",), state),
        state=state,
    )
    return system, jaxrod.with_memory(system, state)


def in_a_plane(method, push=0.1):
    """A hanging rod of a method, pushed in the plane zx."""
    made, state = rod()
    effects = jaxrod.clamp(state), jaxrod.gravity((push, 0.0, -1.0))
    return jaxrod.make_scene(made, *effects, method=method), state


METHODS = {
    "pyelastica": jaxrod.pyelastica,
    "planar": lambda: jaxrod.planar("zx"),
    "torsion free": jaxrod.torsion_free,
    "implicit": jaxrod.implicit,
}


WITHOUT_JIT = {
    "a step of a system": lambda: jaxrod.advance(*pair(), DT, 1),
    "the health of a system": lambda: jaxrod.health(*pair(), DT),
    "the stable step of a system": lambda: jaxrod.stable_dt(pair()[0]).dt,
    **{
        f"a step, {name}": lambda method=method: jaxrod.step(*in_a_plane(method()), DT)
        for name, method in METHODS.items()
    },
    "a step": lambda: jaxrod.step(*hanging(), DT),
    "no records": lambda: jaxrod.rollout(*hanging(), DT, 0),
    "records of one step": lambda: jaxrod.rollout(*hanging(), DT, 2),
    "a batch of no steps": lambda: batch(0),
    "a batch of one step": lambda: batch(1),
    "a gradient of no steps": lambda: jax.grad(tip_after(0))(1.0),
    "a gradient of one step": lambda: jax.grad(tip_after(1))(1.0),
}


LONG = {"a step of a system", "the gradient of a system", "the gradient, implicit"}


def names_of(programs):
    """Names of programs; those that compile for long are slow tests."""
    return [
        pytest.param(name, marks=pytest.mark.slow) if name in LONG else name
        for name in programs
    ]


@pytest.mark.fast_sets(1)
@pytest.mark.default_precision
@pytest.mark.parametrize("name", names_of(WITHOUT_JIT))
def test_without_jit_it_is_the_same(name):
    wanted = WITHOUT_JIT[name]()
    with jax.disable_jit():
        got = WITHOUT_JIT[name]()
    for one, other in zip(*map(jax.tree.leaves, (got, wanted)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)


def obstacle():
    ball = jaxrod.shapes.sphere((0.0, 0.02, 0.15), 0.015)
    return jaxrod.contact(ball, stiffness=100.0, damping=0.1, points_per_element=8)


MADE_OUTSIDE = {
    "contact": (obstacle, None),
    "drag": (lambda: jaxrod.fluids.stokes_drag(0.1, 0.2, 0.01), None),
    "gravity without twist": (jaxrod.gravity, jaxrod.torsion_free()),
}


@pytest.mark.slow
@pytest.mark.default_precision
@pytest.mark.parametrize("name", MADE_OUTSIDE)
def test_a_scene_of_what_was_made_outside_may_be_made_within_jit(name):
    made, state = rod()
    effects = jaxrod.clamp(state), MADE_OUTSIDE[name][0]()

    def tip(dt):
        scene = jaxrod.make_scene(made, *effects, method=MADE_OUTSIDE[name][1])
        return jaxrod.advance(scene, state, dt, 2).tip

    np.testing.assert_allclose(jax.jit(tip)(DT), tip(DT), atol=1e-7)


def test_bad_values_are_seen_within_jit():
    """They are known there: what they are is said as it is outside."""
    made, _ = rod()
    thin = jaxrod.contact(jaxrod.shapes.sphere((0.0, 0.1, 0.0), 0.001), stiffness=1.0)
    with pytest.warns(jaxrod.ThinBodyWarning):
        jax.make_jaxpr(lambda: jaxrod.make_scene(made, thin))()
    bent = replace(made, rest_curvatures=made.rest_curvatures + 1.0)
    untwisted = jaxrod.torsion_free()
    with pytest.raises(ValueError, match="straight at rest"):
        jax.make_jaxpr(lambda: jaxrod.make_scene(bent, method=untwisted))()


@pytest.mark.slow
def test_structure_that_follows_from_known_numbers_is_found_within_jit():
    """Frequencies, and points of contact from lengths that the scenes were given."""
    made, state = rod()
    scene = jaxrod.make_scene(made, jaxrod.clamp(state))
    wanted = jaxrod.natural_frequencies(scene, state)
    got = []
    jax.make_jaxpr(lambda: got.append(jaxrod.natural_frequencies(scene, state)))()
    np.testing.assert_allclose(got[0], wanted)


@pytest.mark.slow
@pytest.mark.default_precision
def test_a_system_of_what_was_made_outside_may_be_made_within_jit():
    one, of_one = rod()
    two, of_two = rod(start=(0.0, 0.018, 0.0))
    state = {"one": of_one, "two": of_two}
    touch = jaxrod.systems.rod_contact("one", "two", stiffness=100.0, damping=0.1)
    held = jaxrod.clamp(of_one)

    def tips(push):
        members = {
            "one": jaxrod.make_scene(one, held),
            "two": jaxrod.make_scene(two, jaxrod.gravity((0.0, push, 0.0))),
        }
        system = jaxrod.make_system(members, touch, state=state)
        return jaxrod.advance(system, state, DT, 1)["two"].tip

    np.testing.assert_allclose(jax.jit(tips)(-1.0), tips(-1.0), atol=1e-6)


def equilibrium(push):
    return jaxrod.equilibrium(*hanging(push)).state.tip[0]


def tip_of(method):
    """A loss: where the tip is after two steps of a method, of the push."""

    def tip(push):
        scene, state = in_a_plane(method(), push)
        return jaxrod.advance(scene, state, DT, 2).tip[0]

    return tip


def height_of_pair(push):
    """A loss: how high a tip is after two steps of a system, of its speed."""
    system, state = pair()
    moving = replace(state["two"], velocities=state["two"].velocities - push)
    after = jaxrod.advance(system, state | {"two": moving}, DT, 2)
    return after["two"].tip[1]


SOUND = {
    "a system": lambda: jaxrod.advance(*pair(), DT, 2),
    "the gradient of a system": lambda: jax.grad(height_of_pair)(0.1),
    "the health of a system": lambda: jaxrod.health(*pair(), DT),
    "the energy of a system": lambda: jaxrod.System.potential_energy(*pair()),
    "the stable step of a system": lambda: jaxrod.stable_dt(pair()[0]).dt,
    **{
        f"the gradient, {name}": lambda m=method: jax.grad(tip_of(m))(0.1)
        for name, method in METHODS.items()
    },
    "a step": lambda: jaxrod.step(*hanging(), DT),
    "a batch": lambda: batch(2),
    "a gradient": lambda: jax.grad(tip_after(2))(1.0),
    "the stable step": lambda: jaxrod.stable_dt(hanging()[0]),
    "an equilibrium": lambda: equilibrium(0.1),
    "its gradient": lambda: jax.grad(equilibrium)(0.1),
    "frequencies": lambda: jaxrod.natural_frequencies(*hanging()),
}


@pytest.mark.fast_sets(1)
@pytest.mark.default_precision
@pytest.mark.parametrize("name", names_of(SOUND))
def test_nothing_stops_being_finite_on_the_way(name):
    with jax.debug_nans(True), jax.debug_infs(True):
        made = SOUND[name]()
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(made))
