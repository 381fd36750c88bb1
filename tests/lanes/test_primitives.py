"""Every primitive that lanes know, each beside XLA's, all in one kernel."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxrod.installation.jax_version import release
from jaxrod.lanes.choice import lane_choices, use_lanes
from jaxrod.lanes.jaxpr.unroll import RULES, supported
from jaxrod.lanes.primitives import cycles_p
from jaxrod.lanes.run_spec import LoopBody, RunSpec
from jaxrod.lanes.true_entries import true_entries
from lanes.scenes import forced

ODD = [0.0, -0.0, np.nan, np.inf, -np.inf, 0.5, -0.5, 1.5, 2.5, -2.5, 7.0, -3.25]
UNREACHABLE = {
    # Made inside JAX's machinery alone.
    *("closed_call", "expand_dims", "optimization_barrier", "pvary", "reshard"),
    # Rows alone have it: `test_rows.py`.
    "sort",
    # Rows of an array are slices before JAX 0.12.
    *(() if release(jax.__version__) >= (0, 12) else ("unstack", "one_minus_square")),
}


def solve(matrix, right):
    """Linear equations with a solver of their own."""
    diagonal = jnp.diagonal(matrix)
    by = lambda _, b: b / diagonal
    return lax.custom_linear_solve(lambda x: diagonal * x, right, by, by)


@jax.custom_vjp
def doubled(x):
    return 2 * x


doubled.defvjp(lambda x: (2 * x, None), lambda _, ct: (2 * ct,))


def counting(x):
    """A loop that ends by its own count."""
    return lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] * 1.5), (0, x))


def scanned(x, reverse):
    """A carry that remembers, and rows of it."""
    turn = lambda c, row: (0.5 * c + row, c - row)
    last, rows = lax.scan(turn, x[0], x, reverse=reverse)
    return jnp.append(rows, last)


def scattered(x, y, name, places, mode="fill"):
    return getattr(x.at[jnp.array(places)], name)(y[: len(places)], mode=mode)


def cases(x, y, z, i, j, b, c, m):
    """Results by name: `x` ordinary, `y` positive and small, `z` odd numbers."""
    both = ("add", "sub", "mul", "div", "max", "min", "atan2", "rem")
    made = {f"{n} {k}": getattr(lax, n)(u, v) for n in both for k, u, v in _pairs(x, z)}
    compared = ("lt", "le", "gt", "ge", "eq", "ne")
    made |= {f"{n} odd": getattr(lax, n)(z, z[::-1]) for n in compared}
    made |= {f"{n} whole": getattr(lax, n)(i, j) for n in compared}
    one = ("neg", "abs", "sign", "floor", "ceil", "is_finite", "square")
    made |= {f"{n} odd": getattr(lax, n)(z) for n in one}
    one = ("sin", "cos", "tan", "tanh", "atan", "sinh", "cosh", "asinh", "cbrt", "erf")
    made |= {n: getattr(lax, n)(x) for n in (*one, "erfc", "exp", "exp2", "expm1")}
    made |= {n: getattr(lax, n)(x) for n in ("logistic", "stop_gradient")}
    one = ("log", "log1p", "sqrt", "rsqrt", "asin", "acos", "atanh")
    made |= {n: getattr(lax, n)(y) for n in one}
    made |= {"acosh": lax.acosh(1 + y), "pow": lax.pow(y, x)}
    made |= {f"power {n}": lax.integer_pow(x, n) for n in (-3, 0, 1, 2, 5, 6, 7, 11)}
    rounding = (lax.RoundingMethod.TO_NEAREST_EVEN, lax.RoundingMethod.AWAY_FROM_ZERO)
    made |= {f"round {r.name}": lax.round(z, r) for r in rounding}
    made |= {
        "clamp": lax.clamp(-0.5 * jnp.ones_like(x), x, y),
        # The upper bound is what counts where bounds are the wrong way round.
        "clamp, bounds crossed": lax.clamp(y + 2, x, -y),
        "where": jnp.where(b, x, y),
        "select of three": lax.select_n(i % 3, x, y, x * y),
        "true entries": true_entries(b, 4),
    }
    whole = ("add", "sub", "mul", "div", "rem", "max", "min")
    whole += ("bitwise_and", "bitwise_or", "bitwise_xor")
    made |= {f"whole {n}": getattr(lax, n)(i, jnp.where(j == 0, 3, j)) for n in whole}
    shifts = ("shift_left", "shift_right_logical", "shift_right_arithmetic")
    made |= {n: getattr(lax, n)(i, abs(j) % 31) for n in shifts}
    made |= {f"whole {n}": getattr(lax, n)(i) for n in ("neg", "abs", "sign")}
    made |= {"whole not": ~i, "not": ~b, "and": b & c, "or": b | c, "xor": b ^ c}
    made |= {"to whole": jnp.int32(9 * x), "to truth": z != 0, "of truth": b * 1.0}
    made |= {"convert truth": lax.convert_element_type(i, bool), "widen": i + x}
    sums = ("sum", "prod", "max", "min", "cumsum", "cumprod")
    made |= {f"{n} {k}": getattr(jnp, n)(m, k) for n in sums for k in (0, 1)}
    made |= {f"all, any {k}": jnp.all(b) ^ jnp.any(c) for k in (0,)}
    made |= {"xor of all": lax.reduce_xor_p.bind(i, axes=(0,))}
    runs = (lax.cumsum, lax.cumprod, lax.cummax, lax.cummin)
    made |= {f"{f.__name__} back": f(x, reverse=True) for f in runs}
    made |= {f"{f.__name__} odd": f(z) for f in (lax.cummax, lax.cummin)}
    equal = jnp.stack([x[0], x[1], x[0], x[1], x[0]])
    for f in (lax.argmax, lax.argmin):
        made |= {
            f"{f.__name__} {k}": f(array, 0, jnp.int32)
            for k, array in (("", x), ("equal", equal), ("odd", z), ("rows", m))
        }
    made |= {
        "product": m @ m.T,
        "batched product": jnp.einsum("ij,ik->ijk", m, m @ m.T),
        "slice": lax.slice(x, (1,), (9,), (3,)),
        "pick": lax.dynamic_slice(x, (i[0],), (5,)),
        "pick from rows": lax.dynamic_slice(m, (i[1], j[1]), (2, 2)),
        "put": lax.dynamic_update_slice(x, y[:4], (i[0],)),
        "pick known": lax.dynamic_slice(x, (20,), (5,)),
        "gather": x[jnp.array([3, -1, 0, 3])],
        "gather outside": x.at[jnp.array([1, 40, 2])].get(mode="fill", fill_value=-7),
        "squeeze, expand": jnp.expand_dims(jnp.squeeze(m[:1], 0), 1),
        "reshape": jnp.reshape(m, (4, 3)) * jnp.ones((4, 1)),
        "transpose": m.T,
        "rev": m[::-1, ::-1],
        "join": jnp.concatenate([m, 2 * m], 1),
        "stack": jnp.stack([x, y], 1),
        "rows": (lambda first, *rest: first - rest[-1])(*m),
        "split": jnp.split(x, 3)[1],
        "tile": jnp.tile(m, (2, 1)),
        "pad": lax.pad(m, m[0, 0], ((1, 2, 1), (-1, 1, 0))),
        "pad, cut at the end": lax.pad(x, x[0], ((2, -3, 2),)),
        "iota": x + jnp.arange(12, dtype=x.dtype),
        "scan": scanned(x, False),
        "scan back": scanned(x, True),
        "while": counting(x)[1],
        "cond": lax.cond(b[0], lambda: x, lambda: y),
        "switch": lax.switch(i[0], [lambda: x, lambda: y, lambda: x * y]),
        "copy": jnp.copy(x),
        "jit": jax.jit(jnp.sin)(x),
        "checkpoint": jax.checkpoint(jnp.sin)(x),
        "custom rules": doubled(jax.nn.relu(x)),
        "solve": solve(jnp.diag(y), x),
        "slope of tanh": jax.vmap(jax.grad(jnp.tanh))(x),
        "sum of cotangents": jax.grad(lambda v: jnp.sum(v * jnp.sin(v) + v))(x),
    }
    for name in ("set", "add", "multiply", "min", "max"):
        made[f"scatter {name}"] = scattered(x, y, name, [2, 5, 7])
        made[f"scatter {name} outside"] = scattered(x, y, name, [2, 40, -30, 7])
    for name in ("add", "multiply", "min", "max"):
        made[f"scatter {name} twice"] = scattered(x, y, name, [2, 2, 7])
    made["scatter rows"] = m.at[jnp.array([2, 0])].add(m[:2])
    return made


def _pairs(x, z):
    return (("", x, x[::-1]), ("odd", z, x), ("odd, odd", z, z[::-1]))


def given(dtype, rods):
    """A row of inputs for each rod."""
    rng = np.random.default_rng(7)
    numbers = rng.normal(size=(rods, 12))
    truths = rng.integers(0, 2, (2, rods, 12)).astype(bool)
    whole = rng.integers(-9, 12, (2, rods, 12)).astype(np.int32)
    return [
        jnp.asarray(a)
        for a in (
            numbers.astype(dtype),
            rng.uniform(0.05, 0.9, (rods, 12)).astype(dtype),
            np.stack([np.roll(ODD, r) for r in range(rods)]).astype(dtype),
            *whole,
            *truths,
            rng.normal(size=(rods, 3, 4)).astype(dtype),
        )
    ]


def primitives(jaxpr):
    """Names of all primitives in a jaxpr and in what it calls."""
    names = set()
    for equation in jaxpr.eqns:
        names.add(equation.primitive.name)
        for value in jax.tree.leaves(
            equation.params, is_leaf=lambda leaf: hasattr(leaf, "eqns")
        ):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                names |= primitives(inner)
    return names


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    "dtype", ["float32", pytest.param("float64", marks=pytest.mark.slow)]
)
def test_every_primitive_is_that_of_xla(dtype):
    """The inputs are a cycle's constants; what it makes replaces its carry."""
    many = given(dtype, 5)
    shapes = jax.eval_shape(cases, *[array[0] for array in many])
    names, avals = list(shapes), list(shapes.values())

    def cycle(*arrays):
        made = cases(*arrays[: len(many)])
        return [made[name] for name in names]

    closed = jax.make_jaxpr(cycle)(
        *[array[0] for array in many], *[jnp.zeros(a.shape, a.dtype) for a in avals]
    )
    known = set(RULES) - UNREACHABLE
    assert known <= primitives(closed.jaxpr), known - primitives(closed.jaxpr)
    spec = RunSpec(LoopBody(closed, len(many)), None)

    def run(*inputs):
        slots = [jnp.zeros(a.shape, a.dtype) + inputs[0].sum() * 0 for a in avals]
        slots = [s.astype(a.dtype) for s, a in zip(slots, avals, strict=True)]
        return cycles_p.bind(jnp.int32(1), *inputs, *slots, spec=spec)

    use_lanes(forced())
    taken = jax.jit(jax.vmap(run))(*many)
    assert lane_choices()[-1].taken, lane_choices()[-1].why
    use_lanes("never")
    # One by one: with the fusion of `configure_cpu` XLA's compiler aborts on all of
    # them in one program.
    expected = jax.vmap(cases)(*many)
    tolerance = {"float32": 2e-6, "float64": 1e-14}[dtype]
    wrong = {}
    for name, found in zip(names, taken, strict=True):
        a, b = (np.asarray(array) for array in (found, expected[name]))
        rounding = 0 if b.dtype.kind != "f" else tolerance * (1 + np.abs(b))
        same = (a == b) | ((a != a) & (b != b))
        with np.errstate(invalid="ignore"):
            near = np.abs(a.astype(float) - b.astype(float)) <= rounding
        if not np.all(same | near):
            wrong[name] = (a[~(same | near)][:3], b[~(same | near)][:3])
    assert not wrong


