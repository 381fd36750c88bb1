"""Runs as kernels for GPUs: what they work out, and that Triton takes them."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.experimental import pallas as pl

import jaxrod
from jaxrod.jax_internals.primitives import lower_on
from jaxrod.lanes import choice, primitives
from jaxrod.lanes.choice import (
    LaneChoice,
    lane_choices,
    lane_mode,
    lanes_wanted,
    lowered_by_lanes,
    use_lanes,
)
from jaxrod.lanes.cycle import Batch, Cycle, Plan
from jaxrod.lanes.machine_code import not_here
from jaxrod.lanes.meanings import MEANINGS, cycles_p, run_p
from jaxrod.lanes.pallas_kernel import pallas_program
from jaxrod.lanes.pallas_memory import BLOCK
from lanes.programs import difference
from lanes.scenes import arm, shaken
from lanes.test_runs import apart

# Pallas compiles by Triton as long as JAX keeps it; without it XLA does the runs.
pytestmark = pytest.mark.filterwarnings(
    "ignore:The Pallas Triton backend is deprecated:DeprecationWarning"
)
FLOATS = ("float32", "float64")
KERNEL = "__gpu$xla.gpu.triton"
"""The name of Triton's kernels in a program that is lowered for CUDA."""


@pytest.fixture(autouse=True)
def always():
    """Takes lanes in every run; on a GPU no compiler for CPUs is needed."""
    if jax.default_backend() == "cpu" and not_here() is not None:
        pytest.skip(not_here())
    before = lane_mode()
    use_lanes("always")
    yield
    use_lanes(before)


@pytest.fixture
def interpreted():
    """Runs on the CPU go through the kernels for GPUs, interpreted."""

    def by_pallas(name, plan, results):
        if lane_mode() == "never":
            return None
        rods = plan.batch.size if plan.batch is not None else 1
        program = pallas_program(plan, rods, interpret=True)
        choice._note(LaneChoice(True, "a kernel for GPUs, interpreted", rods))
        return program

    def on_cpus(maker):
        for primitive in (run_p, cycles_p):
            kernels = primitives._kernels(primitive, maker)
            lower_on("cpu", primitive, MEANINGS[primitive], kernels)

    on_cpus(by_pallas)
    yield
    on_cpus(lowered_by_lanes)


def plan_of(cycle, constants, carry, rods, own):
    """The plan of a cycle for a batch; `own` says which constants are of each rod."""
    n = len(constants)
    closed = jax.make_jaxpr(lambda *a: cycle(a[:n], a[n:]))(*constants, *carry)
    rows = (*own, *[True] * len(carry))
    return Plan(Cycle(closed, n), None, batch=Batch(rods, rows))


def oscillator(constants, carry):
    """A damped swing, what it is driven by, its turns and whether it is fast."""
    stiffness, (dt, damping) = constants
    angle, rate, turns, fast = carry
    rate = rate - dt * (jnp.exp(stiffness) * jnp.sin(angle) + damping**2 * rate)
    angle = angle + dt * rate
    fast = jnp.logical_xor(fast, jnp.abs(rate) > 0.5)
    return [angle, rate, turns + jnp.asarray(angle > 1, jnp.int32), fast]


def swings(rods, dtype, seed=0):
    """What an oscillator of two entries is given."""
    rng = np.random.default_rng(seed)
    carry = (
        jnp.asarray(rng.normal(size=(rods, 2)), dtype),
        jnp.asarray(rng.normal(size=(rods, 2)), dtype),
        jnp.asarray(rng.integers(-5, 5, (rods, 2)), jnp.int32),
        jnp.asarray(rng.integers(0, 2, (rods, 2)), bool),
    )
    stiffness = jnp.asarray(rng.normal(size=(rods, 2)), dtype)
    return (stiffness, jnp.asarray([0.1, 0.3], dtype)), carry


