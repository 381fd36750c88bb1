"""Refuses the releases of JAX that are known to compute wrong numbers or to crash.

Imports nothing but the standard library, so that it can run before JAX does.
The same releases are excluded in pyproject.toml, but an environment solved by
hand, or a package that pins another JAX, can still end up with one of them.
`docs/supported_versions.md` has the programs that show each fault.
"""

from __future__ import annotations

import re
from importlib import metadata

OLDEST = (0, 10, 1)
"""Oldest release of JAX that the test suite runs with."""

UNSOUND = {
    (0, 10, 2): (
        "its CPU compiler gives wrong rows for large batches of 3 x 3 products, which "
        "is what rods are made of, and crashes on weighted sums over arrays of seven "
        "axes"
    ),
    (0, 11, 0): (
        "it crashes on weighted sums over arrays of seven axes on CPUs and gives wrong "
        "numbers on some GPUs"
    ),
    (0, 11, 1): (
        "it gives wrong numbers on some GPUs, takes quadratic time on CPUs for writing "
        "an array in a loop, and flax.nnx of flax 0.12.8 cannot be imported with it"
    ),
}
"""Fault of each refused release of JAX, by release."""


class UnsoundJaxError(ImportError):
    """The installed JAX is a release that jaxrod refuses to run on."""


def release(version: str) -> tuple[int, ...]:
    """Returns the numeric release part of a version: "0.10.2.dev1" -> (0, 10, 2)."""
    match = re.match(r"\d+(\.\d+)*", version)
    return tuple(int(part) for part in match.group().split(".")) if match else ()


def fault(package: str, version: str) -> str | None:
    """Returns the reason why a version is refused, or None if it is accepted.

    Args:
        package: "jax" or "jaxlib".
        version: Version of the package, such as "0.10.2".
    """
    number = release(version)
    if number in UNSOUND:
        why = UNSOUND[number]
    elif number < OLDEST:
        oldest = ".".join(map(str, OLDEST))
        why = f"jaxrod is tested with {oldest} and newer only"
    else:
        return None
    return f"{package} {version} is refused: {why}. {remedy()}"


def remedy() -> str:
    """Returns the command that installs a sound JAX."""
    refused = ",".join("!=" + ".".join(map(str, number)) for number in UNSOUND)
    oldest = ".".join(map(str, OLDEST))
    return f'Install another with: pip install "jax>={oldest},{refused}"'


def require_sound_jax() -> None:
    """Raises if the installed jax or jaxlib is a refused release.

    Raises:
        UnsoundJaxError: If it is; the message explains the fault and how to install
            another release.
    """
    for package in ("jax", "jaxlib"):
        sentence = fault(package, metadata.version(package))
        if sentence is not None:
            raise UnsoundJaxError(sentence)
