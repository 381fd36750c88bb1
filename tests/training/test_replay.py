"""The replay ring forgets the oldest and recalls everything else alike."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.training.algorithms.replay import (
    Transition,
    append,
    empty_replay,
    sample,
    sample_indices,
)

ENVS = 3


def steps_from(first, count):
    """Transitions that say in which time step and environment they happened."""
    when = jnp.arange(first, first + count)[:, None] + jnp.zeros((1, ENVS))
    where = jnp.arange(ENVS)[None] + jnp.zeros((count, 1))
    both = jnp.stack([when, where], axis=-1)
    return Transition(
        observation=both,
        action=-where[..., None],
        reward=10 * when,
        next_observation=both + 1,
        terminated=when % 2 == 0,
    )


def ring_after(blocks, slots=12, block=4):
    replay = empty_replay(slots, ENVS, 2, 1, jnp.float64)
    write = jax.jit(append)
    for i in range(blocks):
        replay = write(replay, steps_from(block * i, block))
    return replay


def test_a_full_ring_holds_the_newest_steps_and_nothing_else():
    for blocks in (1, 3, 4, 8):
        replay = ring_after(blocks)
        kept = np.sort(np.asarray(replay.transitions.reward[:, 0]) / 10)
        newest = np.arange(max(0, 4 * blocks - 12), 4 * blocks)
        np.testing.assert_array_equal(kept[12 - len(newest) :], newest)
        assert int(replay.size) == len(newest)


def test_a_block_that_would_run_over_the_end_is_refused():
    replay = empty_replay(12, ENVS, 2, 1, jnp.float64)
    with pytest.raises(ValueError, match=r"12 slots, got 5"):
        append(replay, steps_from(0, 5))


@pytest.mark.slow
def test_fields_of_a_transition_stay_together():
    replay = ring_after(5)
    keys = jax.random.split(jax.random.key(0), ENVS)
    times = sample_indices(replay, keys, 7, 4)
    assert times.shape == (7, 4, ENVS)
    batch = sample(replay, times[3])
    when, where = batch.observation.T
    assert when.shape == (4 * ENVS,)
    np.testing.assert_array_equal(batch.reward, 10 * when)
    np.testing.assert_array_equal(batch.action[:, 0], -where)
    np.testing.assert_array_equal(batch.next_observation, batch.observation + 1)
    np.testing.assert_array_equal(batch.terminated, when % 2 == 0)
    # Every environment gives the same number of samples.
    assert np.all(np.bincount(where.astype(int)) == 4)


@pytest.mark.parametrize("blocks", [2, 5])
def test_every_transition_there_is_is_recalled_equally_often(blocks):
    replay = ring_after(blocks)
    filled = min(4 * blocks, 12)
    draws = 20_000
    keys = jax.random.split(jax.random.key(1), ENVS)
    times = np.asarray(sample_indices(replay, keys, draws, 1))
    for env in range(ENVS):
        counts = np.bincount(times[:, 0, env], minlength=12)
        assert np.all(counts[filled:] == 0)
        expected = draws / filled
        # Chi squared with filled - 1 degrees of freedom, six deviations off.
        chi = np.sum((counts[:filled] - expected) ** 2) / expected
        assert chi < filled - 1 + 6 * np.sqrt(2 * (filled - 1))


def test_what_an_environment_recalls_does_not_depend_on_its_neighbours():
    keys = jax.random.split(jax.random.key(2), ENVS)
    together = sample_indices(ring_after(3), keys, 5, 2)
    alone = sample_indices(ring_after(3), keys[1:2], 5, 2)
    np.testing.assert_array_equal(together[:, :, 1:2], alone)
