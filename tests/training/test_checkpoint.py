"""Checkpoints give back what was saved, or say what is wrong."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.envs import make
from jaxrod.files import DamagedFileError
from jaxrod.training.runs.checkpoint import Checkpoints


@pytest.fixture
def checkpoints(tmp_path):
    return Checkpoints(tmp_path / "checkpoints")


def test_keys_numbers_and_empty_arrays_come_back(checkpoints):
    state = {
        "key": jax.random.key(3),
        "nothing": jnp.zeros((0,)),
        "number": jnp.float32(0.1),
        "several": jnp.arange(6).reshape(2, 3),
        "short": jnp.asarray([1.5, -2.0], jnp.bfloat16),
        "whether": jnp.asarray([True, False]),
    }
    checkpoints.save(1, state, {"steps": 7})
    template = jax.tree.map(jnp.zeros_like, state)
    restored, facts = checkpoints.restore(template)
    assert facts == {"steps": 7}
    assert jax.tree.structure(restored) == jax.tree.structure(state)
    for a, b in zip(*map(jax.tree.leaves, (state, restored)), strict=True):
        assert a.dtype == b.dtype and a.shape == b.shape
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("now", "said"),
    [
        ({"a": jnp.zeros(4), "b": 1}, r"float64\[3\] at state\['a'\].* float64\[4\]"),
        ({"a": jnp.zeros(3, "f4"), "b": 1}, r"holds float64\[3\].* needs float32\[3\]"),
        ({"a": jax.random.key(0), "b": 1}, r"this run needs key<fry>\[2\]"),
        # Of the same number, kinds and shapes: by its place it would be taken.
        ({"a": jnp.zeros(3), "c": 1}, r"lacks state\['c'\], also has state\['b'\]"),
        ({"a": jnp.zeros(3)}, r"also has state\['b'\]"),
    ],
)
def test_another_structure_is_refused_by_name(checkpoints, now, said):
    arrays = lambda tree: jax.tree.map(jnp.asarray, tree)
    checkpoints.save(1, arrays({"a": jnp.zeros(3), "b": 1}), {})
    with pytest.raises(ValueError, match=rf"0000000001\.npz .*{said}"):
        checkpoints.restore(arrays(now))


ARMS = ("tracking", "reaching", "structured", "unstructured")


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("name", "variant"),
    [
        *((name, variant) for name in ARMS for variant in ("paper", "clean")),
        pytest.param("following", "clean", marks=pytest.mark.slow),
        pytest.param("snake", "clean", marks=pytest.mark.slow),
        pytest.param("octopus", "clean", marks=pytest.mark.slow),
        pytest.param("gripper", "clean", marks=pytest.mark.slow),
    ],
)
def test_the_parameters_of_every_task_come_back(name, variant, checkpoints):
    """Two control points, as in Cases 3 and 4, have no breaks between them."""
    params = make(name, variant=variant).default_params()
    checkpoints.save(1, params, {})
    restored, _ = checkpoints.restore(jax.tree.map(jnp.zeros_like, params))
    for a, b in zip(*map(jax.tree.leaves, (params, restored)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_only_its_own_old_files_are_removed(checkpoints):
    folder, state = checkpoints.folder, {"a": jnp.zeros(2)}
    folder.mkdir()
    others = ["1", "5.npz", "0000000001.npz.copy", "model.pt"]
    for name in others:
        (folder / name).write_text("mine")
    (folder / "0000000000.npz").mkdir()
    for step in (1, 2, 3):
        checkpoints.save(step, state, {})
    assert checkpoints.steps() == [3, 2]
    kept = {"0000000000.npz", "0000000002.npz", "0000000003.npz", *others}
    assert {file.name for file in folder.iterdir()} == kept
    # A damaged later one must not push out the one to go on from.
    checkpoints.path(9).write_text("torn")
    checkpoints.restore(state, 3)
    checkpoints.save(4, state, {})
    assert checkpoints.steps() == [9, 4, 3]


def test_every_flipped_byte_of_the_numbers_is_noticed(checkpoints):
    state = {"a": jnp.arange(40.0)}
    checkpoints.save(1, state, {"updates": 1})
    file = checkpoints.path(1)
    whole = file.read_bytes()
    numbers = whole.index(np.arange(40.0).tobytes())
    for place in range(numbers, numbers + 320, 17):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        with pytest.raises(DamagedFileError, match=r"0000000001\.npz is damaged: "):
            checkpoints.restore(state)
    for length in range(0, len(whole), 41):
        file.write_bytes(whole[:length])
        with pytest.raises(DamagedFileError, match="is damaged: it is torn"):
            checkpoints.restore(state)
