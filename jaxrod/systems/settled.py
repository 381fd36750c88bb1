r"""Where a scene or a system comes to rest, by adaptive dynamic relaxation.

The motion itself is followed, with the inertia there is, and damped at the rate
$2\omega$ that is critical for the frequency at which it moves just now. That is
Rayleigh's quotient of the velocities $u$ with the change of the accelerations $a$ that
all loads give at rest, over some steps of duration $t$ together:

$$\omega^2 = -\frac{u\cdot M\,\Delta a}{t\; u\cdot M u}.$$

Fast modes die first, and the damping follows what is left down to the slowest one;
where motion gains speed, as in a fall, there is none (Underwood, Dynamic relaxation, in
Computational Methods for Transient Analysis, North-Holland 1983).

How far it is from rest is measured too: one kick from rest, in a time so short that
nothing moves, gives every node mass times acceleration, what is held and tied included.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxrod.analysis.stability import stable_dt
from jaxrod.composite import Composite
from jaxrod.effects.loads import ExponentialDamping
from jaxrod.rods.rod import Rod, RodState
from jaxrod.scene import Model, Scene, check_moment, kinetic_energy
from jaxrod.stepping.checks import check_arguments, check_first
from jaxrod.stepping.memory import with_memory
from jaxrod.stepping.runs import advance, step
from jaxrod.structure import pytree
from jaxrod.systems.rigid_bodies import BodyState, RigidBodies, body_angular_momenta
from jaxrod.validation import as_array, check_count

SHARE = 1e-8
"""Of the load that bends a rod by its own size, what may be out of balance [1]."""
ROUNDING = 8
"""Units of round-off of the stiffness of stretch that are no load."""
INSTANT = 1e-3
"""Of a step, the time of the kick that measures loads [1]."""


@pytree
class Settled:
    """A scene or a system at rest, if `converged`."""

    state: Any
    """State at the end, without velocities."""
    converged: Bool[Array, ""]
    """Whether loads balance there, to the tolerances."""
    steps: Int[Array, ""]
    """Steps taken."""
    force_residual: Float[Array, ""]
    """Largest mass times acceleration of a node or a body at rest there [N]."""
    couple_residual: Float[Array, ""]
    """Largest rate of the angular momentum of an element or a body [N m]."""


def settled(
    scene: Model,
    state: Any,
    *,
    dt: ArrayLike | None = None,
    force_tolerance: ArrayLike | None = None,
    couple_tolerance: ArrayLike | None = None,
    every: int = 16,
    max_steps: int = 1_000_000,
) -> Settled:
    """Follows a scene or a system until it rests: see the module.

    For all that can be stepped, contact and bodies included, where `equilibrium` takes
    one rod. Works inside jit and vmap. It cannot be differentiated in reverse mode, and
    nothing here knows the implicit function theorem; forward mode follows all steps.

    It finds places of rest that are reached by falling. What stands exactly on the top
    of a hill, as a straight column, stays there and has converged; what nothing holds
    never does. Friction of contacts is a drag, which is zero at rest: things come to
    lie where they would without it.

    Args:
        scene: The scene or system, without schedules (`.at(time)`).
        state: Where to start; its velocities are set to zero.
        dt: Step size [s]; by default `stable_dt(scene).dt`.
        force_tolerance: Largest force out of balance [N]; by default, of the rod of
            which that is least, 1e-8 of its bending stiffness over its length squared,
            and eight units of round-off of its stiffness of stretch.
        couple_tolerance: Largest couple out of balance [N m]; by default the same times
            the length.
        every: Steps between looks at the kinetic energy and at the residual.
        max_steps: Largest number of steps, rounded up to a multiple of `every`.

    Returns:
        The state at rest, and how well the loads balance there.

    Raises:
        ValueError: If it depends on time, if there is no rod to take tolerances from
            and they are not given, or if an argument is out of range.
        TypeError: If `scene` or `state` is something else.
    """
    every = check_count("every", every, 1, 100_000)
    blocks = -(-check_count("max_steps", max_steps, 1) // every)
    check_first(scene, 0, 0)
    _check_moment(scene)
    size = check_arguments(
        scene, state, stable_dt(scene).dt if dt is None else dt, None
    )
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
    start = with_memory(scene, state)
    return _settled(
        scene, start, size, (bounds[0], bounds[1]), jnp.asarray(blocks), every
    )


@pytree
class Way:
    """How far it has come."""

    state: Any
    """The state, moving."""
    pushes: Any
    """Rates after the kick from rest there."""
    rate: Array
    """Of damping [1/s]."""
    blocks: Array
    """Blocks of steps taken."""
    residuals: tuple[Array, Array]
    """Largest force [N] and couple [N m] out of balance."""
    finite: Array
    """Whether it has not blown up."""


@functools.partial(jax.jit, static_argnames="every")
def _settled(
    scene: Model,
    state: Any,
    dt: Array,
    tolerances: tuple[Array, Array],
    blocks: Array,
    every: int,
) -> Settled:
    start = _with_rates(state, jax.tree.map(jnp.zeros_like, _rates(state)))
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
    still = _with_rates(end.state, jax.tree.map(jnp.zeros_like, _rates(end.state)))
    return Settled(still, balanced(end), end.blocks * every, *end.residuals)


def _block(scene: Model, way: Way, dt: Array, every: int) -> Way:
    """Some steps more, and the damping for those that follow."""
    damped = _damped(scene, way.rate)
    padded = _each(way.state, lambda own: _with_memories(own, 1))
    moved = _each(
        advance(damped, padded, dt, every), lambda own: _with_memories(own, -1)
    )
    pushes = _pushes(scene, moved, dt)
    mean = jax.tree.map(lambda a, b: 0.5 * (a + b), _rates(way.state), _rates(moved))
    # Changes of accelerations times the duration of the block: of the unit of rates.
    change = jax.tree.map(lambda a, b: every / INSTANT * (b - a), way.pushes, pushes)

    def energy(share: float) -> Array:
        rates = jax.tree.map(lambda a, b: a + share * b, mean, change)
        return _kinetic(scene, _with_rates(moved, rates))

    moving = energy(0.0)
    stopped = moving == 0
    # By the square of the duration, and no faster than steps can follow.
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


def _each(state: Any, function: Callable[[Any], Any]) -> Any:
    """The state with a function of every member's."""
    if not isinstance(state, dict):
        return function(state)
    # The record of lists of neighbours is no member's.
    known = (RodState, BodyState)
    return {k: function(v) if isinstance(v, known) else v for k, v in state.items()}


