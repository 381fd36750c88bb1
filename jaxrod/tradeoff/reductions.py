"""Reductions that a scene or a system allows, and what they save.

A reduction leaves out of a step what does not happen in a motion. `reductions` tries
them on a model and a state, with the checks that a run makes, and counts operations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrod.analysis.inertia_scaling import scale_inertia
from jaxrod.methods.implicit import implicit
from jaxrod.methods.planar import planar
from jaxrod.methods.planar_verlet import PLANES, PlaneName
from jaxrod.methods.torsion_free import torsion_free
from jaxrod.model import Model, check_model
from jaxrod.validation import is_traced

WORTHWHILE = 1.01
"""Smallest ratio of steps at which scaled inertia is listed [1]."""

LEVEL = 1e-4
"""Largest difference of heights of a rod in a plane that is tried, by its extent [1].
"""


@dataclass(frozen=True)
class Reduction:
    """A reduction that a model allows.

    Example:
        >>> found = tradeoff.reductions(scene, state)[0]
        >>> found.exact, found.saving > 0.5, found.model.method
        (True, True, Planar(plane='zx', of=Consistent()))
    """

    name: str
    """Name of the method or function, such as "planar('xy')"."""
    exact: bool
    """Whether results change by round-off only."""
    neglects: str
    """Description of what it neglects; empty if it is exact."""
    saving: float
    """Fraction of the operations per simulated second that it saves [1]."""
    members: tuple[str, ...]
    """Names of the members of a system that it changes; `("",)` for a scene."""
    model: Any
    """The scene or the system with the reduction."""

    def __str__(self) -> str:
        """One line: the reduction, what it saves and what it neglects."""
        where = ", ".join(filter(None, self.members))
        effect = "exact" if self.exact else f"neglects {self.neglects}"
        of = f" for {where}" if where else ""
        return f"{self.name}{of}: saves {self.saving:.0%} of the operations, {effect}"


def reductions(model: Model, state: Any) -> tuple[Reduction, ...]:
    """Finds the reductions that a scene or a system allows in a state.

    Each one is tried alone: motion in a plane, which is exact; no twist; scaled
    inertia. A member of a system counts if the couplings allow the reduction. The
    saving is counted in operations of a compiled step, and for scaled inertia in steps.
    Nothing is run, and times may be saved in another proportion. It does not work
    inside jit.

    Args:
        model: The scene or the system, whose rods step in space.
        state: A state of it, from which it will run.

    Returns:
        The reductions, exact ones first, and then the largest saving first.

    Raises:
        TypeError: If `model` is of another type.
        ValueError: If numbers are traced.

    Example:
        >>> for found in tradeoff.reductions(scene, state):
        ...     print(found.name, found.exact)
        planar('zx') True
        scale_inertia() False
        torsion_free() False
    """
    check_model(model)
    if is_traced(model, state):
        raise ValueError(
            "reductions needs numbers that are known, not traced by jax.jit or vmap"
        )
    before = _operations(model, state)
    found = []
    for name, neglects, method in _methods(model, state):
        changed = allowed(model, state, partial(with_method, method))
        if changed:
            reduced = model.with_members(changed)
            saving = 1 - _operations(reduced, state) / before
            names = tuple(sorted(changed))
            found.append(
                Reduction(name, not neglects, neglects, saving, names, reduced)
            )
    scaled = allowed(model, state, with_scaled_inertia)
    reduced = model.with_members(scaled)
    gain = float(reduced.stable_step(1.0).dt / model.stable_step(1.0).dt)
    if gain > WORTHWHILE:
        neglects = "the true rotary inertia across the rod"
        names = tuple(sorted(scaled))
        found.append(
            Reduction("scale_inertia()", False, neglects, 1 - 1 / gain, names, reduced)
        )
    return tuple(sorted(found, key=lambda one: (not one.exact, -one.saving)))


def _methods(model: Model, state: Any) -> Iterator[tuple[str, str, Any]]:
    """Yields names of methods, what they neglect, and the methods for each law."""
    for plane in planes_of(model, state):
        yield f"planar({plane!r})", "", partial(planar, plane)
    yield "torsion_free()", "polar inertia", lambda law: torsion_free()


def planes_of(model: Model, state: Any) -> list[PlaneName]:
    """Planes that a rod lies in; others need no compiled check."""
    states = model.states_by_name(state)
    places = [np.asarray(states[name].positions) for name in _rods(model)]
    return [
        plane
        for plane, (_, _, out) in PLANES.items()
        if any(np.ptp(x[..., out, :]) <= LEVEL * np.ptp(x) for x in places)
    ]


def _rods(model: Model) -> dict[str, Any]:
    """Members of a model that are rods with a method in space, by name."""
    return {
        name: own
        for name, own in model.interfaces().items()
        if own.rod is not None
        and own.method.explicit
        and own.method.in_space is own.method
    }


def allowed(model: Model, state: Any, change: Callable[[Any], Any]) -> dict[str, Any]:
    """Members that may be changed together, by name: all rods, or one after another."""
    states = model.states_by_name(state)

    def fits(name: str, own: Any) -> bool:
        # Each rod alone first: this compiles less than a system.
        try:
            changed = change(own).as_member()
            changed.check_for(changed.method, name, states[name])
        except (ValueError, TypeError):
            return False
        return True

    rods = {name: own for name, own in _rods(model).items() if fits(name, own)}
    if not rods:
        return {}

    def accepted(names: list[str]) -> dict[str, Any]:
        try:
            changed = {name: change(rods[name]) for name in names}
            reduced = model.with_members(changed)
            first = jnp.int32(0) if model.evolves else None
            reduced.check_run(state, 1.0, first)
        except (ValueError, TypeError):
            return {}
        return changed

    together = accepted(list(rods))
    if together or len(rods) == 1:
        return together
    kept: list[str] = []
    for name in rods:
        if accepted([*kept, name]):
            kept.append(name)
    return accepted(kept) if kept else {}


def planar_by(plane: PlaneName) -> Callable[[Any], Any]:
    """Function that makes a member planar, for `allowed`."""
    return partial(with_method, partial(planar, plane))


def untwisted(member: Any) -> Any:
    """Scene or equal scenes of a member, without twist."""
    return member.with_method(lambda law: torsion_free())


def unlimited(member: Any) -> Any:
    """Scene or equal scenes of a member, with implicit steps."""
    return member.with_method(lambda law: implicit())


def with_method(method: Callable[[Any], Any], member: Any) -> Any:
    """Scene or equal scenes of a member, with the method that `method` makes."""
    return member.with_method(method)


def with_scaled_inertia(member: Any) -> Any:
    """Scene or equal scenes of a member, with scaled inertia."""
    return member.each(lambda scene: scale_inertia(scene).scene)


def _operations(model: Model, state: Any) -> float:
    """Number of operations of a step, as written."""
    ready = model.with_memory(state)
    dt = jnp.asarray(1.0, jax.tree.leaves(model)[0].dtype)
    first = jnp.int32(0) if model.evolves else None
    stepper = model.run_stepper(ready, dt, first)
    carry = jax.eval_shape(stepper.begin, ready)
    costs: Any = jax.jit(stepper.cycle).lower(carry).cost_analysis()
    return float(costs["flops"])
