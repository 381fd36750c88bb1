"""PyElastica mode beside PyElastica 1.0 itself, to round-off."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.rods import motion
from jaxrod.structure import pytree
from pyelastica import scenes
from pyelastica.reference import Loads, simulate

STEPS = 1000
# Elements, and whether the first is held; the seed is the place in the list.
DRAWN = [
    (2, True),
    (3, False),
    (5, True),
    (8, False),
    (13, True),
    (20, True),
    (34, False),
    (60, True),
]


@pytree
class NodeForces(jaxrod.extend.Effect):
    """Given forces on the nodes, as any user of jaxrod may write an effect."""

    forces: jnp.ndarray

    def loads(self, rod, at):
        return motion.Loads(forces=tuple(self.forces))


def same_scene(drawn):
    """The drawn scene as jaxrod has it: scene and initial state."""
    spec, drawn_loads = drawn.spec, drawn.loads
    rod, rest = jaxrod.rod_along(
        spec.positions,
        # Of two elements two radii could be those of the ends: they are refused.
        radius=spec.radii if len(spec.radii) > 2 else spec.radii[0],
        density=spec.density,
        youngs_modulus=spec.youngs_modulus,
        shear_modulus=spec.shear_modulus,
        directors=spec.directors,
        dtype=jnp.float64,
    )
    n = rod.n_elements
    share = np.full(n + 1, 1 / n)
    share[[0, -1]] /= 2
    effects = [
        jaxrod.gravity(drawn_loads.gravity),
        jaxrod.end_load(drawn_loads.end_force, drawn_loads.end_couple),
        NodeForces(jnp.asarray(np.outer(drawn_loads.uniform_force, share))),
        jaxrod.actuation.ElementCouples(jnp.asarray(drawn_loads.element_couples)),
        jaxrod.exponential_damping(drawn.damping_rate),
    ]
    if drawn.clamped:
        effects.append(jaxrod.fixed_end(rest))
    moving = replace(rest, velocities=jnp.asarray(drawn.velocities))
    moving = jaxrod.with_angular_velocities(
        rod, moving, jnp.asarray(drawn.angular_velocities)
    )
    return jaxrod.make_scene(rod, *effects, method=jaxrod.pyelastica()), moving


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("seed", range(len(DRAWN)))
def test_a_thousand_steps_agree_with_pyelastica(seed, record):
    n, clamped = DRAWN[seed]
    drawn = scenes.random_scene(seed, n_elements=n)
    # Half the drawn loads: under the full ones the free rod of three elements folds,
    # and then PyElastica answers a change of 1e-15 in its own start with 7e-11.
    halved = Loads(**{name: load / 2 for name, load in vars(drawn.loads).items()})
    drawn = replace(
        drawn, loads=halved, clamped=clamped, damping_rate=0.5, deprecated_damping=0.0
    )
    scene, state = same_scene(drawn)
    dt = float(jaxrod.stable_dt(scene, 0.5).dt)
    theirs = simulate(**(vars(drawn) | {"dt": dt}), steps=STEPS)
    ours = jaxrod.advance(scene, state, dt, STEPS)
    moved = np.max(np.abs(theirs.positions[-1] - drawn.spec.positions))
    assert moved > 1e-3, "the rod should move"
    where = f"n = {n}, {'clamped' if clamped else 'free'}, seed {seed}"
    errors = {
        "positions [m]": ours.positions - theirs.positions[-1],
        "directors": ours.directors - theirs.directors[-1],
    }
    for name, error in errors.items():
        record(
            f"PyElastica mode after {STEPS} steps, {name}: {where}",
            "PyElastica 1.0",
            np.max(np.abs(error)),
            at_most=1e-11,
        )