@pytest.mark.parametrize(
    ("dtype", "rods"),
    [
        ("float32", 5),
        pytest.param("float64", BLOCK + 1, marks=pytest.mark.slow),
    ],
)
def test_cycles_of_a_padded_batch_are_the_same_for_any_count(dtype, rods):
    (stiffness, shared), carry = swings(rods, dtype)
    one = [array[0] for array in (stiffness, *carry)]
    plan = plan_of(oscillator, (one[0], shared), one[1:], rods, (True, False))
    interpret_once()
    found = jax.jit(pallas_program(plan, rods, interpret=True))
    meant = jax.jit(lambda *a: MEANINGS[cycles_p](*a, plan=plan))
    for count in (0, 1, 3, -1):
        given = (jnp.int32(count), stiffness, shared, *carry)
        for one, other in zip(found(*given), meant(*given), strict=True):
            assert one.dtype == other.dtype and one.shape == other.shape
            rounding = 8 * float(jnp.finfo(dtype).eps)
            np.testing.assert_allclose(one, other, rtol=rounding, atol=rounding)
    assert found._cache_size() == 1


@cache
def interpret_once():
    """Lets JAX's interpreter of kernels register its options, after which programs are
    compiled anew."""
    pl.pallas_call(
        lambda x, y: y.__setitem__((), x[()]),
        out_shape=jax.ShapeDtypeStruct((), jnp.float32),
        interpret=True,
    )(jnp.float32(1))


def odd(_, carry):
    """What compilers differ in: extremes, rounding, conversion, division, shifts."""
    x, y, i, j = carry
    whole = [lax.div(i, j), lax.rem(i, j), lax.shift_left(i, j)]
    whole += [lax.shift_right_arithmetic(i, j), lax.shift_right_logical(i, j)]
    whole += [jnp.asarray(x, jnp.int32), jnp.asarray(x, jnp.uint8)]
    floats = [lax.max(x, y), lax.min(x, y), -x, lax.max(x, jnp.ones_like(x))]
    for method in (
        lax.RoundingMethod.TO_NEAREST_EVEN,
        lax.RoundingMethod.AWAY_FROM_ZERO,
    ):
        floats.append(lax.round(x, method))
    return [
        jnp.concatenate(floats),
        y,
        jnp.concatenate([jnp.asarray(w, jnp.int32) for w in whole]),
        j,
    ]


@pytest.mark.slow
def test_odd_numbers_are_those_of_xla():
    floats = [
        0.0,
        -0.0,
        0.5,
        -0.5,
        1.5,
        2.5,
        -2.5,
        1e20,
        -1e20,
        np.inf,
        -np.inf,
        np.nan,
    ]
    floats += [0.49999997, 300.0, -1.0]
    wholes = [0, 1, -1, 7, -7, 31, 32, 33, -(2**31), 2**31 - 1]
    x, y = (a.reshape(-1) for a in np.meshgrid(floats, floats))
    i, j = (a.reshape(-1) for a in np.meshgrid(wholes, wholes))
    rods = len(x)
    given = (
        jnp.asarray(x, jnp.float32)[:, None],
        jnp.asarray(y, jnp.float32)[:, None],
        jnp.asarray(np.resize(i, rods), jnp.int32)[:, None],
        jnp.asarray(np.resize(j, rods), jnp.int32)[:, None],
    )
    # The step is not repeated: what it makes is larger than what it is given.
    shapes = [array[0] for array in given]
    made = jax.make_jaxpr(lambda *a: odd((), a))(*shapes)
    grown = [jnp.zeros(a.shape, a.dtype) for a in made.out_avals]

    def cycle(constants, carry):
        return odd((), constants)

    plan = plan_of(cycle, shapes, grown, rods, (True,) * 4)
    begun = [jnp.zeros((rods, *a.shape), a.dtype) for a in grown]
    found = jax.jit(pallas_program(plan, rods, interpret=True))(
        jnp.int32(1), *given, *begun
    )
    expected = jax.jit(jax.vmap(lambda *a: odd((), a)))(*given)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)
    signs = np.signbit(found[0][:, 2]) == np.signbit(expected[0][:, 2])
    assert signs.all()


METHODS = {
    "consistent": {},
    "planar": {"method": jaxrod.planar("xy")},
}


def scene_of(method, n, dtype):
    """A damped arm under gravity: `(scene, state, dt)`."""
    rod, state = arm(n, dtype)
    effects = (jaxrod.clamp(state), jaxrod.exponential_damping(2.0))
    pull = jaxrod.gravity((1.0, -9.81, 0.0))
    scene = jaxrod.make_scene(rod, *effects, pull, **METHODS[method])
    return scene, state, jnp.asarray(1e-4, dtype)


