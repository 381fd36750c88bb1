"""A trained policy as a pure function, and as two files without pickle."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxrod.files import (
    OBJECT,
    check_entries,
    one_of,
    read_json,
    reading,
    whole,
    write_atomically,
)
from jaxrod.structure import pytree, static
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
        ValueError: the folder holds no policy, or one of another format, or a file
            is damaged or holds what no policy can be; with the name of the file.
    """
    folder = Path(folder)
    texts, numbers = folder / "policy.json", folder / "policy.npz"
    for file in (texts, numbers):
        if not file.is_file():
            raise ValueError(
                f"{folder} must hold policy.json and policy.npz, lacks {file.name}"
            )
    description = read_json(texts)
    with reading(texts):
        _check_description(description)
    with reading(numbers):
        if not zipfile.is_zipfile(numbers):
            raise ValueError("it is torn")
        with np.load(numbers, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        _check_numbers(arrays, description)
    found = {name: jnp.asarray(array) for name, array in arrays.items()}
    return Policy(
        moments=RunningMoments(
            found["observation_count"],
            found["observation_mean"],
            found["observation_variance"],
        ),
        limit=found["observation_limit"],
        layers=tuple(
            (found[f"kernel_{i}"], found[f"bias_{i}"])
            for i in range(description["layers"])
        ),
        activation=description["activation"],
        output=description["output"],
        # Policies written before it was told decided at every control step.
        action_repeat=description.get("action_repeat", 1),
    )


def _check_description(description: dict[str, Any]) -> None:
    """Raises ValueError unless this can describe a policy."""
    if description.get("format") != FORMAT:
        raise ValueError(
            f"it is of format {description.get('format')!r}, this version reads "
            f"format {FORMAT}"
        )
    check_entries(
        description,
        {
            "activation": one_of(*_ACTIVATIONS),
            "output": one_of(*_OUTPUTS),
            "layers": whole(1, 1000),
            "observation_size": whole(1),
            "action_size": whole(1),
        },
        {"action_repeat": whole(1, 2**31 - 1), "about": OBJECT},
    )


def _check_numbers(
    arrays: dict[str, np.ndarray], description: Mapping[str, Any]
) -> None:
    """Raises ValueError unless these are the numbers of the policy described."""
    layers = range(description["layers"])
    names = {f"{part}_{i}" for i in layers for part in ("kernel", "bias")}
    names |= {f"observation_{part}" for part in ("count", "mean", "variance", "limit")}
    for name in sorted(names ^ arrays.keys()):
        if name in names:
            raise ValueError(f"it lacks {name!r}, which follows from policy.json")
        raise ValueError(f"it has {name!r}, which does not follow from policy.json")
    sizes = [description["observation_size"]]
    sizes += [arrays[f"bias_{i}"].size for i in layers[:-1]]
    sizes += [description["action_size"]]
    shapes: dict[str, tuple[int, ...]] = {
        "observation_count": (),
        "observation_limit": (),
        "observation_mean": (sizes[0],),
        "observation_variance": (sizes[0],),
    }
    for i in layers:
        shapes |= {
            f"kernel_{i}": (sizes[i], sizes[i + 1]),
            f"bias_{i}": (sizes[i + 1],),
        }
    for name, shape in shapes.items():
        array = arrays[name]
        if array.shape != shape:
            raise ValueError(
                f"{name!r} has the shape {array.shape}, not {shape}, which follows "
                "from policy.json"
            )
        if array.dtype.kind != "f" or not np.isfinite(array).all():
            raise ValueError(f"{name!r} must hold finite numbers")
    for name in ("observation_count", "observation_variance"):
        if (arrays[name] < 0).any():
            raise ValueError(f"{name!r} must not be negative")
    if arrays["observation_limit"] <= 0:
        raise ValueError("'observation_limit' must be positive")


def held_for(policy: Callable[[Array], Array]) -> int:
    """Control steps for which an action of a policy is to be held: 1 if not told."""
    return getattr(policy, "action_repeat", 1)
