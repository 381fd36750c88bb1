"""Checks that this machine computes correctly.

Compilers have bugs, and a wrong number looks like any other number. Each check
here runs a small program whose right answer is known, or reports a setting that
changes answers. The command `jaxrod doctor` prints the result, and the test suite
asserts that every check passes.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxrod.installation import jax_version
from jaxrod.installation.machine import available_cores, processor
from jaxrod.installation.program_cache import (
    MOST_BYTES,
    chosen_folder,
    kept_files,
    obstacle,
)

if TYPE_CHECKING:
    import jax

CALLS = 8
"""Number of calls of one program whose results are compared with the first call."""

ALL_BUT_NOTHING = 0.05
"""Largest free fraction of a device's memory that is reported as almost none [1]."""


@dataclass(frozen=True)
class Check:
    """Result of one check."""

    name: str
    """Name of the check."""
    ok: bool
    """False if results computed here cannot be trusted."""
    detail: str
    """Measured numbers and facts, as text."""
    advice: str = ""
    """Advice on how to improve the result; empty if nothing is wrong or slow."""


def run_checks() -> list[Check]:
    """Runs every check and returns the results; prints nothing.

    A check that raises an exception counts as failed, so a broken installation is
    described in the list and raises nothing.
    """
    checks = [_guard("versions", check_versions)]
    found = _guard("devices", check_devices)
    checks.append(found)
    if found.ok:
        for device in _one_device_per_platform():
            checks += check_device(device)
    checks.append(_guard("lanes", check_lanes))
    checks.append(_guard("compiled programs", check_program_cache))
    checks.append(_guard("default precision", check_default_precision))
    checks.append(check_processors())
    return checks


def check_device(device: jax.Device) -> Iterator[Check]:
    """Yields the checks that run a program on one device."""
    where = f" on {device.platform}"
    for dtype in (np.float32, np.float64):
        name = f"batched products, {np.dtype(dtype).name}{where}"
        yield _guard(name, partial(check_batched_products, device, dtype))
    yield _guard("compensated sum" + where, partial(check_compensated_sum, device))
    yield _guard("matrix products" + where, partial(check_matrix_products, device))
    yield _guard("equal bits" + where, partial(check_repeatability, device))
    fraction = os.environ.get("XLA_PYTHON_CLIENT_MEM_FRACTION", "")
    memory = check_memory(device.platform, device.memory_stats(), fraction)
    if memory is not None:
        yield memory


def check_versions() -> Check:
    """Checks that all packages of JAX are sound and of one series, such as 0.12."""
    versions = {name: metadata.version(name) for name in ("jax", "jaxlib")}
    for plugin in ("jax-cuda12-plugin", "jax-cuda13-plugin", "jax-rocm7-plugin"):
        try:
            versions[plugin] = metadata.version(plugin)
        except metadata.PackageNotFoundError:
            continue
    versions["numpy"] = np.__version__
    detail = ", ".join(f"{name} {version}" for name, version in versions.items())
    detail += f", Python {platform.python_version()}"
    for package in ("jax", "jaxlib"):
        sentence = jax_version.fault(package, versions[package])
        if sentence is not None:
            return Check("versions", False, detail, sentence)
    series = jax_version.release(versions["jax"])[:2]
    for package, version in versions.items():
        if package.startswith("jax") and jax_version.release(version)[:2] != series:
            advice = (
                f"jax {versions['jax']} and {package} {version} are of different "
                f"series. Install matching ones with: pip install "
                f'"jax=={versions["jax"]}" "{package}=={versions["jax"]}"'
            )
            return Check("versions", False, detail, advice)
    return Check("versions", True, detail)


def check_devices() -> Check:
    """Lists the devices that JAX sees."""
    import jax

    devices = jax.devices()
    kinds = sorted({f"{device.platform} ({device.device_kind})" for device in devices})
    return Check("devices", True, f"{len(devices)} x {', '.join(kinds)}")


