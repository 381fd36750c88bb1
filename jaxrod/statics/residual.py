r"""The balance of loads that an implicit method solves for, and its derivative.

From a base configuration nodes are displaced by $d$ and elements rotated by rotation
vectors $\theta$ in their material frames. At the pace $w$ (an inverse duration, zero in
statics) nodes of mass $m$ have velocities $v = w d$. Elements with frames $R$ and
rotary inertia $J$ have angular momenta $P = R J\,w\theta$. All loads $f, c$, at the
displaced configuration and at these rates, balance damping with decay rates $g_t, g_r$
and the change from the base rates $v_b, P_b$:

$$m\,((w + g_t)\,v - w\,v_b) = f, \qquad (w + g_r)\,P - w\,P_b = c.$$
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxrod.geometry import vectors
from jaxrod.geometry.matrices import (
    Matrix,
    add,
    scale,
    scaled_identity,
    skew,
    stacked,
    subtract,
    turned_diagonal,
)
from jaxrod.geometry.rotations import (
    directors,
    multiply_quaternions,
    normalise,
    rotation_exp,
    rotation_log_and_coupling,
    to_material,
    to_world,
)
from jaxrod.geometry.vectors import Vec3
from jaxrod.lanes.steps import by_kernel
from jaxrod.loaded_rod import LoadedRod, constrain_rates
from jaxrod.rods.elasticity import (
    ElasticLaw,
    ElementTangent,
    JointTangent,
    element_tangent,
    internal_loads,
    joint_tangent,
    times_inverse,
)
from jaxrod.rods.motion import Motion
from jaxrod.statics.block_matrices import BlockTridiagonal, quarters
from jaxrod.statics.degrees_of_freedom import (
    degrees_of_freedom,
    stack_dofs,
    unstack_dofs,
)
from jaxrod.statics.effect_tangents import (
    Tangent,
    total_loads,
    with_differentiated,
    with_turning_tangents,
)
from jaxrod.statics.loose_modes import are_any, held_in_the_middle, loose_modes
from jaxrod.structure import pytree, static


@pytree
class Increment:
    """Displacements of nodes and rotations of elements from a base configuration."""

    displacement: Vec3
    """Displacements, world frame, `n + 1` nodes [m]."""
    turn: Vec3
    """Rotation vectors of the `n` elements, in their material frames at the base
    configuration [rad]."""


@pytree
class LoadBalance:
    r"""Residual of an implicit step or equilibrium, as a function of the increment.

    The increment moves nodes and rotates elements from the configuration `base`. The
    residual of a node of mass $m$ is $m\,((w + g_t)\,v - w\,v_b) - f$: inertia and
    damping, minus all loads $f$, at the velocity $v$. Here $w$ is `pace`, $g_t$ the
    decay rate of velocities, and $v_b$ the velocity in `base`. The residual of an
    element has the same form.
    """

    scene: LoadedRod
    """Scene whose loads are to balance."""
    law: ElasticLaw
    """Constants of the elastic law."""
    base: Motion
    """Configuration from which increments start, with the rates that inertia
    maintains."""
    pace: Float[Array, ""]
    """Inverse duration w: rates are w times increments [1/s]; zero in statics."""
    damping: tuple[Array, Array] | None
    """Decay rates of velocities and of spins [1/s]; `None` without damping."""
    at_rest: bool = static(default=False)
    """Whether the problem is static, without inertia."""

    def motion(self, increment: Increment) -> Motion:
        """Motion after an increment: the configuration and its rates."""
        orientation = normalise(
            multiply_quaternions(self.base.orientation, rotation_exp(increment.turn))
        )
        rates = vectors.scale(self.pace, increment.turn)
        momentum = vectors.multiply(self._inertia, rates)
        moved = replace(
            displaced(self.base, increment.displacement),
            orientation=orientation,
            velocity=vectors.scale(self.pace, increment.displacement),
            spin=to_world(directors(orientation), momentum),
        )
        # Driven components have already moved: their rate does not follow from the
        # increment.
        return moved if self.at_rest else constrain_rates(self.scene, moved)

    def residual(self, increment: Increment) -> Float[Array, "n+1 6"]:
        """Inertia and damping minus the loads; zero for held components.

        Forces on nodes [N] and couples on elements [N m], world frame.
        """
        motion = self.motion(increment)
        internal = internal_loads(self.law, motion)
        node_rate, element_rate = self._rates
        change = vectors.subtract(
            vectors.scale(node_rate, motion.velocity),
            vectors.scale(self.pace, self.base.velocity),
        )
        push = vectors.scale(self.scene.rod.node_masses, change)
        twist = vectors.subtract(
            vectors.scale(element_rate, motion.spin),
            vectors.scale(self.pace, self.base.spin),
        )
        loads = total_loads(self.scene, motion, internal)
        return self.free * (stack_dofs(push, twist) - loads)

    def tangent(self, increment: Increment) -> Tangent:
        """Derivative of the residual with respect to a small step (see `retract`).

        Rows and columns of held components are those of the identity.
        """
        motion = self.motion(increment)
        node_rate, element_rate = self._rates
        masses = self.pace * node_rate * self.scene.rod.node_masses
        momentum = self._momentum_tangent(increment, motion)
        turning = scale(element_rate, momentum)
        turning = with_turning_tangents(turning, self.scene, motion)
        chain = assemble_tangent(
            element_tangent(self.law, motion),
            joint_tangent(self.law, motion),
            jnp.broadcast_to(masses, self.base.position[0].shape),
            turning,
        )
        free = self.free
        return with_differentiated(
            _restricted(chain, free), self.scene, motion, self.pace, momentum, free
        )

    def mass(self) -> Float[Array, "n+1 6 6"]:
        """Blocks of masses [kg] and rotary inertias [kg m^2], world frame.

        Rows and columns of held components are zero.
        """
        rod = self.scene.rod
        frame = directors(self.base.orientation)
        turning = stacked(turned_diagonal(frame, vectors.split(rod.principal_inertias)))
        turning = jnp.pad(turning, ((0, 1), (3, 0), (3, 0)))
        one = jnp.eye(3, dtype=turning.dtype)[None]
        moving = jnp.pad(rod.node_masses[:, None, None] * one, ((0, 0), (0, 3), (0, 3)))
        free = self.free
        return free[:, :, None] * free[:, None, :] * (moving + turning)

    # Methods for kernels: each takes one argument.

    def about(self, increment: Increment) -> tuple[Array, Tangent, Array | None]:
        """Residual and tangent at an increment, in statics with the mass blocks."""
        mass = self.mass() if self.at_rest else None
        return self.residual(increment), self.tangent(increment), mass

    def stiffness(self, increment: Increment) -> Tangent:
        """Tangent at an increment, in statics with springs that resist loose modes."""
        return self.held(self.tangent(increment), increment)[0]

    def retracted(self, given: tuple[Increment, Array]) -> Increment:
        """Increment after `retract` of the two entries of `given`."""
        return self.retract(*given)

    def increment_along_edges(self, given: tuple[Increment, Array]) -> Increment:
        """Increment after `retract_along_edges` of the two entries of `given`."""
        return self.retract_along_edges(*given)

    def held(
        self, tangent: Tangent, increment: Increment
    ) -> tuple[Tangent, Bool[Array, ""]]:
        """Adds springs that resist loose modes to a tangent, in statics.

        Returns:
            The tangent, and whether there are loose modes.
        """
        if not self.at_rest:
            return tangent, jnp.zeros((), bool)
        rod = self.scene.rod
        there = (tangent, rod, self.motion(increment), self.free)
        modes = loose_modes(*lax.stop_gradient(there))
        return held_in_the_middle(tangent, rod, modes), are_any(modes)

    def retract(self, increment: Increment, step: Float[Array, "n+1 6"]) -> Increment:
        """Increment with a small step added, to first order.

        A step displaces the nodes and rotates the elements, both in the world frame.
        """
        return jax.tree.map(jnp.add, increment, self.change(increment, step))

    def retract_along_edges(
        self, increment: Increment, step: Float[Array, "n+1 6"]
    ) -> Increment:
        """Increment as in `retract` to first order, but with linearly changing strains.

        The edges turn with the elements. Otherwise rotations would stretch the elements
        of a slender rod in proportion to the square of the angle. Stretching is far
        stiffer than bending, so that would limit Newton's method to small rotations.
        """
        moved = self.retract(increment, step)
        displacement, turn = unstack_dofs(step)
        before = self.motion(increment)
        edges = before.edges
        linear = vectors.add(edges, vectors.inner_difference(displacement))
        strained = vectors.add(linear, vectors.cross(edges, turn))
        local = to_material(directors(before.orientation), strained)
        edges = to_world(directors(self.motion(moved).orientation), local)
        closing = self._closing(vectors.subtract(edges, linear))
        return replace(moved, displacement=vectors.add(moved.displacement, closing))

    def change(self, increment: Increment, step: Float[Array, "n+1 6"]) -> Increment:
        """First-order change of an increment caused by a small step; see `retract`."""
        displacement, turn = unstack_dofs(step)
        own = to_material(directors(self.base.orientation), turn)
        once = vectors.cross(increment.turn, own)
        twice = vectors.cross(increment.turn, once)
        change = vectors.add(
            vectors.scale(-0.5, once), vectors.scale(_coupling(increment), twice)
        )
        return Increment(displacement, vectors.add(own, change))

    def with_held_components(
        self, given: tuple[Float[Array, "n+1 6"], Increment]
    ) -> Increment:
        """Increment `found`, with held components taken from the step `guess`.

        They are the entries of `given`: `guess`, then `found`.
        """
        guess, found = given
        free = Increment(*unstack_dofs(self.free))
        displacement, turn = unstack_dofs(guess)
        own = to_material(directors(self.base.orientation), turn)
        held = Increment(displacement, own)
        return jax.tree.map(lambda a, b, c: jnp.where(a == 1, b, c), free, found, held)

    def _closing(self, gaps: Vec3) -> Vec3:
        """Displacements of free nodes that change the edges by `gaps` [m]."""
        x, y, z = map(_closed, gaps, unstack_dofs(self.free)[0])
        return x, y, z

    @property
    def free(self) -> Float[Array, "n+1 6"]:
        """Flags of all components: 1 if free, 0 if held by the scene."""
        return stack_dofs(*degrees_of_freedom(self.scene, self.base))

    @property
    def _inertia(self) -> Vec3:
        """Rotary inertia of the elements about d1, d2, d3 [kg m^2]."""
        return vectors.split(self.scene.rod.principal_inertias)

    @property
    def _rates(self) -> tuple[Array, Array]:
        """Sum of pace and damping rate, for velocities and for spins [1/s]."""
        if self.damping is None:
            return self.pace, self.pace
        return self.pace + self.damping[0], self.pace + self.damping[1]

    def _momentum_tangent(self, increment: Increment, motion: Motion) -> Matrix:
        """Derivative of angular momenta with respect to rotations [kg m^2/s].

        Both are in the world frame.
        """
        frame = directors(motion.orientation)
        inertia = turned_diagonal(frame, vectors.scale(self.pace, self._inertia))
        turn = to_world(frame, increment.turn)
        changed = times_inverse(inertia, turn, _coupling(increment))
        return subtract(changed, skew(motion.spin))


def _coupling(increment: Increment) -> Array:
    """Coupling coefficient c of the rotation vectors: `rotation_log_and_coupling`."""
    return rotation_log_and_coupling(rotation_exp(increment.turn))[1]


def _restricted(
    matrix: BlockTridiagonal, free: Float[Array, "n+1 6"]
) -> BlockTridiagonal:
    """Matrix with rows and columns of the identity for held components (`free` 0)."""
    before = jnp.pad(free[:-1], ((1, 0), (0, 0)))
    after = jnp.pad(free[1:], ((0, 1), (0, 0)))
    held = jnp.eye(6, dtype=free.dtype)[None] * (1 - free)[:, :, None]
    return BlockTridiagonal(
        lower=matrix.lower * free[:, :, None] * before[:, None, :],
        diagonal=matrix.diagonal * free[:, :, None] * free[:, None, :] + held,
        upper=matrix.upper * free[:, :, None] * after[:, None, :],
    )


def _closed(gaps: Array, free: Array) -> Array:
    """One component of displacements whose differences are `gaps`, zero at held nodes.

    If both ends are held the remainder is distributed along the rod; if none is, the
    mean is zero.
    """
    total = vectors.pad(jnp.cumsum(gaps), 1, 0)
    start, finish = free[0] == 0, free[-1] == 0
    first = jnp.where(start, 0, jnp.where(finish, total[-1], jnp.mean(total)))
    last = jnp.where(finish, total[-1], first)
    along = jnp.linspace(0, 1, total.shape[0], dtype=total.dtype)
    return free * (total - (first + along * (last - first)))


def displaced(motion: Motion, displacement: Vec3) -> Motion:
    """Motion with nodes displaced [m], by Kahan summation if it has a `remainder`."""
    if motion.remainder is None:
        return replace(motion, position=vectors.add(motion.position, displacement))
    step = vectors.subtract(displacement, motion.remainder)
    position = vectors.add(motion.position, step)
    moved = vectors.subtract(position, motion.position)
    return replace(motion, position=position, remainder=vectors.subtract(moved, step))


@jax.custom_jvp
def implicit_solution(balance: LoadBalance, increment: Increment) -> Increment:
    """Increment that solves the balance of loads, differentiable in its parameters.

    The value is `increment` itself. Its derivative is that of the exact solution, by
    the implicit function theorem: one linear solve for any number of iterations.
    Held components change as they do in `increment`.
    """
    return increment


@implicit_solution.defjvp
def _implicit_solution_jvp(
    primals: tuple[LoadBalance, Increment], tangents: tuple[LoadBalance, Increment]
) -> tuple[Increment, Increment]:
    balance, found = primals
    found = implicit_solution(balance, found)
    unbalanced = lambda balance, found: by_kernel(balance, "residual", found)
    _, change = jax.jvp(unbalanced, (balance, found), tangents)
    step = by_kernel(balance, "stiffness", found).solve(-change)
    return found, jax.tree.map(jnp.add, tangents[1], balance.change(found, step))


def assemble_tangent(
    element: ElementTangent, joint: JointTangent, masses: Array, turning: Matrix
) -> BlockTridiagonal:
    """Assembles the tangents of elements and joints into a matrix of the whole rod.

    Block `k` has the displacement of node `k` and the rotation of element `k`. The last
    node has no element; zeros take its place.

    Args:
        element: Tangents of the elements.
        joint: Tangents of the joints.
        masses: Terms to add on the diagonal of the nodes, `(n + 1,)`.
        turning: Matrices to add to the elements' diagonal blocks.
    """
    bend = stacked(joint.stiffness)
    carried = bend - stacked(skew(joint.couple))
    stretch, couple = stacked(element.stretching), stacked(element.coupling)
    own = stacked(add(element.turning, turning))
    own = _placed(own, 0, 1) + _placed(bend, 0, 2) + _placed(carried, 1, 1)
    before, after = _placed(stretch, 1, 0), _placed(stretch, 0, 1)
    nodes = before + after + stacked(scaled_identity(masses))
    couple_after, none = _placed(couple, 0, 1), jnp.zeros_like(nodes)
    couple_transposed = jnp.swapaxes(couple_after, 1, 2)
    return BlockTridiagonal(
        lower=quarters(-before, _placed(couple, 1, 0), none, _placed(-bend, 1, 1)),
        diagonal=quarters(nodes, -couple_after, -couple_transposed, own),
        upper=quarters(-after, none, couple_transposed, _placed(-carried, 0, 2)),
    )


def _placed(blocks: Array, before: int, after: int) -> Array:
    """Blocks with `before` zero blocks in front and `after` zero blocks behind."""
    return jnp.pad(blocks, ((before, after), (0, 0), (0, 0)))
