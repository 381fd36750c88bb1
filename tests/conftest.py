"""Shared test set-up: strict JAX, both precisions, and what to skip where."""

import ctypes
import gc
import os
import shutil
import tempfile
from collections import Counter

# Every worker of a parallel run computes on one thread, so that two workers on two
# cores do not fight. These are read when the libraries start, hence before imports.
if "PYTEST_XDIST_WORKER" in os.environ:
    for variable in ("OMP_NUM_THREADS", "NPROC", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
os.environ.setdefault("MPLBACKEND", "Agg")
# Nothing is kept for programs outside of the tests.
os.environ.setdefault("JAXROD_CACHE", "0")

import jax
import pytest

from jaxrod.installation.backend import with_backend_options

# Compiled as jaxrod does for its users: twice as fast to compile. In force for this
# process and those it starts, so that both compute the same to the last bit. JAX
# reads it when it first computes, hence here, before any test module is imported.
os.environ["XLA_FLAGS"] = with_backend_options(os.environ.get("XLA_FLAGS", ""))

# Many tests compile the same programs: what this process or one that it starts has
# compiled is kept until its tests end. One folder for each worker, because JAX does
# not write whole files at once; a program that runs some tests again and again, one
# process at a time, names a folder of its own.
_compiled = tempfile.TemporaryDirectory(prefix="jaxrod-compiled-")
for name, value in {
    "jax_compilation_cache_dir": os.environ.get(
        "JAXROD_TESTS_COMPILED", _compiled.name
    ),
    "jax_persistent_cache_min_compile_time_secs": 0.3,
}.items():
    jax.config.update(name, value)
    os.environ[name.upper()] = str(value)

# 64-bit types exist in every test and dtypes are passed explicitly, so that one
# process tests both precisions. Tests marked `default_precision` run without.
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

MAY_BE_SKIPPED = {
    "no Chromium is installed": "the player in a browser, where there is no browser",
    "JAX sees no accelerator": "runs on a GPU, where there is none",
    "the sb3 extra is not installed": "the adapter for Stable Baselines 3, without "
    "the extra `sb3`: PyTorch may come with CUDA, which takes gigabytes",
    "PyTorch is not installed": "tensors of PyTorch, and learners that use them",
    "RSL-RL is not installed": "a learner of RSL-RL",
    "skrl is not installed": "a learner of skrl",
    "rejax is not installed": "a learner of rejax, whose gymnax wants an older JAX",
    "could not import 'ray'": "sweeps on a Ray cluster, without the extra `ray`",
    "could not import 'moviepy'": "films by Gymnasium, without the extra `video`",
    "could not import 'yaml'": "descriptions of clusters, where nothing reads YAML",
    "PyElastica has no such drag": "a comparison with slender-body theory, where "
    "PyElastica was built without it",
    "nothing is kept without a checksum": "programs kept on disk, where jaxrod keeps "
    "none because JAX does not check what it reads",
    "no C compiler is installed": "exported headers, where nothing compiles C",
    "no zsh is installed": "completion in zsh, where there is no such shell",
    "Windows has no owners and modes": "folders that others can write to, on Windows",
    "no free port": "several processes, where every port that was tried is taken",
    "effects that do not go together": "draws of random scenes that are refused",
}
"""Beginnings of reasons, and what is then not tested. Any other skip is a failure: it
would hide a feature."""
CHROMIUM_NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")


def chromium_path() -> str | None:
    """Returns the path of an installed Chromium, or None."""
    return next(filter(None, map(shutil.which, CHROMIUM_NAMES)), None)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Skips what this machine cannot run, and says why; marks sets that are slow."""
    sets = Counter()
    for item in items:
        marker = item.get_closest_marker("fast_sets")
        if marker and not item.get_closest_marker("slow"):
            test = item.nodeid.partition("[")[0]
            sets[test] += 1
            if sets[test] > marker.args[0]:
                item.add_marker(pytest.mark.slow)
    missing = {
        "browser": lambda: None if chromium_path() else "no Chromium is installed",
        "gpu": lambda: (
            None if jax.default_backend() != "cpu" else "JAX sees no accelerator"
        ),
    }
    for marker, reason in missing.items():
        marked = [item for item in items if item.get_closest_marker(marker)]
        why = reason() if marked else None
        if why:
            for item in marked:
                item.add_marker(pytest.mark.skip(reason=why))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """Makes failures of skips that are not listed."""
    return refused_skip((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """Makes failures of files that are skipped for reasons that are not listed."""
    return refused_skip((yield))


def refused_skip(report):
    """The report of a test, failed if it was skipped for a reason not listed above."""
    if not report.skipped or hasattr(report, "wasxfail"):
        return report
    reason = report.longrepr[-1].removeprefix("Skipped: ")
    if not reason.startswith(tuple(MAY_BE_SKIPPED)):
        report.outcome = "failed"
        report.longrepr = (
            f"skipped ({reason}), which would hide a feature: tests/conftest.py lists "
            "what may be skipped"
        )
    return report


@pytest.fixture(autouse=True)
def precision(request):
    """Turns 64-bit types off in tests marked `default_precision`."""
    with jax.enable_x64(request.node.get_closest_marker("default_precision") is None):
        yield


@pytest.fixture(autouse=True, scope="module")
def memory():
    """Gives back what compiled programs hold, before there is too much of it."""
    yield
    if resident_bytes() > MOST_BYTES:
        jax.clear_caches()
        gc.collect()
        # What the compiler has freed is kept by the C library until it is told.
        ctypes.CDLL(None).malloc_trim(0)


MOST_BYTES = 2e9
"""Of memory in use at the end of a file of tests."""


def resident_bytes() -> int:
    """Memory that this process has in use; 0 where it cannot be told."""
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    """Runs a test once in each precision."""
    return jax.numpy.dtype(request.param)


@pytest.fixture(scope="session")
def chromium():
    """The path of an installed Chromium; for tests marked `browser`."""
    return chromium_path()


@pytest.fixture
def compiled_for_cpus():
    """Compiles for CPUs, even beside a GPU: only there does XLA count operations."""
    with jax.default_device(jax.devices("cpu")[0]):
        yield
