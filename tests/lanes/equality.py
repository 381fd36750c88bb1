"""Random scenes and systems: rows and XLA come to the same states and gradients.

    PYTHONPATH=tests:. python tests/lanes/equality.py --scenes 100 --systems 100
    PYTHONPATH=tests:. python tests/lanes/equality.py --named plectoneme --steps 150

Each is run for 100 steps in float64, by rows (forced) and by XLA. Scenes and systems
are those of `tests/extremes`: all methods, supports and effects of one rod; all joints,
contacts and losses of systems. Kinds that bring something new come first. A kind is
compiled once and run with several sets of numbers (`--draws`). Some are differentiated
too: a weighted sum of the state after 20 steps, by all floats of the model and of the
first state.

Rounding grows in runs, and in some of them exponentially. So XLA also runs from a state
whose numbers are all off by one unit in the last place. What rows and XLA are apart is
compared with what that makes.

The record has a line for each scene and system. The same command goes on after the
kinds that the record has, and prints a summary of all lines.
"""

from __future__ import annotations

import argparse
import collections
import json
import sys
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from benchmarks.c_programs.scenes import SCENES
from extremes.pair_cases import COMPILING, STRUCTURES, limit
from extremes.views import View
from jaxrod.lanes.choice import lane_choices, use_lanes

RECORD = Path(__file__).parent / "records" / "equality.jsonl"
STEPS, GRADIENT_STEPS = 100, 20
STATE, GRADIENT = 1e-12, 1e-10
"""Largest relative differences of states and of gradients that are counted as equal."""
CHAOTIC = 1e-6
"""Difference by one unit in the last place beyond which nothing is left to compare."""
OF_ROUNDING = 100.0
"""Times the difference by one unit in the last place that is counted as equal, too."""


@cache
def kind_of(what: str, seed: int) -> Any:
    """All of a random scene or system that is chosen by name."""
    return STRUCTURES[what](seed).kind


@cache
def names_of(what: str, seed: int) -> frozenset[str]:
    """All that a random scene or system has, by name."""
    kind = kind_of(what, seed)
    if what == "scene":
        own = {f"method {kind.method}", f"support {kind.support}"}
        return frozenset(own | {f"section {kind.section}", *kind.effects})
    own = {f"method {kind.method}", f"contact {kind.contact}", f"rigid {kind.rigid}"}
    own |= {f"joint {how}" for how, *_ in kind.relations}
    own |= {f"loss {loss}" for loss in kind.losses}
    own |= {f"body {one}" for one in kind.members if isinstance(one, str)}
    return frozenset(own | {f"held {kind.held}"})


@cache
def all_names(what: str) -> frozenset[str]:
    """All names that random scenes or systems have."""
    return frozenset().union(*(names_of(what, seed) for seed in range(1, 300)))


def chosen_seeds(what: str, count: int, span: int = 1500) -> list[int]:
    """Seeds of kinds, of which each brings what the ones before have least often.

    Of systems those of few members come first, because they compile faster.
    """
    had: collections.Counter[str] = collections.Counter()
    seeds, chosen = list(range(5001, 5001 + span)), []

    def value(seed: int) -> float:
        members = getattr(kind_of(what, seed), "members", ())
        new = sum(4.0 ** -had[name] for name in names_of(what, seed))
        return new / max(len(members), 1) ** 2

    for _ in range(count):
        best = max(seeds, key=value)
        seeds.remove(best)
        chosen.append(best)
        had.update(names_of(what, best))
    return chosen


def parted(tree: Any) -> tuple[list[Any], list[Any], Any]:
    """Float leaves of a pytree, its other leaves, and a function that joins them."""
    leaves, structure = jax.tree.flatten(tree)
    is_float = [jnp.issubdtype(x.dtype, jnp.floating) for x in leaves]

    def joined(floats: list[Any], others: list[Any]) -> Any:
        rest = {True: iter(floats), False: iter(others)}
        return jax.tree.unflatten(structure, [next(rest[which]) for which in is_float])

    of = lambda wanted: [
        x for x, which in zip(leaves, is_float, strict=True) if which == wanted
    ]
    return of(True), of(False), joined


def nudged(state: Any, seed: int) -> Any:
    """A state whose floats are all off by one unit in the last place, at random."""
    rng = np.random.default_rng(seed)
    floats, others, joined = parted(state)
    off = [
        jnp.asarray(x * (1 + 2.0**-52 * rng.choice((-1.0, 1.0), np.shape(x))))
        for x in floats
    ]
    return joined(off, others)


