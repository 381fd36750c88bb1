r"""Registration: which recorded marker is which, and where the camera's frame is.

The drawing predicts the places $p_{rj}$ of the markers in every recording. Recorded
points $q_{rj}$ are one rotation and one shift away, in an order that may differ from
recording to recording:

$$\min_{R, t, \pi_r} \sum_{r, j} |R\,q_{r\pi_r(j)} + t - p_{rj}|^2.$$

For every order of every recording, rotation and shift follow from a singular value
decomposition. Those of the best orders are tried on all recordings, whose own orders
follow from them; rotation, shift and orders are then improved in turn.

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
"""Markers of which all orders are tried."""
CANDIDATES = 6
"""Orders of each recording whose frames are tried on all recordings."""
ON_A_LINE = 1e-4
"""Ratio of the extent across a line to that along it, squared, below which points are
on it [1]."""
ROUNDS = 10
"""Largest number of times that orders follow from a frame."""


@dataclass(frozen=True)
class Registration:
    """Orders of the markers, and the frame of the camera.

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
    """Column of each of the arm's markers, in each recording."""
    rotation: Float[np.ndarray, "3 3"]
    """Matrix that turns recorded vectors into the arm's frame."""
    shifts: Float[np.ndarray, "recordings 3"]
    """Place of the recorded origin in the arm's frame, in each recording [m]."""
    distance: float
    """Root mean square distance of the markers from their predictions [m]."""
    margin: float
    """Smallest ratio, over the recordings, of the distance with the second best order
    to that with the best [1]. Close to one, the labels are a guess."""

    def apply(self, recording: Recording, number: int) -> Recording:
        """A recording with its markers in the arm's order and frame."""
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
    """Finds labels and frame of recordings from predictions of the same frames.

    Args:
        recordings: The recordings.
        predictions: Predicted places of the markers `(frames, markers, 3)` of each [m].
        axes: Rotation from the camera's frame, if it is known `(3, 3)`.
        shift: Place of the recorded origin in the arm's frame, if it is known `(3,)`
            [m].
        origin: Number of the marker whose predicted place is exact in every recording,
            if there is one. Each recording then has a shift of its own.

    Raises:
        ValueError: If there are too many markers to try all orders, or no frame of a
            recording has all of them.

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
            f"labels of at most {MOST_MARKERS} markers can be found, got {count}: name "
            "the columns of the recordings after the arm's markers"
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
    """Means over the frames of a recording in which all markers were seen."""

    frames: int
    seen: Float[np.ndarray, "markers 3"]
    """Mean of each recorded point [m]."""
    made: Float[np.ndarray, "markers 3"]
    """Mean of each predicted point [m]."""
    squares: Float[np.ndarray, "markers markers"]
    """Mean square of recorded point i plus that of predicted point j [m^2]."""
    products: Float[np.ndarray, "markers markers 3 3"]
    """Mean of predicted point j times recorded point i [m^2]."""

    @property
    def count(self) -> int:
        """Number of markers."""
        return len(self.made)

    def costs(self, options: np.ndarray, turn: np.ndarray, shifts: np.ndarray) -> Any:
        """Sum of squared distances for each order, each with its own shift [m^2]."""
        away = _turned(turn, self.seen).sum(axis=0) - self.made.sum(axis=0)
        moved = np.sum(shifts * (self.count * shifts + 2 * away), axis=-1)
        table = self.squares - 2 * np.sum(turn * self.products, axis=(-1, -2))
        found = moved + np.sum(table[options, np.arange(self.count)], axis=-1)
        # Less is the rounding of the squares.
        return np.maximum(found, np.finfo(float).eps * self.squares.max())

    def paired(self, options: np.ndarray, origin: int | None) -> np.ndarray:
        """Products of paired points, summed over the markers, for each order.

        They are those of vectors from a marker, if one is the origin.
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
            "which is needed where labels or the frame of the camera are not known"
        )
    q, p = recording.points[whole], predicted[whole]
    squares = np.mean(np.sum(q**2, -1), 0)[:, None] + np.mean(np.sum(p**2, -1), 0)
    products = np.mean(q[:, :, None, None, :] * p[:, None, :, :, None], axis=0)
    return _Moments(int(whole.sum()), q.mean(0), p.mean(0), squares, products)


@dataclass(frozen=True)
class _Known:
    """Known parts of the frame of the camera; see `register`."""

    axes: np.ndarray | None
    shift: np.ndarray | None
    origin: int | None

    @property
    def whole(self) -> bool:
        """Whether nothing of the frame has to be found."""
        return self.axes is not None and not (self.shift is self.origin is None)

    def likely(
        self, moments: _Moments, options: np.ndarray
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Frames in which a recording fits best, one for each of its best orders."""
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
        """Shift of a recording for each order, where `found` is what orders say [m]."""
        if self.origin is not None:
            seen = moments.seen[options[:, self.origin]]
            return moments.made[self.origin] - _turned(turn, seen)
        shift = found if self.shift is None else self.shift
        return np.broadcast_to(shift, (len(options), 3))


def _as_known(
    recordings: Sequence[Recording], predictions: Sequence[np.ndarray], known: _Known
) -> Registration:
    """Registration where labels and frame are known; any marker may be missing."""
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
    """Orders for a frame, a frame for orders, in turn until the orders stay."""
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
    """Points after a rotation, or after each of several."""
    return np.sum(turn * points[..., None, :], axis=-1)


def _in_space(products: np.ndarray) -> bool:
    """Whether points determine a rotation: they are not all on a line."""
    sizes = np.linalg.svd(products, compute_uv=False)
    return bool(sizes[1] > ON_A_LINE * sizes[0])


def _rotations(products: np.ndarray) -> np.ndarray:
    """Rotations that turn recorded points best into predicted ones `(..., 3, 3)`."""
    u, _, vt = np.linalg.svd(products)
    proper = np.ones(products.shape[:-1])
    proper[..., 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    return (u * proper[..., None, :]) @ vt
