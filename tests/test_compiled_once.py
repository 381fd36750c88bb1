"""A user's own program is traced and compiled once, whatever jaxrod imports on the way.

JAX looks programs up by its options too. A package that registers one when it is
imported, as Pallas does, has everything traced before compiled once more.
"""

import subprocess
import sys

import pytest

EVERY_MODULE = """
import importlib, pkgutil, sys
import jax
import jax.numpy as jnp

traces = []

@jax.jit
def doubled(x):
    traces.append(x)
    return 2 * x

doubled(jnp.ones(3))
import jaxrod

# What stands on flax or on another program's interface imports that at once.
others = ("cli", "training", "brax", "gym", "goal_env", "stable_baselines", "torch")
for package in ("jaxrod", "jaxrod.envs"):
    root = importlib.import_module(package)
    for module in pkgutil.walk_packages(root.__path__, f"{package}."):
        if "__main__" in module.name or any(o in module.name for o in others):
            continue
        importlib.import_module(module.name)
        doubled(jnp.ones(3))
        assert len(traces) == 1, f"{module.name} changes the options of JAX"
assert {"jaxrod.stepping.runs", "jaxrod.lanes.primitives"} <= set(sys.modules)
assert not [name for name in sys.modules if name.startswith("jax.extend")]
"""

EVERY_FUNCTION = """
import jax
import jax.monitoring
import jax.numpy as jnp
import jaxrod

compiled, traces = [], []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **more: compiled.append(event)
    if event == "/jax/core/compile/backend_compile_duration" else None
)
rod, start = jaxrod.straight_rod(
    4, length=1.0, radius=0.05, density=1000.0, youngs_modulus=1e6
)
scene = jaxrod.make_scene(rod, jaxrod.clamp(start), jaxrod.gravity())
other = jaxrod.make_scene(rod, jaxrod.gravity())
states = {"a": start, "b": start}
ends = ("a", 4), ("b", 4)
joint = jaxrod.systems.ball_joint(*ends, states, stiffness=1e3, damping=1.0)
system = jaxrod.make_system({"a": scene, "b": other}, joint, state=states)
many = jax.tree.map(lambda leaf: jnp.stack([leaf] * 8), start)
numbers = [jnp.float32(1e-5 * k) for k in (1, 2, 3)]
programs = {
    "step": lambda dt: jaxrod.step(scene, start, dt).tip,
    "advance": lambda dt: jaxrod.advance(scene, start, dt, 3).tip,
    "advance of a batch": lambda dt: jax.vmap(
        lambda s: jaxrod.advance(scene, s, dt, 3).tip)(many),
    "advance of a system": lambda dt: jaxrod.advance(system, states, dt, 3)["b"].tip,
    "gradient": jax.grad(lambda dt: jaxrod.advance(scene, start, dt, 3).tip[1]),
    "rollout": lambda dt: jaxrod.rollout(scene, start, dt, 4, 2).tip,
    "stable_dt": lambda dt: jaxrod.stable_dt(scene, 0.5 + dt).dt,
    "stable_dt of a system": lambda dt: jaxrod.stable_dt(system, 0.5 + dt).dt,
    "highest_frequency": lambda dt: jaxrod.highest_frequency(scene, start) * dt,
    "equilibrium": lambda dt: jaxrod.equilibrium(scene, start).state.tip * dt,
    "reactions": lambda dt: dt * jaxrod.reactions(scene, start)[0].force[0],
    "total_energy": lambda dt: scene.total_energy(start) * dt,
    "health": lambda dt: jaxrod.health(scene, start, dt),
}
chosen = sys.argv[1:] or list(programs)
for name in chosen:
    traces.clear()

    @jax.jit
    def program(dt):
        traces.append(dt)
        return programs[name](dt)

    for k, dt in enumerate(numbers):
        before = len(compiled)
        jax.block_until_ready(program(dt))
        new = len(compiled) - before
        assert len(traces) == 1, f"{name}: call {k + 1} traces it again"
        assert new == 0 if k else new >= 1, f"{name}: call {k + 1} compiles {new} times"
    assert program._cache_size() == 1, name
"""


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    "program", [EVERY_MODULE, EVERY_FUNCTION], ids=["modules", "functions"]
)
def test_nothing_imported_on_the_way_has_a_program_compiled_again(program):
    done = subprocess.run(
        [sys.executable, "-c", "import sys\n" + program], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
