"""The interface of a member: everything that a system uses of a rod or of bodies.

A system holds objects that have a method `as_member`: scenes of one rod, scenes of
equal rods with a leading axis, rigid bodies, and classes of your own. The method
returns a `Member`, so that no other code depends on their kind. A new kind of member
needs three pytrees: the `Member`, its state, and its `MemberStepper`.

Its state is a pytree with `positions` `(3, nodes)`, `orientations` `(4, elements)`,
`velocities`, `rates`, `with_rates` and a `layout`, as `RodState` and `BodyState` have.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from jaxrod.analysis.health import EnergyAccount, HealthLimits
from jaxrod.effects.base import Effect, Reaction, StabilityBound
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import Method
from jaxrod.rods.motion import Loads, Motion
from jaxrod.rods.rod import Rod
from jaxrod.systems.coupling import Carried, Parts
from jaxrod.systems.members.steppers import MemberStepper
from jaxrod.validation import check_kind


class Member(ABC):
    """Part of a system: one rod, equal rods, rigid bodies, or a kind of your own.

    Hooks are pure. The defaults are for members without rods, memory and supports.

    Example:
        >>> arm = scene.as_member()
        >>> isinstance(arm, extend.Member), arm.parts().n_nodes
        (True, 11)
    """

    # Structure and parameters.

    def as_member(self) -> Member:
        """The member itself: a system calls this method of each entry of `members`."""
        return self

    @property
    @abstractmethod
    def dtype(self) -> Any:
        """Floating-point dtype of all its numbers."""

    @property
    @abstractmethod
    def array_shape(self) -> tuple[int, ...]:
        """Shape of an array with one number per element or body, of all rods.

        A system stores this shape. Additional axes later show that the system has
        become a batch of systems.
        """

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Effects that act on the member."""
        return ()

    @property
    def rod(self) -> Rod | None:
        """Parameters of the rod or of equal rods; `None` for other members."""
        return None

    @property
    def method(self) -> Method:
        """Method of its rods, which says what they leave out; for others, nothing."""
        return Method()

    @abstractmethod
    def parts(self) -> Parts:
        """Constants that couplings read, such as the masses of nodes.

        The field `held`, flags of nodes that supports hold, is not set here.
        """

    def check(self, name: str) -> None:
        """Raises an error if the member does not fit a system; `make_system` calls it.

        Args:
            name: Name of the member, for messages.
        """
        for effect in self.effects:
            check_kind(f"member {name!r}: effect", effect, Effect)

    def check_statics(self, name: str) -> None:
        """Raises a ValueError if the member cannot be used in a static solve.

        That is the case if its loads are not the gradient of an energy.

        Args:
            name: Name of the member, for messages.
        """
        del name

    def check_for(self, method: Method, name: str, state: Any) -> None:
        """Raises a ValueError if a rod could not step with a method from a state.

        What couplings see and do is checked elsewhere. All values are known.

        Args:
            method: The method, of another member that couplings join to this one.
            name: Name of the member, for messages.
            state: State of the member.
        """
        del method, name, state

    @abstractmethod
    def check_state(self, name: str, state: Any, dtype: Any) -> None:
        """Raises a TypeError or a ValueError if a state is not of this member.

        Args:
            name: Name of the member, for messages.
            state: The state to check.
            dtype: Floating-point dtype of the system, which the state must have.
        """

    # The entry of a member in `System.members` is a scene, rigid bodies, or the member
    # itself. "Copy" below means a copy of this entry.

    def each(self, function: Callable[..., Any], *given: Any) -> Any:
        """Value of a function of the member's entry in the system and of `given`.

        For equal rods it is mapped over the rods, by `jax.vmap`.
        """
        return function(self, *given)

    def with_effect(self, effect: Effect) -> Any:
        """Copy of the member's entry in the system with one more effect."""
        raise NotImplementedError(f"{type(self).__name__} takes no effects")

    def in_own_type(self, name: str) -> Any:
        """Copy of the member's entry, with effects converted to the member's dtype.

        Args:
            name: Name of the member, for messages.

        Raises:
            ValueError: If a number does not fit the dtype.
        """
        return self

    def with_method(self, method: Callable[[Any], Any]) -> Any:
        """Copy of the member's entry with another method.

        Args:
            method: Function from the present method to the new one.

        Raises:
            ValueError: If the scene does not fit the method.
        """
        # Not abstract: it is called for members with a rod alone.
        raise NotImplementedError(f"{type(self).__name__} has no method")

    def in_space(self) -> Any:
        """Copy of the member's entry that leaves nothing out, for statics."""
        return self

    def with_free_ends(self, free: Array) -> Any:
        """Copy of the member's entry whose effects know which ends are free.

        Args:
            free: Flags of the ends of its rods `(rods, 2)`: 1 if free, 0 otherwise.
        """
        return self

    # Memory of effects.

    @property
    def remembers(self) -> bool:
        """Whether any of its effects has memory, which changes from step to step."""
        return False

    def recalling(self, state: Any) -> Any:
        """Copy of the member's entry whose effects have the memory of a state."""
        return self

    @property
    def without_slip(self) -> Any:
        """Copy of the member's entry whose static friction holds, if it has any."""
        return self

    def with_memory(self, state: Any) -> Any:
        """Copy of the state with initial memory of effects, if the state holds none."""
        return state

    def memory(self, state: Any) -> Any:
        """Memory of its effects in a state, else their initial memory.

        It is empty for members without memory.
        """
        return ()

    def remembering_rest(self, state: Any) -> Any:
        """Copy of a state at rest, with the memory of effects after a step of zero."""
        return state

    # The state in the form that couplings read, and steps.

    def held(self, state: Any) -> Vec3 | None:
        """Flags per node and world axis: 1 where a support holds the node, else 0.

        `None` means that no node is held.
        """
        return None

    @abstractmethod
    def motion(self, state: Any) -> Motion:
        """Positions and rates in a state, in the form that couplings read.

        Nodes of all rods are in one flat array, and so are elements. `Motion.spin` is
        the angular momentum.
        """

    @abstractmethod
    def stepper(
        self, state: Any, parts: Parts, carried: Carried | None, dt: Array
    ) -> MemberStepper:
        """Integrator of this member in a run, with its constants computed once.

        Args:
            state: State of the member.
            parts: Its constants.
            carried: Masses that are attached to its bodies, if there are any.
            dt: Step size [s].
        """

    @abstractmethod
    def stable_step(self, bound: StabilityBound, safety: ArrayLike) -> tuple[Any, Any]:
        """Largest stable step times the factor `safety` [s], and what limits it.

        The latter is a `StableStep` for rods, and `None` for other members.

        Args:
            bound: Bounds that couplings add.
            safety: Fraction of the limit to use.
        """

    @abstractmethod
    def health(self, state: Any, dt: ArrayLike, limits: HealthLimits) -> Any:
        """Flags of numerical faults in a state: a pytree with an entry `flagged`."""

    def passages(self, before: Any, after: Any) -> Array | None:
        """Number of points that went through fixed bodies between two states.

        `None` for a member without contact with fixed bodies.
        """
        return None

    def energy_account(self, state: Any, mean: Array, dt: Array) -> EnergyAccount:
        """Energy of the member, and what round-off may add to it, for `health`.

        Args:
            state: State of the member.
            mean: Mean velocity `(3,)`, which does not count as motion [m/s].
            dt: Step size [s].
        """
        velocities, spins = state.rates
        shifted = state.with_rates(velocities - mean[:, None], spins)
        kinetic = self.kinetic_energy(state)
        masses = self.parts().node_masses
        spacings = jnp.sum(jnp.spacing(state.positions) ** 2, axis=0)
        return EnergyAccount(
            total=kinetic + self.potential_energy(state),
            own=self.kinetic_energy(shifted),
            per_step=jnp.finfo(kinetic.dtype).eps * kinetic,
            lost=0.5 * jnp.sum(masses * spacings) / dt**2,
            weights=jnp.zeros_like(kinetic),
        )

    def loaded(self, loads: Loads) -> Any:
        """Copy of the member's entry with loads of couplings as one more effect."""
        # Not abstract: it is called for members with a rod alone.
        raise NotImplementedError(f"{type(self).__name__} has no rod")

    def rates_of_change(self, state: Any, loads: Loads) -> Motion | None:
        """Rates of change of a state; `velocity` has the accelerations of its nodes.

        Args:
            state: State of the member.
            loads: Loads of couplings.

        Returns:
            Nodes of all rods are in one flat array. `None` for members whose nodes
            cannot be tied or attached.
        """
        return None

    def reactions(self, state: Any, loads: Loads) -> tuple[Reaction | None, ...]:
        """Reaction of each effect, under the `loads` of couplings."""
        return ()

    def contact_forces(self, state: Any) -> list[Vec3]:
        """Contact forces of fixed bodies on the nodes, one entry per contact [N]."""
        return []

    # Energies and momenta.

    @abstractmethod
    def momenta(self, state: Any) -> tuple[Array, Array]:
        """Momenta of nodes [kg m/s], and angular momenta of elements [kg m^2/s]."""

    @abstractmethod
    def kinetic_energy(self, state: Any) -> Array:
        """Kinetic energy of translation and rotation [J]."""

    @abstractmethod
    def potential_energy(self, state: Any) -> Array:
        """Elastic energy plus potential energies of effects [J]."""

    @abstractmethod
    def momentum(self, state: Any) -> Array:
        """Total linear momentum, world frame [kg m/s]."""

    @abstractmethod
    def angular_momentum(self, state: Any) -> Array:
        """Total angular momentum about the origin, world frame [kg m^2/s]."""


