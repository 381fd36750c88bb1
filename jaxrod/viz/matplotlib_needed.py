"""The message where matplotlib is not installed."""

from __future__ import annotations


def need_matplotlib() -> None:
    """Raises, with the command that installs it, if matplotlib is missing.

    Raises:
        ModuleNotFoundError: It is.
    """
    try:
        # Only to see whether it is there.
        import matplotlib  # noqa: F401
    except ModuleNotFoundError as missing:
        if missing.name != "matplotlib":
            raise
        raise ModuleNotFoundError(
            'pictures need matplotlib; install it with: pip install "jaxrod[viz]"',
            name="matplotlib",
        ) from missing
