"""Order of convergence in the time step, of every part of the state separately."""

from dataclasses import fields
from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.rods import deformed


def orders(scene, state, duration, coarsest):
    """Observed order in dt of each part of the state, from successive differences."""
    steps = [round(duration / coarsest) * 2**k for k in range(4)]
    ends = [jaxrod.advance(scene, state, duration / n, n) for n in steps]
    result = {}
    for field in fields(state):
        if getattr(state, field.name) is None:
            continue
        values = [np.asarray(getattr(end, field.name)) for end in ends]
        gaps = [np.max(np.abs(b - a)) for a, b in pairwise(values)]
        result[field.name] = np.log2(gaps[-2] / gaps[-1])
    return result


def loaded(rest, damping):
    return (
        jaxrod.clamp(rest),
        jaxrod.gravity((1.0, 2.0, -9.0)),
        jaxrod.end_load((2.0, 0.0, 1.0), (0.3, 0.2, 0.5)),
        jaxrod.actuation.ElementCouples(jnp.full((3, 6), 0.5)),
        jaxrod.exponential_damping(damping, 2 * damping),
    )


SCENES = {
    "free, spinning": lambda rest: (),
    "clamped, loaded": lambda rest: loaded(rest, 0.0),
    "clamped, loaded, strongly damped": lambda rest: loaded(rest, 40.0),
    "end element held": lambda rest: (jaxrod.fixed_end(rest),),
}


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("name", SCENES)
def test_the_consistent_step_is_of_second_order_in_dt(name, record):
    rod, rest = jaxrod.straight_rod(
        6, length=1.0, radius=0.05, density=1e3, youngs_modulus=1e6, dtype=jnp.float64
    )
    state = deformed(rod, 8, largest_angle=0.4, largest_strain=0.02, speed=0.5)
    scene = jaxrod.make_scene(rod, *SCENES[name](rest))
    coarsest = float(jaxrod.stable_dt(scene, 0.1).dt)
    for part, order in orders(scene, state, 40 * coarsest, coarsest).items():
        record(
            f"Order in dt of {part.replace('_', ' ')}: rod {name}",
            "2",
            order,
            between=(1.9, 2.1),
        )


def test_the_largest_step_errs_far_less_than_the_elements(record):
    """A stable step follows the shortest waves, so a higher order would gain little."""

    def tip(n, safety):
        rod, state = jaxrod.straight_rod(
            n,
            length=1.0,
            radius=0.02,
            density=1e3,
            youngs_modulus=1e6,
            direction=(1.0, 0.0, 0.0),
            dtype=jnp.float64,
        )
        scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity())
        n_steps = int(np.ceil(0.5 / float(jaxrod.stable_dt(scene, safety).dt)))
        return np.asarray(jaxrod.advance(scene, state, 0.5 / n_steps, n_steps).tip)

    in_time = np.max(np.abs(tip(10, 1.0) - tip(10, 0.1)))
    in_space = np.max(np.abs(tip(10, 0.1) - tip(40, 1.0)))
    record(
        "Swinging arm of 10 elements: error of the largest step, divided by "
        "the error of the elements",
        "0",
        in_time / in_space,
        at_most=0.01,
    )
