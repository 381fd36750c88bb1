r"""Registration: identifies recorded markers, and finds the frame of the camera.

The drawing predicts the positions $p_{rj}$ of the markers $j$ in every recording $r$.
Recorded points $q$ differ from them by one rotation $R$, one shift $t$, and an order
$\pi_r$ that may differ between recordings. They are found by

$$\min_{R, t, \pi_r} \sum_{r, j} |R\,q_{r\pi_r(j)} + t - p_{rj}|^2.$$

For every order of every recording, rotation and shift follow from a singular value
decomposition. Those of the best orders are tried on all recordings, and give the best
order of each. Rotation, shift and orders are then improved in turn.

Source: W. Kabsch, A solution for the best rotation to relate two sets of vectors, 1976;
K. S. Arun, T. S. Huang, S. D. Blostein, Least-squares fitting of two 3-D point sets,
1987.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxrod.twin.recordings import Recording

MOST_MARKERS = 7
"""Largest number of markers that can be identified, because all orders are tried."""
CANDIDATES = 6
"""Number of best orders of each recording whose rotations and shifts are tried on all
recordings."""
ON_A_LINE = 1e-4
"""Points count as on a line if the second singular value of their products (squared
extents) is at most this fraction of the first [1]."""
ROUNDS = 10
"""Largest number of alternations between finding orders and finding the frame."""


@dataclass(frozen=True)
class Registration:
    """Order of the recorded markers, and frame of the camera, found by `register`.

    Example:
        >>> quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        >>> found = twin.Registration(
        ...     np.array([[0]]), quarter, np.zeros((1, 3)), distance=0.0, margin=9.0
        ... )
        >>> seen = np.array([[[1.0, 0.0, 0.0]]])  # in the frame of the camera
        >>> pose = twin.Recording("pose", np.zeros(1), np.ones((1, 1)), seen)
        >>> found.apply(pose, 0).points.tolist()
        [[[0.0, 1.0, 0.0]]]
    """

    orders: Int[np.ndarray, "recordings markers"]
    """Index in `Recording.points` of each of the arm's markers, for each recording."""
    rotation: Float[np.ndarray, "3 3"]
    """Rotation matrix from the recorded frame to the arm's frame."""
    shifts: Float[np.ndarray, "recordings 3"]
    """Position of the recorded zero point in the arm's frame, by recording [m]."""
    distance: float
    """Root mean square distance of the registered markers from predictions [m]."""
    margin: float
    """Smallest ratio, over the recordings, of the distance with the second best order
    to that with the best [1]. Close to one, the order is uncertain."""

    def apply(self, recording: Recording, number: int) -> Recording:
        """Converts the recording of index `number` to the arm's order and frame."""
        points = recording.points[:, self.orders[number]]
        turned = np.sum(points[..., None, :] * self.rotation, axis=-1)
        turned = turned + self.shifts[number]
        return replace(recording, points=turned, labelled=True)


def register(
    recordings: Sequence[Recording],
    predictions: Sequence[np.ndarray],
    *,
    axes: np.ndarray | None = None,
    shift: np.ndarray | None = None,
    origin: int | None = None,
) -> Registration:
    """Finds marker orders and camera frame of recordings from predicted markers.

    Args:
        recordings: The recordings.
        predictions: Predicted positions of the markers in the frames of each recording
            `(frames, markers, 3)` [m].
        axes: Rotation matrix from the recorded to the arm's frame `(3, 3)`; `None` if
            it is not known.
        shift: Position of the recorded zero point in the arm's frame `(3,)` [m]; `None`
            if it is not known.
        origin: Index of a marker whose predicted position is exact in every recording,
            if there is one. It gives each recording a separate shift.

    Raises:
        ValueError: If there are too many markers to try all orders, no frame of a
            recording has all markers, or all markers are on a line.

    Example:
        >>> where = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, -0.1], [0.05, 0.0, -0.3]]])
        >>> shuffled = where[:, [2, 0, 1]]  # of one frame
        >>> pose = twin.Recording("pose", np.zeros(1), np.ones((1, 1)), shuffled, False)
        >>> found = twin.register([pose], [where], axes=np.eye(3), shift=np.zeros(3))
        >>> found.orders.tolist()  # the arm's first marker is the second one seen
        [[1, 2, 0]]
    """
    count = predictions[0].shape[1]
    same = np.arange(count)[None]
    known = _Known(axes, shift, origin)
    if known.whole and all(r.labelled for r in recordings):
        return _as_known(recordings, predictions, known)
    if all(r.labelled for r in recordings):
        every = same
    elif count > MOST_MARKERS:
        raise ValueError(
            f"registration finds the labels of at most {MOST_MARKERS} markers, got "
            f"{count}: name the columns of the recordings after the arm's markers"
        )
    else:
        every = np.array(list(itertools.permutations(range(count))))
    moments = [_moments(r, p) for r, p in zip(recordings, predictions, strict=True)]
    options = [same if r.labelled else every for r in recordings]
    frames = [
        f for m, o in zip(moments, options, strict=True) for f in known.likely(m, o)
    ]
    found = [_improved(moments, options, known, *frame) for frame in frames]
    return min(found, key=lambda one: one.distance)


