r"""The largest safe time step of a scene, and the mode of motion that limits it.

Position Verlet is stable while $h\,\omega_{\max} < 2$. Without a state, the highest
frequency about the unstressed shape is bounded element by element. Every element shares
its mass between its nodes. If the stiffness of every element and its joints is at most
$\lambda$ times the element's inertia, the same holds for the whole rod. For an element
of mass $m$, length $\ell$, rotary inertia $J$, shear stiffness $S$ and joints that
contribute $\beta$ (half of each joint's squared frequency), $\lambda$ is the larger
root of

$$(\lambda - a)(\lambda - c - \beta) = a c,\qquad
  a = \frac{4 S}{m\,\ell},\quad c = \frac{S\,\ell}{J},$$

or the squared frequency of stretch, if that is larger. For a long uniform rod this is
the exact limit. It holds for any taper, curvature and stiffness, and
`Effect.stability_bound` adds the contribution of effects. With
`mass_matrix="higher_order"` masses are at least those of the nodes divided by 4/3, or
slightly more at the ends: see `jaxrod.rods.mass_matrix`.

Frequencies change when the rod is deformed. Under PyElastica's law they grow in inverse
proportion to the stretch of a compressed rod. Under the consistent law compression by a
fraction $\varepsilon$ raises the highest frequency by at most the fraction
$0.6\,\varepsilon$, and never by more than 8 % (at $\varepsilon = 1/3$). A safety factor
of 0.9 covers this; a factor of 0.99 covers rods that are never compressed by more than
1.5 %. Violent vibrations of single elements need more margin: Verlet has resonances of
third and fourth order at $\sqrt3/2$ and $\sqrt2/2$ of the limit. Undamped rods with
strains of 0.1 and joint angles of one radian blew up at safety factors of 0.72 and
above; at 0.65 none of 64 did.

Damping enters the limit as added inertia. Solved exactly in the kick (consistent mode),
a rate $g$ turns an inertia $m$ into $m\,\frac{gh}2\coth\frac{gh}2$. As a factor after
the kick (PyElastica mode) it gives $m\,(1+e^{gh})/2$, and explicit drag of rate $c$
subtracts $m\,ch/2$. With these inertias the step is stable exactly while
$h\,\omega_{\max} < 2$. As $h\,\omega_{\max}$ grows with $h$, the single step at which
it is 2 is bracketed and then found to round-off.

Four things make the bound smaller than the limit. First, everything that may touch is
assumed to touch. Second, stiffness and drag are added as if they acted on one motion.
But friction acts along a surface, and contact stiffness perpendicular to it. The step
that each alone allows is up to 1.62 times as large (the golden ratio, if both allow the
same step). Third, in PyElastica mode motions decaying by an exponent of more than 1.28
within a step are assumed to decay less. There the bound grows in proportion to the
rate, while the limit may be infinite. Friction between members is divided between
translation and rotation by inertia without damping. So in this mode the bound of rods
that only rotate with strong damping is up to five times too small. Fourth, damping that
is solved by itself after the kick (`internal_damping`, `short_wave_damping`) is not
counted: with strong damping of this kind, steps up to 25 times as large were stable.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeVar, overload

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int

from jaxrod.analysis.frequency import (
    InertiaFactors,
    Vibration,
    fastest_vibration,
    no_damping,
)
from jaxrod.effects.base import Effect, StabilityBound
from jaxrod.effects.time import depends_on_time
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import (
    conjugate,
    directors,
    multiply_quaternions,
    rotation_log,
    split_quaternion,
)
from jaxrod.loaded_rod import (
    LoadedRod,
    check_scene,
    check_scene_and_state,
    damping_rates,
)
from jaxrod.methods.drag_kick import without_drag
from jaxrod.model import Model, check_model
from jaxrod.rods.mass_matrix import bounds_of_elements
from jaxrod.rods.motion import Loads, Motion, motion_of
from jaxrod.rods.repr import repr_or_class_name, step_repr
from jaxrod.rods.rod import Rod, RodState
from jaxrod.structure import pytree
from jaxrod.validation import as_array, check_time_step

Details = TypeVar("Details")

MODE_NAMES = ("shear and bending", "stretch", "twist")
COMPRESSED = 0.9
"""Smallest fraction of the bound to which compression lowers it in consistent mode."""
ROUNDING = 1e-4
"""Largest fraction of the bound that the round-off of positions alone may cost [1]."""
_MOST_ROUNDS = 100
"""Largest number of evaluations in the search for a step; bisection alone takes 60."""
_DECAY_SLOPE = 0.5
"""Upper bound of ((x/2) coth(x/2) - 1) / x: the inertia added by damping that is solved
exactly, divided by the exponent x (rate times step)."""
_FACTOR_TURN = 1.2784645427610738
"""Exponent x at which (1 + exp x) / 2x is smallest: root of 1 + exp x = x exp x."""
_FACTOR_SLOPE = 1.7955607383343108
"""Smallest value of (1 + exp x) / 2x. Above that x, x times this value replaces (1 +
exp x) / 2 for damping that is applied after a kick."""


@pytree
class StableStep:
    """A time step and what limits it. Functions that take a time step also take this.

    Example:
        >>> found = jaxrod.stable_dt(scene)
        >>> f"{float(found.dt):.2e} s", found.limiting_mode
        ('8.29e-04 s', 'shear and bending of element 0')
    """

    dt: Float[Array, ""]
    """Largest stable step times the safety factor [s]."""
    element: Int[Array, ""]
    """Index of the element with the highest frequency."""
    mode: Int[Array, ""]
    """Index into `MODE_NAMES` of the limiting motion."""
    angular_frequency: Float[Array, ""]
    """Highest angular frequency without damping: a bound, or measured at the given
    state [rad/s]."""
    uncertainty: Float[Array, ""]
    """Fraction by which the exact step with damping or drag may be larger than the one
    found [1]: round-off for the bound, a thousandth at a given state, zero without
    damping and drag."""

    def __repr__(self) -> str:
        """One line: the step and what limits it."""
        return repr_or_class_name(step_repr, self)

    @property
    def limiting_mode(self) -> str:
        """Limiting motion as text; for concrete values only."""
        return f"{MODE_NAMES[int(self.mode)]} of element {int(self.element)}"


@overload
def stable_dt(
    scene: LoadedRod, safety: ArrayLike = ..., *, state: RodState | None = ...
) -> StableStep: ...


@overload
def stable_dt(scene: Model, safety: ArrayLike = ..., *, state: Any = ...) -> Any: ...


def stable_dt(
    scene: Any, safety: ArrayLike = 0.8, *, state: RodState | None = None
) -> Any:
    """Largest step at which a scene is stable, times a safety factor.

    Without a state it is a bound in closed form for the unstressed shape, never above
    the true limit there. With a state it is measured at that deformation, to a per
    cent, from `highest_frequency`, for the cost of some hundred steps. Use that for
    rods that are strongly compressed in PyElastica mode, or to gain the last few per
    cent.

    Args:
        scene: The scene, or a system; schedules count with their `largest` values.
        safety: Fraction of the limit to use, in (0, 1]: 0.5 is cautious, 0.9 fast.
            Above 0.9 a rod that is compressed while it moves may blow up.
        state: The deformation at which to measure, if any. Effects with schedules are
            not measured there: they count with their bounds, so that the step is stable
            at all times. Give `scene.at(time)` to measure them at one time. A system
            with schedules is measured at one time only. In a system joints, friction
            and dashpots are measured too, and only contact that touches at the state:
            measure again when the contact changes.

    Returns:
        The step, and the element and motion that limit it.

    Raises:
        ValueError: If `safety` is not in (0, 1], or the state does not match the
            scene's rod. With a state, also if a system has schedules or implicit
            members.
        TypeError: If `scene` or `state` has the wrong type.

    Example:
        >>> found = jaxrod.stable_dt(scene)
        >>> found.limiting_mode
        'shear and bending of element 0'
        >>> careful = jaxrod.stable_dt(scene, safety=0.4)
        >>> round(float(careful.dt / found.dt), 3)
        0.5
    """
    check_model(scene)
    return scene.stable_step(safety, state=state)


def scene_stable_step(
    scene: LoadedRod, safety: ArrayLike, *, state: RodState | None = None
) -> StableStep:
    """Largest step at which one rod is stable, times a safety factor: `stable_dt`."""
    check_scene(scene)
    dtype = scene.rod.rest_lengths.dtype
    factor = as_array("safety", safety, "", positive=True, at_most=1, dtype=dtype)
    if scene.method.solves_drag:
        # Drag only adds inertia, which can be left out.
        scene = without_drag(scene)
    if state is None:
        return _bounded(scene.at_largest, factor)
    check_scene_and_state(scene, state)
    return _measured(_at_most(scene.recalling(state), state), factor, state)


@pytree
class _AtMost(Effect):
    """Effect in place of one with schedules: its bounds, as springs around a state."""

    effect: Effect
    """The effect, with schedules replaced by their largest values."""
    still: Motion
    """Configuration in which the springs have no load."""

    def loads(self, rod: Rod, motion: Motion) -> Loads:
        """Loads of the springs, which are as stiff as the effect ever is."""
        bound = self.effect.stability_bound(rod)
        if bound is None:
            return Loads()
        forces = couples = None
        if bound.nodes is not None:
            moved = vectors.subtract(motion.position, self.still.position)
            forces = vectors.scale(-bound.nodes, moved)
        if bound.elements is not None:
            back = conjugate(self.still.orientation)
            turned = rotation_log(multiply_quaternions(back, motion.orientation))
            couples = vectors.scale(-bound.elements, turned)
        return Loads(forces, couples)

    def stability_bound(self, rod: Rod) -> StabilityBound | None:
        """Bounds of the effect, for their drag."""
        return self.effect.stability_bound(rod)

    def damping_rates(self, rod: Rod) -> tuple[Array, Array] | None:
        """Decay rates of the effect."""
        return self.effect.damping_rates(rod)

    def constrain(self, rod: Rod, motion: Motion) -> Motion:
        """Positions and orientations that the effect holds."""
        return self.effect.constrain(rod, motion)

    def constrain_rates(self, rod: Rod, motion: Motion) -> Motion:
        """Velocities and spins that the effect holds."""
        return self.effect.constrain_rates(rod, motion)


def _at_most(scene: LoadedRod, state: RodState) -> LoadedRod:
    """Scene whose effects with schedules are as stiff around a state as they ever are.

    Their stiffness at other times is less, in every direction.
    """
    if not scene.depends_on_time:
        return scene
    still = motion_of(state).at_rest
    pairs = zip(scene.effects, scene.at_largest.effects, strict=True)
    effects = tuple(
        _AtMost(largest, still) if depends_on_time(effect) else effect
        for effect, largest in pairs
    )
    return replace(scene, effects=effects)


def scene_step_warning(
    scene: LoadedRod, dt: Array, state: RodState | None
) -> tuple[str | None, bool]:
    """Tests whether a concrete step of one rod is stable; see `Model.step_warning`."""
    check_scene(scene)
    check_time_step(dt)
    if not scene.method.explicit:
        return None, False
    bound = scene_stable_step(scene, 1.0)
    largest, where = float(bound.dt), ""
    near = float(dt) > COMPRESSED * largest
    if state is not None and (near or not scene.method.has_energy):
        factor, shortest = map(float, compression(scene, state))
        if factor < 1 - ROUNDING:
            largest *= factor
            where = f" in a rod compressed to {shortest:.3g} of its length"
    if not float(dt) > largest:
        return None, near
    return (
        f"dt = {float(dt):.3g} s is above the stability bound {largest:.3g} s set by "
        f"{bound.limiting_mode}{where}",
        False,
    )


@jax.jit
def compression(
    scene: LoadedRod, state: RodState
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Factor by which a state's compression lowers the bound, and its smallest extent.

    In PyElastica mode frequencies grow in inverse proportion to the stretch of
    compressed elements. In consistent mode the factor is the ratio of the bounds with
    and without compression, at the largest values of schedules, as in `stable_dt`.

    Returns:
        A factor of at most one, and the smallest ratio of an element's extent to its
        rest length [1]: along d3 in consistent mode, between its nodes in PyElastica
        mode.
    """
    scene = scene.at_largest
    rod = scene.rod
    edges = vectors.inner_difference(vectors.split(state.positions))
    edges = vectors.scale(1 / rod.rest_lengths, edges)
    if not scene.method.has_energy:
        shortest = jnp.min(vectors.safe_norm(edges))
        return jnp.minimum(shortest, 1), shortest
    extents = vectors.dot(directors(split_quaternion(state.orientations))[2], edges)
    factors = no_damping(rod)
    highest = jnp.max(frequency_bounds(scene, factors, extents))
    factor = jnp.max(frequency_bounds(scene, factors)) / highest
    return jnp.minimum(factor, 1), jnp.min(extents)