SCENES = [
    (method, dtype, own)
    for method, dtypes in (("consistent", ["float32"]), ("planar", FLOATS))
    for dtype in dtypes
    for own in (False, True)
]
ROUNDING = {"float32": 1e-6, "float64": 2e-15}


@pytest.mark.slow
@pytest.mark.parametrize(("method", "dtype", "own"), SCENES)
def test_runs_of_rods_are_the_same(interpreted, method, dtype, own, record):
    record(
        f"lanes: kernel for GPUs, interpreted: {method}, {dtype}, "
        f"constants {'of each rod' if own else 'shared'}",
        "XLA, 0, 1 and 3 steps",
        compared(method, dtype, own, 5),
        at_most=ROUNDING[dtype],
    )


@pytest.mark.gpu
@pytest.mark.parametrize(("method", "dtype", "own"), SCENES)
def test_runs_of_rods_are_the_same_on_a_gpu(method, dtype, own):
    assert compared(method, dtype, own, BLOCK + 3) < ROUNDING[dtype]


def compared(method, dtype, own, rods):
    """The largest difference from XLA, of runs of some counts compiled once."""
    scene, state, dt = scene_of(method, 2, dtype)
    many = shaken(state, rods, 0, flat=method == "planar")

    def run(scene, many, count):
        def one(factor, state):
            scaled = jax.tree.map(lambda leaf: leaf * factor, scene)
            return jaxrod.advance(scaled, state, dt, count)

        if own:
            factors = 1 + 0.01 * jnp.arange(rods, dtype=dtype)
            return jax.vmap(one)(factors, many)
        return jax.vmap(lambda state: jaxrod.advance(scene, state, dt, count))(many)

    before = len(lane_choices())
    results = []
    for mode in ("always", "never"):
        use_lanes(mode)
        compiled = jax.jit(lambda *a: run(*a))
        results.append([compiled(scene, many, jnp.int32(n)) for n in (0, 1, 3)])
        assert compiled._cache_size() == 1
    assert [made.taken for made in lane_choices()[before:]] == [True]
    return apart(*results)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2000, 2012))
def test_a_random_program_is_the_same(interpreted, seed):
    worst, _ = difference(seed)
    assert worst is not None and worst <= 1
    assert "interpreted" in lane_choices()[-1].why


# For CUDA, without a GPU ----------------------------------------------------------


def lowered(run, *arguments):
    """The text of a program for CUDA; JAX 0.12 asks for which device."""
    device = jax.sharding.AbstractDevice("NVIDIA H100 80GB HBM3", None, "gpu")
    mesh = jax.sharding.AbstractMesh((), (), abstract_device=device)
    with jax.sharding.use_abstract_mesh(mesh):
        traced = jax.jit(lambda *a: run(*a)).trace(*arguments)
        return traced.lower(lowering_platforms=("cuda",)).as_text()


def swing(rods, dtype="float32", cycle=oscillator):
    """The text for CUDA of an oscillator's cycles, by the choice that is in force."""
    (stiffness, shared), carry = swings(rods, dtype)
    one = [array[0] for array in (stiffness, *carry)]
    plan = plan_of(cycle, (one[0], shared), one[1:], rods, (True, False))
    run = lambda *given: cycles_p.bind(*given, plan=plan)
    return lowered(run, jnp.int32(3), stiffness, shared, *carry)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_triton_takes_a_kernel(dtype):
    assert KERNEL in swing(BLOCK, dtype)
    last = lane_choices()[-1]
    assert last.taken and "thread" in last.why and last.operations > 10


@pytest.mark.parametrize(
    ("mode", "rods", "words"),
    [("auto", 64, None), ("never", 64, None), ("always", 31, "fewer than 32")],
)
def test_xla_does_it_on_a_gpu(mode, rods, words):
    use_lanes(mode)
    before = len(lane_choices())
    assert KERNEL not in swing(rods)
    made = lane_choices()[before:]
    assert (words is None and not made) or words in made[-1].why