class Programs:
    """The compiled programs of one kind in one mode, and whether a kernel runs each."""

    def __init__(self, mode: str, steps: int = STEPS):
        """Compiles nothing yet: programs are compiled in `mode` as they are called."""
        self.mode, self.reasons = mode, {}

        def run(model: Any, state: Any, dt: Any) -> Any:
            return jaxrod.advance(model, state, dt, steps)

        self._run = jax.jit(run, compiler_options=COMPILING)
        self._slope: Any = None

    def _called(self, name: str, program: Any, *given: Any) -> Any:
        use_lanes(self.mode)
        before = len(lane_choices())
        made = program(*given)
        assert before < 100, "the record of choices is full"
        self.reasons.setdefault(name, [c for c in lane_choices()[before:]])
        return jax.block_until_ready(made)

    def state(self, model: Any, state: Any, dt: Any) -> Any:
        """The state after all steps."""
        return self._called("state", self._run, model, state, dt)

    def gradient(self, model: Any, state: Any, dt: Any) -> Any:
        """The slopes of a weighted sum of the state a few steps later."""
        floats, others, joined = parted((model, state))
        ends, *_ = parted(state)
        rng = np.random.default_rng(0)
        weights = [rng.normal(size=np.shape(x)) for x in ends]

        def loss(floats: Any, others: Any, dt: Any) -> Any:
            model, state = joined(floats, others)
            after = jaxrod.advance(model, state, dt, GRADIENT_STEPS)
            ends, *_ = parted(after)
            return sum(jnp.sum(w * x) for w, x in zip(weights, ends, strict=True))

        if self._slope is None:
            self._slope = jax.jit(jax.grad(loss), compiler_options=COMPILING)
        return self._called("gradient", self._slope, floats, others, dt)

    def left(self, name: str) -> str:
        """The reason why XLA runs a program; empty if kernels run all of it."""
        choices = self.reasons[name]
        if not choices:
            return "nothing was compiled"
        return "; ".join(sorted({c.why for c in choices if not c.taken}))


def states_apart(one: Any, other: Any, begun: Any) -> tuple[float, str]:
    """Largest difference of two states over the size of each kind of number, and where.

    The kind is the name of the array. Its size is the largest number of it in any
    member, at the beginning or at the end.
    """
    sizes: dict[str, float] = collections.defaultdict(float)
    apart: dict[str, float] = collections.defaultdict(float)
    flat = [jax.tree_util.tree_leaves_with_path(t) for t in (one, other, begun)]
    for (path, a), (_, b), (_, c) in zip(*flat, strict=True):
        name = str(path[-1])
        a, b, c = (np.asarray(x, float) for x in (a, b, c))
        if not np.array_equal(np.isfinite(a), np.isfinite(b)):
            return float("inf"), name
        sizes[name] = max(sizes[name], np.max(np.abs(b), initial=0.0))
        sizes[name] = max(sizes[name], np.max(np.abs(c), initial=0.0))
        apart[name] = max(apart[name], float(np.max(np.abs(a - b), initial=0.0)))
    return max((float(apart[name] / (sizes[name] or 1.0)), name) for name in apart)


def slopes_apart(one: Any, other: Any) -> float:
    """Largest difference of two gradients, over the largest slope by each array."""
    return max(
        float(np.max(np.abs(a - b), initial=0.0) / (np.max(np.abs(b)) or 1.0))
        for a, b in zip(map(np.asarray, one), map(np.asarray, other), strict=True)
        if np.size(a)
    )


def compared(what: str, seed: int, draw: int, programs: Any, *, slopes: bool) -> Any:
    """The line of one scene or system in the record."""
    structure = STRUCTURES[what](seed)
    line = {"what": what, "seed": seed, "draw": draw}
    try:
        model, state, _ = structure.make(View(), draw)
    except ValueError as refused:
        return line | {"refused": " ".join(str(refused).split())[:100]}
    state = jaxrod.with_memory(model, state)
    implicit = structure.kind.method == "implicit"
    dt = float(limit(model)) * (10 if implicit else 0.5)
    found = numbers(model, state, dt, programs, slopes=slopes)
    if not found:
        return line | {"refused": "the state is not finite"}
    return line | {"names": sorted(names_of(what, seed))} | found


def numbers(model: Any, state: Any, dt: float, programs: Any, *, slopes: bool) -> Any:
    """Differences of rows and XLA after a run; empty if the state is not finite."""
    model, state, dt = jax.tree.map(jnp.asarray, (model, state, dt))
    rows, xla = programs
    found = rows.state(model, state, dt)
    expected = xla.state(model, state, dt)
    floats, *_ = parted(expected)
    if not all(np.all(np.isfinite(x)) for x in floats):
        return {}
    apart, where = states_apart(found, expected, state)
    rounding = max(
        states_apart(xla.state(model, nudged(state, n), dt), expected, state)[0]
        for n in (1, 2)
    )
    line = {"left": rows.left("state"), "apart": apart, "where": where}
    line["one_ulp"] = rounding
    if slopes:
        expected = xla.gradient(model, state, dt)
        line |= {
            "gradient": slopes_apart(rows.gradient(model, state, dt), expected),
            "gradient_left": rows.left("gradient"),
            "gradient_one_ulp": slopes_apart(
                xla.gradient(model, nudged(state, 1), dt), expected
            ),
        }
    return line


def named(name: str, steps: int) -> Any:
    """The line of a scene of `benchmarks/c_programs`, such as the plectoneme."""
    model, state, dt = SCENES[name].build("float64")
    state = jaxrod.with_memory(model, state)
    programs = Programs("rows", steps), Programs("never", steps)
    found = numbers(model, state, dt, programs, slopes=False)
    return {"what": name, "steps": steps} | found


