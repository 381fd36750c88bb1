"""Drawn faults that change no number that anybody could see, each with its reason."""

from __future__ import annotations

REASONS: dict[tuple[str, str], str] = {}
"""By file and words of the change."""
