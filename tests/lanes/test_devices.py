"""Lanes on several devices, and in programs that leave the process."""

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from jax import export

import jaxrod
from jaxrod.lanes.choice import lane_choices
from jaxrod.lanes.primitives import cycles_p
from jaxrod.lanes.run_spec import LoopBody, RunSpec
from lanes.test_runs import hanging, shaken

PROGRAM = """
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)
from jax.sharding import AxisType, NamedSharding, PartitionSpec
import jaxrod
from lanes.test_runs import apart, hanging, shaken
scene, state, dt = hanging(3)
many = shaken(state, 8, 0)
run = lambda rods: jax.vmap(lambda s: jaxrod.advance(scene, s, dt, 9))(rods)
jaxrod.use_lanes("never")
expected = jax.jit(lambda rods: run(rods))(many)
jaxrod.use_lanes("always")
mesh = jax.make_mesh((2,), ("i",), axis_types=(AxisType.Auto,))
each = PartitionSpec("i")
spread = jax.device_put(many, NamedSharding(mesh, each))
own = jax.jit(jax.shard_map(run, mesh=mesh, in_specs=each, out_specs=each))
assert apart(jax.device_get(own(spread)), jax.device_get(expected)) < 1e-11
last = jaxrod.lane_choices()[-1]
assert last.taken and last.rods == 4, last
left = jax.jit(lambda rods: run(rods))(spread)
assert apart(jax.device_get(left), jax.device_get(expected)) < 1e-11
last = jaxrod.lane_choices()[-1]
assert not last.taken and "spreads" in last.why, last
"""


@pytest.mark.slow
def test_each_device_has_lanes_within_shard_map_and_none_without():
    made = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        check=False,
    )
    assert made.returncode == 0, made.stderr[-3000:]


@pytest.mark.slow
def test_a_program_to_be_exported_has_no_kernels_in_it():
    scene, state, dt = hanging(3)
    run = jax.jit(jax.vmap(lambda s: jaxrod.advance(scene, s, dt, 3)))
    many = shaken(state, 8, 0)
    exported = export.export(run)(many)
    assert not lane_choices()[-1].taken
    assert exported.call(many).positions.shape == (8, 3, 4)


def test_cycles_for_two_platforms_have_no_kernel_for_one():
    rows = jnp.ones((8, 3))
    closed = jax.make_jaxpr(lambda x: [2 * x])(rows[0])
    spec = RunSpec(LoopBody(closed, 0), 1)
    run = jax.jit(jax.vmap(lambda x: cycles_p.bind(jnp.int32(1), x, spec=spec)))
    run.trace(rows).lower(lowering_platforms=("cpu", "cuda"))
    last = lane_choices()[-1]
    assert not last.taken and "several platforms" in last.why
