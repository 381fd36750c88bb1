"""Export of policies for controllers, each with a JSON file that describes it.

That file, FILE.json for the exported FILE, is called its contract: entries and units of
observation and action, rate, normalisation, memory. It also marks FILE as written by
jaxrod; other files are never replaced.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod.envs import Environment, OneEpisode, held_for
from jaxrod.files import DamagedFileError, read_json, write_atomically
from jaxrod.training.exporting import c_header, onnx_file
from jaxrod.training.exporting.program import Program
from jaxrod.training.exporting.walk import walked
from jaxrod.training.runs.owned_folder import as_json

MARK = "jaxrod exported policy 1"
"""Value of `format` in a contract, by which jaxrod recognises its own files."""


def export_c(
    policy: Any,
    env: Environment,
    file: str | os.PathLike[str],
    *,
    about: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Writes a policy as a C header, and its contract.

    The header is C99 and needs `math.h` alone. All memory is static: weights are
    constants, and each function has static scratch arrays, so two threads must not call
    it simultaneously. The functions normalise observations and clip actions. `policy.h`
    declares

        void policy_act(const float observation[], float action[]);

    For a policy with memory there is also a struct `policy_memory`, which belongs to
    the caller and is the first argument of `policy_act`. `policy_start(memory,
    observation)` begins an episode.

    Args:
        policy: A `Policy`, or a policy with memory (`jaxrod.envs.MemoryPolicy`) that
            does not use the state of the environment.
        env: Environment of the policy, for the entries, units and rate in the contract.
        file: Header to write. Its name without the ending is the prefix of all C names.
        about: Facts about the run for the contract, such as the task.
        overwrite: Whether to replace a file that was exported before.

    Returns:
        The contract, which is written to `file` + ".json".

    Raises:
        ValueError: The policy computes something that cannot be exported; the message
            names it. Or a file exists that must not be replaced.

    Example:
        >>> env = envs.make("trivial")
        >>> sizes = training.untrained_policy(env)
        >>> policy = jax.tree.map(lambda leaf: jnp.ones(leaf.shape), sizes)
        >>> contract = training.export_c(policy, env, "policy.h")
        >>> contract["functions"], contract["observation"]["entries"][0]["unit"]
        ({'act': 'policy_act'}, 'm')
    """
    path = Path(file)
    prefix = c_header.prefix_of(path.stem)

    def write(traced: _Traced, facts: dict[str, Any]) -> bytes:
        begins = {} if traced.start is None else {"start": f"{prefix}_start"}
        facts["functions"] = {"act": f"{prefix}_act", **begins}
        lines = _as_lines(path.name, facts)
        return c_header.header(prefix, traced.act, traced.start, lines).encode()

    return _export(policy, env, path, about, overwrite, write)


