"""Programs whose first calls are measured: what is prepared, and what is then called.

Each function prepares a model and returns a function without arguments, the call.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from typing import Any

from benchmarks.shared.files import ROOT

Call = Callable[[], Any]


def _blocks(page: str) -> list[str]:
    """Programs in Python that a page prints."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(r"^```python\n(.*?)^```", text, re.S | re.M)


def _run(source: str) -> dict[str, Any]:
    """Names that a program defines; what it prints is dropped."""
    names: dict[str, Any] = {}
    with redirect_stdout(StringIO()):
        exec(source, names)
    return names


def readme_rod() -> Call:
    """README's first program."""
    first, *_ = _blocks("README.md")
    return lambda: _run(first) and None


def readme_numbers() -> Call:
    """README's first program without its replay and its picture."""
    first, *_ = _blocks("README.md")
    numbers, *_ = first.partition("\nscene, state = arm")
    return lambda: _run(numbers) and None


def readme_system() -> Call:
    """README's system."""
    *_, last = _blocks("README.md")
    return lambda: _run("import jaxrod\njaxrod.configure_cpu()\n" + last) and None


def _documented_system() -> tuple[Any, Any, Any]:
    """The system of docs/systems.md, its state, and its stable step [s]."""
    import jaxrod

    names = _run(_blocks("docs/systems.md")[0].partition("\ndt = ")[0])
    system, state = names["system"], names["state"]
    return system, state, jaxrod.stable_dt(system).dt


def system_advance() -> Call:
    """A run of the system of docs/systems.md."""
    import jaxrod

    system, state, dt = _documented_system()
    return lambda: jaxrod.advance(system, state, dt, 1000)


def system_rollout() -> Call:
    """A recorded run of the same system."""
    import jaxrod

    system, state, dt = _documented_system()
    return lambda: jaxrod.rollout(system, state, dt, 1000, 100)


def system_gradient() -> Call:
    """The gradient of a run of the same system with respect to its start."""
    import jax

    import jaxrod

    system, state, dt = _documented_system()

    def height(state: Any) -> Any:
        return jaxrod.advance(system, state, dt, 100)["ball"].positions[2, 0]

    gradient = jax.jit(jax.grad(height))
    return lambda: gradient(state)


def _rod(n_elements: int, **options: Any) -> tuple[Any, Any]:
    """A clamped rod under its weight, and its state."""
    import jaxrod

    rod, state = jaxrod.straight_rod(
        n_elements,
        length=1.0,
        radius=0.02,
        density=1000.0,
        youngs_modulus=1e7,
        direction=(1.0, 0.0, 0.0),
    )
    effects = jaxrod.clamp(state), jaxrod.gravity()
    return jaxrod.make_scene(rod, *effects, **options), state


def equilibrium() -> Call:
    """The equilibrium of a clamped rod of 20 elements under its weight."""
    import jaxrod

    scene, state = _rod(20)
    return lambda: jaxrod.equilibrium(scene, state)


def system_equilibrium() -> Call:
    """The equilibrium of the two welded rods of docs/systems.md."""
    (block,) = [b for b in _blocks("docs/systems.md") if "def at_rest" in b]
    names = _run(block.partition("\nsagging = ")[0])
    return lambda: names["at_rest"](0.05)


def friction_equilibrium() -> Call:
    """The equilibrium of a rod of 40 elements that sticks to a cylinder."""
    import jaxrod

    radius = 0.005
    rod, state = jaxrod.straight_rod(
        40,
        length=1.0,
        radius=radius,
        density=1000.0,
        youngs_modulus=1e6,
        start=(-0.48, 0.0, 0.1 + radius),
        direction=(1.0, 0.0, 0.0),
    )
    post = jaxrod.shapes.cylinder((0.0, -0.5, 0.0), (0.0, 0.5, 0.0), 0.1)
    rough = jaxrod.contact(
        post, stiffness=1e6, damping=1.0, friction=0.3, points_per_element=4
    )
    sticks = jaxrod.sticking_contact(rough, rod, state)
    scene = jaxrod.make_scene(rod, sticks, jaxrod.gravity())
    return lambda: jaxrod.equilibrium(scene, state)


