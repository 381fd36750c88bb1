"""Scenes without twist: what they cost, what they go with, and what they refuse."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.effects.base import Effect
from jaxrod.geometry.rotations import directors
from jaxrod.rods.motion import Loads
from jaxrod.structure import pytree
from physics.reductions import arithmetic_left, check_one_program
from physics.rods import arm
from physics.torsion_free import largest_gap, swinging, with_twist


@pytest.mark.slow
def test_batches_and_numbers_do_not_recompile():
    check_one_program(*swinging(n=5, sideways=1.0), rtol=1e-12)


@pytest.mark.slow
def test_it_costs_about_half_the_arithmetic(record):
    record(
        "Arithmetic of a step without twist, divided by that of a step with it",
        "compiled programs",
        arithmetic_left(method=jaxrod.torsion_free()),
        at_most=0.55,
    )


@pytest.mark.slow
def test_twist_does_not_limit_the_step():
    scene, state = swinging(n=8)
    inertia = scene.rod.rotary_inertia.at[1].mul(1e-4)
    scene = replace(scene, rod=replace(scene.rod, rotary_inertia=inertia))
    bound = jaxrod.stable_dt(scene, 1.0)
    limited = jaxrod.stable_dt(with_twist(scene), 1.0)
    assert limited.limiting_mode.startswith("twist")
    assert not bound.limiting_mode.startswith("twist")
    measured = jaxrod.stable_dt(scene, 1.0, state=state)
    assert 1 <= float(measured.dt / bound.dt) < 1.2
    noisy = replace(
        state,
        positions=state.positions + 1e-8 * jnp.cos(jnp.arange(27.0).reshape(3, 9)),
    )
    after = jaxrod.advance(scene, noisy, bound.dt, 2000)
    assert float(jnp.max(jnp.abs(after.velocities))) < 10


@pytest.mark.slow
def test_compensation_inertia_scaling_and_other_numbers_of_elements():
    scene, state = swinging(n=10, dtype=jnp.float32, sideways=2.0)
    start = jaxrod.compensated(state)
    one = jaxrod.advance(scene, start, 2e-4, 500)
    exact = jax.tree.map(lambda a: a.astype(jnp.float64), (scene, state))
    other = jaxrod.advance(*exact, 2e-4, 500)
    np.testing.assert_allclose(one.positions, other.positions, atol=2e-6)
    assert one.remainders is not None and bool(jnp.any(one.remainders != 0))
    assert not bool(jaxrod.health(scene, one, 2e-4).flagged)
    fewer, there = jaxrod.resample(scene, other, 5)
    assert not fewer.method.twist and there.positions.shape == (3, 6)
    scaled = jaxrod.scale_inertia(jaxrod.resample(*exact, 40)[0])
    assert not scaled.scene.method.twist and float(scaled.gain) >= 1


@pytree
class Drag(Effect):
    """Resists motion across elements: needs directions, not frames."""

    rate: jax.Array

    def loads(self, rod, motion):
        d3 = directors(motion.orientation)[2]
        push = tuple(-self.rate * (c[1:] + c[:-1]) for c in motion.velocity)
        along = push[0] * d3[0] + push[1] * d3[1] + push[2] * d3[2]
        x, y, z = (
            jnp.pad(p - along * d, (0, 1)) for p, d in zip(push, d3, strict=True)
        )
        return Loads(forces=(x, y, z))


@pytree
class Magnet(Effect):
    """Turns elements towards a field: couples, but none about the element."""

    field: jax.Array

    def loads(self, rod, motion):
        d1, d2, _ = directors(motion.orientation)
        dot = lambda a: (
            a[0] * self.field[0] + a[1] * self.field[1] + a[2] * self.field[2]
        )
        return Loads(couples=(-dot(d2), dot(d1), jnp.zeros_like(d1[0])))


@pytree
class Vane(Effect):
    """A force along d1: turns with the element."""

    size: jax.Array

    def loads(self, rod, motion):
        d1, _, _ = directors(motion.orientation)
        return Loads(forces=tuple(jnp.pad(self.size * c, (0, 1)) for c in d1))


@pytest.mark.slow
def test_effects_of_ones_own_work_unless_they_turn_with_the_elements():
    scene, state = swinging(n=6)
    own = (Drag(jnp.asarray(0.3)), Magnet(jnp.array([0.0, 0.0, 3.0])))
    scene = jaxrod.make_scene(
        scene.rod, *scene.effects, *own, method=jaxrod.torsion_free()
    )
    bare = jaxrod.advance(scene, state, 2e-4, 500)
    full = jaxrod.advance(with_twist(scene), state, 2e-4, 500)
    assert largest_gap(bare, full) < 1e-11
    with pytest.raises(ValueError, match="turn with the elements, got Vane"):
        jaxrod.make_scene(
            scene.rod, Vane(jnp.asarray(1.0)), method=jaxrod.torsion_free()
        )


def refused(rod, state):
    """What a scene without twist does not take, and a word of the sentence."""
    changed = lambda **fields: replace(rod, **fields)
    bend, shear = rod.bend_twist_stiffness, rod.shear_stretch_stiffness
    couple = (0.0, 0.0, 1.0)
    return {
        "bending stiffness": changed(bend_twist_stiffness=bend.at[0].mul(2.0)),
        "shear stiffness": changed(shear_stretch_stiffness=shear.at[1].mul(2.0)),
        "straight at rest": changed(rest_curvatures=rod.rest_curvatures.at[1].set(0.1)),
        "shear at rest": changed(rest_strains=rod.rest_strains.at[0].set(0.01)),
        "got ElementCouples": jaxrod.actuation.ElementCouples(jnp.zeros((3, 4))),
        "follower": jaxrod.end_load(couple=couple, follower=True),
        "about d3, got EndLoad": jaxrod.end_load(couple=couple),
        "about d3, got UniformLoad": jaxrod.uniform_load(couple_per_length=couple),
        "one held end": (jaxrod.clamp(state), jaxrod.fixed_end(state, "tip")),
        "got Contact with friction": jaxrod.contact(
            jaxrod.shapes.sphere((0.0, 0.0, 2.0), 0.3),
            stiffness=1e3,
            friction=0.3,
            friction_drag=1.0,
        ),
    }


def test_what_twists_is_refused_in_words():
    rod, state = arm(4)
    for words, spoiled in refused(rod, state).items():
        effects = spoiled if isinstance(spoiled, tuple) else (spoiled,)
        with pytest.raises(ValueError, match=rf"torsion_free\(\) needs.*{words}"):
            if isinstance(spoiled, jaxrod.Rod):
                jaxrod.make_scene(spoiled, method=jaxrod.torsion_free())
            else:
                jaxrod.make_scene(rod, *effects, method=jaxrod.torsion_free())
    scene = jaxrod.make_scene(rod, method=jaxrod.torsion_free())
    driven = replace(
        scene, effects=(jaxrod.actuation.ElementCouples(jnp.zeros((3, 4))),)
    )
    with pytest.raises(ValueError, match="ElementCouples"):
        jax.jit(lambda s: jaxrod.advance(driven, s, 1e-4, 5))(state)
