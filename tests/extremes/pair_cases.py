"""A random scene or system, its runs in several views, and how far they are apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from extremes.pair_kinds import Kind, random_kind
from extremes.pair_scenes import scene_in
from extremes.pair_system_kinds import random_system
from extremes.pair_systems import system_in
from extremes.views import View, about_axis, random_turn, shaken, told

DISTURBED = 1e-12
"""Share of what it is by which the state of the disturbed run is off, four times."""
ROUNDING = 2.0**-52
ALLOWED = 100.0
"""Times the difference that rounding makes by the disturbed run."""
CHAOTIC = 1e9
"""Growth of a disturbance beyond which rounding becomes what happens."""
FAR = np.array([1300.0, -450.0, 220.0])
"""A translation [m]."""
COMPILING = {"xla_backend_optimization_level": 0}
"""Programs run for a moment: they are compiled as fast as can be."""


@partial(jax.jit, compiler_options=COMPILING)
def run(model: Any, state: Any, dt: Any, n_steps: Any, first: Any) -> Any:
    """A run from a step on."""
    return jaxrod.advance(model, state, dt, n_steps, first=first)


@partial(jax.jit, compiler_options=COMPILING)
@jax.vmap
def run_batch(model: Any, state: Any, dt: Any, n_steps: Any, first: Any) -> Any:
    """Runs from a step on, as one batch."""
    return jaxrod.advance(model, state, dt, n_steps, first=first)


@partial(jax.jit, compiler_options=COMPILING, static_argnums=(3, 4))
def recorded(model: Any, state: Any, dt: Any, n_steps: int, every: int) -> Any:
    """The last record of a rollout."""
    records = jaxrod.rollout(model, state, dt, n_steps, every)
    return jax.tree.map(lambda leaf: leaf[-1], records)


@partial(jax.jit, compiler_options=COMPILING)
def limit(model: Any) -> Any:
    """The largest stable step."""
    return jaxrod.stable_dt(model, 1.0).dt


def members_of(state: Any) -> dict[str, Any]:
    """States of rods and bodies by name."""
    if isinstance(state, dict):
        return {k: s for k, s in state.items() if hasattr(s, "positions")}
    return {"rod": state}


@dataclass
class Seen:
    """A scene or system in a view."""

    view: View
    model: Any
    state: Any
    names: dict[str, str]
    """Names in this view by those in the first."""
    twists: bool

    def told(self, after: Any) -> dict[str, np.ndarray]:
        """Results in SI units, in the frame of the first view."""
        before, after = members_of(self.state), members_of(after)
        found = {}
        for name, own in self.names.items():
            first = name in ("rod", "m0")
            one = told(
                self.view, before[own], after[own], first=first, twists=self.twists
            )
            found |= {f"{name}.{what}": values for what, values in one.items()}
        return found


class Case:
    """A random scene or system, its runs, and how far its views are from it."""

    def __init__(self, kind: Any, make: Any, seed: int, draw: int):
        """Runs it as it is, and disturbed.

        Args:
            kind: All of it that is chosen by name.
            make: Makes it in a view: model, state, names.
            seed: Of all that is static.
            draw: Which of its sets of numbers.
        """
        self.kind, self.make = kind, make
        self.random = np.random.default_rng([seed, 1, draw])
        self.results: list[tuple[str, float, float, str]] = []
        self.first = self.seen(View())
        self.limit = float(limit(self.first.model))
        self.dt = self.limit * (10 if kind.method == "implicit" else 0.5)
        self.steps = int(np.random.default_rng([seed, 1]).integers(60, 200))
        after = self.runs(self.first)
        self.after = self.first.told(after)
        if not all(np.all(np.isfinite(v)) for v in self.after.values()):
            raise FloatingPointError("not finite")
        places = [v for k, v in self.after.items() if k.endswith("positions")]
        self.extent = float(np.ptp(np.concatenate(places, axis=1), axis=1).max())
        self.noise = self.disturbed()
        if max(self.noise.values()) > CHAOTIC:
            raise FloatingPointError("too chaotic to compare anything")

    def seen(self, view: View) -> Seen:
        """The scene in a view."""
        model, state, names = self.make(view)
        return Seen(
            view, model, jaxrod.with_memory(model, state), names, self.kind.twists
        )

    def runs(self, seen: Seen, parts: Any = None, dt: float | None = None) -> Any:
        """The state after all steps, in runs of as many steps as `parts` has."""
        state, first = seen.state, 0
        for n in parts or [self.steps]:
            state = self.part(seen, state, n, first, dt)
            first += n
        return state

    def part(
        self, seen: Seen, state: Any, n: int, first: int, dt: float | None = None
    ) -> Any:
        """The state some steps later."""
        # Arrays: a number of Python or of NumPy would be another program.
        step = jnp.asarray((self.dt if dt is None else dt) * seen.view.units[2], float)
        return run(seen.model, state, step, jnp.asarray(n), jnp.asarray(first))

    def disturbed(self) -> dict[str, float]:
        """Distance from itself at the end, for each unit of a small disturbance."""
        random, quarter = self.random, self.steps // 4
        parts = [quarter, quarter, quarter, self.steps - 3 * quarter]
        ends = []
        for size in (0.0, DISTURBED):
            state, first = self.first.state, 0
            for n in parts:
                if size:
                    state = shaken(state, size, self.extent, random)
                state = self.part(self.first, state, n, first)
                first += n
            ends.append(self.first.told(state))
        apart = differences(*ends)
        return {name: distance / DISTURBED for name, distance in apart.items()}

    def compare(self, kind: str, found: dict[str, np.ndarray], size: float) -> None:
        """Notes how far a pair is apart, over what rounding explains.

        Args:
            kind: Of the pair.
            found: What came out of the second.
            size: Rounding, over the extent of all.
        """
        worst, apart, where = 0.0, 0.0, ""
        for name, distance in differences(self.after, found).items():
            scale = np.max(np.abs(self.after[name]))
            if name.endswith("positions"):
                scale = self.extent
            explained = size * max(self.noise[name], scale)
            ratio = distance / max(explained, 1e-300)
            if not ratio <= worst:
                worst, apart, where = ratio, distance / max(scale, 1e-300), name
        self.results.append((kind, worst, apart, where))

    def numbers(self) -> dict[str, View]:
        """Views that differ in numbers alone."""
        turn = random_turn(self.random)
        if self.kind.flat:
            turn = about_axis(2, self.random.uniform(0, 2 * np.pi))
        units = tuple(10 ** self.random.uniform(-3, 3, 3))
        views = {
            "turned": View(turn=turn),
            "other units": View(units=units),
            "turned, other units": View(turn=turn, units=units),
        }
        return views | ({"far away": View(shift=FAR)} if self.kind.anywhere else {})

    def same_program(self, seen: Seen) -> bool:
        """Whether a view differs in numbers alone."""
        return program_of(seen) == program_of(self.first)

    def far_rounding(self) -> float:
        """Rounding of places that are far away, over the extent."""
        return float(np.linalg.norm(FAR)) * ROUNDING / self.extent

    def compare_numbers(self) -> None:
        """All views that one program does."""
        seens = {"as it is": self.first}
        for kind, view in self.numbers().items():
            seen = self.seen(view)
            if not self.same_program(seen):
                raise AssertionError(f"{kind} is not the same program")
            size = self.far_rounding() if kind == "far away" else ROUNDING
            self.compare(kind, seen.told(self.runs(seen)), size)
            step = float(limit(seen.model)) / view.units[2]
            off = 0.0 if step == self.limit else abs(step / self.limit - 1)
            allowed = 1e5 * size
            self.results.append((f"stable_dt {kind}", off / allowed, off, ""))
            seens[kind] = seen
        self.compare_parts()
        self.seens = seens

    def compare_parts(self) -> None:
        """Two runs one after the other, to rounding or to second order."""
        half = int(self.random.integers(1, self.steps))
        split = self.first.told(self.runs(self.first, [half, self.steps - half]))
        if self.kind.exact_parts:
            self.compare("two runs", split, ROUNDING)
            return
        off = [self._relative(self.after, split)]
        dt, counts = 0.25 * self.dt, [4 * half, 4 * (self.steps - half)]
        ends = [self.runs(self.first, n, dt) for n in ([sum(counts)], counts)]
        off.append(self._relative(*map(self.first.told, ends)))
        # About a sixteenth at a quarter of the step.
        rounding = ALLOWED * ROUNDING * max(1.0, *self.noise.values())
        ratio = ALLOWED * off[1] / (0.3 * off[0] + rounding)
        self.results.append(("two runs, to second order", ratio, off[0], ""))

    def _relative(self, one: Any, other: Any) -> float:
        """Largest difference, over what it is of."""
        return max(
            apart / np.max(np.abs(one[name])) if np.any(one[name]) else 0.0
            for name, apart in differences(one, other).items()
        )

    def compare_batch(self) -> None:
        """Three at once against one by one."""
        near = {k: s for k, s in self.seens.items() if k != "far away"}
        three = dict(list(near.items())[:3])
        stack = lambda *trees: jax.tree.map(lambda *x: jnp.stack(x), *trees)
        dts = jnp.array([self.dt * s.view.units[2] for s in three.values()])
        counts = jnp.full(len(three), self.steps)
        states = stack(*[s.state for s in three.values()])
        models = stack(*[s.model for s in three.values()])
        after = run_batch(models, states, dts, counts, 0 * counts)
        for k, seen in enumerate(three.values()):
            own = jax.tree.map(lambda leaf, k=k: leaf[k], after)
            self.compare("batch", seen.told(own), ROUNDING)

    def compare_record(self) -> None:
        """The last record of a rollout of a few more or less steps."""
        every = 5 if self.kind.exact_parts else self.steps
        steps = self.steps - self.steps % every
        dt = jnp.asarray(self.dt, float)
        last = recorded(self.first.model, self.first.state, dt, steps, every)
        alone = self.first.told(self.runs(self.first, [steps]))
        found = self.first.told(last)
        self.compare(
            "rollout", {k: self.after[k] + found[k] - alone[k] for k in found}, ROUNDING
        )

    def compare_view(self, kind: str, view: View) -> None:
        """A view that is another program."""
        seen = self.seen(view)
        self.compare(kind, seen.told(self.runs(seen)), ROUNDING)
        step = float(limit(seen.model)) / view.units[2]
        off = 0.0 if step == self.limit else abs(step / self.limit - 1)
        self.results.append((f"stable_dt {kind}", off / 1e-9, off, ""))


def program_of(seen: Seen) -> Any:
    """All that a compiled program depends on."""
    leaves, structure = jax.tree.flatten((seen.model, seen.state))
    return structure, [jax.typeof(leaf) for leaf in leaves]


def differences(one: dict[str, Any], other: dict[str, Any]) -> dict[str, float]:
    """Largest difference of each kind of number."""
    return {
        name: float(np.max(np.abs(values - other[name])))
        for name, values in one.items()
    }


@dataclass(frozen=True)
class Structure:
    """A random scene or system without its numbers: every program of it.

    Its cases have other numbers in the same programs.
    """

    kind: Any
    make: Callable[[View, int], Any]
    """Model, state and names in a view, with one of its sets of numbers."""
    seed: int

    @staticmethod
    def of_scene(seed: int) -> Structure:
        """A random scene; not all of them can be made."""
        return Structure.of_kind(random_kind(np.random.default_rng([seed, 0])), seed)

    @staticmethod
    def of_kind(kind: Kind, seed: int) -> Structure:
        """A scene of a kind."""

        def make(view: View, draw: int) -> Any:
            return *scene_in(view, kind, seed, draw), {"rod": "rod"}

        return Structure(kind, make, seed)

    @staticmethod
    def of_system(seed: int) -> Structure:
        """A random system."""
        kind = random_system(np.random.default_rng([seed, 0]))

        def make(view: View, draw: int) -> Any:
            return system_in(view, kind, seed, draw)

        return Structure(kind, make, seed)

    def other_program(self) -> tuple[str, View]:
        """A view that is another program."""
        if self.kind.reversible and self.seed % 2:
            return "reversed", View(reversed=True)
        plain = View(halved=True, crowded=True)
        if not self.kind.any_order:
            return "rearranged", plain
        return "rearranged", replace(plain, shuffled=self.seed, exchanged=True)

    def examined(self, draw: int, pairs: str = "all") -> Case:
        """All pairs of one of its sets of numbers.

        Raises:
            ValueError: If it cannot be made.
            FloatingPointError: If there is nothing to compare.
        """
        case = Case(self.kind, partial(self.make, draw=draw), self.seed, draw)
        case.compare_numbers()
        if pairs == "all":
            case.compare_view(*self.other_program())
            if self.seed % 8 == 0:
                case.compare_batch()
            if self.seed % 8 == 1:
                case.compare_record()
        return case


STRUCTURES = {"scene": Structure.of_scene, "system": Structure.of_system}
