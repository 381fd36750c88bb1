"""What a check of this machine has found."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Check:
    """Result of one check."""

    name: str
    """Name of the check."""
    ok: bool
    """False when results computed here cannot be trusted."""
    detail: str
    """Findings, with numbers."""
    advice: str = ""
    """Advice on a mend; empty when nothing is wrong or slow."""
