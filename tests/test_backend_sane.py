"""The compiler that the other tests rely on computes right."""

import jax
import numpy as np
import pytest

from jaxrod.installation import doctor

CPU = jax.devices("cpu")[0]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_large_batches_of_products_have_no_wrong_rows(dtype):
    check = doctor.check_batched_products(CPU, dtype)
    assert check.ok, check.detail


def test_compensation_of_a_float32_sum_is_not_optimised_away():
    check = doctor.check_compensated_sum(CPU)
    assert check.ok, check.detail


def test_the_whole_installation_is_sound():
    failed = [check for check in doctor.run_checks() if not check.ok]
    assert not failed


@pytest.mark.gpu
def test_accelerator_computes_right():
    failed = [c for c in doctor.check_device(jax.devices()[0]) if not c.ok]
    assert not failed


@pytest.mark.default_precision
def test_float64_is_checked_even_where_it_is_off():
    assert jax.numpy.zeros(()).dtype == np.float32
    check = doctor.check_batched_products(CPU, np.float64)
    assert check.ok, check.detail
    assert "e-1" in check.detail.partition("limit ")[2], "checked to float32 only"
