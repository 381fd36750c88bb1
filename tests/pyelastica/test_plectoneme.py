"""A rod that is twisted until it loops, beside PyElastica's.

The scene is that of benchmarks/plectoneme, which goes on where the rod touches itself.
"""

import elastica
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from benchmarks.plectoneme import scene

N = 30


def ends(step, times, dt):
    """Shapes at some times, each reached by so many steps."""
    found, before = {}, 0
    for time in times:
        steps = round(time / dt)
        found[time] = scene.shape(*step(steps - before, before))
        before = steps
    return found


@pytest.mark.slow
def test_a_rod_loops_as_theirs_until_it_touches_itself(record):
    """At 1.5 turns it buckles and throws a loop."""
    dt, times = scene.time_step(N), (5.0, 8.0)
    system, state = scene.ours(N)
    advance = jax.jit(jaxrod.advance)
    now = {"state": state}

    def our_step(steps, first):
        now["state"] = advance(
            system, now["state"], dt, jnp.asarray(steps), first=jnp.asarray(first)
        )
        rod = now["state"]["rod"]
        return rod.positions, rod.directors[0]

    simulator, rod = scene.theirs(N)
    stepper, clock = elastica.PositionVerlet(), {"time": np.float64(0.0)}

    def their_step(steps, _):
        for _ in range(steps):
            clock["time"] = stepper.step(simulator, clock["time"], np.float64(dt))
        return rod.position_collection, rod.director_collection[0]

    mine, other = ends(our_step, times, dt), ends(their_step, times, dt)
    assert other[8.0].writhe > 0.05
    for time in times:
        for name in ("twist", "writhe"):
            a, b = getattr(mine[time], name), getattr(other[time], name)
            record(
                f"{name.capitalize()} of a twisted rod after {time:g} s, difference",
                f"PyElastica 1.0: {b:.6f}",
                abs(a - b),
                at_most=1e-9,
            )
