"""No value becomes another one on its way into a scene; none is refused wordlessly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from extremes.factories import all_cases, fault_of
from extremes.values import QUICK


def faults(labels):
    found = ((case, fault_of(case, wrong)) for case, wrong in all_cases(labels))
    return [f"{case}: {fault}" for case, fault in found if fault]


@pytest.mark.default_precision
def test_bad_and_extreme_values_are_refused_by_name_or_kept():
    assert not faults(QUICK)


@pytest.mark.slow
@pytest.mark.default_precision
def test_more_bad_and_extreme_values():
    assert not faults(None)


def stable_step(dtype, **properties):
    rod, state = jaxrod.straight_rod(4, dtype=dtype, **properties)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state))
    return float(jaxrod.stable_dt(scene).dt)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::jaxrod.effects.unlikely.UnlikelyWarning")
def test_a_rod_of_any_size_is_refused_or_steps_as_in_double_precision():
    """Sizes, densities and stiffnesses over dozens of powers of ten."""
    random = np.random.default_rng(0)
    refused = 0
    for _ in range(200):
        length = 10 ** random.uniform(-12, 12)
        properties = {
            "length": length,
            "radius": length * 10 ** random.uniform(-4, 0.5),
            "density": 10 ** random.uniform(-6, 6),
            "youngs_modulus": 10 ** random.uniform(-6, 16),
            "poisson_ratio": random.uniform(-0.99, 0.5),
        }
        try:
            single = stable_step(jnp.float32, **properties)
        except ValueError as refusal:
            assert "in float32, got" in str(refusal)
            refused += 1
            continue
        double = stable_step(jnp.float64, **properties)
        np.testing.assert_allclose(single, double, rtol=1e-4, err_msg=properties)
    assert 20 < refused < 150, "too few of both to learn from"


def test_a_rod_too_small_for_single_precision_says_what_to_do():
    """Second moments of area of 1e-35 m^4: fit for float64 alone."""
    properties = {"radius": 2e-9, "density": 1e3, "youngs_modulus": 1e7}
    with pytest.raises(ValueError, match=r"radius\^4.*got.*kg m\^2.*jax_enable_x64"):
        stable_step(jnp.float32, length=5e-8, **properties)
    step = stable_step(jnp.float64, length=5e-8, **properties)
    like = stable_step(jnp.float64, length=1.0, **properties | {"radius": 0.04})
    np.testing.assert_allclose(step, 5e-8 * like, rtol=1e-12)


@pytest.mark.default_precision
def test_a_rod_far_from_the_origin_for_its_precision_is_refused():
    make = lambda dtype, x: jaxrod.straight_rod(
        20,
        length=1.0,
        radius=0.05,
        density=1e3,
        youngs_modulus=1e7,
        start=(x, 0.0, 0.0),
        dtype=dtype,
    )
    make(jnp.float32, 1e3)
    with pytest.raises(
        ValueError, match=r"start must be nearer to the origin.*elements"
    ):
        make(jnp.float32, 1e5)
    with jax.enable_x64(True):
        make(jnp.float64, 1e5)
