"""`jaxrod doctor` tells sound machines from unsound ones."""

import json
from importlib import metadata

import jax
import numpy as np
import pytest

from jaxrod import cli
from jaxrod.installation import doctor, jax_version

CPU = jax.devices("cpu")[0]


@pytest.fixture
def pretend_version(monkeypatch):
    """Makes the metadata of jax and jaxlib report a version."""
    real = metadata.version

    def pretend(version):
        monkeypatch.setattr(
            metadata,
            "version",
            lambda name: version if name in ("jax", "jaxlib") else real(name),
        )

    return pretend


@pytest.mark.parametrize("version", ["0.10.2", "0.11.0", "0.11.1", "0.10.0", "0.4.38"])
def test_unsound_jax_is_refused_with_the_version_the_fault_and_the_remedy(
    version, pretend_version
):
    pretend_version(version)
    with pytest.raises(jax_version.UnsoundJaxError) as caught:
        jax_version.require_sound_jax()
    sentence = str(caught.value)
    assert sentence.startswith(f"jax {version} is refused: ")
    assert "pip install" in sentence
    check = doctor.check_versions()
    assert not check.ok
    assert check.advice == sentence


@pytest.mark.parametrize("version", ["0.10.1", "0.11.2", "0.12.0.1", "0.12.1", "1.0"])
def test_sound_jax_is_accepted(version, pretend_version):
    pretend_version(version)
    jax_version.require_sound_jax()


def test_development_builds_count_as_their_release():
    assert jax_version.release("0.10.2.dev20260601+abc") == (0, 10, 2)


def test_jaxlib_of_another_series_is_reported(monkeypatch):
    real = metadata.version
    monkeypatch.setattr(
        metadata, "version", lambda name: "99.0.1" if name == "jaxlib" else real(name)
    )
    check = doctor.check_versions()
    assert not check.ok
    assert "99.0.1" in check.advice


def test_a_compiler_that_drops_rows_is_caught(monkeypatch):
    """Stands in for jax 0.10.2: one row too many comes out wrong."""
    real = jax.jit

    def wrong_last_row(function):
        return lambda *args: real(function)(*args).at[-1].set(0.0)

    monkeypatch.setattr(jax, "jit", wrong_last_row)
    check = doctor.check_batched_products(CPU, np.float32)
    assert not check.ok
    assert "1 rows are wrong" in check.detail


def test_a_compiler_that_drops_compensation_is_caught(monkeypatch):
    monkeypatch.setattr(jax, "jit", lambda _: lambda start, _: start)
    assert not doctor.check_compensated_sum(CPU).ok


def test_a_check_that_crashes_is_a_failed_check(monkeypatch):
    def crash():
        raise RuntimeError("no driver")

    monkeypatch.setattr(doctor, "check_devices", crash)
    failed = [check for check in doctor.run_checks() if not check.ok]
    assert [check.name for check in failed] == ["devices"]
    assert "no driver" in failed[0].detail


def test_fast_math_is_reported(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
    assert not doctor.check_processors().ok
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    assert doctor.check_processors().ok


def test_one_program_gives_the_same_bits_here():
    check = doctor.check_repeatability(CPU)
    assert check.detail.startswith("0 of 8 calls")
    assert not check.advice


def test_other_bits_are_counted_and_advised_on(monkeypatch):
    results = iter([0.0, 0.0, -0.0, 1.0])
    call = lambda: [np.array([next(results)])]
    assert doctor.calls_that_differ(call, 3) == 2
    monkeypatch.setattr(doctor, "calls_that_differ", lambda call: 3)
    check = doctor.check_repeatability(CPU)
    assert check.ok
    assert "deterministic_ops" in check.advice


@pytest.mark.parametrize(
    ("used", "setting", "words", "full"),
    [
        (1e9, "", "80.0 GB for JAX (three quarters of the device), 1.0 GB", False),
        (79e9, "0.9", "(0.9 of the device), 79.0 GB in use", True),
    ],
)
def test_memory_is_told_and_a_full_device_advised_on(used, setting, words, full):
    stats = {"bytes_limit": 80 * 10**9, "bytes_in_use": int(used)}
    check = doctor.check_memory("gpu", stats, setting)
    assert words in check.detail
    assert bool(check.advice) == full


def test_a_device_that_says_nothing_of_its_memory_has_no_check():
    assert doctor.check_memory("cpu", None, "") is None
    assert doctor.check_memory("gpu", {}, "") is None


def test_exit_code_and_json_agree_on_a_sound_machine(capsys):
    assert cli.main(["doctor", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["sound"] is True
    assert {"name", "ok", "detail", "advice"} == set(report["checks"][0])


def test_exit_code_is_one_and_the_text_says_what_is_wrong(monkeypatch, capsys):
    bad = doctor.Check("batched products", False, "error 0.8", "Install another.")
    monkeypatch.setattr(doctor, "run_checks", lambda: [bad])
    assert cli.main(["doctor"]) == 1
    text = capsys.readouterr().out
    assert "WRONG" in text
    assert "Install another." in text
    assert "not sound: 1 of 1" in text