def check_fields(
    name: str,
    state: Any,
    shape: tuple[int, ...],
    elements: int,
    dtype: Any,
    spins: str,
) -> None:
    """Raises a ValueError if fields of a state have the wrong shape or dtype.

    Args:
        name: Name of the member.
        state: Its state.
        shape: Shape that positions must have, and velocities.
        elements: Number of elements, each with an orientation.
        dtype: Dtype of the system, which the fields must have.
        spins: Name of the field of angular velocities or angular momenta.
    """
    if state.positions.shape != shape:
        raise ValueError(
            f"positions of {name!r} must have shape {shape}, got "
            f"{state.positions.shape}"
        )
    if state.positions.dtype != dtype:
        raise ValueError(
            f"state of {name!r} must be {dtype}, as the system is, got "
            f"{state.positions.dtype}"
        )
    for field, wanted in (
        ("orientations", (*shape[:-2], 4, elements)),
        ("velocities", shape),
        (spins, (*shape[:-2], 3, elements)),
    ):
        own = getattr(state, field)
        if jnp.shape(own) != wanted:
            raise ValueError(
                f"{field} of {name!r} must have shape {wanted}, got {jnp.shape(own)}"
            )
        kind = getattr(own, "dtype", type(own).__name__)
        if kind != dtype:
            raise ValueError(
                f"{field} of {name!r} must be {dtype}, as the system is, got {kind}"
            )


