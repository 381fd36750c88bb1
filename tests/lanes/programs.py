"""Random small programs: each is run by lanes and by XLA, and the results compared.

    PYTHONPATH=tests python tests/lanes/programs.py --count 10000 [--first SEED]
        [--mode rows] [--log FILE]

With `--log`, processes run 100 programs each, and the outcome of each program is a line
of FILE. The same command goes on where another stopped. A program that ends its process
counts as such.

A program takes constants and a carry of random shapes through some operations picked
at random among all that lanes know, and makes a carry of the same shapes of what comes
out.
It is repeated a few times over a batch that is no multiple of the lanes.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

RODS = 5
CYCLES = 2


class Pool:
    """Arrays made so far, by the kind of their numbers."""

    def __init__(self, rng, arrays):
        self.rng = rng
        self.arrays = list(arrays)

    def some(self, kind):
        """An array of a kind: float, integer or truth; made if there is none."""
        tests = {"f": jnp.floating, "i": jnp.integer, "b": jnp.bool_}
        fitting = [a for a in self.arrays if jnp.issubdtype(a.dtype, tests[kind])]
        if fitting:
            return fitting[self.rng.integers(len(fitting))]
        source = self.arrays[self.rng.integers(len(self.arrays))]
        if kind == "b":
            return source > 0
        if kind == "i":
            return jnp.asarray(jnp.clip(source, -50, 50), jnp.int32)
        return jnp.asarray(source, self.arrays[0].dtype)

    def like(self, array, kind):
        """An array of a kind, in the shape of another; of its type if of its kind."""
        made = fitted(self.some(kind), array.shape)
        same = np.dtype(array.dtype).kind == np.dtype(made.dtype).kind
        return jnp.asarray(made, array.dtype) if same else made


def fitted(array, shape):
    """The entries of an array in another shape, repeated or cut."""
    size = int(np.prod(shape, dtype=int))
    flat = jnp.reshape(array, (-1,))
    if flat.shape[0] < size:
        flat = jnp.tile(flat, -(-size // flat.shape[0]))
    return jnp.reshape(flat[:size], shape)


def _binary(function, kind="f"):
    def apply(pool):
        a = pool.some(kind)
        return function(a, pool.like(a, kind))

    return apply


def _unary(function, kind="f"):
    return lambda pool: function(pool.some(kind))


def _along(function, kind="f"):
    """A function that takes an axis, of an array that has one."""

    def apply(pool):
        a = pool.some(kind)
        a = a[None] if a.ndim == 0 else a
        return function(a, int(pool.rng.integers(a.ndim)))

    return apply


def _select(pool):
    a = pool.some("f")
    return jnp.where(pool.like(a, "b"), a, pool.like(a, "f"))


def _pad(pool):
    a = pool.some("f")
    config = [tuple(int(n) for n in pool.rng.integers(-1, 3, 2)) for _ in a.shape]
    config = [
        (max(lo, -1), max(hi, 0), int(pool.rng.integers(0, 2))) for lo, hi in config
    ]
    return lax.pad(a, jnp.zeros((), a.dtype), config)


def _slice(pool):
    a = pool.some("f")
    starts = [int(pool.rng.integers(0, n)) for n in a.shape]
    limits = [
        int(pool.rng.integers(s + 1, n + 1))
        for s, n in zip(starts, a.shape, strict=True)
    ]
    strides = [int(pool.rng.integers(1, 3)) for _ in a.shape]
    return lax.slice(a, starts, limits, strides)


def _dynamic_slice(pool):
    a = pool.some("f")
    if a.ndim == 0 or a.size > 30:
        return a
    sizes = [int(pool.rng.integers(1, n + 1)) for n in a.shape]
    index = jnp.sum(pool.some("i")) % 7 - 2
    return lax.dynamic_slice(a, [index] * a.ndim, sizes)


def _dynamic_update(pool):
    a = pool.some("f")
    if a.ndim == 0 or a.size > 30:
        return a
    sizes = [int(pool.rng.integers(1, n + 1)) for n in a.shape]
    index = jnp.sum(pool.some("i")) % 7 - 2
    return lax.dynamic_update_slice(a, fitted(pool.some("f"), sizes), [index] * a.ndim)


def _gather(pool):
    a = pool.some("f")
    a = a[None] if a.ndim == 0 else a
    places = np.asarray(pool.rng.integers(-a.shape[0], a.shape[0], 4))
    return a[places]


def _gather_moving(pool):
    a = pool.some("f")
    a = a[None] if a.ndim == 0 else a
    places = fitted(pool.some("i"), (6,)) % (a.shape[0] + 2) - 1
    mode = ("fill", "clip", "promise_in_bounds")[pool.rng.integers(3)]
    if mode == "promise_in_bounds":
        places = jnp.clip(places, 0, a.shape[0] - 1)
    return a.at[places].get(mode=mode)


def _scatter_moving(pool):
    a = pool.some("f")
    a = a[None] if a.ndim == 0 else a
    places = fitted(pool.some("i"), (7,)) % (a.shape[0] + 2) - 1
    values = fitted(pool.some("f"), (7, *a.shape[1:]))
    name = ("add", "mul", "min", "max")[pool.rng.integers(4)]
    # A product of many numbers would amplify rounding.
    values = jnp.tanh(values)
    return getattr(a.at[places], name)(values, mode="drop")


def _scatter_masked(pool):
    """A sum over some entries of a list, whose numbers are computed from gathers."""
    a = pool.some("f")
    a = jnp.ravel(a)
    places = fitted(pool.some("i"), (19,)) % a.shape[0]
    there = fitted(pool.some("b"), (19,))
    numbers = jnp.sin(a[places]) * jnp.cos(fitted(pool.some("f"), (19,)))
    return jnp.zeros_like(a).at[places].add(jnp.where(there, numbers, 0))


def _scatter(pool):
    a = pool.some("f")
    a = a[None] if a.ndim == 0 else a
    places = np.asarray(pool.rng.integers(0, a.shape[0], 3))
    values = fitted(pool.some("f"), (3, *a.shape[1:]))
    if pool.rng.integers(2):
        return a.at[places].add(values)
    return a.at[np.unique(places)].set(values[: len(np.unique(places))])


def _scan(pool):
    a, carry = pool.some("f"), pool.some("f")
    rows = fitted(a, (3, *carry.shape))

    def turn(c, row):
        c = jnp.tanh(c + row)
        return c, c * row

    last, made = lax.scan(turn, carry, rows, reverse=bool(pool.rng.integers(2)))
    return made if pool.rng.integers(2) else last


def _loop(pool):
    count = int(pool.rng.integers(1, 4))
    return lax.fori_loop(0, count, lambda i, c: jnp.sin(c) + i, pool.some("f"))


def _while(pool):
    """A loop whose length depends on numbers."""
    a, b, weight = pool.some("f"), pool.some("f"), pool.some("f")
    flags, most = pool.some("b"), int(pool.rng.integers(1, 8))
    rolled, rows = bool(pool.rng.integers(2)), fitted(b, (4, *a.shape))

    def goes_on(carry):
        x, _, count, flag = carry
        left = jnp.sum(jnp.abs(x)) > 0.2 + 0.1 * jnp.mean(jnp.abs(weight))
        return (left | jnp.any(flag)) & (count < most)

    def once(carry):
        x, y, count, flag = carry
        if rolled:
            x, _ = lax.scan(lambda c, row: (jnp.sin(c + row), None), x, rows)
        x = 0.6 * jnp.tanh(x) + 0.05 * fitted(y, x.shape)
        y = jnp.flip(jnp.cos(y), tuple(range(y.ndim))) * jnp.sum(x)
        return x, jnp.tanh(y), count + 1, flag & (count < 2)

    x, y, count, flag = lax.while_loop(goes_on, once, (a, b, 0, flags))
    pool.arrays += [x, flag]
    return y + count


def _rounds(pool):
    """A scan that is a loop of its own: it is long and mixes entries."""
    a, b, c = pool.some("f"), pool.some("f"), pool.some("f")
    count = int(pool.rng.choice((66, 70)))
    rows = fitted(c, (count, 2)), fitted(pool.some("b"), (count,))

    def turn(carry, row):
        (x, n), (pair, flag) = carry, row
        x = jnp.tanh(jnp.flip(x, tuple(range(x.ndim))) + pair[0] + jnp.mean(b))
        x = jnp.where(flag, x, -x)
        return (x, n + flag), (jnp.sum(x) * pair, n)

    backwards = bool(pool.rng.integers(2))
    (x, n), (made, counts) = lax.scan(turn, (a, 0), rows, reverse=backwards)
    pool.arrays += [x, counts[::17]]
    return jnp.tanh(made[::9]) + n


def _branch(pool):
    a = pool.some("f")
    index = jnp.sum(pool.some("i")) % 3
    cases = [lambda x: x * 2, jnp.sin, lambda x: -x]
    if pool.rng.integers(2):
        return lax.switch(index, cases, a)
    return lax.cond(index > 0, cases[0], cases[2], a)


def _matrix(pool):
    a = fitted(pool.some("f"), (2, 3))
    return a @ fitted(pool.some("f"), (3, 2))


def _einsum(pool):
    a = fitted(pool.some("f"), (2, 3, 2))
    return jnp.einsum("bij,bjk->bik", a, fitted(pool.some("f"), (2, 2, 3)))


def _derivative(pool):
    """Brings in what only appears in derivatives."""
    a = pool.some("f")
    b = pool.like(a, "f")

    def function(x):
        return jnp.sum(jnp.where(b > 0, jnp.sin(x) * b, x * x)[..., None][..., 0])

    return jax.grad(function)(a)


def _safe(function, least, most):
    """A function over a part of its range."""
    return lambda x: function(jnp.clip(x, least, most))


_POSITIVE = (1e-2, 1e3)
OPERATIONS = (
    *map(_binary, (lax.add, lax.sub, lax.mul, lax.max, lax.min, lax.atan2)),
    _binary(lambda a, b: a / (jnp.abs(b) + 0.5)),
    _binary(lambda a, b: lax.rem(a, jnp.abs(b) + 0.5)),
    _binary(lambda a, b: jnp.clip(jnp.abs(a), 0.1, 5) ** jnp.clip(b, -3, 3)),
    *map(_unary, (lax.neg, lax.abs, lax.sign, lax.sin, lax.cos, lax.tanh, lax.erf)),
    *map(_unary, (lax.floor, lax.ceil, jnp.round, lax.is_finite, lax.logistic)),
    *map(_unary, (lax.square, lax.atan, lax.asinh, lax.cbrt, lax.erfc)),
    _unary(lambda x: lax.round(x, lax.RoundingMethod.AWAY_FROM_ZERO)),
    *(
        _unary(lambda x, k=k: _safe(lambda y: y**k, 0.2, 3)(x))
        for k in (-3, -1, 0, 3, 5)
    ),
    *(
        _unary(_safe(f, -5, 5))
        for f in (lax.exp, lax.exp2, lax.expm1, lax.sinh, lax.cosh)
    ),
    *(_unary(_safe(f, *_POSITIVE)) for f in (lax.log, lax.log1p, lax.sqrt, lax.rsqrt)),
    *(_unary(_safe(f, -0.9, 0.9)) for f in (lax.asin, lax.acos, lax.atanh, lax.tan)),
    _unary(_safe(lax.acosh, 1.1, 10)),
    *(_binary(f) for f in (lax.lt, lax.le, lax.gt, lax.ge, lax.eq, lax.ne)),
    *(
        _binary(f, "b")
        for f in (lax.bitwise_and, lax.bitwise_or, lax.bitwise_xor, lax.eq)
    ),
    _unary(lax.bitwise_not, "b"),
    *(_binary(f, "i") for f in (lax.add, lax.sub, lax.mul, lax.max, lax.min)),
    # Not by zero: XLA's compiler itself dies of a quotient of known numbers by zero.
    *(_binary(lambda a, b, f=f: f(a, b % 7 + 1), "i") for f in (lax.div, lax.rem)),
    *(_binary(f, "i") for f in (lax.bitwise_and, lax.bitwise_or, lax.bitwise_xor)),
    *(_binary(f, "i") for f in (lax.shift_left, lax.shift_right_arithmetic)),
    *(_binary(f, "i") for f in (lax.shift_right_logical, lax.lt, lax.eq, lax.ge)),
    *(_unary(f, "i") for f in (lax.neg, lax.abs, lax.sign, lax.bitwise_not)),
    lambda pool: jnp.asarray(pool.some("i"), pool.arrays[0].dtype),
    _unary(lambda x: jnp.asarray(x, jnp.int32), "f"),
    _unary(lambda x: jnp.asarray(x, bool), "f"),
    _unary(lambda x: jnp.asarray(x, jnp.int32), "b"),
    *(_along(lambda a, k, f=f: f(a, axis=k)) for f in (jnp.sum, jnp.max, jnp.min)),
    *(
        _along(lambda a, k, f=f: f(a, axis=k))
        for f in (jnp.cumsum, jnp.argmax, jnp.argmin)
    ),
    _along(lambda a, k: jnp.prod(jnp.clip(a, -2, 2), axis=k)),
    _along(lambda a, k: lax.cummax(a, axis=k, reverse=True)),
    _along(lambda a, k: jnp.any(a, axis=k), "b"),
    _along(lambda a, k: jnp.all(a, axis=k), "b"),
    _along(lambda a, k: jnp.flip(a, axis=k)),
    _along(lambda a, k: jnp.concatenate([a, a], axis=k)),
    _along(lambda a, k: jnp.stack([a, -a], axis=k)),
    _along(lambda a, k: jnp.expand_dims(a, k)),
    _along(lambda a, k: jnp.moveaxis(a, k, 0)),
    _along(lambda a, k: jnp.split(jnp.concatenate([a, a], axis=k), 2, axis=k)[1]),
    _unary(lambda x: jnp.reshape(x, (-1,))),
    _unary(lambda x: jnp.tile(x, 2) if x.ndim else x),
    _unary(lambda x: jnp.broadcast_to(x, (2, *x.shape))),
    _unary(lambda x: x + jnp.arange(x.size, dtype=x.dtype).reshape(x.shape)),
    _unary(
        lambda x: (
            lax.clamp(-1.0, x, jnp.asarray(1, x.dtype)) if False else jnp.clip(x, -1, 1)
        )
    ),
    *(_select, _pad, _slice, _dynamic_slice, _dynamic_update, _gather, _scatter),
    *(_scan, _loop, _branch, _matrix, _einsum, _derivative),
)
MOVING = (_gather_moving, _scatter_moving, _scatter_masked)
"""Operations at places that change, which loops have and unrolled lanes have not."""
_ANY = (1, 2, 3, 4, 5, 7, 8, 9, 17, 20)
NESTED = (_while, _rounds)
"""Loops that are functions of their own, which only rows have."""
LENGTHS = {"always": (1, 2, 3), "loops": _ANY, "rows": _ANY}
"""Lengths of axes, by mode: where there are loops, they begin at a length of five."""


def random_program(seed, mode="always"):
    """A program and what it is given: `(cycle, constants, carry)`.

    Two rows are shared.
    """
    rng = np.random.default_rng(seed)
    dtype = (jnp.float32, jnp.float64)[rng.integers(2)]

    def shape():
        return tuple(int(n) for n in rng.choice(LENGTHS[mode], rng.integers(0, 3)))

    constants = [jnp.asarray(rng.normal(size=shape()), dtype) for _ in range(2)]
    carry = [
        jnp.asarray(rng.normal(size=shape()), dtype),
        jnp.asarray(rng.normal(size=shape()), dtype),
        jnp.asarray(rng.integers(-9, 9, shape()), jnp.int32),
        jnp.asarray(rng.integers(0, 2, shape()), bool),
    ]
    known = OPERATIONS + (() if mode == "always" else 6 * MOVING)
    known += 9 * NESTED if mode == "rows" else ()
    picks = rng.integers(0, len(known), rng.integers(3, 9))
    inner_seed = int(rng.integers(2**31))

    def cycle(constants, carry):
        pool = Pool(np.random.default_rng(inner_seed), [*constants, *carry])
        for pick in picks:
            made = known[pick](pool)
            if 0 < made.size <= 20 * max(LENGTHS[mode]):
                pool.arrays.append(made)
        after = []
        for array in carry:
            kind = {"f": "f", "i": "i", "b": "b"}[np.dtype(array.dtype).kind]
            made = fitted(pool.some(kind), array.shape)
            if kind == "f":
                made = jnp.tanh(0.3 * jnp.asarray(made, array.dtype)) + 0.1 * array
            after.append(jnp.asarray(made, array.dtype))
        return after

    return cycle, constants, carry, dtype


def difference(seed, mode="always"):
    """The largest difference of a random program, in units of what rounding allows."""
    from jaxrod.lanes.choice import lane_choices, use_lanes
    from jaxrod.lanes.primitives import cycles_p
    from jaxrod.lanes.run_spec import LoopBody, RunSpec

    cycle, constants, carry, dtype = random_program(seed, mode)
    n = len(constants)
    closed = jax.make_jaxpr(lambda *a: cycle(list(a[:n]), list(a[n:])))(
        *constants, *carry
    )
    rng = np.random.default_rng(seed)
    many = [
        jnp.asarray(np.asarray(c)[None] + rng.normal(size=(RODS, *c.shape)), c.dtype)
        if c.dtype == dtype
        else jnp.asarray(
            np.roll(np.broadcast_to(c, (RODS, *c.shape)), rng.integers(3), 0), c.dtype
        )
        for c in carry
    ]
    own = np.stack([np.asarray(constants[1]) * (1 + 0.1 * r) for r in range(RODS)])
    own = jnp.asarray(own, dtype)
    spec = RunSpec(LoopBody(closed, n), None)

    def run(own, *carry):
        given = (jnp.int32(CYCLES), constants[0], own, *carry)
        return cycles_p.bind(*given, spec=spec)

    use_lanes(mode)
    taken = jax.jit(jax.vmap(run))(own, *many)
    if not lane_choices()[-1].taken:
        return None, lane_choices()[-1].why
    use_lanes("never")
    expected = jax.jit(jax.vmap(lambda *a: run(*a)))(own, *many)
    scale = {jnp.float32: 2e-4, jnp.float64: 1e-11}[dtype]
    worst = 0.0
    for a, b in zip(taken, expected, strict=True):
        a, b = np.asarray(a, float), np.asarray(b, float)
        bad = np.isnan(a) != np.isnan(b)
        apart = np.where(np.isnan(a), 0.0, np.abs(a - b)) / (1 + np.abs(b))
        worst = max(worst, float(np.max(apart / scale, initial=0.0)), 1e9 * bad.any())
    return worst, str(closed)


def outcomes(seeds, mode):
    """Yields each seed with `same`, its difference, or the reason why XLA runs it."""
    jax.config.update("jax_enable_x64", True)
    for n, seed in enumerate(seeds):
        if n and n % 200 == 0:
            jax.clear_caches()
        worst, program = difference(seed, mode)
        if worst is None:
            yield seed, f"left: {program}"
        else:
            yield seed, f"{worst:.3g}" if worst > 1 else "same"


def logged(log):
    """The outcomes in a log by mode and seed, and the seed that began last."""
    found, last = {}, None
    for line in log.read_text().splitlines() if log.exists() else ():
        mode, seed, *outcome = line.split(" ", 2)
        last = int(seed)
        if outcome:
            found[mode, last] = outcome[0]
    return found, last


def add_to_log(log, seeds, mode):
    """Writes each seed into a log as it begins, and again with its outcome."""
    with log.open("a", buffering=1) as file:
        for seed in seeds:
            file.write(f"{mode} {seed}\n")
            ((_, outcome),) = outcomes([seed], mode)
            file.write(f"{mode} {seed} {outcome}\n")


def run_logged(log, seeds, mode):
    """Runs the seeds that a log lacks, in processes of 100; returns all outcomes."""
    program = [sys.executable, __file__, "--mode", mode, "--log", str(log), "--part"]
    while True:
        known, _ = logged(log)
        todo = [str(seed) for seed in seeds if (mode, seed) not in known][:100]
        if not todo:
            return {seed: known[mode, seed] for seed in seeds}
        done = subprocess.run([*program, *todo], check=False)
        if done.returncode:
            with log.open("a") as file:
                file.write(f"{mode} {logged(log)[1]} ended with {done.returncode}\n")


def main(arguments):
    """Compares programs and prints those that differ."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--mode", default="always", choices=LENGTHS)
    parser.add_argument("--log", type=Path)
    parser.add_argument("--part", type=int, nargs="*", help="seeds to add to the log")
    options = parser.parse_args(arguments)
    mode, log = options.mode, options.log
    if options.part:
        return add_to_log(log, options.part, mode)
    seeds = range(options.first, options.first + options.count)
    found = run_logged(log, seeds, mode) if log else dict(outcomes(seeds, mode))
    left = bad = 0
    for seed, outcome in found.items():
        left += outcome.startswith("left")
        bad += outcome != "same" and not outcome.startswith("left")
        if outcome != "same":
            print(f"{seed}: {outcome}", flush=True)
    print(f"{options.count} programs, {bad} differ, {left} left to XLA")
    return bad


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
