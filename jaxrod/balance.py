r"""The balance of loads that an implicit method solves for, and its derivative.

From a base configuration nodes are displaced by $d$ and elements turned by rotation
vectors $\theta$ in their material frames. At the pace $w$ (one over a duration; zero
in statics) they do so with velocities $v = w d$ and angular momenta
$P = R J\,w\theta$, and all loads $f, c$, at the displaced configuration and at these
rates, balance damping and the change from the base rates $v_b, P_b$:

$$m\,((w + g_t)\,v - w\,v_b) = f, \qquad (w + g_r)\,P - w\,P_b = c.$$
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxrod import vectors
from jaxrod._pytree import pytree
from jaxrod.block_tridiagonal import BlockTridiagonal
from jaxrod.effect_tangents import coloured, has_closed_form, turning_tangent
from jaxrod.effects import Effect
from jaxrod.elasticity import ElasticLaw, internal_loads
from jaxrod.motion import Motion
from jaxrod.rotations import (
    directors,
    multiply_quaternions,
    normalise,
    rotation_exp,
    rotation_log_and_coupling,
    to_material,
    to_world,
)
from jaxrod.scene import Scene, external_loads, hold_rates
from jaxrod.tangents import (
    Matrix,
    add,
    assembled,
    element_tangent,
    joint_tangent,
    scale,
    skew,
    subtract,
    times_inverse,
    turned_diagonal,
)
from jaxrod.vectors import Vec3


@pytree
class Moves:
    """Displacements of nodes and turns of elements from a base configuration."""

    displacement: Vec3
    """World frame, `n + 1` nodes [m]."""
    turn: Vec3
    """Rotation vectors in the base material frames, `n` elements [rad]."""


@pytree
class Balance:
    """What is to be balanced."""

    scene: Scene
    """The scene."""
    law: ElasticLaw
    """Constants of the elastic law."""
    base: Motion
    """Where moves start from, and the rates that inertia would keep."""
    pace: Float[Array, ""]
    """Rates per move [1/s]; zero in statics."""
    damping: tuple[Array, Array] | None
    """Decay rates of velocities and spins [1/s]."""

    def motion(self, moves: Moves) -> Motion:
        """Where the rod is, and its rates."""
        orientation = normalise(
            multiply_quaternions(self.base.orientation, rotation_exp(moves.turn))
        )
        rates = vectors.scale(self.pace, moves.turn)
        momentum = vectors.multiply(self._inertia, rates)
        return replace(
            displaced(self.base, moves.displacement),
            orientation=orientation,
            velocity=vectors.scale(self.pace, moves.displacement),
            spin=to_world(directors(orientation), momentum),
        )

    def residual(self, moves: Moves) -> Float[Array, "n+1 6"]:
        """Inertia and damping less the loads, zero for what the scene holds.

        Forces on nodes [N] and couples on elements [N m], world frame.
        """
        motion = self.motion(moves)
        internal = internal_loads(self.law, motion)
        assert internal.forces is not None and internal.couples is not None
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
        loads = self._loads(motion, internal.forces, internal.couples)
        return self.free * (blocks(push, twist) - loads)

    def tangent(self, moves: Moves) -> BlockTridiagonal:
        """Derivative of the residual by a step: see `moved`.

        What the scene holds keeps the identity for its rows and columns.
        """
        motion = self.motion(moves)
        node_rate, element_rate = self._rates
        masses = self.pace * node_rate * self.scene.rod.node_masses
        momentum = self._momentum_tangent(moves, motion)
        turning = scale(element_rate, momentum)
        for effect in self.scene.effects:
            if has_closed_form(effect):
                turn = turning_tangent(effect, self.scene.rod, motion)
                turning = turning if turn is None else add(turning, turn)
        total = assembled(
            element_tangent(self.law, motion),
            joint_tangent(self.law, motion),
            jnp.broadcast_to(masses, self.base.position[0].shape),
            turning,
        )
        others = tuple(e for e in self.scene.effects if not has_closed_form(e))
        if others:
            rest = self._differentiated(others, motion, momentum)
            total = jax.tree.map(jnp.subtract, total, rest)
        return _restricted(total, self.free)

    def moved(self, moves: Moves, step: Float[Array, "n+1 6"]) -> Moves:
        """Moves with a small step on top, to first order.

        A step displaces the nodes and turns the elements, both in the world frame.
        """
        change = self.change(moves, step)
        return Moves(
            displacement=vectors.add(moves.displacement, change.displacement),
            turn=vectors.add(moves.turn, change.turn),
        )

    def followed(self, moves: Moves, step: Float[Array, "n+1 6"]) -> Moves:
        """As `moved`, to first order, but with strains that change in proportion.

        Turned elements of a slender rod would otherwise find their nodes off by the
        square of the turn, and be stretched: far stiffer than bending, this is what
        keeps Newton's method to small turns. So the edges turn with the elements.
        """
        moved = self.moved(moves, step)
        displacement, turn = unblocked(step)
        before = self.motion(moves)
        edges = before.edges
        linear = vectors.add(edges, vectors.inner_difference(displacement))
        strained = vectors.add(linear, vectors.cross(edges, turn))
        local = to_material(directors(before.orientation), strained)
        edges = to_world(directors(self.motion(moved).orientation), local)
        free = unblocked(self.free)[0]
        gaps = zip(vectors.subtract(edges, linear), free, strict=True)
        x, y, z = (_closed(gap, nodes) for gap, nodes in gaps)
        return replace(moved, displacement=vectors.add(moved.displacement, (x, y, z)))

    def change(self, moves: Moves, step: Float[Array, "n+1 6"]) -> Moves:
        """How moves change with a step."""
        displacement, turn = unblocked(step)
        own = to_material(directors(self.base.orientation), turn)
        once = vectors.cross(moves.turn, own)
        twice = vectors.cross(moves.turn, once)
        change = vectors.add(
            vectors.scale(-0.5, once), vectors.scale(_coupling(moves), twice)
        )
        return Moves(displacement, vectors.add(own, change))

    @property
    def free(self) -> Float[Array, "n+1 6"]:
        """One for what can move, zero for what the scene holds."""
        moving = hold_rates(self.scene, jax.tree.map(jnp.ones_like, self.base))
        still = hold_rates(self.scene, jax.tree.map(jnp.zeros_like, self.base))
        return blocks(
            vectors.subtract(moving.velocity, still.velocity),
            vectors.subtract(moving.spin, still.spin),
        )

    @property
    def _inertia(self) -> Vec3:
        """Rotary inertia of the elements about their axes [kg m^2]."""
        transverse, polar = self.scene.rod.inertias
        return transverse, transverse, polar

    @property
    def _rates(self) -> tuple[Array, Array]:
        """Pace and damping rate together, of velocities and of spins [1/s]."""
        if self.damping is None:
            return self.pace, self.pace
        return self.pace + self.damping[0], self.pace + self.damping[1]

    def _loads(self, motion: Motion, forces: Vec3, couples: Vec3) -> Array:
        """Given loads and those of all effects, couples in the world frame."""
        loads = external_loads(self.scene, motion, forces, couples)
        # Fusing further, XLA's CPU compiler takes minutes over the derivative.
        # One by one: those that do not depend on what is differentiated are no part
        # of reverse mode.
        loads = jax.tree.map(lax.optimization_barrier, loads)
        assert loads.forces is not None and loads.couples is not None
        return blocks(
            loads.forces, to_world(directors(motion.orientation), loads.couples)
        )

    def _momentum_tangent(self, moves: Moves, motion: Motion) -> Matrix:
        """Derivative of the angular momenta by the turn."""
        frame = directors(motion.orientation)
        inertia = turned_diagonal(frame, vectors.scale(self.pace, self._inertia))
        turn = to_world(frame, moves.turn)
        changed = times_inverse(inertia, turn, _coupling(moves))
        return subtract(changed, skew(motion.spin))

    def _differentiated(
        self, effects: tuple[Effect, ...], motion: Motion, momentum: Matrix
    ) -> BlockTridiagonal:
        """Derivative of the loads of effects, whatever they are."""
        others = replace(self, scene=replace(self.scene, effects=effects))
        none = jax.tree.map(jnp.zeros_like, (motion.position, motion.spin))
        # Fused with what computes the motion, 18 times over, it compiles for minutes.
        motion, momentum = jax.tree.map(lax.optimization_barrier, (motion, momentum))
        _, push = jax.linearize(lambda there: others._loads(there, *none), motion)

        def answer(step: Array) -> Array:
            displacement, turn = unblocked(step)
            half = vectors.scale(0.5, turn)
            still = jnp.zeros_like(half[0])
            turned = multiply_quaternions((still, *half), motion.orientation)
            x, y, z = (vectors.dot(row, turn) for row in momentum)
            change = jax.tree.map(jnp.zeros_like, motion)
            return push(
                replace(
                    change,
                    position=displacement,
                    orientation=turned,
                    velocity=vectors.scale(self.pace, displacement),
                    spin=(x, y, z),
                )
            )

        return jax.tree.map(lax.optimization_barrier, coloured(answer, self.free))


def _coupling(moves: Moves) -> Array:
    """The coupling coefficient of the turns: see `rotation_log_and_coupling`."""
    return rotation_log_and_coupling(rotation_exp(moves.turn))[1]


def _restricted(
    matrix: BlockTridiagonal, free: Float[Array, "n+1 6"]
) -> BlockTridiagonal:
    """The identity in place of the rows and columns of what is not free."""
    before = jnp.pad(free[:-1], ((1, 0), (0, 0)))
    after = jnp.pad(free[1:], ((0, 1), (0, 0)))
    held = jnp.eye(6, dtype=free.dtype)[None] * (1 - free)[:, :, None]
    return BlockTridiagonal(
        lower=matrix.lower * free[:, :, None] * before[:, None, :],
        diagonal=matrix.diagonal * free[:, :, None] * free[:, None, :] + held,
        upper=matrix.upper * free[:, :, None] * after[:, None, :],
    )


def _closed(gaps: Array, free: Array) -> Array:
    """Displacements whose differences are the gaps, zero where nodes are not free.

    If both ends are held what is left over is shared out along the rod; if none is
    the mean is zero.
    """
    total = vectors.pad(jnp.cumsum(gaps), 1, 0)
    start, finish = free[0] == 0, free[-1] == 0
    first = jnp.where(start, 0, jnp.where(finish, total[-1], jnp.mean(total)))
    last = jnp.where(finish, total[-1], first)
    along = jnp.linspace(0, 1, total.shape[0], dtype=total.dtype)
    return free * (total - (first + along * (last - first)))


def displaced(motion: Motion, displacement: Vec3) -> Motion:
    """The nodes moved [m]; with a remainder, by Kahan's compensated sum."""
    if motion.remainder is None:
        return replace(motion, position=vectors.add(motion.position, displacement))
    step = vectors.subtract(displacement, motion.remainder)
    position = vectors.add(motion.position, step)
    moved = vectors.subtract(position, motion.position)
    return replace(motion, position=position, remainder=vectors.subtract(moved, step))


