r"""Linear systems along a rod whose unknowns alternate between joints and elements.

On a rod of $N$ elements the unknowns are vectors of three components,
$\kappa_0, s_0, \kappa_1, \dots, s_{N-1}, \kappa_N$; joint $k$ is before element $k$.
Each vector is coupled with the next two. The couplings $S$ are symmetric and positive
semidefinite, the weights $W \ge 0$ are diagonal, and the solution is

$$p = (1 + W S)^{-1} W b = (W^{-1} + S)^{-1} b.$$

The second form is solved by elimination without pivoting ($L D L^T$), which needs only
the inverses of the pivots. They are $w/(1 + w\sigma)$, where $\sigma$ is the diagonal
entry of $S$ after the earlier eliminations: weights may be zero, and may be huge.

Elimination proceeds from both ends of the rod to the middle element simultaneously.
Every operation is therefore on two numbers, one for each side.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from jaxrod.geometry import vectors
from jaxrod.geometry.matrices import Matrix, transpose
from jaxrod.geometry.vectors import Vec3
from jaxrod.structure import pytree

_Triangle = list[list[Any]]
"""Symmetric matrix as rows, each of which ends at the diagonal."""
_Kept = list[tuple[Array, list[Array]]]
"""Eliminated unknowns in order. Each is a pair of a number and factors: the unknown is
the number minus the factors times the unknowns after it."""


@pytree
class ChainOfPairs:
    """Weights $W$ and couplings $S$ of the joints and elements of a rod; `N` is odd.

    Couplings are 3 x 3 matrices. A coupling of "a with b" has the components of a as
    rows and those of b as columns. Of the coupling of a joint or element with itself,
    only the entries up to the diagonal are read.
    """

    joint_weights: Vec3
    """Weights $W$ of the `N + 1` joints, one per component."""
    element_weights: Vec3
    """Weights $W$ of the `N` elements, one per component."""
    joints: Matrix
    """Coupling of each joint with itself."""
    elements: Matrix
    """Coupling of each element with itself."""
    before: Matrix
    """Coupling of each element with the joint before it."""
    after: Matrix
    """Coupling of each element with the joint after it."""
    across_elements: Matrix
    """Coupling of the joint before each element with the joint after it."""
    across_nodes: Matrix
    """Coupling of the element before with the element after each of the `N - 1` inner
    nodes."""

    def solve(self, joints: Vec3, elements: Vec3) -> tuple[Vec3, Vec3]:
        """Unknowns $p$ of joints and elements for the right-hand sides $b$ of both.

        Right-hand sides may be given for `N - 1` elements and `N` joints. Those of the
        last element and joint are then zero, and their unknowns are not returned.
        """
        n = len(elements[0])
        more = len(self.element_weights[0]) - n
        half = n // 2
        joints, elements = (_padded(side, more) for side in (joints, elements))
        weights = [*self.joint_weights, *self.element_weights]
        right = [*joints, *elements]
        # From the tip towards the base, the joint after an element comes before it.
        rounds = jax.tree.map(
            lambda first, last: jnp.stack([first[:half], last[::-1][:half]], axis=1),
            (weights, self._own(self.before), right, self._onwards),
            (weights, self._own(self.after), right, self._backwards),
        )
        none = jnp.zeros(2, elements[0].dtype)
        rest = jax.tree.map(lambda _: none, (self._own(self.before), right))
        if half:
            rest, kept = lax.scan(_eliminate_round, rest, rounds)
        # Without barriers, XLA repeats many computations, and compilation is slow.
        joints, elements, rest = lax.optimization_barrier((joints, elements, rest))
        middle = self._middle(half, joints, elements, rest)
        first, last, element = lax.optimization_barrier(middle)
        found = [jnp.zeros((0, 2), elements[0].dtype)] * 6
        if half:
            following = [jnp.stack(both) for both in zip(first, last, strict=True)]
            following += [jnp.stack([c, c]) for c in element]
            _, found = lax.scan(_solve_round, following, kept, reverse=True)
        return (
            _in_order(n + 1, found[:3], first, last),
            _in_order(n, found[3:], element),
        )

    def _own(self, between: Matrix) -> _Triangle:
        """Coupling of each pair of a joint and an adjacent element with itself.

        It is the lower triangle of a 6 x 6 matrix, the joint first. `between` is the
        coupling of that element with that joint.
        """
        joints = [list(self.joints[i][: i + 1]) for i in range(3)]
        return joints + [[*between[i], *self.elements[i][: i + 1]] for i in range(3)]

    @property
    def _onwards(self) -> tuple[Matrix, Matrix, Matrix]:
        """Blocks of S between each joint and element and the next, from base to tip.

        As (row, column) they are (next joint, joint), (next joint, element) and (next
        element, element).
        """
        return (
            transpose(self.across_elements),
            transpose(self.after),
            transpose(self.across_nodes),
        )

    @property
    def _backwards(self) -> tuple[Matrix, Matrix, Matrix]:
        """The blocks of `_onwards` for the opposite order, from tip to base."""
        return self.across_elements, transpose(self.before), self.across_nodes

    def _middle(
        self, at: int, joints: Vec3, elements: Vec3, rest: Any
    ) -> tuple[list[Array], list[Array], list[Array]]:
        """Unknowns of the middle element, after those of the joints on its two sides.

        Args:
            at: Index of the middle element.
            joints: Right-hand sides of all joints.
            elements: Right-hand sides of all elements.
            rest: Couplings and right-hand sides added by elimination on the base side
                and on the tip side.
        """
        (one, one_right), (other, other_right) = (
            jax.tree.map(lambda c, k=k: c[k], rest) for k in range(2)
        )
        threes = range(3)
        first = [
            [self.joints[i][j][at] + one[i][j] for j in range(i + 1)] for i in threes
        ]
        last = [
            [self.across_elements[j][i][at] for j in threes]
            + [self.joints[i][j][at + 1] + other[i][j] for j in range(i + 1)]
            for i in threes
        ]
        element = [
            [self.before[i][j][at] + one[3 + i][j] for j in threes]
            + [self.after[i][j][at] + other[3 + i][j] for j in threes]
            + [
                self.elements[i][j][at] + (one[3 + i][3 + j] + other[3 + i][3 + j])
                for j in range(i + 1)
            ]
            for i in threes
        ]
        right = [c[at] + r for c, r in zip(joints, one_right[:3], strict=True)]
        right += [c[at + 1] + r for c, r in zip(joints, other_right[:3], strict=True)]
        right += [
            c[at] + (r + s)
            for c, r, s in zip(elements, one_right[3:], other_right[3:], strict=True)
        ]
        weights = [c[at] for c in self.joint_weights]
        weights += [c[at + 1] for c in self.joint_weights]
        weights += [c[at] for c in self.element_weights]
        kept, _, _ = _eliminate([*first, *last, *element], right, weights)
        found = _solve(kept, [])
        return found[:3], found[3:6], found[6:]


def _padded(a: Vec3, after: int) -> Vec3:
    """Vector field with `after` zeros appended."""
    x, y, z = (vectors.pad(c, 0, after) for c in a)
    return x, y, z


def _in_order(count: int, ends: list[Array], *middle: list[Array]) -> Vec3:
    """First `count` unknowns in their order along the rod.

    `ends` has the unknowns of each round, first on the base side and second on the tip
    side; `middle` has the unknowns at the middle.
    """
    x, y, z = (
        jnp.concatenate([both[:, 0], jnp.stack(between), both[::-1, 1]])[:count]
        for both, *between in zip(ends, *middle, strict=True)
    )
    return x, y, z


def _eliminate_round(rest: Any, given: Any) -> tuple[Any, Any]:
    """Eliminates the next joint and element from the base, and from the tip.

    Args:
        rest: Couplings and right-hand sides added by earlier rounds.
        given: Weights, couplings and right-hand sides of this round.

    Returns:
        Couplings and right-hand sides added for the next round, and the eliminated
        unknowns.
    """
    weights, own, right, (to_joint, past_element, to_element) = given
    matrix, right = jax.tree.map(jnp.add, (own, right), rest)
    zeros = [[0.0] * (i + 1) for i in range(3)]
    matrix = matrix + [[*to_joint[i], *past_element[i], *zeros[i]] for i in range(3)]
    joint, matrix, right = _eliminate(matrix, [*right, *zeros[2]], weights[:3])
    matrix, right = lax.optimization_barrier((matrix, right))
    matrix = matrix + [[*to_element[i], *zeros[2], *zeros[i]] for i in range(3)]
    element, matrix, right = _eliminate(matrix, [*right, *zeros[2]], weights[3:])
    return (matrix, right), (joint, element)


def _solve_round(following: list[Array], kept: Any) -> tuple[list[Array], list[Array]]:
    """Unknowns of a round's joint and element, from those `following` in the next.

    `kept` has the eliminated unknowns of both, as a number and factors.
    """
    joint, element = kept
    elements = _solve(element, following)
    joints = _solve(joint, [*elements, *following[:3]])
    return [*joints, *elements], [*joints, *elements]


def _eliminate(
    matrix: _Triangle, right: list[Any], weights: list[Array]
) -> tuple[_Kept, _Triangle, list[Any]]:
    """Eliminates the first unknowns of (1 / W + S) p = b, one for each weight.

    Args:
        matrix: Couplings S.
        right: Right-hand sides b.
        weights: Weights W of the unknowns to eliminate.

    Returns:
        The eliminated unknowns, and couplings and right-hand sides of the others.
    """
    kept = []
    for weight in weights:
        pivot = weight / (1 + weight * matrix[0][0])
        column = [row[0] for row in matrix[1:]]
        parts = [pivot * entry for entry in column]
        kept.append((pivot * right[0], parts))
        right = [r - part * right[0] for r, part in zip(right[1:], parts, strict=True)]
        matrix = [
            [
                entry - part * other
                for entry, other in zip(row[1:], column, strict=False)
            ]
            for row, part in zip(matrix[1:], parts, strict=True)
        ]
    return kept, matrix, right


def _solve(kept: _Kept, following: list[Array]) -> list[Array]:
    """Values of eliminated unknowns, from those of the unknowns `following` them.

    `kept` has a number and factors for each: the unknown is the number minus the
    factors times the later unknowns.
    """
    known = list(following)
    for own, parts in reversed(kept):
        for part, unknown in zip(parts, known, strict=True):
            own = own - part * unknown
        known.insert(0, own)
    return known[: len(kept)]
