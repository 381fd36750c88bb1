r"""Rest states of a scene or a system, by adaptive dynamic relaxation.

The motion is followed with its true inertia and damped at the rate $2\omega$.
This is the critical rate for the current frequency $\omega$ of the motion. It is found
by a Rayleigh quotient,

$$\omega^2 = -\frac{u\cdot M\,\Delta a}{t\; u\cdot M u},$$

with the masses $M$, the velocities $u$ and the change $\Delta a$ of the accelerations
that all loads would give at rest, over a block of steps of total duration $t$.

Fast modes decay first, and the damping adapts to the remaining motion down to the
slowest mode. While the motion gains speed, as in a fall, there is no damping
(Underwood, Dynamic relaxation, in Computational Methods for Transient Analysis,
North-Holland 1983).

The distance from rest is measured too. One kick from rest, so short that nothing moves,
gives the mass times acceleration of every node, with supports and ties taken into
account.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxrod.analysis.stability import stable_dt
from jaxrod.effects.loads import ExponentialDamping
from jaxrod.model import Model, TimeStep
from jaxrod.rods.rod import Rod
from jaxrod.stepping.runs import advance, check_first, step
from jaxrod.structure import pytree
from jaxrod.validation import as_array, check_count

SHARE = 1e-8
"""Default force tolerance as a fraction of a rod's bending stiffness over its length
squared [1]."""
ROUNDING = 8
"""Part of the default force tolerance for round-off, in units of the machine epsilon
times the stretching stiffness [1]."""
INSTANT = 1e-3
"""Duration of the kick that measures loads out of balance, as a fraction of a step [1].
"""


@pytree
class Settled:
    """A scene or a system at rest, if `converged`.

    Example:
        >>> rest = systems.settled(scene, state, max_steps=16)
        >>> int(rest.steps), bool(rest.converged)  # too few steps to come to rest
        (16, False)
    """

    state: Any
    """State at the end, with zero velocities."""
    converged: Bool[Array, ""]
    """Whether loads balance in `state`, to the tolerances."""
    steps: Int[Array, ""]
    """Number of steps taken."""
    force_residual: Float[Array, ""]
    """Largest mass times acceleration of a node or a body released from rest [N]."""
    couple_residual: Float[Array, ""]
    """Largest rate of change of the angular momentum of an element or body released
    from rest [N m]."""


def settled(
    scene: Model,
    state: Any,
    *,
    dt: TimeStep | None = None,
    force_tolerance: ArrayLike | None = None,
    couple_tolerance: ArrayLike | None = None,
    every: int = 16,
    max_steps: int = 1_000_000,
) -> Settled:
    """Follows the damped motion of a scene or a system until it comes to rest.

    The method is described in the docstring of this module. It works for all scenes and
    for systems whose members allow `with_effect`, which adds a drag to them. It follows
    their motion, while `jaxrod.equilibrium` solves for the balance of loads. It works
    inside jit and vmap. It cannot be differentiated in reverse mode, and does not use
    the implicit function theorem; forward mode follows all steps.

    It finds rest states that are reached by falling. A model in unstable equilibrium,
    such as a straight column, stays there and counts as converged. A model in free fall
    never converges. Friction of contacts is a drag, which is zero at rest: rods and
    bodies come to rest where they would without friction.

    Args:
        scene: The scene or system, without schedules (`.at(time)`).
        state: Initial state; its velocities are set to zero.
        dt: Step size [s]; by default the result of `stable_dt`.
        force_tolerance: Largest force out of balance [N]. By default it is
            $10^{-8} B / L^2 + 8 e S$, with the bending stiffness $B$, length $L$ and
            stretching stiffness $S$ of a rod and the machine epsilon $e$. The
            smallest value of all rods is used.
        couple_tolerance: Largest couple out of balance [N m]; by default L times that
            force, again the smallest value of all rods.
        every: Steps between checks of the kinetic energy and of the residual.
        max_steps: Largest number of steps, rounded up to a multiple of `every`.

    Returns:
        The state at rest, and how well the loads balance there.

    Raises:
        ValueError: If the scene depends on time, if tolerances are not given and there
            is no rod to derive them from, or if an argument is out of range.
        TypeError: If `scene` or `state` is of the wrong type.

    Example:
        >>> rest = systems.settled(scene, state)
        >>> bool(rest.converged), round(float(rest.state.tip[2]), 2)  # hanging [m]
        (True, -0.96)
    """
    every = check_count("every", every, 1, 100_000)
    blocks = -(-check_count("max_steps", max_steps, 1) // every)
    check_first(scene, 0, 0)
    scene.check_moment()
    size = scene.check_run(state, stable_dt(scene).dt if dt is None else dt, None)
    given = (force_tolerance, couple_tolerance)
    bounds = []
    for name, unit, value, default in zip(
        ("force_tolerance", "couple_tolerance"),
        ("N", "N m"),
        given,
        _default_tolerances(scene),
        strict=True,
    ):
        if value is None and default is None:
            raise ValueError(
                f"{name} must be given, in {unit}: there is no rod to take it from"
            )
        bounds.append(
            as_array(
                name,
                default if value is None else value,
                unit,
                positive=True,
                dtype=size.dtype,
            )
        )
    start = scene.with_memory(state)
    return _settled(
        scene, start, size, (bounds[0], bounds[1]), jnp.asarray(blocks), every
    )


@pytree
class Way:
    """Carry of the relaxation loop, which advances by blocks of steps."""

    state: Any
    """Current state, in motion."""
    pushes: Any
    """Velocities and spins of all members after a short kick from rest in this state,
    in proportion to the accelerations."""
    rate: Array
    """Damping rate of velocities and spins in the next block [1/s]."""
    blocks: Array
    """Number of blocks of steps taken."""
    residuals: tuple[Array, Array]
    """Largest force [N] and couple [N m] out of balance."""
    finite: Array
    """Whether the kinetic energy is finite."""


@functools.partial(jax.jit, static_argnames="every")
def _settled(
    scene: Model,
    state: Any,
    dt: Array,
    tolerances: tuple[Array, Array],
    blocks: Array,
    every: int,
) -> Settled:
    start = _still(scene, state)
    pushes = _pushes(scene, start, dt)
    zero, none = jnp.zeros((), dt.dtype), jnp.zeros_like(blocks)
    residuals = _residuals(scene, start, pushes, dt)
    first = Way(start, pushes, zero, none, residuals, jnp.ones((), bool))

    def balanced(way: Way) -> Array:
        force, couple = way.residuals
        return (force <= tolerances[0]) & (couple <= tolerances[1])

    end = lax.while_loop(
        lambda way: (way.blocks < blocks) & ~balanced(way) & way.finite,
        lambda way: _block(scene, way, dt, every),
        first,
    )
    still = _still(scene, end.state)
    return Settled(still, balanced(end), end.blocks * every, *end.residuals)


def _block(scene: Model, way: Way, dt: Array, every: int) -> Way:
    """Advances by `every` damped steps, and finds the damping rate for the next."""
    damped = _damped(scene, way.rate)
    moved = advance(damped, _with_memories(scene, way.state, 1), dt, every)
    moved = _with_memories(scene, moved, -1)
    pushes = _pushes(scene, moved, dt)
    mean = jax.tree.map(
        lambda a, b: 0.5 * (a + b), _rates(scene, way.state), _rates(scene, moved)
    )
    # Changes of accelerations times the duration of the block, in units of rates.
    change = jax.tree.map(lambda a, b: every / INSTANT * (b - a), way.pushes, pushes)

    def energy(share: float) -> Array:
        rates = jax.tree.map(lambda a, b: a + share * b, mean, change)
        return scene.kinetic_energy(_with_rates(scene, moved, rates))

    moving = energy(0.0)
    stopped = moving == 0
    # Squared frequency times the squared duration, bounded by what steps can resolve.
    squared = (energy(-1.0) - energy(1.0)) / (4 * jnp.where(stopped, 1, moving))
    rate = 2 * jnp.sqrt(jnp.clip(squared, 0, (0.5 * every) ** 2)) / (every * dt)
    return Way(
        state=moved,
        pushes=pushes,
        rate=jnp.where(stopped, 0, rate),
        blocks=way.blocks + 1,
        residuals=_residuals(scene, moved, pushes, dt),
        finite=jnp.isfinite(moving),
    )


def _rates(scene: Model, state: Any) -> dict[str, tuple[Array, Array]]:
    """Velocities and angular momenta (angular velocities of bodies) of all members."""
    return {name: own.rates for name, own in scene.states_by_name(state).items()}


def _with_rates(scene: Model, state: Any, rates: dict[str, tuple[Array, Array]]) -> Any:
    """Copy of the state with the given velocities and spins of all members."""
    states = scene.states_by_name(state)
    moving = {name: states[name].with_rates(*own) for name, own in rates.items()}
    return scene.with_states(state, moving)


def _still(scene: Model, state: Any) -> Any:
    """Copy of the state with zero velocities and spins."""
    none = jax.tree.map(jnp.zeros_like, _rates(scene, state))
    return _with_rates(scene, state, none)


def _pushes(scene: Model, state: Any, dt: Array) -> Any:
    """Velocities and spins after a kick from rest: accelerations times its duration.

    The duration is `INSTANT` times the step `dt` [s].
    """
    return _rates(scene, step(scene, _still(scene, state), INSTANT * dt))


def _residuals(scene: Model, state: Any, pushes: Any, dt: Array) -> tuple[Array, Array]:
    """Largest force [N] and couple [N m] out of balance, over nodes and elements.

    They are the momenta after the kick from rest (`pushes`), divided by its duration,
    `INSTANT * dt`.
    """
    largest = [jnp.zeros((), dt.dtype)] * 2
    pushed = scene.states_by_name(_with_rates(scene, state, pushes))
    for name, member in scene.interfaces().items():
        for k, push in enumerate(member.momenta(pushed[name])):
            size = jnp.max(jnp.sum(push * push, axis=-2))
            largest[k] = jnp.maximum(largest[k], size)
    force, couple = (jnp.sqrt(size) / (INSTANT * dt) for size in largest)
    return force, couple


def _damped(scene: Model, rate: Array) -> Model:
    """Copy of the model with all velocities and spins damped at `rate` [1/s]."""
    return scene.with_effect(ExponentialDamping(rate, rate))


def _with_memories(scene: Model, state: Any, more: int) -> Any:
    """Adds an empty memory for one more effect (`more` = 1), or drops the last (-1)."""

    def one(own: Any) -> Any:
        if getattr(own, "memory", None) is None:
            return own
        memory = (*own.memory, {}) if more > 0 else own.memory[:more]
        return replace(own, memory=memory)

    states = scene.states_by_name(state).items()
    return scene.with_states(state, {name: one(own) for name, own in states})


def _default_tolerances(scene: Model) -> tuple[Array | None, Array | None]:
    """Default tolerances of force [N] and couple [N m]; `None` without rods.

    They are the smallest ones of all rods.
    """
    members = scene.interfaces().values()
    rods = [member.rod for member in members if member.rod is not None]
    if not rods:
        return None, None
    forces, couples = zip(*(_tolerances_of(rod) for rod in rods), strict=True)
    return functools.reduce(jnp.minimum, forces), functools.reduce(jnp.minimum, couples)


def _tolerances_of(rod: Rod) -> tuple[Array, Array]:
    """Tolerances of force [N] and couple [N m] of a rod; the smallest of equal rods.

    The force is `SHARE B / L^2 + ROUNDING eps S`, with bending stiffness `B`, length
    `L`, machine epsilon `eps` and stretching stiffness `S`. The couple is the force
    times `L`.
    """
    length = jnp.sum(rod.rest_lengths, axis=-1)
    bending = jnp.min(rod.bend_twist_stiffness[..., :2, :], axis=(-2, -1))
    stretch = jnp.max(rod.shear_stretch_stiffness[..., 2, :], axis=-1)
    rounding = ROUNDING * jnp.finfo(length.dtype).eps * stretch
    force = SHARE * bending / length**2 + rounding
    return jnp.min(force), jnp.min(force * length)
