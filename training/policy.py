"""A trained policy as a pure function, and as two files without pickle."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod._files import write_atomically
from jaxrod._pytree import pytree, static
from jaxrod._validation import check_count
from jaxrod.training.normalisation import RunningMoments, normalise

FORMAT = 1
"""Version of the files; raised when their meaning changes."""

_ACTIVATIONS = {
    "tanh": jnp.tanh,
    "relu": lambda x: jnp.maximum(x, 0),
    "elu": lambda x: jnp.where(x > 0, x, jnp.expm1(jnp.minimum(x, 0))),
}
_OUTPUTS = {"clip": lambda x: jnp.clip(x, -1, 1), "tanh": jnp.tanh}


@pytree
class Policy:
    """Deterministic policy: observation -> action in [-1, 1].

    Normalises the observation by fixed moments, applies a multilayer perceptron
    and bounds the result. A pytree: pass it through `jit`, `vmap` and `grad`.

    Attributes:
        moments: mean and variance that observations are normalised by.
        limit: normalised observations are clipped to +- this.
        layers: (kernel, bias) of each layer, kernel of shape (inputs, outputs).
        activation: "tanh", "relu" or "elu", between the layers.
        output: what bounds the action: "clip" or "tanh".
        action_repeat: control steps for which an action is to be held, as in
            training. Evaluations and replays do so; a policy called by hand cannot.
    """

    moments: RunningMoments
    limit: Float[Array, ""]
    layers: tuple[tuple[Array, Array], ...]
    activation: str = static(default="tanh")
    output: str = static(default="clip")
    action_repeat: int = static(default=1)

    def __call__(
        self, observation: Float[Array, "*batch observation"]
    ) -> Float[Array, "*batch action"]:
        """Returns the action for one observation, or for a batch of them."""
        hidden = normalise(self.moments, observation, self.limit)
        for i, (kernel, bias) in enumerate(self.layers):
            if i > 0:
                hidden = _ACTIVATIONS[self.activation](hidden)
            bias = jnp.expand_dims(bias, tuple(range(hidden.ndim - 1)))
            hidden = hidden @ kernel + bias
        return _OUTPUTS[self.output](hidden)


def save_policy(
    policy: Policy, folder: str | Path, about: Mapping[str, Any] | None = None
) -> None:
    """Writes `policy.json` (what it is) and `policy.npz` (its numbers).

    Args:
        policy: the policy.
        folder: made if missing.
        about: further facts for the JSON file, such as the task.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    arrays = {
        "observation_count": policy.moments.count,
        "observation_mean": policy.moments.mean,
        "observation_variance": policy.moments.variance,
        "observation_limit": policy.limit,
    }
    for i, (kernel, bias) in enumerate(policy.layers):
        arrays |= {f"kernel_{i}": kernel, f"bias_{i}": bias}
    description = {
        "format": FORMAT,
        "activation": policy.activation,
        "output": policy.output,
        "action_repeat": policy.action_repeat,
        "layers": len(policy.layers),
        "observation_size": int(policy.layers[0][0].shape[0]),
        "action_size": int(policy.layers[-1][1].shape[0]),
        "about": dict(about or {}),
    }
    buffer = io.BytesIO()
    np.savez(
        buffer,
        allow_pickle=False,
        **{name: np.asarray(array) for name, array in arrays.items()},
    )
    write_atomically(folder / "policy.npz", buffer.getvalue())
    text = json.dumps(description, indent=2) + "\n"
    write_atomically(folder / "policy.json", text.encode())


def load_policy(folder: str | Path) -> Policy:
    """Reads a policy written by `save_policy`.

    Raises:
        ValueError: the folder holds no policy, or one of another format, or one
            whose `action_repeat` is not a count.
    """
    folder = Path(folder)
    try:
        description = json.loads((folder / "policy.json").read_text())
        with np.load(folder / "policy.npz", allow_pickle=False) as stored:
            arrays = {name: jnp.asarray(stored[name]) for name in stored.files}
    except FileNotFoundError as missing:
        raise ValueError(
            f"folder must hold policy.json and policy.npz, got {str(folder)!r}"
        ) from missing
    if description["format"] != FORMAT:
        raise ValueError(
            f"folder {str(folder)!r} holds a policy of format "
            f"{description['format']}; this version reads format {FORMAT}"
        )
    return Policy(
        moments=RunningMoments(
            arrays["observation_count"],
            arrays["observation_mean"],
            arrays["observation_variance"],
        ),
        limit=arrays["observation_limit"],
        layers=tuple(
            (arrays[f"kernel_{i}"], arrays[f"bias_{i}"])
            for i in range(description["layers"])
        ),
        activation=description["activation"],
        output=description["output"],
        # Policies written before it was told decided at every control step.
        action_repeat=check_count(
            "action_repeat", description.get("action_repeat", 1), 1
        ),
    )


def held_for(policy: Callable[[Array], Array]) -> int:
    """Control steps for which an action of a policy is to be held: 1 if not told."""
    return getattr(policy, "action_repeat", 1)
