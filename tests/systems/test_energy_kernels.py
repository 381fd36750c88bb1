"""Energies and health of contact are the same by a kernel and by XLA."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.lanes.choice import lane_choices, lane_mode, use_lanes
from jaxrod.lanes.llvm.machine_code import not_here
from systems.members import rod


@pytest.fixture
def mode():
    """Restores the choice of kernels."""
    before = lane_mode()
    yield
    use_lanes(before)
    jax.clear_caches()


@pytest.mark.slow
@pytest.mark.parametrize("listed", [False, True])
def test_a_kernel_has_the_values_and_derivatives_of_xla(listed, mode):
    if not_here() is not None:
        pytest.skip(not_here())
    one, two = rod(4, 0.4), rod(4, 0.4, (0.2, -0.2, 0.035), (0.0, 1.0, 0.0))
    state = {"one": one[1], "two": two[1]}
    members = {"one": jaxrod.make_scene(one[0]), "two": jaxrod.make_scene(two[0])}
    lists = None
    if listed:
        lists = jaxrod.systems.neighbour_lists(pairs=20, candidates=40, cell_slots=0)
    law = jaxrod.systems.rod_contact("one", "two", stiffness=1e4, lists=lists)
    system = jaxrod.make_system(members, law, state=state)

    def lowered(way):
        moved = state["two"].positions.at[2].add(-way)
        return {**state, "two": replace(state["two"], positions=moved)}

    def energy(way):
        return system.potential_energy(lowered(way))

    def values():
        jax.clear_caches()
        ways = jnp.array([0.0, 0.004, 0.01])
        deep = jax.vmap(lambda w: system.health(lowered(w), 1e-5).largest_violation)
        found = [
            jax.vmap(energy)(ways),
            jax.vmap(jax.grad(energy))(ways),
            jax.jacfwd(jax.grad(energy))(0.004),
            deep(ways),
        ]
        return [np.asarray(one) for one in found]

    use_lanes("auto")
    by_kernel = values()
    assert lane_choices()[-1].taken, lane_choices()[-1].why
    use_lanes("never")
    by_xla = values()
    assert by_xla[0][2] > by_xla[0][1] > 0
    for ours, theirs in zip(by_kernel, by_xla, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-14)
