"""Automatic widening of a randomised task during a run.

Training starts near the nominal task. Whenever the returns are high enough at the
present share of the randomisation, the share rises; if they are too low, it falls
(`Randomisation.widening`). The share is one number of the train state, so changing it
compiles nothing, and checkpoints hold it. It changes between chunks only.

Source: OpenAI, Solving Rubik's Cube with a Robot Hand, 2019 (automatic domain
randomisation). One share is moved here instead of every bound by itself.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxrod.envs import Environment, RandomisedParams


class Widening:
    """Share of the randomisation, and the rule by which returns change it.

    Attributes:
        share: Present share, from 0 to 1.
    """

    def __init__(self, rule: Mapping[str, Any]) -> None:
        """Starts at the share that `rule`, a `Randomisation.widening`, names."""
        self.rule, self.share = rule, float(rule["start"])
        self._returns: list[float] = []

    def take(self, returns: Sequence[float]) -> None:
        """Counts the episodes of a chunk, and moves the share if they are enough.

        Every episode counts once: a mean is over those since the last decision.
        """
        self._returns += returns
        if len(self._returns) < self.rule["episodes"]:
            return
        mean, self._returns = float(np.mean(self._returns)), []
        if mean >= self.rule["above"]:
            self.share = min(1.0, self.share + self.rule["step"])
        elif mean <= self.rule.get("below", -np.inf):
            self.share = max(0.0, self.share - self.rule["step"])

    def take_again(self, rows: Sequence[Mapping[str, str]]) -> None:
        """Repeats all decisions of a run from its rows of episodes.csv."""
        for _, chunk in groupby(rows, lambda row: row["env_steps"]):
            self.take([float(row["episode_return"]) for row in chunk])

    def put(self, tree: Any) -> Any:
        """Returns `tree` with the present share in all `RandomisedParams` in it."""

        def put(node: Any) -> Any:
            if not _is_params(node):
                return node
            was = jnp.asarray(node.share)
            now = jax.device_put(np.asarray(self.share, was.dtype), was.sharding)
            return dataclasses.replace(node, share=now)

        return jax.tree.map(put, tree, is_leaf=_is_params)


def widening_of(env: Environment) -> Widening | None:
    """Widening of a randomised environment; None if it has none."""
    inner = getattr(env, "unwrapped", env)
    rule = getattr(getattr(inner, "randomisation", None), "widening", None)
    return Widening(rule) if rule else None


def check_holds_params(state: Any, name: str) -> None:
    """Raises ValueError unless a train state holds parameters that can be widened.

    `name` is the name of the algorithm.
    """
    if not any(map(_is_params, jax.tree.leaves(state, is_leaf=_is_params))):
        raise ValueError(
            f"widening needs an algorithm whose train state holds the parameters of "
            f"the environment, and that of {name} does not"
        )


def _is_params(node: Any) -> bool:
    return isinstance(node, RandomisedParams)
