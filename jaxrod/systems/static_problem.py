r"""The static problem of a system: its loads as a function of its configuration.

The stepper of a system provides everything that statics needs. A kick from rest, so
short that nothing moves, gives the accelerations $a$ that all loads cause at a
configuration, with supports, ties and attachments taken into account. $P r$ is the part
of rates $r$ that these allow, and moving at such rates for a second leads to another
configuration. The kinetic energy $T(P r)$ is quadratic, and its matrix $M$ is the mass.
Loads out of balance, forces on nodes and couples on elements, and their stiffness are

$$g = M a, \qquad K r = -M \frac{\partial a}{\partial r}\,P r.$$

So an equilibrium needs no further hook of a coupling, an effect or a member of your
own. Loads are those at rest: friction, dashpots and drag are zero.

The matrices are dense. They are computed column by column, by one compiled kernel.
Rigid motions of the parts of a member, its rods or its bodies, are candidates for
motions that no load resists. Small motions about a state at rest have the frequencies
of $K$ and $M$.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxrod.geometry import matrices, vectors
from jaxrod.geometry.rotations import directors, to_material, to_world
from jaxrod.geometry.vectors import Vec3
from jaxrod.lanes.steps import by_kernel
from jaxrod.loaded_rod import free_under
from jaxrod.rods.motion import Motion
from jaxrod.structure import pytree, static
from jaxrod.systems.coupling import Parts, Seen, searched, with_found
from jaxrod.systems.stepping.assembly import Assembly, SystemState
from jaxrod.systems.stepping.stepper import Motions, SystemStepper, stepper_at

INSTANT = 1e-9
"""Duration of the kick that measures loads, divided by `Scales.time`, the bending time
of the fastest rod [1]."""
ANCHOR, ROUNDINGS = 1e-8, 100
"""Weight of the regularisation that keeps free rods in place in `moved_along_edges`
[1], and its smallest value in units of the machine epsilon."""


@pytree
class Scales:
    """Scales of length, energy and time for a system, computed from its rods."""

    length: Float[Array, ""]
    """Length of the longest rod [m]."""
    element: Float[Array, ""]
    """Length of the shortest element [m]."""
    energy: Float[Array, ""]
    """Bending stiffness divided by length, mean over all members made of rods [J]."""
    time: Float[Array, ""]
    """Bending time of the fastest rod, `L^2 sqrt(rho / B)` with the mass per length rho
    and the bending stiffness B [s]."""


def scales_of(system: Assembly) -> Scales:
    """Scales for a system; all are one if it has no rods."""
    lengths, elements, energies, times = [], [], [], []
    for own in system.parts().values():
        if not own.is_rod:
            continue
        assert own.rest_lengths is not None and own.bend_twist_stiffness is not None
        assert own.linear_density is not None
        whole = jnp.sum(own.rest_lengths) / own.count
        stiffness = jnp.mean(own.bend_twist_stiffness[0])
        lengths.append(whole)
        elements.append(jnp.min(own.rest_lengths))
        energies.append(stiffness / whole)
        times.append(whole**2 * jnp.sqrt(jnp.mean(own.linear_density) / stiffness))
    if not lengths:
        one = jnp.ones((), system.dtype)
        return Scales(one, one, one, one)
    return Scales(
        jnp.max(jnp.stack(lengths)),
        jnp.min(jnp.stack(elements)),
        jnp.mean(jnp.stack(energies)),
        jnp.min(jnp.stack(times)),
    )


@pytree
class Linear:
    """A static problem, linearised about a configuration.

    Unknowns are displacements divided by the scale of length, and rotations. Their
    rates are called scaled rates.
    """

    motions: Any
    """Configuration about which the problem is linearised."""
    loads: Float[Array, " m"]
    """Loads out of balance on the scaled unknowns, forces times length [J]."""
    stiffness: Float[Array, "m m"]
    """Stiffness matrix for allowed rates; zero for all other rates [J]."""
    mass: Float[Array, "m m"]
    """Mass matrix for allowed rates; zero for all other rates [kg m^2]."""
    projection: Float[Array, "m m"]
    """Projection P on the rates that supports, ties and attachments allow."""

    @property
    def barred(self) -> Float[Array, "m m"]:
        """Matrix (1 - P)^T (1 - P), which measures rates that are not allowed."""
        rest = jnp.eye(len(self.loads), dtype=self.mass.dtype) - self.projection
        return rest.T @ rest


@pytree
class StaticProblem:
    """A system and its stepper, with a step so short that nothing moves."""

    system: Assembly
    """The system."""
    stepper: SystemStepper
    """The stepper of the system; its kick from rest gives the accelerations."""
    scales: Scales
    """Scales of the unknowns."""
    normal_axis: int | None = static(default=None)
    """World axis along which nothing moves, 0 for x; `None` in space."""

    # Methods for kernels take one argument, often a pair: a configuration, and rates.

    def allowed(self, given: tuple[Motions, Any]) -> Any:
        """Part P r of rates r that constraints allow; `given` is (configuration, r)."""
        motions, rates = given

        def held(own: Any) -> Any:
            moving = with_rates(motions, self._in_plane(own))
            return rates_of(self.stepper.supported(moving))

        none = jax.tree.map(jnp.zeros_like, rates)
        return jax.tree.map(jnp.subtract, held(rates), held(none))

    def _in_plane(self, rates: Any) -> Any:
        """Rates without those that leave the plane of planar members, if there is one.

        Supports, ties and attachments do not mix these with the other rates.
        """
        if self.normal_axis is None:
            return rates
        reduced = {}
        for name, (velocity, spin) in rates.items():
            inside = [float(k != self.normal_axis) for k in range(3)]
            reduced[name] = (
                tuple(k * v for k, v in zip(inside, velocity, strict=True)),
                tuple((1 - k) * s for k, s in zip(inside, spin, strict=True)),
            )
        return reduced

    def momenta(self, given: tuple[Motions, Any]) -> Any:
        """Gradient, with respect to rates r, of the kinetic energy T(P r).

        P r is the part of r that constraints allow; `given` is (configuration, r).
        """
        motions, rates = given

        def energy(own: Any) -> Array:
            moving = with_rates(motions, self.allowed((motions, own)))
            state = self.stepper.leave(moving)
            total = jnp.zeros((), self.system.dtype)
            for name, member in self.system.interfaces().items():
                total = total + member.kinetic_energy(state[name])
            return total

        return jax.grad(energy)(rates)

    def accelerations(self, motions: Motions) -> Any:
        """Rates of change of velocities and angular momenta, from all loads at rest.

        Supports, ties and attachments are taken into account.
        """
        rest = at_rest(motions)
        still = rates_of(self.stepper.supported(rest))
        kicked = rates_of(self.stepper.kick(rest))
        dt = self.stepper.dt
        return jax.tree.map(lambda a, b: (a - b) / dt, kicked, still)

    def moved(self, given: tuple[Motions, Any]) -> Motions:
        """Configuration after one second at rates r; `given` is (configuration, r)."""
        one = jnp.ones((), self.system.dtype)
        return at_rest(self.stepper.drift(with_rates(*given), one))

    def accelerations_after(self, given: tuple[Motions, Any]) -> Any:
        """Accelerations after one second at rates r; `given` is (configuration, r)."""
        return self.accelerations(self.moved(given))

    def column(self, given: tuple[Motions, Array]) -> tuple[Array, ...]:
        """Loads, and the products of all matrices with a vector of scaled rates.

        `given` is the pair of a configuration and this vector. For a unit vector the
        products are columns of the matrices.

        Returns:
            Loads out of balance, the allowed part of the rates, the momenta of this
            part, and the change of the loads that it causes; all scaled.
        """
        motions, _ = given
        rates = self.rates(given)
        none = jax.tree.map(jnp.zeros_like, rates)
        allowed = self.allowed((motions, rates))
        here, change = jax.jvp(
            lambda own: self.accelerations_after((motions, own)), (none,), (allowed,)
        )
        together = jax.tree.map(lambda *leaves: jnp.stack(leaves), rates, here, change)
        momenta = jax.vmap(
            lambda own: self.scaled_momenta(motions, self.momenta((motions, own)))
        )(together)
        return momenta[1], self.scaled(motions, allowed), momenta[0], momenta[2]

    def moved_with_gaps(self, given: tuple[Motions, Array]) -> tuple[Motions, Array]:
        """Configuration after one second at scaled rates, and the gaps of its edges.

        `given` is the pair of the configuration and the rates. Strains should change
        linearly. But moving at rates stretches the edges of rods in proportion to the
        square of the rotation of their elements, and stretching is far stiffer than
        bending. The gaps are the relative displacements of the nodes of each element
        that undo this, axis by axis [m].
        """
        motions, rates = given[0], self.rates(given)
        moved = self.moved((motions, rates))
        before, after = self.stepper.seen(motions), self.stepper.seen(moved)
        moving = self.stepper.seen(with_rates(motions, rates))
        gaps = [jnp.zeros(0, self.system.dtype)]
        for name, parts in _rods(before):
            here, there = before[name].motion, after[name].motion
            now = _edges(there, parts)
            turning = vectors.cross(
                _edges(here, parts), moving[name].angular_velocities
            )
            local = to_material(directors(here.orientation), vectors.add(now, turning))
            wanted = to_world(directors(there.orientation), local)
            gaps += [*vectors.subtract(wanted, now)]
        return moved, jnp.concatenate(gaps)

    def placed(self, given: tuple[Motions, Any]) -> Motions:
        """Configuration after one second at rates r; ties and attachments hold exactly.

        `given` is (configuration, r).
        """
        return at_rest(self.stepper.supported(self.moved(given)))

    def entered(self, state: SystemState) -> Motions:
        """Configuration of a state, with all ties and attachments enforced."""
        return self.placed(_still(self.stepper.enter(state)))

    def moved_after(self, given: tuple[Motions, Array]) -> Motions:
        """Configuration after one second at constant scaled rates r (see `rates`).

        `given` is the pair of the configuration before and r.
        """
        return self.moved((given[0], self.rates(given)))

    def left_after(self, given: tuple[Motions, Array]) -> dict[str, Any]:
        """State at rest that a configuration reaches in one second at scaled rates r.

        `given` is (configuration, r). The vector r has the velocities of all members
        divided by the scale of length, and their angular velocities. Ties and
        attachments hold exactly. Effects have the memory that they have there.
        """
        rest = self.stepper.leave(self.placed((given[0], self.rates(given))))
        members = self.system.interfaces()
        return {name: members[name].remembering_rest(rest[name]) for name in rest}

    def accelerations_scaled(self, given: tuple[Motions, Array]) -> Array:
        """Accelerations at the configuration reached in one second at scaled rates r.

        `given` is (configuration, r). The result is scaled in the same way as r: see
        `scaled`.
        """
        moved = self.moved_after(given)
        return self.scaled(moved, self.accelerations(moved))

    def with_held(self, given: tuple[Motions, Motions]) -> Motions:
        """The configuration found, with held nodes and elements as in the initial one.

        `given` is the pair of the configuration found and the initial one. Members are
        held at their initial places or at the places in a support's parameters. Both
        have derivatives, while the configuration found has none.
        """
        found, start = given
        together = {}
        for name, stepper in self.stepper.members.items():
            motion, at = found[name], start[name]
            nodes, elements = free_under(stepper.supported, motion)
            turning = jnp.where(elements[0] == 1, 1, elements[1])
            turning = jnp.where(turning == 1, 1, elements[2])
            position, orientation = jax.tree.map(
                lambda free, there, here: jnp.where(free == 1, there, here),
                (nodes, (turning,) * 4),
                (motion.position, motion.orientation),
                (at.position, at.orientation),
            )
            together[name] = replace(motion, position=position, orientation=orientation)
        return self.placed(_still(together))

    def motions_of_the_whole(
        self, motions: Motions
    ) -> tuple[Float[Array, "modes m"], Float[Array, ""]]:
        """Rigid motions of each rod and body, and the `rounding` of positions.

        They are scaled rates, normalised, one per row. The rotation of all elements of
        a rod about their own d3 is one of them.
        """
        still = jax.tree.map(jnp.zeros_like, rates_of(motions))
        found = []
        for name, own in self.stepper.seen(motions).items():
            like = motions[name].velocity, motions[name].spin
            for rates in rigid_motions(own, self.scales.length):
                shaped = jax.tree.map(lambda a, b: a.reshape(b.shape), rates, like)
                found.append(ravel_pytree({**still, name: shaped})[0])
        whole = jnp.stack(found)
        whole = whole / jnp.sqrt(jnp.sum(whole**2, axis=1, keepdims=True))
        return whole, self.rounding(motions)

    # Matrices and vectors of scaled rates.

    def rounding(self, motions: Motions) -> Float[Array, ""]:
        """Relative round-off of positions: eps max(1, largest coordinate / length) [1].

        The length is the scale of length of the system.
        """
        places = [c for motion in motions.values() for c in motion.position]
        far = jnp.max(jnp.stack([jnp.max(jnp.abs(place)) for place in places]))
        return jnp.finfo(far.dtype).eps * jnp.maximum(1, far / self.scales.length)

    def listed(self, motions: Motions) -> StaticProblem:
        """Copy with the neighbour lists found at a configuration."""
        seen = self.stepper.seen(motions)
        found = lax.stop_gradient(searched(self.stepper.couplings, seen))
        couplings = with_found(self.stepper.couplings, found)
        return replace(self, stepper=replace(self.stepper, couplings=couplings))

    def rates(self, given: tuple[Motions, Array]) -> Any:
        """Converts a vector of scaled rates to velocities and angular momenta.

        `given` is the pair of the configuration and this vector: velocities divided by
        the scale of length, and angular velocities.
        """
        motions, scaled = given
        _, tree_of = ravel_pytree(rates_of(motions))
        length = self.scales.length
        return {
            name: (vectors.scale(length, velocity), self._spins(motions, name, turning))
            for name, (velocity, turning) in tree_of(scaled).items()
        }

    def scaled(self, motions: Motions, rates: Any) -> Float[Array, " m"]:
        """Converts velocities and angular momenta of all members to scaled rates.

        `motions` is the configuration.
        """
        moving = self.stepper.seen(motions)
        found = {}
        for name, (velocity, spin) in rates.items():
            own = moving[name]
            row = jax.tree.map(lambda a: a.reshape(-1), spin)
            own = replace(own, motion=replace(own.motion, spin=row))
            found[name] = (
                vectors.scale(1 / self.scales.length, velocity),
                _shaped(own.angular_velocities, spin),
            )
        return ravel_pytree(found)[0]

    def scaled_momenta(self, motions: Motions, momenta: Any) -> Float[Array, " m"]:
        """Gradient with respect to scaled rates, from that with respect to rates.

        `momenta` is the latter, and `motions` is the configuration.
        """
        length = self.scales.length
        found = {
            name: (vectors.scale(length, moving), self._spins(motions, name, turning))
            for name, (moving, turning) in momenta.items()
        }
        return ravel_pytree(found)[0]

    def _spins(self, motions: Motions, name: str, turning: Vec3) -> Vec3:
        """Angular momenta of the member `name`, from its angular velocities.

        `turning` are the angular velocities [rad/s], and `motions` is the
        configuration.
        """
        row = jax.tree.map(lambda a: a.reshape(-1), turning)
        return _shaped(spins(self.stepper.seen(motions)[name], row), turning)

    def linear(self, motions: Motions) -> Linear:
        """Linearises the problem about a configuration, column by column."""
        motions = jax.tree.map(lax.optimization_barrier, motions)
        problem = self.listed(motions)
        numbers = jnp.arange(ravel_pytree(rates_of(motions))[0].size)

        def column(number: Array) -> tuple[Array, ...]:
            seed = (numbers == number).astype(self.system.dtype)
            parts: tuple[Array, ...] = by_kernel(problem, "column", (motions, seed))
            return parts

        loads, projection, mass, caused = lax.map(column, numbers)
        mass = 0.5 * (mass + mass.T)
        # Some members cannot turn: their rotations have neither stiffness nor mass.
        moves = jnp.diagonal(mass) > 0
        return Linear(
            motions=motions,
            loads=loads[0],
            stiffness=-caused.T,
            mass=mass,
            projection=jnp.where(moves[None, :], projection.T, 0),
        )

    def moved_along_edges(
        self, here: Linear, scaled: Float[Array, " m"], loose: Float[Array, "modes m"]
    ) -> Motions:
        """Configuration after one second at scaled rates; strains change linearly.

        Nodes are displaced to close the gaps of `moved_with_gaps`, in the least-squares
        sense where ties and supports do not allow more.

        Args:
            here: The configuration before.
            scaled: Scaled rates.
            loose: Motions along which these displacements get no momentum.
        """
        _, tree_of = ravel_pytree(rates_of(here.motions))
        moved, gaps = by_kernel(self, "moved_with_gaps", (here.motions, scaled))
        first, second = self._places_of_edges(here.motions)
        # Gaps are closed by displacements alone, without rotations.
        (columns,) = np.nonzero(displacements(here.motions))
        allowed = here.projection[:, columns]
        along = allowed[second] - allowed[first]
        others = jnp.eye(scaled.size, dtype=scaled.dtype)[:, columns] - allowed
        matrix = along.T @ along + others.T @ others
        anchor = max(ANCHOR, ROUNDINGS * float(jnp.finfo(scaled.dtype).eps))
        matrix = matrix + anchor * jnp.eye(columns.size, dtype=scaled.dtype)
        part = jax.scipy.linalg.solve(matrix, along.T @ gaps, assume_a="pos")
        closing = jnp.zeros_like(scaled).at[columns].set(part)
        momenta = loose @ here.mass
        inertia = momenta @ loose.T
        # The same weight for heavy and light motions, and one for rows of zeros.
        own = jnp.diagonal(inertia)
        size = jnp.sqrt(jnp.where(own > 0, own, 1))
        inertia = inertia / size[:, None] / size[None, :]
        inertia = inertia + jnp.diag(jnp.where(own > 0, 0.0, 1.0))
        carried = (momenta @ closing) / size
        shares = jax.scipy.linalg.solve(inertia, carried, assume_a="pos") / size
        closing = closing - loose.T @ shares
        closed: Motions = by_kernel(self, "placed", (moved, tree_of(closing)))
        return closed

    def _places_of_edges(self, motions: Motions) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the two nodes of each edge in the vector of unknowns.

        There is one pair of indices for each edge and axis.
        """
        leaves, tree = jax.tree.flatten(rates_of(motions))
        ends = np.cumsum([leaf.size for leaf in leaves])
        places = [
            np.arange(end - leaf.size, end)
            for leaf, end in zip(leaves, ends, strict=True)
        ]
        numbers = jax.tree.unflatten(tree, places)
        none = np.zeros(0, int)
        first, second = [none], [none]
        for name, parts in _rods(self.stepper.seen(motions)):
            for component in numbers[name][0]:
                rows = component.reshape(parts.count, parts.n_elements + 1)
                first.append(rows[:, :-1].ravel())
                second.append(rows[:, 1:].ravel())
        return np.concatenate(first), np.concatenate(second)


