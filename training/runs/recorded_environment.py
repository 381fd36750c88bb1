"""Entries of `config.json` from which the environment of a run is made again."""

from __future__ import annotations

import json
import re
from typing import Any

from jaxrod.envs import Environment
from jaxrod.envs.importing import import_path
from jaxrod.envs.registry import Origin, options_of, origin_of
from jaxrod.files import with_tuples
from jaxrod.training.runs.recorded_settings import plain


def recorded_environment(env: Environment) -> dict[str, Any]:
    """Task, variant and options that make an environment again, or else a description.

    `jaxrod.envs.make` remembers them for the environments that it makes. An instance of
    a user's class is made again by the class, if its arguments are attributes of the
    instance.
    """
    how = origin_of(env) or _by_its_class(env)
    if how is None:
        return described_environment(env)
    return {
        "task": how.task,
        "variant": _text(how.options.get("variant")),
        "env_options": {name: plain(value) for name, value in how.options.items()},
    }


def described_environment(env: Environment) -> dict[str, Any]:
    """Entries for an environment that cannot be made again: text that identifies it."""
    words = re.sub(r" at 0x[0-9a-fA-F]+", "", f"{type(env).__module__}: {env!r}")
    return {
        "task": env.name,
        "variant": _text(getattr(env, "variant", None)),
        "env_options": None,
        "environment": words,
    }


def _text(value: Any) -> str | None:
    return value if isinstance(value, str) else None


def _by_its_class(env: Environment) -> Origin | None:
    """A user's class and the options with which it makes `env`; None if it does not."""
    build = type(env)
    path = import_path(build, of_file=True)
    if path is None or path.startswith("jaxrod."):
        return None
    try:
        options = options_of(path, build, env)
        read = json.loads(json.dumps(plain(options)))
        again = build(**{name: with_tuples(value) for name, value in read.items()})
        same = again == env or vars(again) == vars(env)
    except Exception:  # A user's class may raise anything; the run goes on without it.
        return None
    return Origin(path, options) if same else None
