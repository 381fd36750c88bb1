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


def both(count, times):
    """Shapes of both rods at some times [s].

    Args:
        count: As `scene.ours` has it.
        times: When.
    """
    dt = scene.time_step(N)
    system, state = scene.ours(N, count)
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

    return ends(our_step, times, dt), ends(their_step, times, dt)


@pytest.mark.slow
def test_a_rod_loops_as_theirs_until_it_touches_itself(record):
    """At 1.5 turns it buckles and throws a loop."""
    times = (5.0, 8.0)
    mine, other = both(1.0, times)
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


@pytest.mark.slow
def test_a_rod_winds_up_as_theirs_with_their_contact(record):
    """By `element_contact`; what rounds differently grows where the rod slides."""
    bars = {25.0: 1e-10, 50.0: 1e-7, 100.0: 1e-4}
    mine, other = both(None, tuple(bars))
    for time, bar in bars.items():
        a, b = mine[time], other[time]
        for name in ("twist", "writhe"):
            one, two = getattr(a, name), getattr(b, name)
            record(
                f"{name.capitalize()} of a rod wound up for {time:g} s",
                f"PyElastica 1.0: {two:.4f}",
                abs(one / two - 1),
                at_most=bar,
            )