def static_problem(
    system: Assembly, state: SystemState
) -> tuple[StaticProblem, Motions]:
    """The static problem of a system, and the configuration of a state."""
    axes = {own.method.normal_axis for own in system.interfaces().values()} - {None}
    if len(axes) > 1:
        raise ValueError(
            "statics and frequencies need one plane for all planar members, got "
            f"{len(axes)}: leave out planar(...)"
        )
    beginning = _Beginning(system.in_space(), next(iter(axes), None))
    problem, start = by_kernel(beginning, "problem", state)
    return problem, start


@pytree
class _Beginning:
    """A system of which a static problem is made, by one kernel."""

    system: Assembly
    """The system, whose members leave nothing out."""
    normal_axis: int | None = static()
    """World axis along which nothing moves; `None` in space."""

    def problem(self, state: SystemState) -> tuple[StaticProblem, Motions]:
        """The static problem, and the configuration of a state."""
        scales = scales_of(self.system)
        stepper = stepper_at(self.system, state, INSTANT * scales.time)
        members = {name: own.at_rest() for name, own in stepper.members.items()}
        stepper = replace(stepper, members=members)
        problem = StaticProblem(self.system, stepper, scales, self.normal_axis)
        bare = {name: state[name] for name in self.system.members}
        return problem, problem.entered(bare)