@dataclass(frozen=True)
class _Moments:
    """Means over those frames of a recording in which all markers were seen."""

    frames: int
    seen: Float[np.ndarray, "markers 3"]
    """Mean position of each recorded point, recorded frame [m]."""
    made: Float[np.ndarray, "markers 3"]
    """Mean position of each predicted marker, arm's frame [m]."""
    squares: Float[np.ndarray, "markers markers"]
    """Mean of |q_i|^2 + |p_j|^2 for recorded point i and predicted marker j [m^2]."""
    products: Float[np.ndarray, "markers markers 3 3"]
    """Mean outer product p_j q_i^T of predicted marker j and recorded point i, at
    `[i, j]` [m^2]."""

    @property
    def count(self) -> int:
        """Number of markers."""
        return len(self.made)

    def costs(self, options: np.ndarray, turn: np.ndarray, shifts: np.ndarray) -> Any:
        """Sum over markers of |R q + t - p|^2 for each order and its shift [m^2].

        The recorded point q of each predicted marker p is a row of `options`. `turn` is
        R, and `shifts` has the t of each row.
        """
        away = _turned(turn, self.seen).sum(axis=0) - self.made.sum(axis=0)
        moved = np.sum(shifts * (self.count * shifts + 2 * away), axis=-1)
        table = self.squares - 2 * np.sum(turn * self.products, axis=(-1, -2))
        found = moved + np.sum(table[options, np.arange(self.count)], axis=-1)
        # Smaller values are round-off of the squares.
        return np.maximum(found, np.finfo(float).eps * self.squares.max())

    def paired(self, options: np.ndarray, origin: int | None) -> np.ndarray:
        """Sum over markers of outer products p q^T of paired points, for each order.

        The recorded point q of each predicted marker p is a row of `options`. If
        `origin` is the index of a marker, points are relative to that marker.
        """
        own = self.products[options, np.arange(self.count)].sum(axis=-3)
        if origin is None:
            return own
        from_origin = options[:, origin]
        own -= self.products[options, origin].sum(axis=-3)
        own -= self.products[from_origin].sum(axis=-3)
        return own + self.count * self.products[from_origin, origin]


def _moments(recording: Recording, predicted: np.ndarray) -> _Moments:
    whole = np.all(np.isfinite(recording.points), axis=(1, 2))
    if not whole.any():
        raise ValueError(
            f"{recording.name}: no frame has all {recording.points.shape[1]} markers, "
            "which registration needs if labels or the camera's frame are unknown"
        )
    q, p = recording.points[whole], predicted[whole]
    squares = np.mean(np.sum(q**2, -1), 0)[:, None] + np.mean(np.sum(p**2, -1), 0)
    products = np.mean(q[:, :, None, None, :] * p[:, None, :, :, None], axis=0)
    return _Moments(int(whole.sum()), q.mean(0), p.mean(0), squares, products)


