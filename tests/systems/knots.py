"""What knot an open rod has: the determinant of a diagram of it, closed far away."""

from __future__ import annotations

import numpy as np


def determinant(nodes, seed=0):
    """Of the closed polygon `(3, n)`: 1 for none, 3 for a trefoil.

    Every crossing of its shadow asks that twice the strand above be the sum of the two
    below; the determinant is how many ways there are to fulfil that, of one kind
    (Fox's colourings).
    """
    turned = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0] @ nodes
    edges = np.roll(turned, -1, axis=1) - turned
    flat, start = edges[:2], turned[:2]
    count = nodes.shape[1]
    area = lambda a, b: a[0] * b[1] - a[1] * b[0]
    apart = start[:, None, :] - start[:, :, None]
    across = area(flat[:, :, None], flat[:, None, :])
    with np.errstate(divide="ignore", invalid="ignore"):
        own = area(apart, flat[:, None, :]) / across
        other = area(apart, flat[:, :, None]) / across
    meet = (0 < own) & (own < 1) & (0 < other) & (other < 1)
    under = []
    for i, j in zip(*np.nonzero(meet), strict=True):
        if turned[2, i] + own[i, j] * edges[2, i] < (
            turned[2, j] + other[i, j] * edges[2, j]
        ):
            under.append((i + own[i, j], j + other[i, j]))
    under.sort()
    if len(under) < 3:
        return 1
    ends = np.array([place for place, _ in under])
    matrix = np.zeros((len(under), len(under)))
    for row, (_, above) in enumerate(under):
        # Strands are numbered by the place below another where they end.
        over = np.searchsorted(ends, above % count) % len(under)
        for strand, share in ((over, 2), (row, -1), ((row + 1) % len(under), -1)):
            matrix[row, strand] += share
    return round(abs(np.linalg.det(matrix[1:, 1:])))


def closed(nodes, far):
    """An open curve along x with straight pieces that close it, `far` aside [m]."""
    ends = nodes[:, :1], nodes[:, -1:]
    outwards = [
        np.array([[sign * far], [0.0], [0.0]]) + 0 * end
        for sign, end in zip((-1, 1), ends, strict=True)
    ]
    below = np.array([[0.0], [-2 * far], [0.0]])
    return np.concatenate(
        [nodes, outwards[1], outwards[1] + below, outwards[0] + below, outwards[0]],
        axis=1,
    )
