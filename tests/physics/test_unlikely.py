"""Numbers that can hardly be meant, and states of another rod."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.rods import arm


@pytest.mark.parametrize("unit", [1.0, 1e-6, 1e6])
def test_a_radius_above_the_length_is_warned_of_in_any_unit(unit):
    rod, _ = arm(4, length=unit, radius=50 * unit)
    words = "radius of the rod.* 50 times its length"
    with pytest.warns(jaxrod.UnlikelyWarning, match=words) as warned:
        jaxrod.make_scene(rod)
    assert [one.filename for one in warned] == [__file__]


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e3])
def test_a_modulus_in_other_units_is_warned_of_where_there_is_gravity(unit):
    """Units of length: dimensionless numbers are the same in each."""
    numbers = {
        "length": unit,
        "radius": 0.01 * unit,
        "density": 1e3 / unit**3,
        "youngs_modulus": 10.0 / unit,
    }
    rod, _ = arm(4, **numbers)
    weight = jaxrod.gravity((0.0, 0.0, -9.81 * unit))
    words = "is 981 times its stiffness"
    with pytest.warns(jaxrod.UnlikelyWarning, match=words) as warned:
        jaxrod.make_scene(rod, weight)
    assert [one.filename for one in warned] == [__file__]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jaxrod.make_scene(rod)
        # Ten thousand times as stiff is soft, and may be meant.
        stiff, _ = arm(4, **numbers | {"youngs_modulus": 1.2e3 / unit})
        jaxrod.make_scene(stiff, weight)


@pytest.mark.filterwarnings("ignore::jaxrod.effects.unlikely.UnlikelyWarning")
def test_scenes_are_made_where_a_program_is_traced():
    """Numbers that are known there may be warned of, others are not looked at."""
    rod, state = arm(4, radius=50.0, youngs_modulus=10.0)
    effects = jaxrod.gravity(), jaxrod.clamp(state)
    jax.jit(lambda: jaxrod.make_scene(rod, *effects))()
    jax.vmap(lambda rod: jaxrod.make_scene(rod, *effects))(
        jax.tree.map(lambda leaf: leaf[None], rod)
    )


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    "hold",
    [
        jaxrod.clamp,
        jaxrod.fixed_end,
        jaxrod.pin_support,
        jaxrod.driven,
        lambda state: jaxrod.hinge_support(state, (0.0, 0.0, 1.0)),
    ],
)
def test_a_support_made_from_another_rods_state_is_refused(hold):
    rod, state = arm(4)
    finer, other = arm(7)
    with pytest.raises(ValueError, match="state has 7 elements, the rod 4"):
        jaxrod.make_scene(rod, hold(other))
    jaxrod.make_scene(rod, hold(state))
    jaxrod.make_scene(finer, hold(state).resampled(rod, finer))


@pytest.mark.parametrize("size", [1e300, 1e-300])
def test_a_direction_of_any_length_is_one(size):
    wanted = np.array([3.0, 0.0, 4.0]) / 5
    _, state = arm(4, direction=tuple(size * wanted))
    np.testing.assert_allclose(state.tip, wanted, atol=1e-15)
    assert state.positions.dtype == jnp.float64
