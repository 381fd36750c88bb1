"""One contract for all methods: what an effect's hook does in one it does in all.

A new method is a row of `METHODS`, a new hook a row of `HOOKS`. Every effect here uses
one hook alone. All are in one scene, switched on one at a time, so that there is one
program for each method and precision.
"""

import itertools
from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.structure import pytree
from physics.rods import arm
from physics.single_hooks import HOOKS

# The programs run a few times: LLVM need not optimise them.
hurried = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
N, STEPS, DT = 3, 40, 5e-5

# How each is chosen.
METHODS = {
    "consistent": jaxrod.consistent(),
    "planar": jaxrod.planar("zx"),
    "torsion free": jaxrod.torsion_free(),
    "pyelastica": jaxrod.pyelastica(),
    "planar pyelastica": jaxrod.planar("zx", jaxrod.pyelastica()),
    "implicit": jaxrod.implicit(1.0),
}
# How far what an effect does may be from what it does in consistent mode, of its size:
# rounding, or another law or integrator, where a hook that is missing or called twice
# would be off by one.
ROUNDING = {"float64": 1e-9, "float32": 0.02}
ANOTHER = {"pyelastica": 0.05, "planar pyelastica": 0.05, "implicit": 0.05}


OFF, ON = np.zeros(len(HOOKS)), np.eye(len(HOOKS))


def moving(dtype):
    """A rod along x that moves in the zx plane; of positions with large remainders."""
    rod, state = arm(N, dtype, youngs_modulus=1e6, direction=(1.0, 0.0, 0.0))
    s = jnp.linspace(0, 1, N + 1, dtype=dtype)
    zero = jnp.zeros_like(s)
    remainders = 1e-3 * jnp.stack([jnp.sin(3 * s), zero, jnp.cos(2 * s)])
    state = replace(
        state,
        positions=state.positions + remainders,
        velocities=jnp.stack([jnp.cos(2 * s), zero, s * s]),
        remainders=remainders,
    )
    turning = jnp.zeros((3, N), dtype).at[0].set(5.0)
    return rod, jaxrod.with_angular_velocities(rod, state, turning)


def whereabouts(sizes, method):
    """Nodes [m] and elements [quaternions] after steps with effects of given sizes."""
    rod, state = moving(sizes.dtype)
    effects = [kind(size) for kind, size in zip(HOOKS, sizes, strict=True)]
    scene = jaxrod.make_scene(rod, *effects, method=METHODS[method])
    end = jaxrod.advance(scene, state, DT, STEPS)
    nodes = jnp.pad(end.positions, ((0, 1), (0, 0)))
    return jnp.concatenate([nodes, end.orientations], axis=1)


@cache
def consequences(method, dtype):
    """What each effect does to every node and element."""
    sizes = jnp.asarray([OFF, *ON], dtype)
    program = hurried(jax.vmap(lambda sizes: whereabouts(sizes, method)))
    without, *ends = np.asarray(program(sizes), np.float64)
    return [end - without for end in ends]


def gap(one, other):
    """Largest difference at a node or element, of what is done there."""
    change, size = (np.linalg.norm(a, axis=0) for a in (one - other, other))
    return np.max(change / np.maximum(size, 0.1 * np.max(size)))


def slow_if(condition):
    return [pytest.mark.slow] if condition else []


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("method", "kind"),
    [
        pytest.param(*each, marks=slow_if(each == ("implicit", "float32")))
        for each in itertools.product(METHODS, ROUNDING)
    ],
)
def test_an_effect_has_the_same_consequence_in_every_method(method, kind):
    found = consequences(method, jnp.dtype(kind))
    expected = consequences("consistent", jnp.dtype("float64"))
    for hook, one, other in zip(HOOKS, found, expected, strict=True):
        assert np.max(np.abs(other)) > 1e-4, f"{hook.__name__} does nothing"
        assert gap(one, other) <= ANOTHER.get(method, ROUNDING[kind]), hook.__name__