@dataclass(frozen=True)
class _Known:
    """Known parts of the frame of the camera; fields as arguments of `register`."""

    axes: np.ndarray | None
    shift: np.ndarray | None
    origin: int | None

    @property
    def whole(self) -> bool:
        """Whether rotation and shift are known (a marker at `origin` gives shifts)."""
        return self.axes is not None and not (self.shift is self.origin is None)

    def likely(
        self, moments: _Moments, options: np.ndarray
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Rotations and shifts of the `CANDIDATES` orders that fit a recording best.

        The orders are rows of `options`; `moments` are the means of the recording.
        """
        if self.axes is None:
            products = moments.paired(options, self.origin)
            if self.origin is None:
                centres = np.outer(moments.made.mean(0), moments.seen.mean(0))
                products = products - moments.count * centres
            turns = _rotations(products)
        else:
            turns = np.broadcast_to(self.axes, (len(options), 3, 3))
        middle = moments.made.mean(0) - _turned(turns, moments.seen.mean(0))
        costs = [
            moments.costs(
                order[None], turn, self.shifts(moments, order[None], turn, to)
            )
            for order, turn, to in zip(options, turns, middle, strict=True)
        ]
        best = np.argsort(np.ravel(costs))[:CANDIDATES]
        return [(turns[k], middle[k]) for k in best]

    def shifts(
        self,
        moments: _Moments,
        options: np.ndarray,
        turn: np.ndarray,
        found: np.ndarray,
    ) -> np.ndarray:
        """Shift of a recording for each order in `options` [m].

        It follows from the marker at the origin and the rotation `turn` if there is
        such a marker, else it is the known shift, else `found`.
        """
        if self.origin is not None:
            seen = moments.seen[options[:, self.origin]]
            return moments.made[self.origin] - _turned(turn, seen)
        shift = found if self.shift is None else self.shift
        return np.broadcast_to(shift, (len(options), 3))


def _as_known(
    recordings: Sequence[Recording], predictions: Sequence[np.ndarray], known: _Known
) -> Registration:
    """Makes a registration from known orders and frame; markers may be missing.

    `predictions` are the positions of the markers, with which its distance is computed.
    """
    assert known.axes is not None
    shifts, squares = [], []
    for recording, predicted in zip(recordings, predictions, strict=True):
        turned = _turned(known.axes, recording.points)
        shift = known.shift
        if known.origin is not None:
            seen = turned[:, known.origin]
            seen = seen[np.isfinite(seen).all(axis=1)]
            if len(seen) == 0:
                raise ValueError(
                    f"{recording.name}: the marker at the origin was never seen"
                )
            shift = predicted[0, known.origin] - seen.mean(axis=0)
        assert shift is not None
        shifts.append(shift)
        away = np.sum((turned + shift - predicted) ** 2, axis=-1)
        squares.append(away[np.isfinite(away)])
    return Registration(
        orders=np.tile(np.arange(predictions[0].shape[1]), (len(recordings), 1)),
        rotation=known.axes,
        shifts=np.array(shifts),
        distance=float(np.sqrt(np.mean(np.concatenate(squares)))),
        margin=np.inf,
    )


def _improved(
    moments: Sequence[_Moments],
    options: Sequence[np.ndarray],
    known: _Known,
    turn: np.ndarray,
    shift: np.ndarray,
) -> Registration:
    """Improves orders and frame in turn, from an initial rotation `turn` and `shift`.

    It ends when the orders do not change. `options` are the orders to choose from, for
    each recording.
    """
    weights = np.array([m.frames for m in moments]) / sum(m.frames for m in moments)
    count, chosen = moments[0].count, np.empty((0, 0), int)
    both = list(zip(moments, options, strict=True))
    for _ in range(ROUNDS):
        shifts = [known.shifts(m, o, turn, shift) for m, o in both]
        costs = [m.costs(o, turn, s) for (m, o), s in zip(both, shifts, strict=True)]
        best = [int(np.argmin(c)) for c in costs]
        orders = np.array([o[k] for o, k in zip(options, best, strict=True)])
        if np.array_equal(chosen, orders):
            break
        chosen = orders
        made = weights @ np.array([m.made.mean(0) for m in moments])
        seen = weights @ np.array([m.seen.mean(0) for m in moments])
        if known.axes is None:
            products = [
                m.paired(o[None], known.origin)[0]
                for m, o in zip(moments, chosen, strict=True)
            ]
            total = np.tensordot(weights, np.array(products), 1)
            if known.origin is None:
                total = total - count * np.outer(made, seen)
            if not _in_space(total):
                raise ValueError(
                    "the markers of all recordings are on a line, so the frame of the "
                    "camera cannot be found: give its axes"
                )
            turn = _rotations(total)
        shift = made - _turned(turn, seen)
    least = np.array([np.min(c) for c in costs])
    ratios = [np.sqrt(np.partition(c, 1)[1] / np.min(c)) for c in costs if len(c) > 1]
    return Registration(
        orders=chosen,
        rotation=turn,
        shifts=np.array([s[k] for s, k in zip(shifts, best, strict=True)]),
        distance=float(np.sqrt(weights @ least / count)),
        margin=float(min(ratios, default=np.inf)),
    )


def _turned(turn: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Rotates points `(..., 3)` by the matrix `turn`, or by each of several."""
    return np.sum(turn * points[..., None, :], axis=-1)


def _in_space(products: np.ndarray) -> bool:
    """Whether points with the sum `products` of p q^T determine a rotation.

    They do not if they are on a line.
    """
    sizes = np.linalg.svd(products, compute_uv=False)
    return bool(sizes[1] > ON_A_LINE * sizes[0])


def _rotations(products: np.ndarray) -> np.ndarray:
    """Rotations R `(..., 3, 3)` that minimise sum |R q - p|^2, from sum p q^T."""
    u, _, vt = np.linalg.svd(products)
    proper = np.ones(products.shape[:-1])
    proper[..., 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    return (u * proper[..., None, :]) @ vt
