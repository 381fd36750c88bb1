"""Drawn faults that change no number that anybody could see, each with its reason."""

from __future__ import annotations

REASONS: dict[tuple[str, str], str] = {
    (
        "envs/soft_bodies/snake_body.py",
        "number: `1.0` -> `(2 * 1.0)` in `normal=(0.0, 0.0, 1.0),`",
    ): "a normal may be of any length: its direction is taken",
    (
        "jaxrod/tradeoff/scenes.py",
        "index: `0` -> `(-1)` in `VISCOSITY / float(rod.linear_density[0]),`",
    ): "the arm is uniform: the first element is like the last",
    (
        "training/algorithms/td3.py",
        "index: `0` -> `(-1)` in `batch.noise[0],`",
    ): "TD3 draws one array of noise for a batch: the first is the last",
    (
        "jaxrod/cli/recording.py",
        "index: `0` -> `(1)` in `reward = jnp.zeros_like(frames.reward[0])`",
    ): "zeros like any row are the same",
    (
        "envs/brax_env.py",
        "number: `2` -> `3` in "
        "`observation, running = self._start(_key(rng, 2 * ticks))`",
    ): "the number of ticks is zero there",
    (
        "jaxrod/systems/stability.py",
        "number: `1` -> `2` in "
        "`return jnp.where(free, jnp.inf, 4 * inertia / jnp.where(free, 1, be...`",
    ): "it divides what `where` does not choose: it has to differ from zero",
}
"""Reasons by file and change."""