def _rates(state: Any) -> Any:
    """Velocities and angular momenta (of bodies, angular velocities) of all members."""
    if isinstance(state, dict):
        known = (RodState, BodyState)
        return {k: _rates(v) for k, v in state.items() if isinstance(v, known)}
    if isinstance(state, BodyState):
        return state.velocities, state.angular_velocities
    return state.velocities, state.angular_momenta


def _with_rates(state: Any, rates: Any) -> Any:
    """The state moving as given."""
    if isinstance(state, dict):
        moving = {name: _with_rates(state[name], own) for name, own in rates.items()}
        return {**state, **moving}
    if isinstance(state, BodyState):
        return replace(state, velocities=rates[0], angular_velocities=rates[1])
    return replace(state, velocities=rates[0], angular_momenta=rates[1])


def _pushes(scene: Model, state: Any, dt: Array) -> Any:
    """Rates that all loads give what is at rest in an instant."""
    still = _with_rates(state, jax.tree.map(jnp.zeros_like, _rates(state)))
    return _rates(step(scene, still, INSTANT * dt))


def _residuals(scene: Model, state: Any, pushes: Any, dt: Array) -> tuple[Array, Array]:
    """Largest force [N] and couple [N m] out of balance."""
    largest = [jnp.zeros((), dt.dtype)] * 2
    for member, own in _members(scene, _with_rates(state, pushes)):
        if isinstance(member, RigidBodies):
            masses, spins = member.masses, body_angular_momenta(member, own)
        else:
            masses, spins = member.rod.node_masses, own.angular_momenta
        # Of equal rods with a leading axis the components are next to last.
        for k, push in enumerate((masses[..., None, :] * own.velocities, spins)):
            size = jnp.max(jnp.sum(push * push, axis=-2))
            largest[k] = jnp.maximum(largest[k], size)
    force, couple = (jnp.sqrt(size) / (INSTANT * dt) for size in largest)
    return force, couple


def _damped(scene: Any, rate: Array) -> Any:
    """The model with all members damped at a rate besides [1/s]."""
    if isinstance(scene, Composite):
        system: Any = scene
        damped = {name: _damped(own, rate) for name, own in system.members.items()}
        return replace(system, members=damped)
    if isinstance(scene, Scene):
        # Of equal rods every number has a leading axis.
        rate = jnp.broadcast_to(rate, scene.rod.rest_lengths.shape[:-1])
    return replace(scene, effects=(*scene.effects, ExponentialDamping(rate, rate)))


def _with_memories(state: Any, more: int) -> Any:
    """A state with room for one more effect's memory, or one less."""
    if isinstance(state, BodyState) or state.memory is None:
        return state
    memory = (*state.memory, {}) if more > 0 else state.memory[:more]
    return replace(state, memory=memory)


def _members(scene: Model, state: Any) -> list[tuple[Any, Any]]:
    """Scenes and rigid bodies with their states."""
    if isinstance(scene, Scene):
        return [(scene, state)]
    members: Any = scene
    return [(own, state[name]) for name, own in members.members.items()]


def _kinetic(scene: Model, state: Any) -> Array:
    return kinetic_energy(scene.rod if isinstance(scene, Scene) else scene, state)


def _check_moment(scene: Model) -> None:
    if isinstance(scene, Composite):
        own: Any = scene
        own.check_moment()
    else:
        check_moment(scene)


def _default_tolerances(scene: Model) -> tuple[Array | None, Array | None]:
    """Of the rod of which they are least; none without rods."""
    if isinstance(scene, Scene):
        rods = [scene.rod]
    else:
        own: Any = scene
        rods = [m.rod for m in own.members.values() if isinstance(m, Scene)]
    if not rods:
        return None, None
    forces, couples = zip(*(_tolerances_of(rod) for rod in rods), strict=True)
    return functools.reduce(jnp.minimum, forces), functools.reduce(jnp.minimum, couples)


def _tolerances_of(rod: Rod) -> tuple[Array, Array]:
    """Of a rod, or the least of equal ones."""
    length = jnp.sum(rod.rest_lengths, axis=-1)
    bending = jnp.min(rod.bend_twist_stiffness[..., :2, :], axis=(-2, -1))
    stretch = jnp.max(rod.shear_stretch_stiffness[..., 2, :], axis=-1)
    rounding = ROUNDING * jnp.finfo(length.dtype).eps * stretch
    force = SHARE * bending / length**2 + rounding
    return jnp.min(force), jnp.min(force * length)