@jax.jit
def _bounded(scene: LoadedRod, safety: Array) -> StableStep:
    shape = len(MODE_NAMES), scene.rod.n_elements
    dtype = scene.rod.rest_lengths.dtype
    rounding = 64 * float(jnp.finfo(dtype).eps)
    found = _largest_step(_bounds, rounding, (scene, None), jnp.zeros(shape, dtype))
    mode, element = jnp.divmod(jnp.argmax(found.details), shape[1])
    return StableStep(
        safety * found.step, element, mode, 2 / found.undamped, found.uncertainty
    )


@jax.jit
def _measured(scene: LoadedRod, safety: Array, state: RodState) -> StableStep:
    nothing = Vibration(
        jnp.zeros((), state.positions.dtype),
        jnp.zeros_like(state.positions),
        jnp.zeros_like(state.angular_momenta),
    )
    found = _largest_step(_vibration, 1e-3, (scene, state), nothing)
    mode, element = limiting(found.details, state)
    return StableStep(
        safety * found.step, element, mode, 2 / found.undamped, found.uncertainty
    )


def limiting(
    vibration: Vibration, state: RodState
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Index into `MODE_NAMES` and element with the largest energy of a vibration."""
    nodes = vibration.displacements[:, 1:]
    axial = jnp.sum(nodes * state.directors[2], axis=0) ** 2
    across = jnp.sum(nodes**2, axis=0) - axial
    turns = vibration.turns**2
    energies = jnp.stack([turns[0] + turns[1] + across, axial, turns[2]])
    return jnp.argmax(jnp.sum(energies, axis=1)), jnp.argmax(jnp.sum(energies, axis=0))


@pytree
class Bracket:
    """Interval around the zero of a decreasing function, and the next argument to try.

    It is narrowed by Chandrupatla's method: inverse quadratic interpolation through the
    last three points if it can be trusted, else bisection. Each narrowing takes one
    function value, and no derivative.
    """

    place: Float[Array, ""]
    """Argument at which to evaluate the function next."""
    last: tuple[Array, Array]
    """Argument evaluated last, and the value there: one end of the interval."""
    other: tuple[Array, Array]
    """Other end of the interval, and the value there, of opposite sign."""
    former: tuple[Array, Array]
    """Argument that was an end until the last narrowing, and the value there; third
    point of the interpolation."""

    @staticmethod
    def between(lower: Array, upper: Array) -> Bracket:
        """Bracket from the ends of an interval; the function is not yet evaluated."""
        # Guessed values of a function that decreases like a hyperbolic tangent: only
        # their signs must be right.
        guess = jnp.tanh(0.5 * (upper - lower))
        return Bracket(
            0.5 * (lower + upper), (lower, guess), (upper, -guess), (upper, -guess)
        )

    @property
    def width(self) -> Float[Array, ""]:
        """Length of the interval."""
        return jnp.abs(self.other[0] - self.last[0])

    @property
    def lower(self) -> Float[Array, ""]:
        """Lower end of the interval, where the function is not negative."""
        return jnp.minimum(self.last[0], self.other[0])

    def narrowed(self, value: Array, shift: float) -> Bracket:
        """Bracket after the function has been evaluated at `place`.

        Args:
            value: Value of the function at `place`.
            shift: Smallest distance of the next argument from either end.
        """
        same = (value >= 0) == (self.last[1] >= 0)
        last = self.place, value
        former = jax.tree.map(lambda a, b: jnp.where(same, a, b), self.last, self.other)
        other = jax.tree.map(lambda a, b: jnp.where(same, a, b), self.other, self.last)
        (x1, f1), (x2, f2), (x3, f3) = last, other, former
        share = jnp.asarray(0.5, x1.dtype)
        place = (x1 - x2) / _not_zero(x3 - x2)
        height = (f1 - f2) / _not_zero(f3 - f2)
        trusted = (height**2 < place) & ((1 - height) ** 2 < 1 - place)
        apart = _not_zero(x2 - x1)
        curved = f1 / _not_zero(f2 - f1) * f3 / _not_zero(f2 - f3) + (
            (x3 - x1) / apart * f1 / _not_zero(f3 - f1) * f2 / _not_zero(f3 - f2)
        )
        share = jnp.where(trusted, curved, share)
        margin = jnp.minimum(shift / jnp.abs(apart), 0.5)
        share = jnp.clip(share, margin, 1 - margin)
        return Bracket(x1 + share * (x2 - x1), last, other, former)


def _not_zero(a: Array) -> Array:
    return jnp.where(a == 0, 1, a)


_Search = tuple[Array, Array, Bracket, Any]
"""Number of evaluations, step h0 without damping, bracket of log(h / h0) for the step
h, and details of the last measurement."""


class _Found(NamedTuple):
    """The step h at which h times the highest frequency is 2, and details."""

    step: Array
    undamped: Array
    """Step without damping and drag [s]."""
    uncertainty: Array
    """Width of the bracket of log h; the step is its lower end [1]."""
    details: Any
    """Details that the last measurement returned."""


_Model = tuple[LoadedRod, RodState | None]
_Measure = Callable[[_Model, InertiaFactors], tuple[Array, Any]]


def _bounds(model: _Model, factors: InertiaFactors) -> tuple[Array, Array]:
    """Bound on the highest frequency [rad/s], and all bounds by motion and element.

    `model` is the scene and the state; `factors` multiply the inertias.
    """
    frequencies = frequency_bounds(model[0], factors)
    return jnp.max(frequencies), frequencies


def _vibration(model: _Model, factors: InertiaFactors) -> tuple[Array, Vibration]:
    """Highest frequency at a state [rad/s], and the vibration that has it.

    `model` is the scene and the state; `factors` multiply the inertias.
    """
    scene, state = model
    assert state is not None
    vibration = fastest_vibration(scene, state, factors)
    return vibration.angular_frequency, vibration


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _largest_step(
    measure: _Measure, tolerance: float, model: _Model, nothing: Any
) -> _Found:
    """Step h at which h times the highest frequency, including damping, is 2.

    Args:
        measure: Function that returns the highest frequency [rad/s] and further
            details. Its arguments are `model` and the factors by which damping
            multiplies masses and rotary inertias; these factors depend on h.
        tolerance: The search ends when the bracket of log h is narrower than this [1].
        model: The scene, and the state at which to measure.
        nothing: Details with the structure of those that `measure` gives.
    """
    scene = model[0]
    if not _is_damped(scene):
        frequency, details = measure(model, no_damping(scene.rod))
        limit = 2 / frequency
        return _Found(limit, limit, jnp.zeros_like(limit), details)
    dtype = scene.rod.rest_lengths.dtype
    floor = 16 * float(jnp.finfo(dtype).eps)

    # Everything is in one loop, so that `measure` is compiled once. Round 0 is without
    # damping and gives the bracket.
    def unfinished(carry: _Search) -> Array:
        k, _, bracket, _ = carry
        return (k < 2) | ((bracket.width > tolerance) & (k < _MOST_ROUNDS))

    def look(carry: _Search) -> _Search:
        k, undamped, bracket, _ = carry
        step = undamped * jnp.exp(bracket.place)
        raw = _inertia_factors(scene, step)
        factors = jax.tree.map(
            lambda a, b: jnp.where(k == 0, a, jnp.maximum(b, floor)),
            no_damping(scene.rod),
            raw,
        )
        frequency, details = measure(model, factors)
        # Numbers of effects may have a wider dtype than those of the rod.
        limit = (2 / frequency).astype(dtype)
        details = jax.tree.map(lambda a, b: a.astype(b.dtype), details, nothing)
        # If drag cancels all inertia, no step is stable.
        least = jnp.minimum(jnp.min(raw[0]), jnp.min(raw[1]))
        room = jnp.where(least > floor, jnp.tanh(jnp.log(limit / step)), -1)
        begun = Bracket.between(*_brackets(scene, limit))
        bracket = jax.tree.map(
            lambda a, b: jnp.where(k == 0, a, b), begun, bracket.narrowed(room, floor)
        )
        return k + 1, jnp.where(k == 0, limit, undamped), bracket, details

    zero, one = jnp.zeros((), dtype), jnp.ones((), dtype)
    first = jnp.asarray(0), one, Bracket.between(zero - 1, one), nothing
    _, undamped, bracket, details = lax.while_loop(unfinished, look, first)
    step = undamped * jnp.exp(bracket.lower)
    return _Found(step, undamped, bracket.width, details)


@_largest_step.defjvp
def _largest_step_jvp(
    measure: _Measure, tolerance: float, primals: Any, tangents: Any
) -> tuple[_Found, _Found]:
    r"""Derivative of the step, from the balance that defines it.

    With $y = \log h$ and $b(y) = \log(2/\omega(y)) - y = 0$, $dy = -db/b'(y)$. The
    search itself is not differentiated.
    """
    (model, nothing), (moved, _) = primals, tangents
    found = _largest_step(measure, tolerance, model, nothing)

    def unhurried(model: _Model) -> Array:
        return 2 / measure(model, no_damping(model[0].rod))[0]

    def balance(model: _Model, height: Array) -> Array:
        factors = _inertia_factors(model[0], jnp.exp(height))
        return jnp.log(2 / measure(model, factors)[0]) - height

    _, undamped_rate = jax.jvp(unhurried, (model,), (moved,))
    undamped_rate = undamped_rate.astype(found.undamped.dtype)
    if _is_damped(model[0]):
        height = jnp.log(found.step)
        _, change = jax.jvp(lambda m: balance(m, height), (model,), (moved,))
        _, slope = jax.jvp(
            lambda y: balance(model, y), (height,), (jnp.ones_like(height),)
        )
        step_rate = (-found.step * change / slope).astype(found.step.dtype)
    else:
        step_rate = undamped_rate
    # The element and mode that limit the step are indices, without a derivative.
    still = jax.tree.map(jnp.zeros_like, found)
    return found, still._replace(step=step_rate, undamped=undamped_rate)


def _brackets(scene: LoadedRod, undamped: Array) -> tuple[Array, Array]:
    """Lower and upper bound on log(h / h0): step h with damping, h0 without.

    With the largest rate of drag everywhere and no damping, the balance is a quadratic
    equation. The same is true with the largest rate of damping and no drag. The step
    must also be below the step at which drag cancels all inertia of a node or element.
    """
    rates, drags = damping_rates(scene) or (None, None), _drag_rates(scene, None)
    least = _drag_rates(scene, None, whole=False)
    slope = _DECAY_SLOPE if scene.method.solves_damping else _FACTOR_SLOPE
    worst, slowest = (jnp.zeros_like(undamped) for _ in range(2))
    gone = jnp.full_like(undamped, jnp.inf)
    for rate, drag, little in zip(rates, drags, least, strict=True):
        added = jnp.zeros_like(undamped) if rate is None else slope * rate * undamped
        taken = jnp.zeros_like(undamped) if drag is None else 0.5 * drag * undamped
        sure = jnp.zeros_like(undamped) if little is None else 0.5 * little * undamped
        worst = jnp.maximum(worst, jnp.max(taken))
        slowest = jnp.maximum(slowest, jnp.max(added))
        net = jnp.max(sure - added)
        runs_out = net > 0
        gone = jnp.minimum(
            gone, jnp.where(runs_out, 1 / jnp.where(runs_out, net, 1), jnp.inf)
        )
    lower = 2 / (worst + jnp.sqrt(worst * worst + 4))
    upper = jnp.minimum(0.5 * (slowest + jnp.sqrt(slowest * slowest + 4)), gone)
    # The ends of the bracket differ by more than round-off.
    lower, upper = jnp.log(lower) - 1e-3, jnp.log(upper) + 1e-3
    return lower.astype(undamped.dtype), upper.astype(undamped.dtype)


def _total(scene: LoadedRod, name: str) -> Array | None:
    """Sum of a field of `StabilityBound` over all effects; `None` if none has it."""
    total = None
    for effect in scene.effects:
        part = getattr(effect.stability_bound(scene.rod), name, None)
        if part is not None:
            total = part if total is None else total + part
    return total


def _is_damped(scene: LoadedRod) -> bool:
    """Whether an effect of the scene has damping or drag; depends on structure only."""
    return damping_rates(scene) is not None or _drag_rates(scene, None) != (None, None)


def _drag_rates(
    scene: LoadedRod, dt: Array | None, *, whole: bool = True
) -> tuple[Array | None, Array | None]:
    """Decay rates of nodes and of elements by drag that is part of the loads [1/s].

    Args:
        scene: The scene.
        dt: Step size [s]. Friction at the surface is divided between nodes and elements
            by their inertias with damping at this step; without damping if `None`.
        whole: Whether both get their full parts of friction. If not, both get less than
            any division would give them.
    """
    rod = scene.rod
    transverse, polar = rod.inertias
    least = jnp.minimum(transverse, polar) if scene.method.twist else transverse
    slips = _total(scene, "slip_drag"), _total(scene, "slip_couple")
    ratio = jnp.ones((), rod.rest_lengths.dtype)
    if slips[0] is not None and slips[1] is not None:
        moved, turned = jnp.max(slips[0] / rod.node_masses), jnp.max(slips[1] / least)
        none = (moved <= 0) | (turned <= 0)
        ratio = jnp.where(none, 1, turned / jnp.where(none, 1, moved))
        rates = damping_rates(scene)
        if dt is not None and rates is not None:
            added = _added(scene)
            factors = [1 + added(jnp.min(rate) * dt) for rate in rates]
            ratio = ratio * factors[0] / factors[1]
    parts = (ratio, 1 / ratio) if whole else (0 * ratio, 0 * ratio)
    total: list[Array | None] = [None, None]
    for effect in scene.effects:
        bound = effect.stability_bound(rod)
        for k, part in enumerate(
            (None, None) if bound is None else bound.drags(*parts)
        ):
            if part is not None:
                own = total[k]
                total[k] = part if own is None else own + part
    nodes_total, elements_total = total
    masses = rod.node_masses
    if rod.mass_matrix == "higher_order":
        masses = masses / bounds_of_elements(rod.element_masses, rod.rest_lengths)[0]
    return (
        None if nodes_total is None else nodes_total / masses,
        None if elements_total is None else elements_total / least,
    )


def _added(scene: LoadedRod) -> Callable[[Array], Array]:
    """Function of rate times step: inertia added by damping, as a fraction [1]."""
    return _added_by_decay if scene.method.solves_damping else _added_by_factor


def _inertia_factors(scene: LoadedRod, dt: Array) -> InertiaFactors:
    """Ratios of effective to true inertia, for a step `dt` with damping [1].

    They are for nodes, `(n + 1,)`, and for elements, `(n,)`. A ratio that is not
    positive means that this step is unstable for any stiffness.
    """
    rates, drags = damping_rates(scene) or (None, None), _drag_rates(scene, dt)
    factors = []
    for rate, drag, one in zip(rates, drags, no_damping(scene.rod), strict=True):
        factor = one
        if rate is not None:
            factor = factor + _added(scene)(rate * dt)
        if drag is not None:
            factor = factor - 0.5 * dt * drag
        factors.append(factor.astype(one.dtype))
    return factors[0], factors[1]


def _added_by_decay(exponent: Array) -> Array:
    """Added inertia (x/2) coth(x/2) - 1 [1], for damping solved in the kick."""
    half = 0.5 * exponent
    small = half < 1e-2
    safe = jnp.where(small, 1, half)
    return jnp.where(small, half * half / 3, safe / jnp.tanh(safe) - 1)


def _added_by_factor(exponent: Array) -> Array:
    """Added inertia (1 + exp x) / 2 - 1, for rates times exp(-x) after the kick.

    Beyond the minimum of (1 + exp x) / 2x it is replaced by a multiple of x. Then step
    times frequency grows with the step, with or without drag, and equals 2 at only one
    step.
    """
    grown = 0.5 * jnp.expm1(jnp.minimum(exponent, _FACTOR_TURN))
    return jnp.where(exponent < _FACTOR_TURN, grown, _FACTOR_SLOPE * exponent - 1)


def frequency_bounds(
    scene: LoadedRod, factors: InertiaFactors, extents: Array | None = None
) -> Float[Array, "3 n"]:
    """Bounds on the highest angular frequency about the unstressed shape [rad/s].

    There is one row per entry of `MODE_NAMES` and one column per element; the bound is
    the largest entry.

    Args:
        scene: The scene.
        factors: Factors of node masses and rotary inertias that represent damping.
        extents: Extents of the elements along d3 divided by their rest lengths [1], if
            they are stretched or compressed; the result is then an estimate.
    """
    rod = scene.rod
    extent = 1 + rod.rest_strains[2] if extents is None else extents
    lengths = rod.rest_lengths
    mass = rod.element_masses * jnp.minimum(factors[0][1:], factors[0][:-1])
    nodes = rod.node_masses * factors[0]
    if rod.mass_matrix == "higher_order":
        whole, eased = bounds_of_elements(rod.element_masses, rod.rest_lengths)
        mass, nodes = mass / eased, nodes / whole
    transverse, polar = rod.inertias * factors[1][None, :]
    least = jnp.minimum(transverse, polar) if scene.method.twist else transverse
    shear = jnp.maximum(rod.shear_stretch_stiffness[0], rod.shear_stretch_stiffness[1])
    stretch = rod.shear_stretch_stiffness[2]

    bend, twist = _joint_bounds(rod, transverse, polar)
    held = _total(scene, "elements")
    if held is not None:
        bend, twist = bend + held / least, twist + held / least
    if not scene.method.twist:
        twist = jnp.zeros_like(twist)
    across, along = (4 * part / (mass * lengths) for part in (shear, stretch))
    # The axial force also turns the element: it acts along d3, not along the edge.
    tension = stretch * (extent - 1 - rod.rest_strains[2])
    lever = shear * extent - tension
    rocking = extent * lever * lengths / transverse
    coupling = jnp.abs(lever) * jnp.sqrt(4 / mass) * jnp.sqrt(1 / transverse)
    anchored = _total(scene, "nodes")
    if anchored is not None:
        anchored = anchored / nodes
        anchored = jnp.maximum(anchored[1:], anchored[:-1])
        across, along = across + anchored, along + anchored
    squares = jnp.stack([_larger_root(across, rocking + bend, coupling), along, twist])
    # A rod sheared at rest couples stretch and rotation, by at most this much.
    sheared = _root(rod.rest_strains[0] ** 2 + rod.rest_strains[1] ** 2)
    tilting = sheared * jnp.sqrt(jnp.maximum(shear, stretch) * lengths / least)
    return _root(squares) + tilting[None, :]


def _root(number: Array) -> Array:
    """Square root with derivative zero at zero."""
    positive = number > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, number, 1)), 0)


def _larger_root(first: Array, second: Array, coupling: Array) -> Array:
    """Larger eigenvalue of a symmetric matrix of two rows.

    Args:
        first: One diagonal entry, positive.
        second: Other diagonal entry, positive.
        coupling: Off-diagonal entry.
    """
    # In units of the larger entry: for small, stiff rods the squares of squared
    # frequencies overflow float32.
    unit = jnp.maximum(first, second)
    half_difference, coupled = 0.5 * (first - second) / unit, coupling / unit
    root = _root(half_difference * half_difference + coupled * coupled)
    return 0.5 * (first + second) + unit * root


def _joint_bounds(rod: Rod, transverse: Array, polar: Array) -> tuple[Array, Array]:
    r"""Contributions of joints to each element's bound, bending and twist [rad^2/s^2].

    Each is half of a joint's squared frequency, computed with half the `transverse` or
    `polar` rotary inertia of either element. In a joint bent by $\theta$ at rest,
    bending is stiffer by the square of $\frac\theta2/\sin\frac\theta2$ and mixes with
    twist.
    """
    stiffness = rod.joint_stiffness / rod.joint_lengths[None, :]
    bending = jnp.maximum(stiffness[0], stiffness[1])
    mobility = 1 / jnp.stack([transverse, polar, jnp.minimum(transverse, polar)])
    mobility = 2 * (mobility[:, 1:] + mobility[:, :-1])
    bend, twist = bending * mobility[0], stiffness[2] * mobility[1]

    rest = rod.rest_curvatures * rod.joint_lengths[None, :]
    half_angle = 0.5 * vectors.safe_norm(vectors.split(rest))
    any_axis = jnp.maximum(bending, stiffness[2]) * mobility[2]
    curved = any_axis / jnp.sinc(half_angle / jnp.pi) ** 2
    mixed = (jnp.sqrt(jnp.maximum(bend, twist)) + half_angle * jnp.sqrt(any_axis)) ** 2
    # Both bounds hold; without curvature the second is exact and bending does not mix
    # with twist.
    straight = half_angle <= jnp.sqrt(jnp.finfo(half_angle.dtype).eps)
    either = jnp.minimum(curved, mixed)
    bend = jnp.where(straight, bend, either)
    twist = jnp.where(straight, twist, either)

    def share(joints: Array) -> Array:
        return 0.5 * (vectors.pad(joints, 0, 1) + vectors.pad(joints, 1, 0))

    return share(bend), share(twist)