def rates_of(motions: Motions) -> Any:
    """Velocities and angular momenta (`Motion.spin`) of all members, by name."""
    return {k: (motion.velocity, motion.spin) for k, motion in motions.items()}


def with_rates(motions: Motions, rates: Any) -> Motions:
    """Copy of the motions with the given velocities and angular momenta, by name."""
    return {
        k: replace(motion, velocity=rates[k][0], spin=rates[k][1])
        for k, motion in motions.items()
    }


def at_rest(motions: Motions) -> Motions:
    """Copy of the motions with zero velocities and angular momenta."""
    return {k: motion.at_rest for k, motion in motions.items()}


def displacements(motions: Motions) -> np.ndarray:
    """Flags of the unknowns: true for displacements, false for rotations."""
    flags = {
        k: (
            jax.tree.map(lambda leaf: np.ones(leaf.size, bool), motion.velocity),
            jax.tree.map(lambda leaf: np.zeros(leaf.size, bool), motion.spin),
        )
        for k, motion in motions.items()
    }
    return np.concatenate(jax.tree.leaves(flags))


def _shaped(field: Vec3, like: Vec3) -> Vec3:
    x, y, z = (a.reshape(b.shape) for a, b in zip(field, like, strict=True))
    return x, y, z


def _still(motions: Motions) -> tuple[Motions, Any]:
    """Pair of a configuration and zero rates, as an argument of `moved`."""
    return motions, jax.tree.map(jnp.zeros_like, rates_of(motions))


