r"""Largest stable step of a system at a state, measured with the system's own step.

Position Verlet drifts for half a step $h/2$, kicks, and drifts on. Let $G(h)$ be the
linear map from small rates before a drift and a kick to the rates after both, about the
state at rest. A motion that swings up has its rates reversed by every kick: $G r = -r$.
So a step is stable as long as all eigenvalues of $I - G(h)$ are below two. Without
damping they are $(h\omega)^2/2$, and this is the limit $h\,\omega < 2$ of each natural
frequency. All loads count as they are at the state: contacts that touch and those that
do not, joints, ties, bodies, dashpots, friction that sticks.

The largest eigenvalue comes from a Krylov space (`jaxrod.analysis.frequency`), and the
step at which it is two from a bracketing search.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxrod.analysis.frequency import (
    KRYLOV_SIZE,
    Vibration,
    krylov,
    largest_eigenvalue,
)
from jaxrod.analysis.stability import Bracket, StableStep, limiting
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors, split_quaternion, to_material
from jaxrod.lanes.steps import by_kernel
from jaxrod.structure import pytree
from jaxrod.systems.coupling import searched, with_found
from jaxrod.systems.stepping.assembly import Assembly, SystemState
from jaxrod.systems.stepping.runs import StableSystemStep, stable_system_dt
from jaxrod.systems.stepping.stepper import SystemStepper, stepper_at

INSTANT = 1e-6
"""Duration of a kick without damping, as a fraction of the step [1]."""
TOLERANCE = 1e-3
"""Largest relative error of the step at which the search ends [1]."""
_MOST_ROUNDS = 60
_BELOW, _ABOVE = 3.0, 2.5
"""Logarithms of how far below and above its first guesses the step is searched [1]."""


@pytree
class _Response:
    """Rates after a drift and a kick, as a linear function of those before."""

    stepper: SystemStepper
    """Integrator of the system, for the duration of the kick."""
    state: dict[str, Any]
    """State of the members, at rest."""
    half: Float[Array, ""]
    """Duration of the drift [s]."""
    share: Float[Array, ""]
    """One if rates count in the kick; zero without damping, drag and friction [1]."""
    units: Any
    """Rates of unit kinetic energy, for each entry of the rates of all members."""

    def lost(self, flat: Array) -> Array:
        """Small scaled rates before the drift minus those after the kick."""
        _, tree_of = ravel_pytree(self.units)
        rates = jax.tree.map(jnp.multiply, tree_of(flat), self.units)
        none = jax.tree.map(jnp.zeros_like, rates)

        def change(rates: Any) -> Any:
            # As constraints allow.
            before = self.stepper.enter(with_state_rates(self.state, rates))
            moved = self.stepper.leave(self.stepper.drift(before, self.half))
            moving = jax.tree.map(lambda rate: self.share * rate, state_rates(moved))
            # XLA would fuse drift and kick, and compile for minutes.
            there, moving = lax.optimization_barrier(
                (self.stepper.enter(with_state_rates(moved, moving)), moving)
            )
            after = state_rates(self.stepper.leave(self.stepper.kick(there)))
            return jax.tree.map(jnp.subtract, moving, after)

        _, changed = jax.jvp(change, (none,), (rates,))
        changed = jax.tree.map(jnp.divide, changed, self.units)
        return ravel_pytree(changed)[0]


class _Fastest(NamedTuple):
    """Largest eigenvalue of a response, and the scaled rates that have it."""

    eigenvalue: Array
    rates: Array


def state_rates(state: SystemState) -> dict[str, Any]:
    """Velocities of nodes, and angular momenta or velocities, of all members."""
    return {name: own.rates for name, own in state.items()}


def with_state_rates(state: SystemState, rates: Any) -> dict[str, Any]:
    """Copy of a state in which all members have other rates."""
    return {name: own.with_rates(*rates[name]) for name, own in state.items()}


def _units(system: Assembly, state: SystemState) -> Any:
    """Rates of unit kinetic energy: the roots of what kinetic energy has per square."""
    members = system.interfaces()
    none = jax.tree.map(jnp.zeros_like, state_rates(state))

    def energy(rates: Any) -> Array:
        moving = with_state_rates(state, rates)
        zero = jnp.zeros((), system.dtype)
        return sum((members[k].kinetic_energy(moving[k]) for k in members), zero)

    def along(axis: int) -> Any:
        # Axis by axis: inertia mixes the axes of a turned element.
        seed = jax.tree.map(lambda a: a.at[..., axis, :].set(1), none)
        return jax.tree.map(jnp.multiply, jax.grad(energy)(seed), seed)

    total = jax.tree.map(lambda a, b, c: a + b + c, *(along(axis) for axis in range(3)))

    def unit(weights: Array) -> Array:
        mean = jnp.mean(weights, axis=-2, keepdims=True)
        own = jnp.where(mean > 0, 1 / jnp.sqrt(jnp.where(mean > 0, mean, 1)), 1)
        return jnp.broadcast_to(own, weights.shape)

    return jax.tree.map(unit, total)


def _fastest(
    system: Assembly, state: SystemState, half: Array, share: Array
) -> _Fastest:
    """Largest eigenvalue for a step of twice `half` [s]; for `share`, see `_Response`.

    With a share of zero the kick is shorter, by the factor `INSTANT`.
    """
    dt = jnp.where(share > 0, 1, INSTANT) * 2 * half
    bare = {name: state[name] for name in system.members}
    still = with_state_rates(bare, jax.tree.map(jnp.zeros_like, state_rates(bare)))
    stepper = stepper_at(system, still, dt.astype(system.dtype))
    found = searched(stepper.couplings, stepper.seen(stepper.enter(still)))
    couplings = with_found(stepper.couplings, lax.stop_gradient(found))
    units = lax.stop_gradient(_units(system, still))
    response = _Response(
        replace(stepper, couplings=couplings), still, half, share, units
    )

    def apply(flat: Array) -> Array:
        own = lax.optimization_barrier(flat)
        return lax.optimization_barrier(by_kernel(response, "lost", own))

    size = ravel_pytree(units)[0].size
    start = jax.random.normal(jax.random.key(0), (size,), system.dtype)
    # Rates that nothing allows are no part of the space.
    basis, projected = krylov(apply, start, min(KRYLOV_SIZE, size))
    largest, weights = largest_eigenvalue(projected)
    motion = jnp.sum(weights[:, None] * basis, axis=0)
    return _Fastest(largest, motion / jnp.sqrt(jnp.sum(motion**2)))


class _Measured(NamedTuple):
    """The step at which the largest eigenvalue is two, and details."""

    step: Array
    frequency: Array
    """Highest angular frequency without damping [rad/s]."""
    rates: Array
    """Scaled rates of the motion that limits the step."""


def _excess(system: Assembly, state: SystemState, height: Array) -> Array:
    """Logarithm of half the largest eigenvalue, at the logarithm `height` of a step."""
    one = jnp.ones_like(height)
    return jnp.log(0.5 * _fastest(system, state, 0.5 * jnp.exp(height), one).eigenvalue)


@jax.custom_jvp
def _limit(system: Assembly, state: SystemState, bound: Array) -> _Measured:
    """Measures the step; `bound` is that of unstressed shapes [s]."""

    # One loop, so that the response is compiled once. Round 0 is without damping.
    def unfinished(carry: tuple[Any, ...]) -> Array:
        k, _, _, bracket, excess, _, _ = carry
        wide = (jnp.abs(excess) > TOLERANCE) & (bracket.width > TOLERANCE)
        return (k < 2) | (wide & (k < _MOST_ROUNDS))

    def look(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        k, frequency, _, bracket, _, _, last = carry
        first = k == 0
        height = jnp.where(first, jnp.log(bound), bracket.place)
        half = 0.5 * jnp.exp(height)
        share = jnp.where(first, jnp.zeros_like(bound), jnp.ones_like(bound))
        found = _fastest(system, state, half, share)
        alone = jnp.sqrt(found.eigenvalue / (2 * INSTANT)) / half
        frequency = jnp.where(first, alone, frequency)
        undamped = jnp.log(2 / frequency)
        excess = jnp.log(0.5 * found.eigenvalue)
        lower = jnp.minimum(undamped, jnp.log(bound)) - _BELOW
        upper = jnp.maximum(undamped, jnp.log(bound)) + _ABOVE
        begun = replace(Bracket.between(lower, upper), place=undamped)
        narrowed = bracket.narrowed(jnp.tanh(-excess), 0.25 * TOLERANCE)
        after = jax.tree.map(lambda a, b: jnp.where(first, a, b), begun, narrowed)
        rates = jnp.where(first, last, found.rates)
        return k + 1, frequency, height, after, excess, excess, rates

    zero = jnp.zeros_like(bound)
    flat = ravel_pytree(state_rates({k: state[k] for k in system.members}))[0]
    begin = (
        jnp.asarray(0),
        zero,
        zero,
        Bracket.between(zero - 1, zero + 1),
        zero,
        zero,
        jnp.zeros_like(flat),
    )
    _, frequency, height, bracket, excess, _, rates = lax.while_loop(
        unfinished, look, begin
    )
    # An excess grows at least in proportion to the step.
    near = jnp.abs(excess) <= TOLERANCE
    step = jnp.where(near, height - jnp.maximum(excess, 0), bracket.lower)
    return _Measured(jnp.exp(step), frequency, rates)


@_limit.defjvp
def _limit_jvp(primals: Any, tangents: Any) -> tuple[_Measured, _Measured]:
    """Derivative of the step, from the balance that defines it."""
    system, state, bound = primals
    found = _limit(system, state, bound)
    height = jnp.log(found.step)
    _, change = jax.jvp(
        lambda system, state: _excess(system, state, height),
        (system, state),
        tuple(tangents[:2]),
    )
    _, slope = jax.jvp(
        lambda y: _excess(system, state, y), (height,), (jnp.ones_like(height),)
    )
    still = jax.tree.map(jnp.zeros_like, found)
    rate = (-found.step * change / slope).astype(found.step.dtype)
    return found, still._replace(step=rate)


@jax.jit
def measured_system_dt(
    system: Assembly, state: SystemState, safety: Array
) -> StableSystemStep:
    """The largest step at which a system is stable at a state, times a safety factor.

    Args:
        system: The system, without schedules and implicit members.
        state: Configuration at which to measure; rates do not count.
        safety: Fraction of the limit to use, in (0, 1].
    """
    system = system.recalling(state)
    bound = lax.stop_gradient(stable_system_dt(system, 1.0).dt)
    # Nothing limits the step of bodies that nothing acts on.
    limited = bound < jnp.inf
    bound = jnp.where(limited, bound, 1).astype(system.dtype)
    found = _limit(system, state, bound)
    step = jnp.where(limited, safety * found.step, jnp.inf)
    bare = {name: state[name] for name in system.members}
    _, tree_of = ravel_pytree(state_rates(bare))
    moving = tree_of(lax.stop_gradient(found.rates))
    names = tuple(system.members)
    energies = jnp.stack(
        [sum(jnp.sum(part**2) for part in moving[name]) for name in names]
    )
    limits: list[Array] = []
    steps: list[StableStep | None] = []
    for k, name in enumerate(names):
        own = jnp.where(jnp.argmax(energies) == k, step, jnp.inf)
        limits.append(own)
        layout = state[name].layout
        limit = lambda dt, mode, element: StableStep(
            dt, element, mode, found.frequency, jnp.asarray(TOLERANCE, dt.dtype)
        )
        if not layout.is_rod:
            steps.append(None)
        elif not layout.is_stacked:
            steps.append(limit(own, *_named(state[name], moving[name])))
        else:
            of_rods = sum(jnp.sum(part**2, axis=(1, 2)) for part in moving[name])
            numbers = jnp.arange(layout.count)
            each = jnp.where(numbers == jnp.argmax(of_rods), own, jnp.inf)
            named = jax.vmap(_named)(state[name], moving[name])
            steps.append(jax.vmap(limit)(each, *named))
    return StableSystemStep(step, tuple(limits), tuple(steps), names)


def _named(state: Any, moving: Any) -> tuple[Array, Array]:
    """Mode and element of one rod, from its scaled rates in the limiting motion."""
    velocities, spins = moving
    frame = directors(split_quaternion(state.orientations))
    turns = vectors.join(to_material(frame, vectors.split(spins)))
    zero = jnp.zeros((), velocities.dtype)
    return limiting(Vibration(zero, velocities, turns), state)