def test_what_triton_does_wrong_is_left_to_xla_in_one_line():
    def wrapped(constants, carry):
        after = oscillator(constants, carry)
        return [lax.rem(after[0], jnp.full_like(after[0], 6.0)), *after[1:]]

    assert KERNEL not in swing(64, cycle=wrapped)
    assert "'rem'" in lane_choices()[-1].why and not lane_choices()[-1].taken


def test_a_program_for_two_platforms_has_no_kernel_for_one():
    (stiffness, shared), carry = swings(64, "float32")
    one = [array[0] for array in (stiffness, *carry)]
    plan = plan_of(oscillator, (one[0], shared), one[1:], 64, (True, False))
    traced = jax.jit(lambda *given: cycles_p.bind(*given, plan=plan)).trace(
        jnp.int32(3), stiffness, shared, *carry
    )
    assert KERNEL not in traced.lower(lowering_platforms=("cpu", "cuda")).as_text()
    assert "several platforms" in lane_choices()[-1].why


@pytest.mark.parametrize(
    ("backend", "mode", "wanted"),
    [("gpu", "auto", False), ("gpu", "always", True), ("tpu", "always", False)],
)
def test_lanes_are_made_on_gpus_only_where_they_are_asked_for(
    monkeypatch, backend, mode, wanted
):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    use_lanes(mode)
    assert lanes_wanted() is wanted


SIGNED = ("int8", "int16", "int32", "int64")
UNSIGNED = ("uint8", "uint16", "uint32")
OF_FLOATS = (
    *("sqrt", "rsqrt", "floor", "ceil", "sin", "cos", "tan", "asin", "acos", "atan"),
    *("sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "exp", "exp2", "expm1"),
    *("log", "log1p", "cbrt", "is_finite", "logistic", "square", "round", "abs"),
    *("neg", "sign"),
)
OF_TWO = ("add", "sub", "mul", "div", "max", "min", "lt", "le", "gt", "ge", "eq", "ne")
OF_WHOLE = (
    *("rem", "bitwise_and", "bitwise_or", "bitwise_xor"),
    *("shift_left", "shift_right_logical", "shift_right_arithmetic"),
)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [*FLOATS, *SIGNED, *UNSIGNED, "bool"])
def test_triton_takes_every_operation(dtype):
    def every(constants, carry):
        a, b = constants
        made = [jnp.where(a != b, a, b)]
        made += [lax.convert_element_type(a, other) for other in others]
        if dtype == "bool":
            made += [getattr(lax, name)(a, b) for name in OF_WHOLE[1:4]]
            return [jnp.asarray(m, m.dtype) for m in [*made, ~a]]
        made += [getattr(lax, name)(a, b) for name in OF_TWO]
        if dtype in FLOATS:
            made += [getattr(lax, name)(a) for name in OF_FLOATS]
            made += [lax.round(a, lax.RoundingMethod.TO_NEAREST_EVEN)]
            return [*made, lax.atan2(a, b), lax.pow(a, b)]
        made += [getattr(lax, name)(a, b) for name in OF_WHOLE]
        made += [~a] if dtype in UNSIGNED else [~a, -a, lax.abs(a), lax.sign(a)]
        return made

    others = [d for d in (*FLOATS, *SIGNED, *UNSIGNED, "bool") if d != dtype]
    a = jnp.ones((), dtype)
    carry = [jnp.zeros((), m.dtype) for m in every((a, a), ())]
    plan = plan_of(every, (a, a), carry, BLOCK, (True, False))
    run = lambda *given: cycles_p.bind(*given, plan=plan)
    many = [jnp.broadcast_to(c, (BLOCK,)) for c in (a, *carry)]
    assert KERNEL in lowered(run, jnp.int32(2), many[0], a, *many[1:])


@pytest.mark.slow
@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("method", METHODS)
def test_triton_takes_runs_of_rods(method, dtype):
    scene, state, dt = scene_of(method, 4, dtype)
    many = shaken(state, 40, 0, flat=method == "planar")
    run = jax.vmap(lambda state: jaxrod.advance(scene, state, dt, 3))
    assert KERNEL in lowered(run, many)
    assert lane_choices()[-1].taken