def read(record: Path) -> list[dict[str, Any]]:
    """All lines of a record."""
    if not record.exists():
        return []
    return [json.loads(line) for line in record.read_text().splitlines()]


def summary(lines: list[dict[str, Any]]) -> list[str]:
    """Lines of a table, from a record."""
    out = ["| | scenes | systems |", "|---|---:|---:|"]
    parts = [[x for x in lines if x["what"] == what] for what in STRUCTURES]
    whole = [[x for x in part if "apart" in x] for part in parts]
    ran = [[x for x in part if x["one_ulp"] <= CHAOTIC] for part in whole]
    taken = [[x for x in part if not x["left"]] for part in ran]
    over = [[x for x in part if x["apart"] > STATE] for part in taken]
    most = lambda part, value: max(map(value, part), default=0.0)
    ratio = lambda x: x["apart"] / max(x["one_ulp"], 2.0**-52)

    def row(name: str, values: Any) -> None:
        out.append(f"| {name} | " + " | ".join(f"{v:.3g}" for v in values) + " |")

    row("cases compared", map(len, ran))
    chaotic = (len(a) - len(b) for a, b in zip(whole, ran, strict=True))
    row("not compared, because rounding grows by a factor of more than 1e9", chaotic)
    row("kinds of cases", (len({x["seed"] for x in part}) for part in ran))
    row("computed by rows", map(len, taken))
    fine = [[x for x in part if x["apart"] <= STATE] for part in taken]
    row(f"rows and XLA differ by at most {STATE:.0e}", map(len, fine))
    row("largest difference", (most(part, lambda x: x["apart"]) for part in taken))
    row(
        "larger ones: largest ratio to the difference of the XLA runs",
        (most(p, ratio) for p in over),
    )
    row(
        "all: median ratio to the difference of the XLA runs",
        (np.median([*map(ratio, p)]) for p in taken),
    )
    slopes = [[x for x in part if "gradient" in x] for part in ran]
    slopes = [[x for x in part if not x["gradient_left"]] for part in slopes]
    row("gradients computed by rows", map(len, slopes))
    row(
        "largest difference of gradients",
        (most(p, lambda x: x["gradient"]) for p in slopes),
    )
    own = [{name for x in part for name in x["names"]} for part in ran]
    row("methods, effects, couplings and other parts that occur", map(len, own))
    row(
        "... of all that the program can draw",
        (len(all_names(what)) for what in STRUCTURES),
    )
    return out


def equal(line: dict[str, Any]) -> bool:
    """Whether a line is within the bounds, or within what rounding makes of it.

    So is a line without a comparison: refused, or too chaotic.
    """
    if "apart" not in line or line["one_ulp"] > CHAOTIC:
        return True
    fine = line["apart"] <= max(STATE, OF_ROUNDING * line["one_ulp"])
    slope = line.get("gradient", 0.0)
    return fine and slope <= max(
        GRADIENT, OF_ROUNDING * line.get("gradient_one_ulp", 0)
    )


def main(arguments: list[str]) -> int:
    """Compares scenes and systems in turns; adds them to a record and sums it up."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--systems", type=int, default=100)
    parser.add_argument("--draws", type=int, default=4)
    parser.add_argument(
        "--gradients",
        type=int,
        nargs=2,
        default=(5, 20),
        metavar="N",
        help="every so many kinds of scenes and of systems",
    )
    parser.add_argument("--record", type=Path, default=RECORD)
    parser.add_argument("--named", choices=SCENES, help="a single scene, not recorded")
    parser.add_argument("--steps", type=int, default=150, help="of a named scene")
    options = parser.parse_args(arguments)
    jaxrod.configure_cpu(1)
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    if options.named:
        print(json.dumps(named(options.named, options.steps)))
        return 0
    wanted = {"scene": options.scenes, "system": options.systems}
    every = dict(zip(wanted, options.gradients, strict=True))
    kinds = {what: chosen_seeds(what, n) for what, n in wanted.items()}
    options.record.parent.mkdir(exist_ok=True)
    for turn in range(max(wanted.values())):
        for what, count in wanted.items():
            lines = read(options.record)
            mine = [x for x in lines if x["what"] == what]
            if turn >= len(kinds[what]) or sum("apart" in x for x in mine) >= count:
                continue
            seed = kinds[what][turn]
            if any(x["seed"] == seed for x in mine):
                continue
            programs, own = (Programs("rows"), Programs("never")), []
            for draw in range(options.draws):
                slopes = turn % every[what] == every[what] - 1
                own.append(compared(what, seed, draw, programs, slopes=slopes))
                words = "" if equal(own[-1]) else "DIFFERS "
                print(words + json.dumps(own[-1] | {"names": None}), flush=True)
            with options.record.open("a") as file:
                file.writelines(json.dumps(line) + "\n" for line in own)
            jax.clear_caches()
    lines = read(options.record)
    print("\n".join(summary(lines)))
    return sum(not equal(line) for line in lines)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
