"""The episodes of a run, in the order in which they were completed."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxrod.envs import EpisodeRecord


class EpisodeLog:
    """Every complete training episode of a run.

    Attributes:
        returns: Sums of the rewards.
        lengths: Numbers of control steps.
        flagged: Whether a numerical health flag ended the episode.
    """

    def __init__(self) -> None:
        """Starts with no episodes."""
        self.returns: list[float] = []
        self.lengths: list[int] = []
        self.flagged: list[bool] = []

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.returns)

    def take(
        self, records: EpisodeRecord, updates: int, env_steps: int
    ) -> list[dict[str, Any]]:
        """Adds the episodes of a chunk.

        Args:
            records: On the host, shape (capacity, steps, num_envs).
            updates: Number of completed updates of the chunk.
            env_steps: Control steps of the run when the chunk ended.

        Returns:
            The new episodes, as rows of a table.
        """
        # The indices are sorted by update, then step, then environment.
        where = np.nonzero(records.finished[:updates])
        returns = [float(x) for x in records.episode_return[where]]
        lengths = [int(x) for x in records.length[where]]
        flagged = [bool(x) for x in records.flagged[where]]
        self.returns += returns
        self.lengths += lengths
        self.flagged += flagged
        return [
            {
                "env_steps": env_steps,
                "episode_return": earned,
                "length": length,
                "flagged": int(flag),
            }
            for earned, length, flag in zip(returns, lengths, flagged, strict=True)
        ]

    def restore(self, rows: list[dict[str, str]]) -> None:
        """Restores the episodes from a table that was written earlier."""
        self.returns = [float(row["episode_return"]) for row in rows]
        self.lengths = [int(row["length"]) for row in rows]
        self.flagged = [row["flagged"] == "1" for row in rows]

    def recent(self, window: int) -> float | None:
        """Mean return of the last `window` episodes, None before the first.

        With the benchmark's window (50 episodes per seed) this is the published final
        score at the end of a run.
        """
        return float(np.mean(self.returns[-window:])) if self.returns else None

    @property
    def flagged_fraction(self) -> float:
        """Fraction of the episodes that a health flag ended; 0 before the first."""
        return float(np.mean(self.flagged)) if self.flagged else 0.0
