"""What a replay accepts, and what it refuses in which words."""

from __future__ import annotations

import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.viz import Cylinder, Replay, Sphere
from viz.swinging_arm import swinging_arm

T, N = 4, 3
TIMES = np.linspace(0, 0.3, T)
NODES = np.random.default_rng(0).normal(size=(T, N + 1, 3))


def test_component_first_arrays_give_the_same_replay():
    one = Replay.from_nodes(NODES, np.full(N, 0.1), TIMES)
    same = Replay.from_rollout(NODES.swapaxes(1, 2), np.full(N, 0.1), TIMES)
    np.testing.assert_array_equal(one.positions, same.positions)
    batch = np.stack([NODES, NODES + 1], axis=1)
    many = Replay.from_rollout(batch.swapaxes(2, 3), np.full((2, N), 0.1), TIMES)
    np.testing.assert_array_equal(many.positions, batch)
    assert many.num_rods == 2


@pytest.mark.parametrize("kind", ["float32", "float64", "bfloat16"])
def test_jax_arrays_of_any_precision_are_accepted(kind):
    replay = Replay.from_nodes(jnp.asarray(NODES, kind), jnp.float32(0.1), TIMES)
    np.testing.assert_allclose(replay.positions[:, 0], NODES, rtol=1e-2)


def test_the_replay_does_not_change_when_the_caller_reuses_an_array():
    nodes = NODES.copy()
    replay = Replay.from_nodes(nodes, 0.1, TIMES)
    nodes[:] = 0
    np.testing.assert_array_equal(replay.positions[:, 0], NODES)


def test_the_bounds_hold_everything():
    replay = Replay.from_nodes(
        NODES,
        0.1,
        TIMES,
        spheres=[Sphere((9.0, 0.0, 0.0), 1.0)],
        cylinders=[Cylinder((0.0, -9.0, 0.0), (0.0, 0.0, 0.0), 0.5)],
    )
    low, high = replay.bounds()
    assert high[0] == 10.0
    assert low[1] == -9.5
    assert np.all(low <= NODES.min(axis=(0, 1)) - 0.1)


BAD = NODES.copy()
BAD[2, 1, 0] = np.nan


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": NODES[..., :2]}, r"positions must have shape .* \[m\].*, got"),
        ({"positions": NODES[:, :1]}, "at least 2 nodes"),
        ({"positions": BAD}, r"positions must be finite, got nan m .*\(t = 0.2 s\)"),
        ({"positions": "arm"}, r"positions must be an array of numbers \[m\], got str"),
        ({"radii": np.full(N + 1, 0.1)}, r"radii must have shape \(3,\).* \[m\], got"),
        ({"radii": -0.01}, "radii must be positive, got -0.01 m"),
        ({"times": TIMES[:-1]}, r"times must have shape \(4,\) \[s\].*got \(3,\)"),
        (
            {"times": TIMES[::-1]},
            "times must increase, got 0.3 s then 0.2 s at index 1",
        ),
        ({"up": "w"}, "up must be .* got 'w'"),
        ({"rod_names": ["a", "b"]}, "rod_names must be empty or hold 1 names, got 2"),
        (
            {"readouts": {"reward": [1.0]}},
            r"readouts\['reward'\] must have shape \(4,\)",
        ),
        ({"spheres": [Sphere((0, 0), 1)]}, r"spheres\[0\].positions must have shape"),
        ({"spheres": [Sphere((0, 0, 0), 0)]}, r"spheres\[0\].radius must .* got 0 m"),
        (
            {"cylinders": [Cylinder((0, 0, 0), (0, 0, 0), 1)]},
            r"cylinders\[0\] must have a length",
        ),
    ],
)
def test_impossible_input_is_refused_by_name_value_and_unit(change, message):
    arguments = {"positions": NODES, "radii": 0.1, "times": TIMES} | change
    with pytest.raises(ValueError, match=message):
        Replay.from_nodes(**arguments)


def test_a_notebook_gets_the_page_in_a_frame():
    shown = swinging_arm(num_frames=5)._repr_html_()
    assert shown.startswith("<iframe srcdoc=")
    assert shown.count("<") == 2


def test_importing_viz_does_not_import_matplotlib():
    program = "import sys, jaxrod.viz; sys.exit('matplotlib' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True)
