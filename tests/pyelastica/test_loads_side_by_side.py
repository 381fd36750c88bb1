"""Loads of PyElastica's library beside their counterparts here, to round-off."""

from dataclasses import replace

import elastica
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.structure import pytree
from pyelastica import reference, scenes
from pyelastica.test_side_by_side import same_scene

STEPS, N = 200, 9
RAMP = 2e-3
START, END = np.array([0.3, -0.2, 0.4]), np.array([-0.1, 0.5, 0.2])


@pytree
class Swing(jaxrod.schedules.Schedule):
    """`EndpointForcesSinusoidal` as a schedule: a formula of time, by the user."""

    size: jax.Array
    normal: jax.Array
    roll: jax.Array

    def __call__(self, clock):
        turn = 0.5 * jnp.pi * (clock.time - RAMP)
        swings = jnp.cos(turn) * self.roll + jnp.sin(turn) * self.normal
        return self.size * jnp.where(clock.time < RAMP, -2 * self.normal, swings)

    @property
    def largest(self):
        return 2 * jnp.abs(self.size) * (jnp.abs(self.roll) + jnp.abs(self.normal))


NORMAL, TANGENT = np.array([0.6, 0.0, 0.8]), np.array([0.0, 1.0, 0.0])


def swing(size):
    """Their sinusoidal force of a size on one end."""
    roll = np.cross(NORMAL, TANGENT)
    return Swing(jnp.asarray(size), jnp.asarray(NORMAL), jnp.asarray(roll))


class EndFollower(elastica.NoForces):
    """A force in the frame of the last element, as users of theirs write it."""

    def __init__(self, force):
        self.force = force

    def apply_forces(self, system, time=0.0):
        """Adds it."""
        frame = system.director_collection[..., -1]
        system.external_forces[..., -1] += self.force @ frame


SIZES = {
    "EndpointForces, ramped up on both ends": 1.0,
    "EndpointForcesSinusoidal": 0.4,
    "UniformTorques": 0.5,
    "UniformForces": 5.0,
    "NoForces subclass, a force that turns with the end": 2.0,
}
"""Of each load over the rod's bending stiffness."""


def ours(rod, sizes):
    """Their loads here; one program, whatever their sizes are."""
    ends, swings, couple, force, follower = sizes
    # Theirs is the total, shared equally by elements; of equal ones that is per length.
    share = END / float(np.sum(rod.rest_lengths))
    return [
        jaxrod.end_load(
            jaxrod.schedules.ramp((0, 0, 0), ends * START, RAMP), end="base"
        ),
        jaxrod.end_load(jaxrod.schedules.ramp((0, 0, 0), ends * END, RAMP)),
        jaxrod.end_load(swing(swings), end="base"),
        jaxrod.end_load(swing(-0.7 * swings)),
        jaxrod.uniform_load(force * share, couple * share),
        jaxrod.end_load(follower * END, follower=True),
    ]


def theirs(sizes):
    """The classes and their arguments."""
    ends, swings, couple, force, follower = sizes
    return [
        (elastica.EndpointForces, ends * START, ends * END, RAMP),
        (
            elastica.EndpointForcesSinusoidal,
            swings,
            -0.7 * swings,
            RAMP,
            TANGENT,
            NORMAL,
        ),
        (elastica.UniformTorques, couple, END),
        (elastica.UniformForces, force, END),
        (EndFollower, follower * END),
    ]


@pytest.fixture(scope="module")
def drawn():
    """A rod of equal elements, curved and tapered, free, moving; no other loads."""
    one = scenes.random_scene(4, n_elements=N)
    stretched = np.full(N, 1.0 / N)
    random = np.random.default_rng(4)
    spec = scenes.curved_rod(
        stretched,
        random.uniform(-1, 1, (3, N - 1)),
        one.spec.radii,
        density=one.spec.density,
        youngs_modulus=one.spec.youngs_modulus,
        shear_modulus=one.spec.shear_modulus,
    )
    nothing = reference.Loads(element_couples=np.zeros((3, N)))
    return replace(
        one,
        spec=spec,
        loads=nothing,
        clamped=False,
        damping_rate=0.0,
        deprecated_damping=0.0,
    )


@pytest.mark.fast_sets(3)
@pytest.mark.parametrize("which", range(len(SIZES)), ids=SIZES)
def test_loads_are_those_of_pyelastica(which, drawn, record, monkeypatch):
    still, state = same_scene(drawn)
    rod = still.rod
    stiffness = float(np.max(rod.bend_twist_stiffness))
    sizes = np.eye(len(SIZES))[which] * list(SIZES.values()) * stiffness
    dt = jnp.asarray(RAMP / 40.5)

    def stepped(sizes):
        effects = ours(rod, sizes)
        scene = jaxrod.make_scene(rod, *effects, method=jaxrod.pyelastica())
        assert dt < jaxrod.stable_dt(scene, 0.9).dt
        return jaxrod.advance(scene, state, dt, jnp.asarray(STEPS))

    def add(simulator, rod, loads):
        kind, *numbers = theirs(sizes)[which]
        simulator.add_forcing_to(rod).using(kind, *numbers)

    monkeypatch.setattr(reference, "_add_loads", add)
    other = reference.simulate(**(vars(drawn) | {"dt": float(dt)}), steps=STEPS)
    mine, free = stepped(sizes), stepped(0 * sizes)
    moved = np.max(np.abs(mine.positions - free.positions))
    turned = np.max(np.abs(mine.directors - free.directors))
    assert max(moved, turned) > 1e-3, "the same without the load"
    name = list(SIZES)[which]
    for what, one, two in (
        ("positions [m]", mine.positions, other.positions[-1]),
        ("directors", mine.directors, other.directors[-1]),
    ):
        record(
            f"{name}, {STEPS} steps: {what}",
            "PyElastica 1.0",
            np.max(np.abs(one - two)),
            at_most=1e-12,
        )
