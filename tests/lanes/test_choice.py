"""Which is taken, lanes or XLA, and what is said about it."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

import jaxrod
from jaxrod.lanes import choice, kernels
from jaxrod.lanes.choice import lane_choices, lanes_wanted, use_lanes
from lanes.test_runs import hanging, shaken


def advanced(rods):
    """Runs a batch; what was chosen for it."""
    scene, state, dt = hanging(4)
    # Only the latest hundred are kept, so that there is no counting from before.
    choice._choices.clear()
    run = lambda s: jaxrod.advance(scene, s, dt, 3)
    jax.jit(jax.vmap(run))(shaken(state, rods, 0))
    return lane_choices()


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("vector", [16, 32, 64])
def test_a_batch_that_fills_half_a_vector_takes_lanes_and_fewer_rows(
    monkeypatch, vector
):
    use_lanes("auto")
    monkeypatch.setattr(kernels, "vector_bytes", lambda: vector)
    width = vector // jnp.zeros(()).dtype.itemsize
    half = max(width // 2, 2)
    for rods, word in ((half, "lanes"), (half - 1, "rows"), (64, "lanes"), (1, "rows")):
        (made,) = advanced(rods)
        assert made.taken and made.why.startswith(word), (rods, made)


@pytest.mark.slow
def test_never_means_never():
    use_lanes("never")
    assert advanced(64) == []


def test_what_lanes_do_not_know_is_left_to_xla_in_one_line():
    @jaxrod.extend.pytree
    class Ranked(jaxrod.extend.Effect):
        def loads(self, rod, motion):
            x, y, z = motion.position
            (ranked, _) = jax.lax.top_k(x, x.size)
            return jaxrod.extend.Loads(forces=(ranked * 1e-3, 0 * y, 0 * z))

    scene, state, dt = hanging(4)
    scene = jaxrod.make_scene(scene.rod, *scene.effects, Ranked())
    many = shaken(state, 8, 0)
    found = jax.jit(jax.vmap(lambda s: jaxrod.advance(scene, s, dt, 3)))(many)
    last = lane_choices()[-1]
    assert not last.taken and "top_k" in last.why and "\n" not in last.why
    use_lanes("never")
    expected = jax.jit(jax.vmap(lambda s: jaxrod.advance(scene, s, dt, 3)))(many)
    assert jnp.array_equal(found.positions, expected.positions)


@pytest.mark.parametrize("backend", ["gpu", "tpu"])
def test_lanes_are_for_cpus_alone(monkeypatch, backend):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    use_lanes("always")
    assert not lanes_wanted()


@pytest.mark.parametrize("mode", ["sometimes", "", None])
def test_a_mode_there_is_not_is_refused_in_words(mode):
    with pytest.raises(ValueError, match="auto, always, loops, rows, never"):
        use_lanes(mode)


def test_a_mode_in_the_environment_that_there_is_not_is_refused_in_words():
    command = "import jaxrod; from jaxrod.lanes.choice import lane_mode; lane_mode()"
    made = subprocess.run(
        [sys.executable, "-c", command],
        env={**os.environ, "JAXROD_LANES": "on"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert made.returncode != 0 and "JAXROD_LANES must be one of" in made.stderr


def test_a_long_step_is_a_loop_and_a_large_one_is_left_to_rows(monkeypatch):
    kernels._run_kernel.cache_clear()
    monkeypatch.setattr(kernels, "MOST_OPERATIONS", 1000)
    use_lanes("auto")
    taken = advanced(9)[-1]
    assert taken.taken and taken.why.startswith("lanes in loops")
    monkeypatch.setattr(kernels, "MOST_MEMORY", 1000)
    taken = advanced(9)[-1]
    assert taken.taken and taken.why.startswith("rows")


@pytest.mark.slow
def test_reverse_passes_of_batches_are_lanes_in_loops():
    scene, state, dt = hanging(4)
    choice._choices.clear()
    use_lanes("auto")
    final = lambda s: jnp.sum(jaxrod.advance(scene, s, dt, 3).positions ** 2)
    jax.jit(jax.vmap(jax.grad(final, allow_int=True)))(shaken(state, 8, 0))
    assert any(made.why.startswith("lanes in loops") for made in lane_choices())
    assert all(made.taken for made in lane_choices())


@pytest.mark.slow
def test_searches_among_thousands_of_elements_are_kernels():
    numbers = dict(length=1.0, radius=0.01, density=1e3, youngs_modulus=1e6)
    rod, one = jaxrod.straight_rod(1100, **numbers)
    _, other = jaxrod.straight_rod(1100, start=(0.05, 0.0, 0.0), **numbers)
    state = {"one": one, "other": other}
    lists = jaxrod.systems.neighbour_lists(pairs=3000, candidates=9000, cell_slots=40)
    contact = jaxrod.systems.rod_contact("one", "other", stiffness=1e3, lists=lists)
    members = {name: jaxrod.make_scene(rod) for name in state}
    system = jaxrod.make_system(members, contact, state=state)
    use_lanes("auto")
    choice._choices.clear()
    jaxrod.advance(system, state, 1e-6, 2)
    chosen = lane_choices()
    assert len(chosen) >= 3 and all(one.taken for one in chosen), chosen