def check_batched_products(
    device: jax.Device, dtype: type[np.float32] | type[np.float64]
) -> Check:
    """Compares |M r|^2 for a batch of vectors r with NumPy.

    This is the program that jax 0.10.2 compiles wrongly on CPUs: in a batch of
    40 001, the rows after 32 768 (float32) or 16 384 (float64) come out wrong.
    """
    import jax
    import jax.numpy as jnp

    rows = 40_001
    name = f"batched products, {np.dtype(dtype).name} on {device.platform}"
    matrix = np.array([[0.9, -0.1, 0.2], [0.3, 1.1, -0.4], [-0.2, 0.5, 0.8]], dtype)
    vectors = np.random.default_rng(0).standard_normal((rows, 3)).astype(dtype)
    # 64-bit types must be on both when the arrays are made and when compiling.
    with jax.enable_x64(True) if dtype == np.float64 else nullcontext():
        put = jax.device_put((matrix, vectors), device)
        squares = jax.vmap(lambda m, r: jnp.sum((m @ r) ** 2), in_axes=(None, 0))
        with jax.default_matmul_precision("highest"):
            got = np.asarray(jax.jit(squares)(*put), np.float64)
    exact = np.sum((vectors.astype(np.float64) @ matrix.astype(np.float64).T) ** 2, 1)
    error = float(np.max(np.abs(got - exact)) / np.max(exact))
    limit = 64 * float(np.finfo(dtype).eps)
    detail = f"relative error {error:.1e} (limit {limit:.1e}, {rows} rows)"
    if error <= limit:
        return Check(name, True, detail)
    wrong = int(np.sum(np.abs(got - exact) > limit * np.max(exact)))
    return Check(
        name,
        False,
        f"{detail}; {wrong} rows are wrong",
        "The compiler gives wrong numbers. " + jax_version.remedy(),
    )