FUNCTIONS = (
    *(jnp.sin, jnp.cos, jnp.tan, jnp.arcsin, jnp.arccos, jnp.arctan, jnp.sinh),
    *(jnp.cosh, jnp.tanh, jnp.arcsinh, jnp.arccosh, jnp.arctanh, jnp.exp, jnp.exp2),
    *(jnp.expm1, jnp.log, jnp.log1p, jnp.cbrt, jnp.sqrt, lax.rsqrt, jnp.abs),
    *(jax.nn.sigmoid, jax.nn.softplus, jax.nn.silu, jax.nn.gelu, jax.nn.relu),
    *(jnp.square, jnp.sign, lambda x: x**3, lambda x: x**0.3, lambda x: 2.0**x),
    *(lambda x: jnp.hypot(x, 2.0), lambda x: jnp.arctan2(x, 2.0), lambda x: x % 0.3),
)


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_derivatives_of_functions_contain_known_primitives_alone(function):
    """A new JAX may differentiate by a primitive that it had not before."""
    slope = jax.grad(function)
    for program in (function, slope, jax.grad(slope)):
        assert supported(jax.make_jaxpr(program)(0.5)) is None


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("kind", ["float32", "int32", "bool"])
def test_a_table_that_all_rods_share_is_read_at_computed_places(kind):
    """Beyond its ends the last number counts; one index is the same for all rods."""
    table = np.random.default_rng(3).normal(scale=9, size=2000).astype(kind)

    def cycle(table, places, same, _):
        read = lambda place: table.at[place].get(mode="clip")
        return [jnp.append(read(3 * places - 1000), read(same[:1] * 7))]

    places = np.random.default_rng(4).integers(0, 1200, (9, 5)).astype(np.int32)
    same = jnp.asarray([31, 4], jnp.int32)
    given = jnp.asarray(table), jnp.asarray(places), same
    slot = jnp.zeros((9, 6), kind)
    closed = jax.make_jaxpr(cycle)(given[0], given[1][0], same, slot[0])
    spec = RunSpec(LoopBody(closed, 3), None)
    batched = jax.vmap(
        lambda places, slot: cycles_p.bind(
            jnp.int32(1), given[0], places, same, slot, spec=spec
        )[0]
    )
    use_lanes(forced())
    taken = jax.jit(batched)(given[1], slot)
    assert lane_choices()[-1].taken, lane_choices()[-1].why
    use_lanes("never")
    expected = jax.vmap(lambda one: cycle(given[0], one, same, None)[0])(given[1])
    np.testing.assert_array_equal(taken, expected)