def tendon_equilibrium() -> Call:
    """The equilibrium of `twin.tentacle`, pulled by both tendons."""
    import jaxrod
    from jaxrod import twin

    scene, state = twin.tentacle((3.0, 0.5))
    return lambda: jaxrod.equilibrium(scene, state)


def tendon_friction_equilibrium() -> Call:
    """The equilibrium of an arm of 36 elements whose two tendons rub at rest."""
    import jaxrod

    rod, state = jaxrod.straight_rod(
        36,
        length=0.36,
        radius=0.01,
        density=1000.0,
        youngs_modulus=5.6e5,
        direction=(0.0, 0.0, -1.0),
        normal=(0.0, 1.0, 0.0),
    )
    tendons = jaxrod.actuation.tendon(
        rod,
        ((0.008, 0.0), (-0.004, 0.007)),
        tension=(3.0, 0.5),
        friction=0.2,
        friction_at_rest=1.0,
    )
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity(), tendons)
    return lambda: jaxrod.equilibrium(scene, state)


def implicit_advance() -> Call:
    """Implicit steps of the same rod of 20 elements."""
    import jaxrod

    scene, state = _rod(20, method=jaxrod.implicit(0.8))
    return lambda: jaxrod.advance(scene, state, 0.01, 10)


def _reach() -> Any:
    """The reach of docs/control.md, of an arm of 20 elements."""
    from jaxrod import control
    from jaxrod.envs import actuated_arm

    return control.reach(actuated_arm(20), (0.4, 0.6, 0.2))


def levenberg_marquardt() -> Call:
    """A reach by Levenberg-Marquardt, 5 iterations."""
    from jaxrod import control

    problem = _reach()
    return lambda: control.levenberg_marquardt(problem, iterations=5).controls


def adam() -> Call:
    """A reach by Adam, 20 iterations."""
    from jaxrod import control

    problem = _reach()
    return lambda: control.adam(problem, iterations=20).controls


def mpc() -> Call:
    """The planner of docs/planning.md: its first action in one episode."""
    import jax
    import jax.numpy as jnp

    from jaxrod import control
    from jaxrod.envs import make

    env = make("reaching", variant="clean", n_elements=10, episode_length=160)
    policy = control.mpc(env, horizon=48, knots=3)
    observation, state = env.reset(jax.random.key(0), env.default_params())
    states = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], state)
    memory = policy.init(observation[None], states)
    act = jax.jit(policy.act)
    return lambda: act(memory, observation[None], states)


def fit() -> Call:
    """The fit of docs/identification.md."""
    from jaxrod import control

    names = _run(_blocks("docs/identification.md")[0].partition("\nfit = ")[0])
    seen = names["film"](names["truth"]) + names["noise"]
    return lambda: control.fit(names["film"], seen, names["start"], noise=1e-3).values


def identify() -> Call:
    """The twin of docs/twin.md."""
    import os
    import tempfile

    import jax

    from jaxrod import twin

    source = _blocks("docs/twin.md")[0].partition("\nwith jax.enable_x64")[0]
    with tempfile.TemporaryDirectory() as folder:
        here = os.getcwd()
        os.chdir(folder)
        try:
            _run(source)
            arm = twin.read_arm("arm.toml")
            pose = twin.read_recording("pose.csv", arm)
        finally:
            os.chdir(here)

    def found() -> Any:
        with jax.enable_x64(True):
            return twin.identify(arm, [pose]).fit.values

    return found


def linearise() -> Call:
    """The linear model of docs/estimation.md."""
    from jaxrod import control

    source = _blocks("docs/estimation.md")[0].partition("\n# What becomes of")[0]
    names = _run(source + "\ncalm = jnp.zeros(3)\n")
    scene, rest, dt, steps = (names[k] for k in ("scene", "rest", "dt", "steps"))

    def linear() -> Any:
        made = control.linearise(
            scene,
            rest,
            dt,
            steps,
            control=names["calm"],
            with_control=names["blown"],
            measure=names["markers"],
        )
        return made.state_matrix, made.input_matrix, made.output_matrix

    return linear
