"""A system of one scene is that scene: bit for bit, and at the same cost."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.lanes import choice
from systems.members import rod, stirred


@jaxrod.extend.pytree
class Warming(jaxrod.extend.Effect):
    """Pushes all nodes along x; remembers how often, and pushes less each time."""

    force: jax.Array | jaxrod.schedules.Schedule
    pushes: jax.Array = jaxrod.extend.memory(default=0.0)

    def loads(self, rod, motion):
        force = self.force / (1.0 + self.pushes)
        along = jnp.full_like(rod.node_masses, force)
        none = jnp.zeros_like(along)
        return jaxrod.extend.Loads(forces=(along, none, none))

    def after_step(self, rod, motion, dt):
        return replace(self, pushes=self.pushes + 1.0)


def scenes(kind):
    body, state = rod()
    state = stirred(state)
    effects = [
        jaxrod.clamp(state),
        jaxrod.gravity((0.0, 0.0, -9.81)),
        jaxrod.exponential_damping(0.5),
        jaxrod.contact(jaxrod.shapes.plane((0, 0, -0.05), (0, 0, 1)), stiffness=1e4),
    ]
    if kind == "remembers":
        effects.append(Warming(jaxrod.schedules.sine(0.2, period=0.02)))
    if kind == "compensated":
        state = jaxrod.compensated(state)
    method = jaxrod.pyelastica() if kind == "pyelastica" else jaxrod.consistent()
    return jaxrod.make_scene(body, *effects, method=method), state


KINDS = ("consistent", "compensated", "pyelastica", "remembers")


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_one_scene_steps_bit_for_bit(kind):
    scene, state = scenes(kind)
    system = jaxrod.make_system({"arm": scene})
    dt = jaxrod.stable_dt(scene).dt
    assert float(jaxrod.stable_dt(system).dt) == float(dt)
    alone = jaxrod.advance(scene, state, dt, 300)
    within = jaxrod.advance(system, {"arm": state}, dt, 300)["arm"]
    assert float(jnp.max(jnp.abs(alone.positions - state.positions))) > 1e-3
    jax.tree.map(np.testing.assert_array_equal, within, alone)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_one_scene_costs_what_it_costs_alone(kind, monkeypatch):
    """Operations as written, and of the program that XLA compiles."""
    scene, state = scenes(kind)
    monkeypatch.setattr(choice, "_mode", [choice.NEVER])
    system = jaxrod.make_system({"arm": scene})

    def costs(model, of_model):
        lowered = jax.jit(jaxrod.step).lower(model, of_model, 1e-4)
        return (
            lowered.cost_analysis()["flops"],
            lowered.compile().cost_analysis()["flops"],
        )

    assert costs(system, {"arm": state}) == costs(scene, state)


@pytest.mark.slow
def test_equal_rods_remember_one_by_one():
    """A group is each of its rods alone, memories and schedules included."""
    scene, state = scenes("remembers")
    speeds = jnp.asarray([0.0, 0.5, 1.0])
    several = jax.vmap(lambda s: replace(state, velocities=s * state.velocities))(
        speeds
    )
    group = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), scene)
    system = jaxrod.make_system({"arms": group})
    dt = jaxrod.stable_dt(scene).dt
    together = jaxrod.advance(system, {"arms": several}, dt, 100)["arms"]
    again = jaxrod.advance(system, {"arms": together}, dt, 100, first=100)["arms"]
    for k in range(3):
        own = jax.tree.map(lambda leaf, k=k: leaf[k], several)
        alone = jaxrod.advance(scene, own, dt, 200)
        assert float(alone.memory[-1]["pushes"]) == 200
        jax.tree.map(
            lambda a, b, k=k: np.testing.assert_allclose(a[k], b, atol=1e-12),
            again,
            alone,
        )
