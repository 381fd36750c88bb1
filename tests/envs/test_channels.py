"""Descriptions of observations and actions say what is where."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxrod.envs import make, names


@pytest.mark.parametrize("task", names())
@pytest.mark.parametrize("vector", ["observation", "action"])
def test_channels_of_a_task_are_its_whole_vector(task, vector):
    env = make(task)
    channels = getattr(env, f"{vector}_channels")
    sizes = [channel.size for channel in channels]
    assert min(sizes) > 0 and sum(sizes) == getattr(env, f"{vector}_size")
    assert all(channel.name and channel.unit for channel in channels)
    assert len({channel.name for channel in channels}) == len(channels)


@pytest.mark.fast_sets(5)
@pytest.mark.parametrize(
    ("task", "part", "words"),
    [
        ("tracking", ("target", "position"), ["position of the target: x, y, z"]),
        ("tracking", ("target", "velocity"), ["speed of the target", "direction"]),
        ("reaching", ("target", "position"), ["position of the goal: x, y, z"]),
        ("reaching", ("target", "orientation"), ["orientation of the goal"]),
        ("structured", ("target", "position"), ["position of the target: x, y, z"]),
        ("following", ("target", "velocity"), ["velocity of the target"]),
        ("following", ("angles",), ["angles of the segments"]),
        ("following", ("arm", "velocities"), ["velocities of these ends"]),
        ("snake", ("controls",), ["current control values"]),
        ("snake", ("body", "positions"), ["cosine", "curvatures to", "rates", "veloc"]),
        ("octopus", ("controls",), ["current control values"]),
        ("lift", ("velocity",), ["velocity of the hand"]),
        ("lift", ("target",), ["vector from the free end", "vector from the hand"]),
        ("insert", ("inwards",), ["axis of the socket"]),
        ("insert", ("mouth",), ["vector from the tip", "vector from the hand"]),
        ("catheter", ("branch",), ["vector from the tip", "direction of the branch"]),
        (
            "catheter",
            ("velocity",),
            [
                "velocity of the base",
                "velocity of its turn",
                "velocity of the tip's angle",
            ],
        ),
        ("gripper", ("controls",), ["current control values", "offset of the ball"]),
    ],
)
def test_what_changes_in_an_observation_is_what_its_channel_names(task, part, words):
    """All numbers of one part of the state change, and the channels that name it."""
    env = make(task)
    params = env.default_params()
    _, state = env.reset(jax.random.key(0), params)
    changed = moved(state, part)
    observe = lambda state: np.asarray(
        env.observe(state, params)
        if task not in ("octopus", "gripper")
        else env.observe(state)
    )
    apart = observe(changed) != observe(state)
    first, seen = 0, []
    for channel in env.observation_channels:
        if apart[first : first + channel.size].any():
            seen.append(channel.name)
        first += channel.size
    assert seen
    for name in seen:
        assert any(name.startswith(word) for word in words), name


def moved(state, part):
    """A state with the numbers of a part of it changed."""
    name, *rest = part
    old = getattr(state, name)
    random = np.random.default_rng(0)
    if rest:
        return dataclasses.replace(state, **{name: moved(old, rest)})
    new = old + 0.1 * random.random(old.shape)
    return dataclasses.replace(state, **{name: new.astype(old.dtype)})
