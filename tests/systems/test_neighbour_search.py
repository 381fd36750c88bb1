"""The neighbour search finds the pairs that a comparison of all pairs finds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxrod.lanes.choice import lane_choices, lane_mode, use_lanes
from jaxrod.lanes.steps import by_kernel
from jaxrod.structure import pytree, static
from jaxrod.systems.contact import neighbour_search
from jaxrod.systems.contact.element_pairs import Bounds, Elements
from jaxrod.systems.contact.neighbour_lists import NeighbourLists
from jaxrod.systems.contact.neighbour_search import candidates, everything, found_by


@pytest.fixture(autouse=True)
def mode():
    """Sets the mode of lanes back that other tests expect."""
    before = lane_mode()
    yield
    use_lanes(before)


@pytree
class Search:
    """A search among two sets of elements, or within the first."""

    own: Bounds
    other: Bounds
    how: NeighbourLists = static()
    once: bool = static()

    def found(self, shift):
        """Lists and counts, with the first elements moved along x by `shift`."""
        x, y, z = self.own.elements.first
        elements = Elements((x + shift, y, z), *self._rest(self.own.elements))
        own = Bounds(elements, self.own.reach, self.own.numbers)
        every, views = (own, self.other), ((0, 0),) if self.once else ((0, 1),)
        free = lambda a, b, one, two: None
        return found_by(self.how, every, views, free, (), once=self.once)

    def _rest(self, elements):
        return elements.edge, elements.radii, elements.follows


def elements(n, seed):
    """Short elements in a box, most of them near one corner."""
    rng = np.random.default_rng(seed)
    first = rng.uniform(0, 1, (3, n)) ** 2
    edge = 0.1 * rng.normal(size=(3, n))
    radii = jnp.asarray(rng.uniform(0.01, 0.06, n))
    vector = lambda v: tuple(map(jnp.asarray, v))
    made = Elements(vector(first), vector(edge), radii, jnp.ones(n))
    return Bounds(made, 1.5 * radii, jnp.arange(n, dtype=radii.dtype))


def nearest(a, b, c, d):
    """Smallest distance of points along segments, from a fine grid of both."""
    s = np.linspace(0, 1, 21)[:, None]
    p, q = a + s * (b - a), c + s * (d - c)
    return np.sqrt(((p[:, None] - q[None]) ** 2).sum(-1).min())


def by_comparison(own, other, once):
    """Pairs within reach, and those that the grid of points cannot decide."""
    one, two = (np.stack(b.elements.first).T for b in (own, other))
    ahead, behind = (np.stack(b.elements.edge).T for b in (own, other))
    sure, open_ = set(), set()
    for i in range(len(one)):
        for j in range(i + 1 if once else 0, len(two)):
            ends = one[i], one[i] + ahead[i], two[j], two[j] + behind[j]
            reach = float(own.reach[i] + other.reach[j])
            distance = nearest(*ends)
            if distance < reach:
                sure.add((i, j))
            elif distance < reach + 0.01:
                open_.add((i, j))
    return sure, open_


@pytest.mark.parametrize("once", [True, False])
def test_all_pairs_within_reach_are_found_and_no_others(once, monkeypatch):
    """In kernels and by XLA; in a grid of cells with blocks, and with neither."""
    own, other = elements(70, 0), elements(45, 1)
    sure, undecided = by_comparison(own, own if once else other, once)
    assert len(sure) > 40
    sizes = {"pairs": 300, "candidates": 900, "refresh_every": 1}
    for mode in ("rows", "never"):
        for slots, block in ((0, 1024), (40, 64)):
            monkeypatch.setattr(neighbour_search, "BLOCK", block)
            how = NeighbourLists(jnp.asarray(1.0), cell_slots=slots, **sizes)
            use_lanes(mode)
            run = jax.jit(lambda search, x: by_kernel(search, "found", x))
            found = run(Search(own, other, how, once), jnp.zeros(()))
            assert mode == "never" or lane_choices()[-1].taken
            (listed,) = found.lists
            there = np.asarray(listed.there)
            both = np.stack([listed.own, listed.other])
            pairs = list(zip(*both[:, there].tolist(), strict=True))
            assert len(set(pairs)) == len(pairs) == int(found.used[0])
            assert sure <= set(pairs) <= sure | undecided
            assert float(found.missed) <= 0
            assert not both[:, ~there].any()


def test_a_search_of_more_pairs_than_indices_is_refused():
    many = jax.eval_shape(lambda: elements(50_000, 0))
    with pytest.raises(ValueError, match=r"50000 elements .* more than 2\^31 pairs"):
        jax.eval_shape(
            lambda own: candidates(own, own, everything(own, own), 100, once=True), many
        )