def blocks(nodes: Vec3, elements: Vec3) -> Float[Array, "n+1 6"]:
    """Node and element fields side by side; zeros where the last node has none."""
    padded = [vectors.pad(entry, 0, 1) for entry in elements]
    return jnp.stack([*nodes, *padded], axis=-1)


def unblocked(step: Float[Array, "n+1 6"]) -> tuple[Vec3, Vec3]:
    """The node and the element field of an array of blocks."""
    return (
        (step[:, 0], step[:, 1], step[:, 2]),
        (step[:-1, 3], step[:-1, 4], step[:-1, 5]),
    )


@jax.custom_jvp
def balanced(balance: Balance, moves: Moves) -> Moves:
    """The moves that balance, found by other means, as a function of the balance.

    The value is `moves` itself. Its derivative, by the implicit function theorem, is
    that of the exact solution: one linear solve, however many iterations it took.
    """
    return moves


@balanced.defjvp
def _balanced_jvp(
    primals: tuple[Balance, Moves], tangents: tuple[Balance, Moves]
) -> tuple[Moves, Moves]:
    balance, found = primals
    found = balanced(balance, found)
    _, change = jax.jvp(lambda b: b.residual(found), primals[:1], tangents[:1])
    step = balance.tangent(found).solve(-change)
    return found, balance.change(found, step)
