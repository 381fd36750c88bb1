"""A random scene or system, its runs in several views, and how far they are apart."""

from __future__ import annotations

import operator
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from extremes.pair_kinds import random_kind
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
"""Programs run once: they are compiled as fast as can be."""


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

    def __init__(self, kind: Any, make: Any, seed: int):
        """Runs it as it is, and disturbed.

        Args:
            kind: All of it that is not a number.
            make: Makes it in a view: model, state, names.
            seed: Of all that is drawn.
        """
        self.kind, self.make = kind, make
        self.random = np.random.default_rng([seed, 1])
        self.results: list[tuple[str, float, float, str]] = []
        self.first = self.seen(View())
        self.limit = float(limit(self.first.model))
        self.dt = self.limit * (10 if kind.method == "implicit" else 0.5)
        self.steps = int(self.random.integers(60, 200))
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
        dt = (self.dt if dt is None else dt) * seen.view.units[2]
        state, first = seen.state, 0
        for n in parts or [self.steps]:
            state = run(seen.model, state, dt, jnp.asarray(n), jnp.asarray(first))
            first += n
        return state

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
                state = run(
                    self.first.model, state, self.dt, jnp.asarray(n), jnp.asarray(first)
                )
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
        structures = map(jax.tree.structure, (seen.model, self.first.model))
        return operator.eq(*structures)

    def far_rounding(self) -> float:
        """Rounding of places that are far away, over the extent."""
        return float(np.linalg.norm(FAR)) * ROUNDING / self.extent

    def compare_numbers(self) -> None:
        """All views that one program does."""
        seens = {"as it is": self.first}
        for kind, view in self.numbers().items():
            seen = self.seen(view)
            # Lists of neighbours have room for what they hold in each view.
            if not (self.same_program(seen) or self.kind.has_lists):
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
        dt, counts = 0.5 * self.dt, [2 * half, 2 * (self.steps - half)]
        ends = [self.runs(self.first, n, dt) for n in ([sum(counts)], counts)]
        off.append(self._relative(*map(self.first.told, ends)))
        # About a fourth at half the step.
        ratio = ALLOWED * off[1] / (0.6 * off[0] + 1e-12)
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
        three = {k: s for k, s in near.items() if self.same_program(s)}
        three = dict(list(three.items())[:3])
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
        last = recorded(self.first.model, self.first.state, self.dt, steps, every)
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


def differences(one: dict[str, Any], other: dict[str, Any]) -> dict[str, float]:
    """Largest difference of each kind of number."""
    return {
        name: float(np.max(np.abs(values - other[name])))
        for name, values in one.items()
    }


def scene_case(seed: int) -> tuple[Any, Case]:
    """A random scene.

    Raises:
        ValueError: If its effects do not go together.
    """
    kind = random_kind(np.random.default_rng([seed, 0]))

    def make(view: View) -> Any:
        return *scene_in(view, kind, seed), {"rod": "rod"}

    return kind, Case(kind, make, seed)


def system_case(seed: int) -> tuple[Any, Case]:
    """A random system."""
    kind = random_system(np.random.default_rng([seed, 0]))
    return kind, Case(kind, partial(system_in, kind=kind, seed=seed), seed)


def examined(what: str, seed: int, pairs: str = "all") -> tuple[Any, Case]:
    """All pairs of a random scene or system."""
    kind, case = (scene_case if what == "scene" else system_case)(seed)
    case.compare_numbers()
    if pairs == "all":
        views = {"rearranged": View(halved=True, crowded=True)}
        if kind.any_order:
            views = {
                "rearranged": View(
                    shuffled=seed, exchanged=True, halved=True, crowded=True
                )
            }
        if kind.reversible and seed % 2:
            views = {"reversed": View(reversed=True)}
        for name, view in views.items():
            case.compare_view(name, view)
        if seed % 5 == 0:
            case.compare_batch()
        if seed % 5 == 1:
            case.compare_record()
    return kind, case
