"""Results of checks of this machine."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Check:
    """Result of one check."""

    name: str
    """Name of the check."""
    ok: bool
    """False if results computed here cannot be trusted."""
    detail: str
    """Findings, with numbers."""
    advice: str = ""
    """Advice on a remedy; empty if nothing is wrong or slow."""