# Minutes of compiling, all together.
@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    [pytest.param(method, marks=slow_if(method != "planar")) for method in METHODS],
)
def test_every_consequence_is_differentiable_and_the_same_in_a_batch(method):
    def tip(sizes):
        places = whereabouts(sizes, method)
        weights = jnp.cos(jnp.arange(places.size)).reshape(places.shape)
        return jnp.vdot(weights, places), places

    differentiated = hurried(jax.value_and_grad(tip, has_aux=True))
    step = 1e-4
    without = differentiated(jnp.asarray(OFF))[0][1]
    batch = consequences(method, jnp.dtype("float64"))
    for k, hook in enumerate(HOOKS):
        (_, places), slopes = differentiated(jnp.asarray(ON[k]))
        np.testing.assert_allclose(places - without, batch[k], atol=1e-11)
        sizes = [jnp.asarray((1 + way * step) * ON[k]) for way in (-1, 1)]
        low, high = (float(differentiated(size)[0][0]) for size in sizes)
        expected = (high - low) / (2 * step)
        assert float(slopes[k]) == pytest.approx(expected, rel=1e-6, abs=1e-10), hook


@pytree
class Nothing(jaxrod.extend.Effect):
    """Overrides no hook that a step calls."""

    def energy(self, rod, state):
        return 0.0


def one_step(method, *effects):
    """A step of a rod with effects, to be traced; and what it is called with."""
    rod, state = moving(jnp.dtype("float64"))
    scene = jaxrod.make_scene(rod, *effects, method=METHODS[method])
    return lambda scene, state: jaxrod.step(scene, state, DT), (scene, state)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    "method",
    [pytest.param(method, marks=slow_if(method == "implicit")) for method in METHODS],
)
def test_every_method_calls_every_hook_that_is_alone(method):
    """Whatever else is in a scene: no other effect is there to have it called."""
    for hook in HOOKS:
        overridden = set(vars(hook)) & {
            "loads",
            "drag",
            "constrain",
            "constrain_rates",
            "damping_rates",
            "dissipate",
        }
        calls = []

        def heard(original, calls=calls):
            def call(*arguments):
                calls.append(arguments)
                return original(*arguments)

            return call

        # Of drag and the same as loads a method asks for one.
        spies = {name: heard(vars(hook)[name]) for name in overridden}
        spy = type(hook.__name__, (hook,), {**spies, **kept(hook)})
        step, numbers = one_step(method, pytree(spy)(jnp.asarray(1.0)))
        calls.clear()
        jax.eval_shape(step, *numbers)
        assert calls, f"{hook.__name__}: {overridden} are not called"


def kept(hook):
    """What a subclass with loads of its own has to say again."""
    return {"wall": hook.wall} if "wall" in vars(hook) else {}


@pytest.mark.fast_sets(1)
@pytest.mark.usefixtures("compiled_for_cpus")
@pytest.mark.parametrize("method", METHODS)
def test_an_effect_that_overrides_no_hook_is_free_in_every_method(method):
    def flops(*effects):
        step, numbers = one_step(method, *effects)
        return jax.jit(step).lower(*numbers).cost_analysis()["flops"]

    assert flops(Nothing()) == flops()


@pytree
class Stored(jaxrod.extend.Effect):
    """Has an energy."""

    def energy(self, rod, state):
        return 3.0 * jnp.sum(state.positions**2)


@pytree
class Stiff(jaxrod.extend.Effect):
    """Resists being moved and turned."""

    def stability_bound(self, rod):
        return jaxrod.extend.StabilityBound(
            nodes=jnp.asarray(1e5), elements=jnp.asarray(1e3)
        )


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("method", METHODS)
def test_energy_and_resistance_count_in_every_method(method):
    rod, state = moving(jnp.dtype("float64"))
    bare, stored, stiff = (
        jaxrod.make_scene(rod, *effects, method=METHODS[method])
        for effects in ((), (Stored(),), (Stiff(),))
    )
    gained = stored.total_energy(state) - bare.total_energy(state)
    assert float(gained) == pytest.approx(3 * float(jnp.sum(state.positions**2)))
    assert float(jaxrod.stable_dt(stiff).dt) < 0.9 * float(jaxrod.stable_dt(bare).dt)
