"""Reach of effects: the range along the rod over which loads depend on the state."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.actuation.muscles import Muscle
from jaxrod.actuation.tendons import Tendon
from jaxrod.statics.declared_properties import _gap_of_tangent
from physics.actuators import actuators, at_once, uneven_rod
from physics.rods import arm, difference


@pytest.mark.slow
@pytest.mark.parametrize("n", [5, 8])
def test_actuators_reach_no_farther_than_they_say(n):
    rod, rest, _ = uneven_rod(n=n)
    reaches = {}
    every = {name: at_once(effect) for name, effect in actuators(rod, rest).items()}
    every["slow muscle"] = jaxrod.actuation.muscle(rod, 3.0, 0.5, fastest=2.0)
    for name, effect in every.items():
        reaches[name] = effect.actual_reach
        if effect.actual_reach != "any":
            assert float(_gap_of_tangent(effect, rod)) < 1e-12, name
    far = {name for name, reach in reaches.items() if reach == "any"}
    assert far == {"tendon on a winch"}
    rubbing = {"friction": 0.2, "friction_at_rest": 1.0}
    cable = jaxrod.actuation.tendon(rod, (0.0, 0.01), tension=1.0, **rubbing)
    assert cable.actual_reach == "any"


@jaxrod.extend.pytree
class FarTendon(Tendon):
    """A tendon that does not say how far it reaches."""

    @property
    def actual_reach(self):
        return "any"


@jaxrod.extend.pytree
class FarMuscle(Muscle):
    """A muscle that does not say how far it reaches."""

    reach = "any"


def told_and_not(n):
    """A scene of a tendon, a muscle and gravity; the same with a dense tangent."""
    rod, state = arm(n, radius=0.03, youngs_modulus=1e6)
    cable = jaxrod.actuation.tendon(rod, (0.02, 0.01), tension=40.0)
    muscle = jaxrod.actuation.muscle(rod, 30.0, 0.5, offsets=(0.0, 0.02))
    others = jaxrod.clamp(state), jaxrod.gravity((1.0, 2.0, -9.81))
    untold = FarTendon(**vars(cable)), FarMuscle(**vars(muscle))
    return state, [
        jaxrod.make_scene(rod, *others, *two) for two in ((cable, muscle), untold)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("n", [6, 7])
def test_equilibria_are_those_of_a_dense_tangent(n):
    state, scenes = told_and_not(n)

    def found(scene, pull):
        down = jaxrod.gravity((0.0, 0.0, pull))
        loaded = jaxrod.make_scene(scene.rod, *scene.effects, down)
        end = jaxrod.equilibrium(loaded, state)
        return end.state.positions, (end.converged, end.stable, end.loose)

    run = jax.jit(jax.jacfwd(found, argnums=1, has_aux=True))
    (slope, flags), (dense, same) = (run(scene, 1.0) for scene in scenes)
    assert flags == same and bool(flags[0]) and bool(flags[1]) and not bool(flags[2])
    assert float(jnp.max(jnp.abs(slope - dense))) < 1e-10 * np.max(np.abs(dense))
    ends = [jaxrod.equilibrium(scene, state).state for scene in scenes]
    assert difference(*ends) < 1e-11


@pytest.mark.slow
@pytest.mark.parametrize("n", [6, 7])
def test_implicit_steps_are_those_of_a_dense_tangent(n):
    state, scenes = told_and_not(n)
    ends = []
    for scene in scenes:
        implicit = jaxrod.make_scene(
            scene.rod, *scene.effects, method=jaxrod.implicit()
        )
        ends.append(jaxrod.advance(implicit, state, 5e-3, 10))
    assert difference(*ends) < 1e-11
    assert difference(ends[0], state) > 1e-3
