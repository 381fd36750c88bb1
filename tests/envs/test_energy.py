"""Why environments do not examine the energy of their arms after every action."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from benchmarks.extremes.actions import turned
from jaxrod.envs import make
from physics.validation import record as record

N_ARMS, CONTROL_STEPS = 96, 300


def playing(env, params, examined):
    """Arms under actions held, jumping and random: flags, and those of energy."""

    def control_step(arm, action):
        bends = jnp.reshape(action, (2, -1))
        scene = params.arm.scene(jnp.pad(bends, ((0, 1), (0, 0))))
        after = jaxrod.advance(scene, arm, params.dt, env.substeps)
        books = {}
        if examined:
            work = jnp.sum(scene.effects[-1].couples * turned(arm, after))
            before = scene.total_energy(arm)
            books = {"energy_before": before, "work_input": work}
        report = jaxrod.health(scene, after, params.dt, **books)
        flags = report.flagged, report.energy
        return jaxrod.freeze(report.flagged, arm, after), flags

    def run(arms, actions):
        return jax.lax.scan(jax.vmap(control_step), arms, actions)[1]

    arms = jax.tree.map(lambda leaf: jnp.repeat(leaf[None], N_ARMS, 0), params.arm.rest)
    random = np.random.default_rng(0)
    size = (CONTROL_STEPS, N_ARMS, env.action_size)
    drawn = random.uniform(-1, 1, size)
    corners = np.sign(drawn)
    held = np.broadcast_to(corners[:1], size)
    jumping = corners[np.arange(CONTROL_STEPS) // 100 * 100]
    kinds = (np.arange(N_ARMS) % 3)[None, :, None]
    actions = np.choose(kinds, (held, jumping, drawn)).astype(np.float32)
    compiled = jax.jit(run).lower(arms, actions).compile()
    return lambda: jax.block_until_ready(compiled(arms, actions))


@pytest.mark.slow
@pytest.mark.default_precision
def test_examining_energy_costs_much_of_a_control_step_and_flags_no_sound_arm(record):
    env = make("tracking", variant="clean")
    params = env.default_params()
    runs = [playing(env, params, examined) for examined in (False, True)]
    times = [[], []]
    for _ in range(5):
        for run, spent in zip(runs, times, strict=True):
            start = time.process_time()
            flagged, energy = run()
            spent.append(time.process_time() - start)
    record(
        "Sound arms under extreme actions whose energy would be flagged, share",
        "none",
        np.any(energy, axis=0).mean(),
        at_most=0,
    )
    assert not np.any(flagged)
    record(
        "Time of a control step of tracking whose energy is examined, over one without",
        "processor time, the least of five",
        min(times[1]) / min(times[0]),
        between=(1.1, 3.0),
    )
