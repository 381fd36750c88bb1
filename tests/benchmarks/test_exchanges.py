"""Bytes that devices send each other, read from the program's text."""

from __future__ import annotations

import json
import subprocess
import sys

import jax
import pytest

from benchmarks.scaling.exchanges import Exchange, exchanges

PROGRAM = """
import dataclasses, json, sys
import jax
jax.config.update("jax_num_cpu_devices", 2)
from benchmarks.scaling.exchanges import exchanges
from benchmarks.scaling.run import updates
from jaxrod.envs.trivial import Trivial
from jaxrod.training import find_algorithm
name, settings = sys.argv[1], json.loads(sys.argv[2])
config = find_algorithm(name).config_type(hidden_sizes=(8,), **settings)
state, lowered = updates(Trivial(), name, config, jax.devices())
weights = getattr(state, "weights", None) or state.learner.weights
print(json.dumps([
    {key: sum(leaf.nbytes for leaf in jax.tree.leaves(tree))
     for key, tree in weights.items()},
    [dataclasses.asdict(e) for e in exchanges(lowered.compile().as_text())],
]))
"""


def exchanged(name, **settings):
    """Bytes of the weights, and what an update exchanges."""
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM, name, json.dumps(settings)],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    weights, found = json.loads(run.stdout.splitlines()[-1])
    return weights, [Exchange(**exchange) for exchange in found]


def test_loops_multiply_what_is_in_them():
    text = """HloModule two

%inner (a: f32[3]) -> f32[3] {
  %a = f32[3]{0} parameter(0)
  ROOT %b = f32[3]{0} all-reduce(%a), replica_groups={{0,1}}, to_apply=%add
}

%open (a: (s32[], f32[3])) -> (s32[], f32[3]) {
  %c = (s32[], f32[3]{0}) while(%a), body=%inner, backend_config={"known_trip_count":{"n":"5"}}
  %d = (f64[2]{0}, pred[4]{0}) all-gather-start(%c), dimensions={0}
}

%left (a: f32[3]) -> f32[3] {
  ROOT %b = f32[3]{0} add(%a, %a)
}

ENTRY %main (a: f32[3]) -> f32[3] {
  %e = f32[3]{0} conditional(%p, %x, %y), branch_computations={%inner, %left}
  ROOT %f = (s32[], f32[3]{0}) while(%e), condition=%inner, body=%open
}
"""  # noqa: E501
    assert exchanges(text) == [
        Exchange("all-reduce", 12, 1, 0),
        Exchange("all-reduce", 12, 1, 1),
        Exchange("all-reduce", 12, 5, 1),
        Exchange("all-gather", 20, 1, 1),
    ]
    unreached = text.replace("branch_computations={%inner, %left}", "")
    with pytest.raises(ValueError, match="nothing calls inner"):
        exchanges(unreached.replace("=%inner", ""))


def test_a_program_of_one_device_exchanges_nothing():
    compiled = jax.jit(lambda x: jax.numpy.sort(x) * 2).lower(jax.numpy.ones(3))
    assert exchanges(compiled.compile().as_text()) == []


@pytest.mark.slow
def test_ppo_exchanges_gradients_and_a_few_means():
    few = {"rollout_steps": 16, "epochs": 2, "minibatches": 4}
    weights, found = exchanged("ppo", num_envs=8, **few)
    inside = [exchange for exchange in found if exchange.open_loops == 1]
    # A gradient for each of the 2 x 4 minibatches, in one array.
    gradients = [e for e in inside if e.times == 8]
    assert [e.size for e in gradients] == [sum(weights.values())]
    rest = sum(e.bytes for e in found) - sum(e.bytes for e in gradients)
    assert rest < 200
    # Nothing grows with the batch.
    assert exchanged("ppo", num_envs=32, **few)[1] == found


@pytest.mark.slow
def test_sac_exchanges_gradients_and_a_few_means():
    few = {"batch_size": 32, "gradient_steps": 2, "buffer_size": 1024}
    weights, found = exchanged("sac", num_envs=8, **few)
    # Gradient steps are a loop that begins when there is enough to learn from.
    gradients = [exchange for exchange in found if exchange.open_loops == 2]
    assert {e.times for e in gradients} == {1}
    learned = sum(weights[name] for name in ("critics", "policy"))
    assert learned <= sum(e.size for e in gradients) <= learned + 8
    assert sum(e.bytes for e in found if e.open_loops < 2) < 100
    assert exchanged("sac", num_envs=16, **few)[1] == found