def _rods(seen: dict[str, Seen]) -> list[tuple[str, Parts]]:
    """Names and constants of the members that are rods."""
    return [(k, seen[k].parts) for k in sorted(seen) if seen[k].parts.is_rod]


def _edges(motion: Motion, parts: Parts) -> Vec3:
    """Vectors from each node of a rod to the next, with all rods concatenated [m]."""

    def differences(component: Array) -> Array:
        rows = component.reshape(parts.count, parts.n_elements + 1)
        return (rows[:, 1:] - rows[:, :-1]).reshape(-1)

    x, y, z = map(differences, motion.position)
    if motion.remainder is None:
        return x, y, z
    u, v, w = map(differences, motion.remainder)
    return vectors.subtract((x, y, z), (u, v, w))


def rigid_motions(own: Seen, length: Array) -> Iterator[tuple[Vec3, Vec3]]:
    """Yields scaled velocities and angular velocities of rigid motions, one by one.

    Each rod or body of a member has three translations and three rotations about its
    middle. A rod also has the rotation of all its elements about their own d3. In each
    motion the other rods or bodies are at rest.

    Args:
        own: The member.
        length: Scale of length, by which velocities are divided [m].
    """
    count = own.parts.count
    centred = []
    for component in own.motion.position:
        rows = component.reshape(count, -1)
        # Relative to the first node, so that no digits are lost far from the origin.
        rows = rows - rows[:, :1]
        centred.append((rows - jnp.mean(rows, axis=1, keepdims=True)).reshape(-1))
    arm: Vec3 = (centred[0], centred[1], centred[2])
    d3 = directors(own.motion.orientation)[2]
    still, unturned = vectors.scale(0.0, arm), vectors.scale(0.0, d3)
    motions = [] if not own.parts.is_rod else [(still, d3)]
    for axis in range(3):
        moving, turning = vectors.along(axis, arm[0]), vectors.along(axis, d3[0])
        motions.append((moving, unturned))
        around = vectors.scale(1 / length, vectors.cross(moving, arm))
        motions.append((around, turning))
    for velocity, turning in motions:
        for part in range(count):
            yield _of_part(part, count, velocity), _of_part(part, count, turning)