def check_axes(
    name: str, what: str, shape: tuple[int, ...], *allowed: tuple[str, ...]
) -> None:
    """Raises a ValueError if an array of a member has too few or too many axes.

    Args:
        name: Name of the member, for the message.
        what: Name of the array, for the message.
        shape: Shape of the array.
        *allowed: Allowed shapes, given as axis names; only the number of axes is
            checked.
    """
    if len(shape) in map(len, allowed):
        return
    wanted = " or ".join(f"({', '.join(axes)})" for axes in allowed)
    raise ValueError(
        f"member {name!r}: its {what} must have the shape {wanted}, got {shape}: use "
        "jax.vmap for a batch of systems"
    )


def step_limit(inertia: Array, stiffness: Array | None, drag: Array | None) -> Array:
    """Step [s] at which a spring and a dashpot become unstable; infinite without them.

    It is the positive root h of `k h^2 + 2 c h = 4 m`, with the stiffness k, the drag c
    and the mass or moment of inertia m.
    """
    zero = jnp.zeros_like(inertia)
    k = zero if stiffness is None else stiffness
    c = zero if drag is None else drag
    square = c * c + 4 * k * inertia
    free = square <= 0
    # The inner `where` avoids the root of zero, which has no derivative.
    below = c + jnp.sqrt(jnp.where(free, 1, square))
    return jnp.where(free, jnp.inf, 4 * inertia / below)
