"""Advantages against the definition, written as a plain loop."""

from __future__ import annotations

import numpy as np
import pytest

from jaxrod.training.algorithms.on_policy import generalised_advantages


def by_definition(reward, value, last, final, terminated, done, gamma, decay):
    steps = len(reward)
    advantage = np.zeros(steps)
    for t in range(steps):
        weight = 1.0
        for k in range(t, steps):
            if terminated[k]:
                following = 0.0
            elif done[k]:
                following = final[k]
            else:
                following = value[k + 1] if k + 1 < steps else last
            advantage[t] += weight * (reward[k] + gamma * following - value[k])
            weight *= gamma * decay
            if done[k]:
                break
    return advantage


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(("gamma", "decay"), [(0.99, 0.95), (0.9, 0.0), (1.0, 1.0)])
def test_equals_the_definition_with_truncation_and_termination(gamma, decay, dtype):
    random = np.random.default_rng(0)
    steps, num_envs = 40, 6
    reward, value, final = random.normal(size=(3, steps, num_envs)).astype(dtype)
    last = random.normal(size=num_envs).astype(dtype)
    terminated = random.random((steps, num_envs)) < 0.1
    done = terminated | (random.random((steps, num_envs)) < 0.1)
    advantage = generalised_advantages(
        reward, value, last, final, terminated, done, gamma, decay
    )
    assert advantage.dtype == dtype
    for i in range(num_envs):
        expected = by_definition(
            *(array[:, i] for array in (reward, value)),
            last[i],
            *(array[:, i] for array in (final, terminated, done)),
            gamma,
            decay,
        )
        tolerance = 1e-4 if dtype == np.float32 else 1e-12
        np.testing.assert_allclose(advantage[:, i], expected, tolerance, tolerance)


def test_final_value_is_read_only_where_an_episode_is_cut_short():
    zeros = np.zeros((3, 1))
    cut = np.array([[False], [True], [False]])
    poison = np.where(cut, 2.0, np.nan)
    advantage = generalised_advantages(
        zeros, zeros, np.zeros(1), poison, cut & False, cut, 0.5, 0.0
    )
    np.testing.assert_allclose(advantage, [[0.0], [1.0], [0.0]])