def check_compensated_sum(device: jax.Device) -> Check:
    """Adds 1e-8 to 1 a million times in float32, with Kahan's compensation.

    A plain float32 sum stays at exactly 1. A compiler that treats floating-point
    addition as associative removes the compensation and gives 1 as well.
    """
    import jax

    name = f"compensated sum on {device.platform}"
    additions, per_turn = 1_000_000, 10

    def turn(_: int, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        total, lost = carry
        for _ in range(per_turn):
            term = increment - lost
            bigger = total + term
            lost = (bigger - total) - term
            total = bigger
        return total, lost

    def add_up(start: jax.Array, turns: int) -> jax.Array:
        return jax.lax.fori_loop(0, turns, turn, (start, 0 * start))[0]

    # Several lanes, so that vector instructions are compiled and checked, too.
    start = jax.device_put(np.ones(16, np.float32), device)
    increment = jax.device_put(np.full(16, 1e-8, np.float32), device)
    got = np.asarray(jax.jit(add_up)(start, additions // per_turn), np.float64)
    exact = 1 + additions * float(np.float32(1e-8))
    error = float(np.max(np.abs(got - exact)))
    detail = f"error {error:.1e} after {additions} additions of 1e-8"
    if error <= 2e-7:
        return Check(name, True, detail)
    return Check(
        name,
        False,
        detail,
        "The compiler reorders floating-point operations, so compensated float32 "
        "states drift. Remove fast-math options from XLA_FLAGS.",
    )


def check_matrix_products(device: jax.Device) -> Check:
    """Measures the precision of float32 matrix products at the default setting.

    GPUs may round the factors to TF32, which keeps 10 bits. The rod equations
    are written without matrix products for that reason; policy networks are not.
    """
    import jax
    import jax.numpy as jnp

    a, b = np.random.default_rng(0).standard_normal((2, 64, 64)).astype(np.float32)
    put = jax.device_put((a, b), device)
    got = np.asarray(jax.jit(jnp.matmul)(*put), np.float64)
    exact = a.astype(np.float64) @ b.astype(np.float64)
    error = float(np.max(np.abs(got - exact)) / np.max(np.abs(exact)))
    # Through a variable: the type stubs of some releases lack this option.
    option = "jax_default_matmul_precision"
    setting = getattr(jax.config, option) or "default"
    detail = f"float32 relative error {error:.1e} (precision setting: {setting})"
    advice = ""
    if error > 1e-5:
        advice = (
            "Matrix products use fewer than 24 bits here. Rods are not affected; for "
            "exact networks set JAX_DEFAULT_MATMUL_PRECISION=highest."
        )
    return Check(f"matrix products on {device.platform}", error < 0.05, detail, advice)


def check_memory(
    platform: str, stats: Mapping[str, int] | None, setting: str
) -> Check | None:
    """Reports how much memory of a device JAX may take, and how much of it is free.

    Args:
        platform: Platform of the device.
        stats: Result of `jax.Device.memory_stats`, in bytes; None if there is none, as
            on CPUs.
        setting: `XLA_PYTHON_CLIENT_MEM_FRACTION`, "" if it is not set.

    Returns:
        The check; None if there is nothing to report.
    """
    limit = (stats or {}).get("bytes_limit", 0)
    if not stats or not limit:
        return None
    used = stats.get("bytes_in_use", 0)
    part = f"{setting} of the device" if setting else "three quarters of the device"
    detail = f"{limit / 1e9:.1f} GB for JAX ({part}), {used / 1e9:.1f} GB in use"
    advice = ""
    if limit - used < ALL_BUT_NOTHING * limit:
        advice = "Almost no memory is free: end other programs on this device."
    return Check(f"memory on {platform}", True, detail, advice)


def check_repeatability(device: jax.Device) -> Check:
    """Calls one program several times and compares the bits of its results.

    It adds many numbers to few places, multiplies matrices and sums, as gradients of
    networks do. On GPUs additions to one place happen in arbitrary order by default. A
    run that is repeated or resumed then agrees up to round-off, but not bit by bit.
    """
    import jax
    import jax.numpy as jnp

    draws = np.random.default_rng(0)
    values = draws.standard_normal((1 << 14, 8)).astype(np.float32)
    places = draws.integers(0, 7, 1 << 14)

    def program(values: jax.Array, places: jax.Array) -> tuple[jax.Array, ...]:
        sums = jnp.zeros((7, 8), values.dtype).at[places].add(values)
        return sums, values.T @ values, jnp.sum(jnp.tanh(values))

    put = jax.device_put((values, places), device)
    compiled = jax.jit(program)
    different = calls_that_differ(lambda: [np.asarray(x) for x in compiled(*put)])
    detail = f"{different} of {CALLS} calls of one program gave different bits"
    advice = ""
    if different:
        advice = (
            "Runs repeat only up to round-off here, and a resumed run may differ from "
            "an uninterrupted one. For equal bits, at lower speed: "
            "XLA_FLAGS=--xla_gpu_deterministic_ops=true."
        )
    return Check(f"equal bits on {device.platform}", True, detail, advice)


def calls_that_differ(call: Callable[[], list[np.ndarray]], calls: int = CALLS) -> int:
    """Returns the number of calls whose results differ from the first in any bit.

    Args:
        call: Function that returns arrays, of the same shapes each time.
        calls: Number of calls, not counting the first.
    """
    first = [array.tobytes() for array in call()]
    return sum([array.tobytes() for array in call()] != first for _ in range(calls))


def check_lanes() -> Check:
    """Compares a batch of steps in lanes with NumPy, or reports why lanes are off.

    Lanes are compiled code in which each entry of a vector register advances one rod of
    the batch. On a GPU, each warp of 32 threads advances one scene of the batch.
    """
    import jax
    import jax.numpy as jnp

    from jaxrod.lanes.choice import ALWAYS, lane_choices, lane_mode, slower, use_lanes
    from jaxrod.lanes.llvm.machine_code import vector_bytes
    from jaxrod.lanes.steps import try_lanes

    words = slower()
    if words is not None:
        advice = f"{words} Numbers are the same; docs/performance.md says more."
        return Check("lanes", True, "off", advice)

    @jax.tree_util.register_dataclass
    @dataclass(frozen=True)
    class Decay:
        """Test integrator: each cycle replaces a value by factor * value + 1."""

        factor: Any

        def begin(self, value: Any) -> Any:
            return value

        def cycle(self, value: Any) -> Any:
            return self.factor * value + 1

        def end(self, value: Any) -> Any:
            return value

    factors = np.linspace(0.1, 0.9, 9, dtype=np.float32)
    starts = np.linspace(-3.0, 3.0, 9, dtype=np.float32)
    before = lane_mode()
    use_lanes(ALWAYS)
    try:
        run = lambda factor, start: try_lanes(Decay(factor), start, 10)
        got = np.asarray(jax.jit(jax.vmap(run))(jnp.asarray(factors), starts))
    finally:
        use_lanes(before)
    exact = starts.astype(np.float64)
    for _ in range(10):
        exact = factors * exact + 1
    error = float(np.max(np.abs(got - exact)))
    choice = lane_choices()[-1]
    kind = f"vectors of {vector_bytes()} bytes"
    if jax.default_backend() != "cpu":
        kind = "warps of the GPU"
    detail = f"{kind}, error {error:.1e} after 10 steps"
    if not choice.taken:
        return Check("lanes", True, "off", f"Batches run in XLA: {choice.why}.")
    if error < 1e-5:
        return Check("lanes", True, detail)
    advice = "Lanes give wrong numbers here. Set JAXROD_LANES=never and report it."
    return Check("lanes", False, detail, advice)


def check_program_cache() -> Check:
    """Reports the folder of kept compiled programs, their number and total size."""
    import jax

    settings: Any = jax.config
    given = settings.jax_compilation_cache_dir
    why = None if given else obstacle()
    if why is not None:
        return Check("compiled programs", True, "not kept", f"Not kept: {why}.")
    folder = Path(given or chosen_folder())
    files = kept_files(folder) if folder.is_dir() else []
    size = sum(size for _, size, _ in files)
    detail = f"{len(files)} files, {1e-6 * size:.1f} MB of {1e-6 * MOST_BYTES:,.0f} MB"
    return Check("compiled programs", True, f"{detail} in {folder}")


def check_default_precision() -> Check:
    """Reports the floating-point dtype that arrays get by default."""
    import jax.numpy as jnp

    default = np.dtype(jnp.zeros(()).dtype).name
    return Check(
        "default precision",
        True,
        f"{default} (JAX_ENABLE_X64=1 makes it float64)"
        if default == "float32"
        else default,
    )


def check_processors() -> Check:
    """Reports the processor, the number of usable cores, and XLA's options."""
    usable = available_cores()
    flags = os.environ.get("XLA_FLAGS", "").strip() or "none"
    detail = f"{processor()}, {usable} of {os.cpu_count()} usable; XLA_FLAGS: {flags}"
    fast_math = "xla_cpu_enable_fast_math" in flags and "fast_math=false" not in flags
    advice = "Remove the fast-math option from XLA_FLAGS." if fast_math else ""
    return Check("processors", not fast_math, detail, advice)


def _one_device_per_platform() -> list[jax.Device]:
    """Returns the default device and, if that is not a CPU, also a CPU."""
    import jax

    devices = [jax.devices()[0]]
    if devices[0].platform != "cpu":
        try:
            devices.append(jax.devices("cpu")[0])
        except RuntimeError:  # JAX_PLATFORMS leaves the CPU out
            pass
    return devices


def _guard(name: str, check: Callable[[], Check]) -> Check:
    """Runs a check; an exception becomes a failed check called `name`."""
    try:
        return check()
    except Exception as error:
        sentence = f"did not run: {type(error).__name__}: {error}"
        return Check(name, False, sentence, "Reinstall JAX for this machine.")
