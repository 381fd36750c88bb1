"""PyElastica's contact of two rods: the forces of each act on that rod."""

import jax
import numpy as np

import jaxrod
from benchmarks.plectoneme.element_contact import element_contact
from jaxrod.systems.stepping.assembly import seen_at_rest
from systems.members import rod


def test_crossing_rods_are_pushed_apart_each_where_it_is_touched():
    """The lower one along x has five elements, the upper one along y has three."""
    below, at_below = rod(5, 0.5, (-0.25, 0.0, 0.0), (1, 0, 0))
    above, at_above = rod(3, 0.3, (0.0, -0.15, 0.035), (0, 1, 0))
    system = jaxrod.make_system(
        {"below": jaxrod.make_scene(below), "above": jaxrod.make_scene(above)},
        element_contact("below", "above", stiffness=1e4),
    )

    @jax.jit
    def forces(state):
        seen, (contact,) = seen_at_rest(system, state)
        loads = contact.loads(seen)
        return loads["below"].forces, loads["above"].forces

    down, up = map(np.stack, forces({"below": at_below, "above": at_above}))
    assert down.shape == (3, 6) and up.shape == (3, 4)
    assert np.sum(down[2]) < -1.0
    np.testing.assert_allclose(np.sum(down, axis=1), -np.sum(up, axis=1), atol=1e-12)
    # Elements in the middle touch, and pass on to their two nodes.
    assert np.all(down[2, [2, 3]] < -0.1) and np.all(up[2, [1, 2]] > 0.1)
