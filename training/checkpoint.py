"""Checkpoints: a train state and a few facts, whole or not at all.

Arrays are fetched from whatever devices hold them and put back the same way, so
a run may continue on another number of devices (then equal up to rounding).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


class Checkpoints:
    """The newest checkpoints of a run, in a folder of their own.

    A checkpoint appears under its name only when it is complete: a process may
    be killed at any moment.
    """

    def __init__(self, folder: Path, keep: int = 2) -> None:
        """Opens the folder.

        Args:
            folder: made if missing.
            keep: how many checkpoints to keep.
        """
        # Slow to import (seconds), and needed only by runs that are written.
        import orbax.checkpoint

        self._orbax = orbax.checkpoint
        self._manager = orbax.checkpoint.CheckpointManager(
            folder.absolute(),
            options=orbax.checkpoint.CheckpointManagerOptions(
                max_to_keep=keep, create=True, enable_async_checkpointing=False
            ),
        )

    def save(self, step: int, state: Any, facts: dict[str, Any]) -> None:
        """Writes a checkpoint, unless that step has one.

        Args:
            step: number of the checkpoint, growing along the run.
            state: the train state.
            facts: what else to remember; anything JSON can hold.
        """
        if step == self.latest_step():
            return
        args = self._orbax.args
        self._manager.save(
            step,
            args=args.Composite(
                state=args.StandardSave(_to_arrays(state)), facts=args.JsonSave(facts)
            ),
        )

    def latest_step(self) -> int | None:
        """Number of the newest checkpoint, None if there is none."""
        return self._manager.latest_step()

    def restore(self, template: Any) -> tuple[Any, dict[str, Any]]:
        """Reads the newest checkpoint.

        Args:
            template: a train state of the same structure and shapes.

        Returns:
            The state, in host memory, and the facts.

        Raises:
            ValueError: the checkpoint is of another structure.
        """
        args = self._orbax.args
        wanted = _to_arrays(template)
        stored = self._manager.restore(
            self.latest_step(),
            args=args.Composite(
                state=args.StandardRestore(wanted), facts=args.JsonRestore()
            ),
        )
        for name, array in wanted.items():
            found = stored.state[name]
            if found.shape != array.shape or found.dtype != array.dtype:
                raise ValueError(
                    f"checkpoint holds {found.dtype}{found.shape} at {name}, this "
                    f"run needs {array.dtype}{array.shape}"
                )
        return _from_arrays(template, stored.state), stored.facts

    def close(self) -> None:
        """Frees what the checkpoint library holds."""
        self._manager.close()


def _to_arrays(tree: Any) -> dict[str, np.ndarray]:
    """The leaves as plain arrays under their numbers; keys as their words.

    Empty ones, which the checkpoint library refuses, hold nothing to remember.
    """
    return {
        _name(i): np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)
        for i, leaf in enumerate(jax.tree.leaves(tree))
        if leaf.size
    }


def _from_arrays(template: Any, arrays: dict[str, np.ndarray]) -> Any:
    def restored(i: int, leaf: Any) -> Any:
        if not leaf.size:
            return leaf
        array = arrays[_name(i)]
        if not _is_key(leaf):
            return array
        return jax.random.wrap_key_data(
            jnp.asarray(array), impl=jax.random.key_impl(leaf)
        )

    leaves, structure = jax.tree.flatten(template)
    return jax.tree.unflatten(
        structure, list(map(restored, range(len(leaves)), leaves))
    )


def _name(i: int) -> str:
    return f"leaf_{i:04d}"


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
