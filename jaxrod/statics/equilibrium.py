"""Statics: equilibria under all loads and their derivatives; solver for one rod."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxrod.effects.base import Effect
from jaxrod.lanes.steps import by_kernel
from jaxrod.loaded_rod import (
    LoadedRod,
    constrain,
    constrain_rates,
    remembering_rest,
    scene_of,
)
from jaxrod.model import Model, check_model
from jaxrod.rods.elasticity import elastic_law
from jaxrod.rods.motion import Motion, motion_of, state_of
from jaxrod.rods.rod import RodState
from jaxrod.statics.declared_properties import check_declared_properties
from jaxrod.statics.degrees_of_freedom import unstack_dofs
from jaxrod.statics.effect_tangents import Tangent, has_closed_form, reaches_any
from jaxrod.statics.newton import default_tolerance, largest
from jaxrod.statics.pseudo_transient import (
    LARGEST_DISPLACEMENT,
    LARGEST_TURN,
    find_rest,
)
from jaxrod.statics.residual import Increment, LoadBalance, implicit_solution
from jaxrod.structure import pytree
from jaxrod.validation import as_array, check_count


@pytree
class Equilibrium:
    """A scene or a system at rest under its loads, if `converged`.

    Example:
        >>> found = jaxrod.equilibrium(scene, state)
        >>> bool(found.converged), bool(found.stable), bool(found.loose)
        (True, True, False)
    """

    state: Any
    """Last state of the search, with all rates zero."""
    converged: Bool[Array, ""]
    """Whether all loads balance at `state`, to the tolerance."""
    stable: Bool[Array, ""]
    """Whether it has converged at a minimum of the stored energy: the tangent is
    positive definite, except for `loose` modes.

    Static friction counts as holding wherever a rod touches. It is meant for loads with
    a potential. For loads that turn with the rod (follower
    couples) it does not exclude instability in motion (flutter).
    """
    loose: Bool[Array, ""]
    """Whether nothing resists a rigid motion of a rod or a body (as on a smooth floor),
    or a rotation of all elements of a rod about their own axes (as on two pins).

    The balance of loads does not determine the position along such a mode. Derivatives
    assume that the middle of the rod does not move along it, or that a system has no
    momentum along it. They are not valid for loads that would drive it.
    """
    iterations: Int[Array, ""]
    """Number of corrections that were accepted."""
    force_residual: Float[Array, ""]
    """Largest component of unbalanced force at a node [N]."""
    couple_residual: Float[Array, ""]
    """Largest component of unbalanced couple on an element [N m]."""


def equilibrium(
    scene: Model,
    state: Any,
    *,
    tolerance: ArrayLike | None = None,
    max_iterations: int = 400,
) -> Equilibrium:
    """Finds an equilibrium of a scene or a system under its loads, from a state.

    Works inside jit and vmap. The equilibrium is differentiable in both modes with
    respect to every number of the model, by the implicit function theorem: one linear
    solve, for any number of iterations.

    Loads are those at rest: drag and dashpots are zero, and so is friction, except for
    the friction of tendons with `friction_at_rest`. The search follows the direction of
    the loads, past folds (buckling, snap-through), in general to a stable equilibrium.
    It can end at an unstable one: if it starts there, if loads do not push away from
    it, as for a straight column under an axial load, or if it comes near one on its
    way. So check `stable`. If no equilibrium exists it does not converge: check
    `converged`.

    Friction of `contact` holds nothing at rest. A free rod laid over a cylinder only
    balances if it is symmetric, and is `loose` along the cylinder. Otherwise it slides
    off, and the search does not converge. `sticking_contact` holds it, and so does a
    support that holds one node across the cylinder.

    The cost of a correction grows with the number of elements for one rod. With effects
    that couple distant parts, and for systems, matrices are dense, with six unknowns
    for each element and each body. Solving grows with the cube of their number.

    Args:
        scene: The scene or system, at one moment; an effect must hold the rod of a
            scene.
        state: Initial guess; held components are held at its values. Its velocities
            do not matter.
        tolerance: Iteration ends after a correction below this many element lengths
            and radians; by default 1e-7, or 3e-4 in single precision.
        max_iterations: Largest number of corrections tried, accepted or not.

    Returns:
        The state at rest, and how well the loads balance there.

    Raises:
        ValueError: If the method has PyElastica's law, if nothing holds the rod of a
            scene, if a number is a schedule, or if an argument is out of range.
        TypeError: If `scene` or `state` has the wrong type.

    Example:
        >>> found = jaxrod.equilibrium(scene, state)
        >>> bool(found.converged), round(float(found.state.tip[2]), 2)
        (True, -0.96)
    """
    check_model(scene)
    found: Equilibrium = scene.equilibrium(
        state, tolerance=tolerance, max_iterations=max_iterations
    )
    return found


def search_limits(
    tolerance: ArrayLike | None, max_iterations: int, dtype: Any
) -> tuple[Array, Array]:
    """Validates and returns the tolerance and the largest number of iterations.

    A tolerance of `None` is replaced by the default of the dtype.
    """
    most = check_count("max_iterations", max_iterations, 1)
    if tolerance is None:
        tolerance = default_tolerance(dtype)
    bound = as_array("tolerance", tolerance, "", positive=True, dtype=dtype)
    return bound, jnp.asarray(most)


def scene_equilibrium(
    scene: LoadedRod,
    state: RodState,
    *,
    tolerance: ArrayLike | None = None,
    max_iterations: int = 400,
) -> Equilibrium:
    """Finds an equilibrium of one rod: see `equilibrium`."""
    scene = scene_of(scene, state)
    if not scene.method.has_energy:
        raise ValueError(f"equilibrium needs the consistent law, got {scene.method!r}")
    dtype = scene.rod.rest_lengths.dtype
    bound, most = search_limits(tolerance, max_iterations, dtype)
    if _is_loose(scene):
        raise ValueError(
            "scene must hold the rod for an equilibrium: a free rod has no equilibrium "
            "under loads, and infinitely many without. Add jaxrod.clamp(state) or "
            "jaxrod.fixed_end(state)"
        )
    check_declared_properties(scene)
    return _equilibrium(scene, replace(state, memory=None), bound, most)


def _is_loose(scene: LoadedRod) -> bool:
    """Whether no effect could hold the rod, by a constraint or by loads that vary."""
    return all(
        type(effect).constrain_rates is Effect.constrain_rates
        and type(effect).constrain is Effect.constrain
        and has_closed_form(effect)
        for effect in scene.effects
    )


def _at_rest(scene: LoadedRod, base: Motion) -> LoadBalance:
    """Static balance of the loads of a scene, for increments from the motion `base`."""
    still = jnp.zeros((), scene.rod.rest_lengths.dtype)
    return LoadBalance(scene, elastic_law(scene.rod), base, still, None, at_rest=True)


@pytree
class _RodPlace:
    """A configuration of a rod with its loads, stiffness and mass (a `Place`).

    Steps are scaled: displacements divided by the rod's length, and rotations [rad].
    """

    configuration: Motion
    """Positions and orientations; rates are zero."""
    units: Float[Array, "1 6"]
    """Scales of a step's components: the length of the rod [m] for displacements, 1 rad
    for rotations."""
    loads: Float[Array, "n+1 6"]
    """Unbalanced loads on free components, times `units` [J]."""
    tangent: Tangent
    """Tangent stiffness, with springs against loose modes (motions of the whole rod
    that nothing resists) [N/m, N, N m]."""
    mass: Float[Array, "n+1 6 6"]
    """Diagonal blocks of the mass matrix, world frame; zero where held [kg, kg m^2]."""
    loose: Bool[Array, ""]
    """Whether nothing resists some motion of the rod as a whole."""

    @property
    def driven(self) -> Bool[Array, ""]:
        """Always False: for one rod it is not tested whether loads drive a loose mode.

        If they do, no step is below the tolerance, and the search does not converge.
        """
        return jnp.zeros((), bool)

    @property
    def balanced(self) -> Bool[Array, ""]:
        """Always False: one rod has no motion that is hardly resisted by accident."""
        return jnp.zeros((), bool)

    def at(self, configuration: Motion) -> _RodPlace:
        """Copy with another configuration; loads and tangent are not updated."""
        return replace(self, configuration=configuration)

    def momentum(self, step: Float[Array, "n+1 6"]) -> Float[Array, "n+1 6"]:
        """Product M s of the mass matrix and a scaled step s, scaled [kg m^2]."""
        moving = (self.units * step)[:, None, :]
        return self.units * jnp.sum(self.mass * moving, axis=2)

    def factors(self, inertia: Array) -> Any:
        """Factors of the matrix K + `inertia` M of stiffness and mass, for `solve`."""
        return self.tangent.with_blocks(inertia * self.mass).factored()

    def solve(self, factors: Any, right: Float[Array, "n+1 6"]) -> Array:
        """Solution s, a scaled step, of (K + inertia M) s = `right`, from factors."""
        return factors.solve(right / self.units) / self.units


@pytree
class _Rest:
    """End of the search for the equilibrium of a rod."""

    configuration: Motion
    converged: Bool[Array, ""]
    positive: Bool[Array, ""]
    """Whether the tangent is positive definite, except for loose modes."""
    loose: Bool[Array, ""]
    iterations: Int[Array, ""]
    force: Float[Array, ""]
    """Largest component of unbalanced force at a node [N]."""
    couple: Float[Array, ""]
    """Largest component of unbalanced couple on an element [N m]."""


@pytree
class _RodAtRest:
    """Static problem of one rod, to be solved by `find_rest` (a `RestProblem`)."""

    balance: LoadBalance
    """Balance of loads without inertia."""

    @property
    def units(self) -> Float[Array, "1 6"]:
        """Scales of the components of a step.

        They are the length of the rod [m] for displacements, and 1 rad for rotations.
        """
        return _six(jnp.sum(self.balance.scene.rod.rest_lengths), 1)

    @property
    def element_lengths(self) -> Float[Array, "1 6"]:
        """Rod length over shortest element length, and 1 for the three rotations."""
        lengths = self.balance.scene.rod.rest_lengths
        return _six(jnp.sum(lengths) / jnp.min(lengths), 1)

    @property
    def largest_step(self) -> Float[Array, "1 6"]:
        """Largest allowed scaled step, in rod lengths and in radians."""
        one = jnp.ones((), self.balance.scene.rod.rest_lengths.dtype)
        return _six(LARGEST_DISPLACEMENT * one, LARGEST_TURN)

    def place(self, configuration: Motion) -> _RodPlace:
        """Loads, tangent and mass at a configuration."""
        # Only rows take the loops over loose modes well.
        place: _RodPlace = by_kernel(self, "linear", configuration, iterates=True)
        return place

    def linear(self, configuration: Motion) -> _RodPlace:
        """The result of `place`, for a kernel."""
        here = replace(self.balance, base=configuration)
        none = _no_increment(configuration)
        residual, bare, mass = by_kernel(here, "about", none)
        tangent, loose = here.held(bare, none)
        loads = -self.units * residual
        return _RodPlace(configuration, self.units, loads, tangent, mass, loose)

    def passes(self, before: _RodPlace, after: _RodPlace) -> Bool[Array, ""]:
        """Always False: no contact keeps a single rod apart from itself."""
        return jnp.zeros((), bool)

    def moved(self, place: _RodPlace, step: Float[Array, "n+1 6"]) -> Motion:
        """Configuration after a scaled step from `place`, to first order.

        Edges turn with their elements, so that strains change linearly.
        """
        given = place.configuration, step
        moved: Motion = by_kernel(self, "moved_along_edges", given)
        return moved

    def moved_along_edges(self, given: tuple[Motion, Array]) -> Motion:
        """The result of `moved` from a configuration, the two entries of `given`."""
        configuration, step = given
        here = replace(self.balance, base=configuration)
        none = _no_increment(configuration)
        return here.motion(here.retract_along_edges(none, self.units * step))


def _six(length: Array, radian: float) -> Float[Array, "1 6"]:
    """Row of `length` for each of three displacements, `radian` for three rotations."""
    turn = jnp.full_like(length, radian)
    return jnp.stack([length, length, length, turn, turn, turn])[None]


@pytree
class _RodStatics:
    """The search for the equilibrium of one rod, in parts that are a kernel each."""

    scene: LoadedRod
    """The scene whose loads are to balance."""

    def rest(self, given: tuple[RodState, Array, Array]) -> _Rest:
        """End of the search from a state.

        `given` are the state, the tolerance and the largest number of corrections.
        """
        state, *limits = given
        problem, start = by_kernel(self, "begun", state)
        end = find_rest(problem, start, *limits)
        force, couple = unstack_dofs(end.here.loads / end.here.units)
        return _Rest(
            configuration=end.here.configuration,
            converged=end.converged,
            positive=end.here.tangent.is_positive(),
            loose=end.here.loose,
            iterations=end.iterations,
            force=largest(force),
            couple=largest(couple),
        )

    def begun(self, state: RodState) -> tuple[_RodAtRest, Motion]:
        """The static problem, and the configuration of a state."""
        start = self.start(state)
        return _RodAtRest(_at_rest(self.scene, start)), start

    def start(self, state: RodState) -> Motion:
        """Configuration at rest of a state, with supports enforced."""
        at_rest = motion_of(state).at_rest
        return constrain_rates(self.scene, constrain(self.scene, at_rest))

    def kept(self, given: tuple[Motion, RodState]) -> tuple[Motion, Increment]:
        """Configuration with the held components of a state, and no increment from it.

        `given` are the configuration and the state.
        """
        found, state = given
        kept = _keep_held(self.scene, found, self.start(state))
        return kept, _no_increment(found)

    def left(self, given: tuple[Motion, Increment]) -> RodState:
        """State at rest after an increment, with the memory that effects then have.

        `given` are the configuration and the increment from it.
        """
        base, increment = given
        rest = state_of(_at_rest(self.scene, base).motion(increment))
        return remembering_rest(self.scene, rest)

    def end_of_search(
        self, state: RodState, tolerance: Array, max_iterations: Array
    ) -> _Rest:
        """The result of `rest`, without derivatives."""
        # The scene has the memory: states with and without are one program.
        given = replace(state, memory=None), tolerance, max_iterations
        statics, given = lax.stop_gradient((self, given))
        if reaches_any(self.scene):
            # Its matrices are dense, and LAPACK has no kernel.
            return statics.rest(given)
        end: _Rest = by_kernel(statics, "rest", given, iterates=True)
        return end


@jax.jit
def _equilibrium(
    scene: LoadedRod, state: RodState, tolerance: Array, max_iterations: Array
) -> Equilibrium:
    statics = _RodStatics(scene)
    most = max_iterations.astype(jnp.int32)
    end = statics.end_of_search(state, tolerance, most)
    # Held components take their values from the state and the scene, with derivatives.
    found, none = by_kernel(statics, "kept", (end.configuration, state))
    increment = implicit_solution(_at_rest(scene, found), none)
    rest = by_kernel(statics, "left", (found, increment))
    known, last = scene.recalling(rest), end
    sticking = known.without_slip
    if sticking is not known:
        # The search started from the springs of its initial state; they have slipped
        # since. A search without corrections ends at its start, by the same kernel.
        statics, zero = _RodStatics(sticking), jnp.zeros_like(most)
        last = statics.end_of_search(rest, tolerance, zero)
    return Equilibrium(
        state=rest,
        converged=end.converged,
        stable=end.converged & last.positive,
        loose=end.loose,
        iterations=end.iterations,
        force_residual=end.force,
        couple_residual=end.couple,
    )


def _no_increment(motion: Motion) -> Increment:
    """Increment of zero, computed from the motion instead of plain zeros.

    Under `vmap` it is then batched like the motion. Plain zeros would be unbatched, and
    JAX would then treat the derivatives of a compiled function with a custom derivative
    rule as unbatched, too.
    """

    def nothing(component: Array) -> Array:
        return jnp.where(component < jnp.inf, 0, jnp.zeros_like(component))

    _, *turning = motion.orientation
    x, y, z = motion.position
    q1, q2, q3 = turning
    return Increment(*jax.tree.map(nothing, ((x, y, z), (q1, q2, q3))))


def _keep_held(scene: LoadedRod, found: Motion, start: Motion) -> Motion:
    """Configuration `found`, with the held components taken from `start`."""
    nodes, elements = unstack_dofs(_at_rest(scene, start).free)
    turning = (elements[0] == 1) | (elements[1] == 1) | (elements[2] == 1)
    free = nodes, (turning,) * 4
    position, orientation = jax.tree.map(
        lambda free, there, here: jnp.where(free == 1, there, here),
        free,
        (found.position, found.orientation),
        (start.position, start.orientation),
    )
    return replace(found, position=position, orientation=orientation)
