"""The error message for a missing matplotlib."""

from __future__ import annotations


def need_matplotlib() -> None:
    """Raises, with the command that installs it, if matplotlib is missing.

    Raises:
        ModuleNotFoundError: Matplotlib is missing.
    """
    try:
        # Imported only to check that it is installed.
        import matplotlib  # noqa: F401
    except ModuleNotFoundError as missing:
        if missing.name != "matplotlib":
            raise
        raise ModuleNotFoundError(
            'pictures need matplotlib; install it with: pip install "jaxrod[viz]"',
            name="matplotlib",
        ) from missing
