"""What effects say of their loads, and hold, is what implicit methods take it for."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest

import jaxrod
from jaxrod.geometry.matrices import skew
from jaxrod.geometry.rotations import directors, to_material, to_world
from jaxrod.statics.declared_properties import check_declared_properties
from jaxrod.statics.effect_tangents import has_closed_form
from jaxrod.structure import pytree
from physics.distant import Repulsion, Tendon
from physics.pins import Pin
from physics.rods import arm

ONE = jnp.asarray(1.0)


@pytree
class Springs(jaxrod.extend.Effect):
    """Ties every node to its place, and neighbours to each other."""

    reach = "neighbours"
    stiffness: jax.Array

    def loads(self, rod, motion):
        edges = jaxrod.geometry.vectors.difference(motion.edges)
        return jaxrod.extend.Loads(
            tuple(
                self.stiffness * (edge - place)
                for edge, place in zip(edges, motion.position, strict=True)
            )
        )


@pytree
class Vanes(jaxrod.extend.Effect):
    """Couples that turn with the elements."""

    couple: jax.Array

    def in_world(self, motion):
        one = jnp.full_like(motion.orientation[0], self.couple)
        return to_world(directors(motion.orientation), (one, -one, 2 * one))

    def loads(self, rod, motion):
        couples = to_material(directors(motion.orientation), self.in_world(motion))
        return jaxrod.extend.Loads(couples=couples)

    def turning_tangent(self, rod, motion):
        return skew(self.in_world(motion))


@pytree
class Nearby(Tendon):
    """Says that it sees neighbours alone, which is not so."""

    reach = "neighbours"


@pytree
class Crowd(Repulsion):
    """The same; no pair of a straight rod's nodes is near enough to be noticed."""

    reach = "neighbours"


@pytree
class Constant(Springs):
    """Says that its loads are constant, which is not so."""

    def turning_tangent(self, rod, motion):
        return None


@pytree
class Backwards(Vanes):
    """Has the sign of its tangent wrong."""

    def turning_tangent(self, rod, motion):
        return skew(tuple(-c for c in self.in_world(motion)))


@pytree
class Drag(jaxrod.extend.Effect):
    """Says that its loads are constant, but they change with rates."""

    drag: jax.Array

    def loads(self, rod, motion):
        return jaxrod.extend.Loads(tuple(-self.drag * c for c in motion.velocity))

    def turning_tangent(self, rod, motion):
        return None


@pytree
class Rail(jaxrod.extend.Effect):
    """Lets the first node slide along an oblique line."""

    def constrain_rates(self, rod, motion):
        x, y, z = motion.velocity
        mean = 0.5 * (x[0] + y[0])
        velocity = (x.at[0].set(mean), y.at[0].set(mean), z.at[0].set(0.0))
        return replace(motion, velocity=velocity)


@pytree
class Tie(jaxrod.extend.Effect):
    """Puts the last node where the first is."""

    def constrain(self, rod, motion):
        return replace(
            motion, position=tuple(c.at[-1].set(c[0]) for c in motion.position)
        )


@pytree
class Slowed(jaxrod.extend.Effect):
    """Halves a velocity in every step."""

    def constrain_rates(self, rod, motion):
        return replace(
            motion, velocity=tuple(c.at[2].multiply(0.5) for c in motion.velocity)
        )


def tendon(kind):
    return kind(ONE, ONE, ONE, jnp.asarray([0, 2, 5]))


HONEST = {
    "a tendon, which says nothing": lambda: tendon(Tendon),
    "springs between neighbours": lambda: Springs(ONE),
    "couples that turn": lambda: Vanes(ONE),
    "a pin": lambda: Pin(jnp.zeros(3), ONE),
}
BROKEN = {
    "Nearby.reach is off by": lambda: tendon(Nearby),
    "Crowd.reach is off by": lambda: Crowd(ONE, 1e-2 * ONE),
    "Constant.turning_tangent is off by": lambda: Constant(ONE),
    "Backwards.turning_tangent is off by": lambda: Backwards(ONE),
    "Drag.turning_tangent is off by": lambda: Drag(ONE),
    "Rail holds some only partly": Rail,
    "Tie holds some only partly": Tie,
    "Slowed holds some only partly": Slowed,
}


def scene_with(effect, dtype):
    rod, _ = arm(6, dtype)
    return jaxrod.make_scene(rod, jaxrod.gravity(), effect)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("name", HONEST)
def test_what_is_so_is_accepted(name, dtype):
    check_declared_properties(scene_with(HONEST[name](), dtype))


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("name", BROKEN)
def test_what_is_not_so_is_refused_in_words(name, dtype):
    with pytest.raises(ValueError, match=name):
        check_declared_properties(scene_with(BROKEN[name](), dtype))


def test_it_is_refused_before_a_step_or_an_iteration_is_made():
    rod, state = arm(6)
    effects = (jaxrod.clamp(state), tendon(Nearby))
    with pytest.raises(ValueError, match=r"Nearby\.reach is off"):
        jaxrod.make_scene(rod, *effects, method=jaxrod.implicit())
    with pytest.raises(ValueError, match=r"Nearby\.reach is off"):
        jaxrod.equilibrium(jaxrod.make_scene(rod, *effects), state)


def test_what_a_base_says_of_other_loads_is_forgotten():
    class Lighter(jaxrod.Gravity):
        """Weight that falls with height: no constant load any more."""

        def loads(self, rod, motion):
            weight = super().loads(rod, motion).forces
            return jaxrod.extend.Loads(tuple(w * motion.position[2] for w in weight))

    class Looser(Springs):
        def loads(self, rod, motion):
            return super().loads(rod, motion)

    class Mixed(Lighter, Springs):
        """The loads of the first base with what the second says of its own."""

    class Same(jaxrod.Gravity):
        """No loads of its own."""

    assert has_closed_form(Same(ONE))
    assert not has_closed_form(Lighter(ONE))
    assert Springs.reach == "neighbours" and Looser.reach == "any"
    assert Mixed.reach == "any"
    with pytest.raises(ValueError, match="reach must be one of neighbours, second"):
        type("Far", (jaxrod.extend.Effect,), {"reach": "far"})