def export_onnx(
    policy: Any,
    env: Environment,
    file: str | os.PathLike[str],
    *,
    about: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Writes a policy as an ONNX model, and its contract.

    The model has the input `observation` and the output `action`, in float32 and
    without a batch axis. Normalisation of observations and clipping of actions are part
    of it. A policy with memory also has inputs `memory_0`, ... and outputs
    `next_memory_0`, ...; the contract has their values at the start of an episode.

    Args:
        policy: A policy, as for `export_c`. Its initial memory must not depend on the
            first observation.
        env: Environment of the policy, for the entries, units and rate in the contract.
        file: Model to write.
        about: Facts about the run for the contract, such as the task.
        overwrite: Whether to replace a file that was exported before.

    Returns:
        The contract, which is written to `file` + ".json".

    Raises:
        ValueError: As for `export_c`.
        ModuleNotFoundError: `onnx` is not installed.

    Example:
        >>> env = envs.make("trivial")
        >>> sizes = training.untrained_policy(env)
        >>> policy = jax.tree.map(lambda leaf: jnp.ones(leaf.shape), sizes)
        >>> contract = training.export_onnx(policy, env, "policy.onnx")
        >>> contract["action"]["lower"], contract["action"]["upper"]
        (-1.0, 1.0)
    """
    path = Path(file)

    def write(traced: _Traced, facts: dict[str, Any]) -> bytes:
        if any(array["start"] is None for array in facts.get("memory", ())):
            raise ValueError(
                "the policy cannot be exported as ONNX: its first memory depends "
                "on the first observation, and a model has no function for that; "
                "export a C header"
            )
        facts["opset"] = onnx_file.OPSET
        text = "\n".join(_as_lines(path.name, facts))
        shapes = [tuple(array["shape"]) for array in facts.get("memory", ())]
        metadata = {"rate_hz": str(facts["rate_hz"]), "jaxrod": facts["jaxrod"]}
        return onnx_file.model(traced.act, shapes, text, metadata)

    return _export(policy, env, path, about, overwrite, write)


class _Traced:
    """A policy traced in float32: programs of one action and of the initial memory."""

    def __init__(self, policy: Any, size: int) -> None:
        with jax.enable_x64(False):
            episode = OneEpisode(jax.tree.map(_single, policy))
            observation = jax.ShapeDtypeStruct((size,), jnp.float32)
            begin = lambda seen: episode.init(seen, None)
            try:
                memory = jax.eval_shape(begin, observation)
                leaves, tree = jax.tree.flatten(memory)
                kept = [i for i, leaf in enumerate(leaves) if leaf.size]

                def act(*given: Any) -> Any:
                    filled = [jnp.zeros(leaf.shape, leaf.dtype) for leaf in leaves]
                    for i, array in zip(kept, given, strict=False):
                        filled[i] = array
                    remembered = jax.tree.unflatten(tree, filled)
                    action, after = episode.act(remembered, given[-1], None)
                    after = jax.tree.leaves(after)
                    return action, *(after[i] for i in kept)

                given = [leaves[i] for i in kept]
                acting = jax.make_jaxpr(act)(*given, observation)
                starting = jax.make_jaxpr(
                    lambda seen: [jax.tree.leaves(begin(seen))[i] for i in kept]
                )(observation)
            except (AttributeError, TypeError) as error:
                raise ValueError(
                    "the policy cannot be exported: it does not act on observations "
                    f"alone, without the state of the environment ({error})"
                ) from error
            self.act: Program = walked(acting)
            self.start = walked(starting) if kept else None
        self.memory = [
            {
                "shape": list(value.places.shape),
                "type": str(np.dtype(value.buffer.dtype)),
                "start": value.numbers.tolist() if value.known else None,
            }
            for value in (self.start.results if self.start else ())
        ]


def _single(leaf: Any) -> Any:
    """Converts a float64 leaf of a policy to float32; other leaves are unchanged."""
    array = jnp.asarray(leaf)
    return array.astype(jnp.float32) if array.dtype == jnp.float64 else array


def _export(
    policy: Any,
    env: Environment,
    path: Path,
    about: Mapping[str, Any] | None,
    overwrite: bool,
    write: Callable[[_Traced, dict[str, Any]], bytes],
) -> dict[str, Any]:
    """Writes the exported file and its contract; returns the contract.

    Args:
        policy: The policy.
        env: Environment of the policy.
        path: File to write.
        about: Facts about the run for the contract.
        overwrite: Whether to replace a file that was exported before.
        write: Function of the traced policy and the contract's entries so far, to which
            it adds; returns the contents of the file.
    """
    contract = path.with_name(f"{path.name}.json")
    _check_replaceable(path, contract, overwrite)
    facts = _facts(policy, env, about)
    traced = _Traced(policy, env.observation_size)
    if traced.memory:
        facts["memory"] = traced.memory
    content = write(traced, facts)
    facts = {
        "format": MARK,
        "file": path.name,
        "sha256": hashlib.sha256(content).hexdigest(),
        **facts,
    }
    text = as_json(contract.name, facts)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, content)
    write_atomically(contract, text)
    return facts


def _facts(
    policy: Any, env: Environment, about: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Entries of the contract that do not depend on the format: sizes, units, rate."""
    held = held_for(policy)
    period = getattr(env, "control_period", None)
    decides = None if period is None else held * float(period)
    observation = _vector(env, "observation")
    moments = getattr(policy, "moments", None)
    if moments is not None:
        observation["normalisation"] = {
            "mean": np.asarray(moments.mean, np.float64).tolist(),
            "variance": np.asarray(moments.variance, np.float64).tolist(),
            "limit": float(policy.limit),
        }
    return {
        "jaxrod": jaxrod.__version__,
        "about": {"task": env.name, **(about or {})},
        "precision": "float32",
        "rate_hz": None if decides is None else 1 / decides,
        "period_s": decides,
        "control_steps_per_action": held,
        "observation": observation,
        "action": {**_vector(env, "action"), "lower": -1.0, "upper": 1.0},
    }


def _vector(env: Environment, name: str) -> dict[str, Any]:
    """Size of the observation or action, and the name and unit of each entry.

    The entries are None if the environment does not describe them. `name` is
    "observation" or "action".
    """
    size = getattr(env, f"{name}_size")
    channels = getattr(env, f"{name}_channels", None)
    if channels is None:
        return {"size": size, "entries": None}
    entries: list[dict[str, Any]] = []
    first = 0
    for channel in channels:
        entries.append(
            {
                "name": channel.name,
                "unit": channel.unit,
                "first": first,
                "size": channel.size,
            }
        )
        first += channel.size
    if first != size:
        raise ValueError(
            f"{name}_channels of {env.name} must have {size} entries, got {first}"
        )
    return {"size": size, "entries": entries}


def _as_lines(name: str, facts: Mapping[str, Any]) -> Sequence[str]:
    """The contract as lines of text, for the comment at the top of the file `name`."""
    about = ", ".join(f"{k} {v}" for k, v in facts["about"].items() if v is not None)
    lines = [f"{name}: a policy exported by jaxrod {facts['jaxrod']}", about, ""]
    if facts["rate_hz"] is None:
        lines.append("Rate: the task does not say.")
    else:
        lines.append(
            f"Rate: {facts['rate_hz']:g} Hz, one action every {facts['period_s']:g} s."
        )
    for vector in ("observation", "action"):
        entries = facts[vector]["entries"]
        lines += ["", f"{vector.capitalize()}: {facts[vector]['size']} numbers"]
        if entries is None:
            lines[-1] += ", which the task does not describe"
        for entry in entries or ():
            last = entry["first"] + entry["size"] - 1
            lines.append(
                f"  {entry['first']}..{last}  {entry['name']} [{entry['unit']}]"
            )
    lines.append("Actions are clipped to [-1, 1].")
    scaling = facts["observation"].get("normalisation")
    if scaling is not None:
        lines.append(
            "Observations are normalised inside, and clipped to "
            f"{scaling['limit']:g} standard deviations."
        )
    if "start" in facts.get("functions", ()):
        names = facts["functions"]
        lines.append(f"Memory: call {names['start']} once, then {names['act']}.")
    lines.append(f"Facts for programs are in {name}.json.")
    return lines


def _check_replaceable(path: Path, contract: Path, overwrite: bool) -> None:
    """Raises ValueError if the file or its contract exists and must not be replaced."""
    there = [one for one in (path, contract) if os.path.lexists(one)]
    if not there:
        return
    try:
        found = read_json(contract)
    except (DamagedFileError, OSError):
        found = {}
    ours = found.get("format") == MARK and found.get("file") == path.name
    if ours and path.exists():
        ours = path.is_file() and found.get("sha256") == (
            hashlib.sha256(path.read_bytes()).hexdigest()
        )
    if not ours:
        raise ValueError(
            f"{there[0]} exists, and {contract.name} does not describe it, so jaxrod "
            "does not replace it. Choose another name, or move it away"
        )
    if not overwrite:
        raise ValueError(
            f"{path} was exported before: replace it with --overwrite "
            "(overwrite=True), or choose another name"
        )