def _of_part(part: int, count: int, field: Vec3) -> Vec3:
    """Copy of a field that is zero except in rod or body number `part` of `count`."""
    x, y, z = (
        jnp.where(jnp.arange(c.size) // (c.size // count) == part, c, 0) for c in field
    )
    return x, y, z


def spins(own: Seen, turning: Vec3) -> Vec3:
    """Angular momenta (`Motion.spin`) of elements or bodies [kg m^2/s].

    `turning` are their angular velocities, world frame [rad/s].
    """
    # Angular velocities are linear in spins: their matrix, column by column.
    columns = []
    for axis in range(3):
        spin = vectors.along(axis, turning[0])
        moving = replace(own, motion=replace(own.motion, spin=spin))
        columns.append(moving.angular_velocities)
    matrix = matrices.transpose((columns[0], columns[1], columns[2]))
    # Scaled to the size of one, because products of three inertias would underflow in
    # float32.
    size = matrix[0][0] + matrix[1][1] + matrix[2][2]
    a, b, c = matrices.scale(1 / size, matrix)
    cofactors = vectors.cross(b, c), vectors.cross(c, a), vectors.cross(a, b)
    determinant = vectors.dot(a, cofactors[0]) * size
    inverse = matrices.transpose(matrices.scale(1 / determinant, cofactors))
    x, y, z = (vectors.dot(row, turning) for row in inverse)
    return x, y, z


def squared_frequencies(system: Assembly, state: SystemState) -> np.ndarray:
    """Squares of all angular frequencies, in increasing order [rad^2/s^2].

    They are computed in a basis of the rates that supports, ties and attachments allow.

    Raises:
        ValueError: If a number is traced.
    """
    here = _linear(system, state)
    projection = np.asarray(here.projection, np.float64)
    left, shares, _ = np.linalg.svd(projection)
    basis = left[:, : round(float(np.trace(projection)))]
    assert np.all(shares[: basis.shape[1]] > 0.5)
    stiffness = basis.T @ np.asarray(here.stiffness, np.float64) @ basis
    mass = basis.T @ np.asarray(here.mass, np.float64) @ basis
    inverse = np.linalg.inv(np.linalg.cholesky(0.5 * (mass + mass.T)))
    squares = inverse @ (0.5 * (stiffness + stiffness.T)) @ inverse.T
    found: np.ndarray = np.linalg.eigvalsh(0.5 * (squares + squares.T))
    return found


@jax.jit
def _linear(system: Assembly, state: SystemState) -> Linear:
    problem, start = static_problem(system, state)
    return problem.linear(start)
