"""Scenes, systems, states and other pytrees in one file: arrays and JSON, no code.

The file is a zip archive without compression, with one `.npy` member for each array and
`structure.json` for everything else. docs/saving.md describes the format.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import math
import os
import re
import zipfile
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod.files import (
    TEXT,
    UntrustedError,
    check_entries,
    one_of,
    parse_json,
    read_plain,
    reading,
    whole,
    write_atomically,
)
from jaxrod.structure import STORABLE

VERSION = 1
"""Version of the file format, increased whenever the meaning of a file changes."""

_TREE = "structure.json"
_FLOATS = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}
"""Floats that JSON cannot represent, by the text that stands for them."""
_FAR = {"envs", "training", "viz"}
"""Namespaces that are not imported to look for a class."""


def save(path: str | os.PathLike[str], thing: Any, *, overwrite: bool = False) -> None:
    """Writes a scene, a system, a state or another pytree into one file.

    The file has arrays and JSON, and no code. If the process dies while writing, no
    partial file remains.

    Args:
        path: The file; its folder must exist.
        thing: An instance of a class of jaxrod, or of one decorated with
            `jaxrod.extend.pytree`; an array, a number, a string or `None`; or dicts
            with string keys, tuples and lists of these, nested to any depth.
        overwrite: Whether to replace a file that `save` has written. Anything else at
            that path, including a link, is never replaced.

    Raises:
        ValueError: If a part cannot be stored, such as a function; the message names
            its place. Also if something that `save` has not written is at the path.
        FileExistsError: If a file that `save` has written is at the path, and
            `overwrite` is false.

    Example:
        >>> import os, tempfile, jaxrod
        >>> path = os.path.join(tempfile.mkdtemp(), "pull.jaxrod")
        >>> jaxrod.save(path, jaxrod.end_load(force=(0.0, 0.0, 2.0)))
        >>> jaxrod.load(path).force.tolist()
        [0.0, 0.0, 2.0]
    """
    if not isinstance(path, str | os.PathLike):
        raise TypeError(
            f"path must be the path of a file, got {type(path).__name__}: give the "
            "path first, and then what to save"
        )
    target = Path(path)
    writer = _Writer()
    description = {
        "format": "jaxrod",
        "version": VERSION,
        "jaxrod": jaxrod.__version__,
        "tree": writer.node(thing, ""),
    }
    text = json.dumps(description, indent=1, allow_nan=False)
    _check_place(target, overwrite)

    def write(file: BinaryIO) -> None:
        # Members get a fixed date, so that the same thing gives the same bytes.
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            archive.writestr(zipfile.ZipInfo(_TREE), text)
            for name, array in writer.arrays.items():
                content = io.BytesIO()
                np.lib.format.write_array(content, array, (1, 0), allow_pickle=False)
                archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getvalue())

    write_atomically(target, write)


def load(path: str | os.PathLike[str], classes: Iterable[type] = ()) -> Any:
    """Reads an object that `save` has written, equal to the last bit.

    It never runs code from a file or imports a module that a file names: it makes
    instances of jaxrod's classes and of those given, and nothing else. It does not
    check whether the numbers make sense.

    Args:
        path: The file.
        classes: Classes of your own that may be in the file.

    Returns:
        The saved object. Arrays of JAX are on the default device.

    Raises:
        ValueError: If the file is damaged, of a newer format, or has a class that is
            neither jaxrod's nor given; or if it has 64-bit numbers of JAX while JAX has
            64-bit types turned off. The message names the file.
        OSError: If it cannot be opened.

    Example:
        >>> import os, tempfile, jaxrod
        >>> path = os.path.join(tempfile.mkdtemp(), "wave.jaxrod")
        >>> jaxrod.save(path, {"drive": jaxrod.schedules.ramp(0.0, 1.0, 2.0)})
        >>> float(jaxrod.load(path)["drive"].duration)
        2.0
    """
    file = Path(path)
    reader = _Reader(_given(classes))
    with reading(file):
        description, members = _contents(file)
    if description["version"] > VERSION:
        raise ValueError(
            f"{file} is of version {description['version']} of the format, written by "
            f"jaxrod {description['jaxrod']}: jaxrod {jaxrod.__version__} reads "
            f"versions up to {VERSION}"
        )
    with reading(file):
        reader.arrays = {
            name.removesuffix(".npy"): _array(name, content)
            for name, content in members.items()
        }
        thing = reader.node(description["tree"], "")
        for name in reader.arrays:
            raise ValueError(f"it has {name}.npy, which {_TREE} does not name")
    if reader.wide:
        raise ValueError(
            f"{file} has {reader.wide}, and JAX has 64-bit types turned off: call "
            'jax.config.update("jax_enable_x64", True) before load. jaxrod.astype '
            "converts what was loaded"
        )
    return thing


def _check_place(target: Path, overwrite: bool) -> None:
    """Raises if `target` exists, unless `save` wrote it and `overwrite` is true."""
    if not os.path.lexists(target):
        return
    try:
        if target.is_symlink():
            raise ValueError("it is a link")
        with reading(target):
            _contents(target)
    except (ValueError, OSError) as error:
        raise ValueError(
            f"{target} exists, and jaxrod.save has not written it: choose another "
            "path, or remove it"
        ) from error
    if not overwrite:
        raise FileExistsError(
            f"{target} exists: jaxrod.save(..., overwrite=True) replaces it"
        )


def _contents(file: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Parsed `structure.json` of a file, and the bytes of its `.npy` members by name.

    Members are not compressed, so they cannot have more bytes than the file.

    Raises:
        ValueError: If the file was not written by `save`.
    """
    content = read_plain(file)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        infos = archive.infolist()
        names = {info.filename for info in infos}
        for name in names:
            if name != _TREE and not re.fullmatch(r"[A-Za-z0-9_.]+\.npy", name):
                raise ValueError(f"it has a member {name!r:.80}, which save never has")
        if len(names) < len(infos):
            raise ValueError("it has two members of one name")
        if any(info.compress_type != zipfile.ZIP_STORED for info in infos):
            raise ValueError("it has compressed members, which save never has")
        if sum(info.file_size for info in infos) > len(content):
            raise ValueError("its members have more bytes than the file")
        members = {info.filename: archive.read(info) for info in infos}
    if _TREE not in members:
        raise ValueError(f"it lacks {_TREE}")
    description = parse_json(members.pop(_TREE).decode())
    kinds = {"format": one_of("jaxrod"), "version": whole(1), "jaxrod": TEXT}
    check_entries(description, {**kinds, "tree": ("a tree", lambda value: True)})
    return description, members


def _array(name: str, content: bytes) -> np.ndarray:
    """Array of a `.npy` member, whose header must agree with the number of bytes."""
    file = io.BytesIO(content)
    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError(f"{name} is of another version of the npy format than 1.0")
    shape, by_columns, dtype = np.lib.format.read_array_header_1_0(file)
    data = memoryview(content)[file.tell() :]
    if dtype.kind not in "biufc" or by_columns:
        raise ValueError(f"{name} has {dtype} numbers or an order that save never has")
    size = dtype.itemsize * math.prod(shape)
    if min(shape, default=0) < 0 or size != len(data):
        raise ValueError(
            f"{name} must have {size} bytes for {dtype}{list(shape)}, got {len(data)}"
        )
    if dtype.kind == "b" and np.frombuffer(data, "u1").max(initial=0) > 1:
        raise ValueError(f"{name} has booleans that are neither 0 nor 1")
    return np.frombuffer(data, dtype).reshape(shape)


def _name(cls: type) -> str:
    """Name of a class in files: without its module, which may change."""
    package, _, rest = cls.__module__.partition(".")
    if package != "jaxrod":
        return cls.__name__
    part = rest.partition(".")[0]
    return ".".join(["jaxrod", *[part] * (part in _FAR), cls.__name__])


def _own() -> dict[str, type]:
    """Imported classes of jaxrod by their names in files, if these are unique."""
    counts = Counter(map(_name, STORABLE))
    own = [cls for cls in STORABLE if cls.__module__.startswith("jaxrod.")]
    return {_name(cls): cls for cls in own if counts[_name(cls)] == 1}


def _given(classes: Iterable[type]) -> dict[str, type]:
    """Maps the names of the user's classes in files to the classes."""
    found: dict[str, type] = {}
    for cls in classes:
        if not isinstance(cls, type) or cls not in STORABLE:
            raise ValueError(
                f"classes must be decorated with jaxrod.extend.pytree, got {cls!r:.80}"
            )
        if found.setdefault(_name(cls), cls) is not cls:
            raise ValueError(f"classes must have different names, got two {_name(cls)}")
    return found


def _check_field(field: dataclasses.Field[Any], value: Any, where: str) -> None:
    """Raises ValueError if a static field's value is not hashable; `where` names it."""
    try:
        if field.metadata.get("static"):
            hash(value)
    except TypeError:
        raise ValueError(f"{where} must be hashable, got {value!r:.80}") from None


class _Writer:
    """Converts a pytree to JSON, and collects its arrays by name."""

    def __init__(self) -> None:
        self.arrays: dict[str, np.ndarray] = {}
        self._named = _own()
        """Classes by the names they have in the file."""

    def node(self, value: Any, place: str) -> Any:
        """JSON for a value; `place`, its path in the pytree, names its arrays."""
        kind = type(value)
        if value is None or kind in (bool, int, str):
            return value
        if kind is float:
            return value if math.isfinite(value) else {"float": str(value)}
        if kind in (list, tuple):
            nodes = [self.node(v, f"{place}[{k}]") for k, v in enumerate(value)]
            return nodes if kind is list else {"tuple": nodes}
        if kind is dict:
            for key in value:
                if not isinstance(key, str):
                    raise ValueError(
                        f"thing{place} must have strings as keys, got {key!r}"
                    )
            by_key = {k: self.node(v, f"{place}[{k!r}]") for k, v in value.items()}
            return {"dict": by_key}
        if isinstance(value, jax.Array):
            return self._jax_array(value, place)
        if kind is np.ndarray or isinstance(value, np.generic):
            tag = "numpy" if kind is np.ndarray else "scalar"
            return self._stored(tag, value, place)
        if kind in STORABLE:
            return self._instance(value, place)
        raise ValueError(
            f"thing{place} is {value!r:.80}, a {kind.__name__}, which a file of arrays "
            "and JSON cannot hold: put its numbers into a class decorated with "
            "jaxrod.extend.pytree, and pass that to jaxrod.load(path, classes=[...])"
        )

    def _instance(self, value: Any, place: str) -> dict[str, Any]:
        cls = type(value)
        name = _name(cls)
        if not name.startswith("jaxrod."):
            self._named.setdefault(name, cls)
        if self._named.get(name) is not cls:
            raise ValueError(
                f"thing{place} is a {name}, a name that two classes share: rename one"
            )
        nodes = {}
        for field in dataclasses.fields(cls):
            part, where = getattr(value, field.name), f"{place}.{field.name}"
            nodes[field.name] = self.node(part, where)
            _check_field(field, part, f"thing{where}")
        return {"class": name, "fields": nodes}

    def _jax_array(self, value: jax.Array, place: str) -> dict[str, Any]:
        if isinstance(value, jax.core.Tracer):
            raise ValueError(
                f"thing{place} must be known, not traced by jax.jit, grad or vmap"
            )
        if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            kind = str(jax.random.key_impl(value))
            return self._stored("array", jax.random.key_data(value), place, key=kind)
        weak = {"weak": True} if value.weak_type else {}
        return self._stored("array", value, place, **weak)

    def _stored(self, kind: str, value: Any, place: str, **more: Any) -> dict[str, Any]:
        """Adds an array to `arrays` under a new name; returns {kind: name, **more}."""
        array = np.asarray(value, order="C")
        if array.dtype.kind not in "biufc":
            raise ValueError(
                f"thing{place} must be numbers of one of NumPy's own types, got "
                f"{array.dtype}"
            )
        name = re.sub(r"[^A-Za-z0-9_]+", ".", place).strip(".")[:80] or "value"
        while name in self.arrays:
            name = f"{name}_{len(self.arrays)}"
        self.arrays[name] = array
        return {kind: name, **more}


class _Reader:
    """Rebuilds a pytree from its JSON and its arrays."""

    def __init__(self, given: Mapping[str, type]) -> None:
        self.arrays: dict[str, np.ndarray] = {}
        self.wide = ""
        """Description of an array that needs 64-bit types, which are turned off; else
        ""."""
        self._given = given
        self._classes = {**_own(), **given}

    def node(self, node: Any, place: str) -> Any:
        """Value that JSON stands for; `place`, its path in the pytree, is for messages.

        Raises:
            ValueError: If `save` never writes such JSON.
        """
        match node:
            case None | bool() | int() | str():
                return node
            case float() if math.isfinite(node):
                return node
            case list():
                return [self.node(v, f"{place}[{k}]") for k, v in enumerate(node)]
            case {"tuple": list(nodes), **rest} if not rest:
                return tuple(self.node(nodes, place))
            case {"dict": dict(nodes), **rest} if not rest:
                return {k: self.node(v, f"{place}[{k!r}]") for k, v in nodes.items()}
            case {"float": str(word), **rest} if word in _FLOATS and not rest:
                return _FLOATS[word]
            case {"class": str(name), "fields": dict(nodes), **rest} if not rest:
                return self._instance(name, nodes, place)
            case {"array": str(name), **rest} if rest.keys() <= {"weak", "key"}:
                return self._jax_array(name, rest)
            case {"numpy": str(name), **rest} if not rest:
                return self._taken(name).copy()
            case {"scalar": str(name), **rest} if not rest:
                return self._taken(name)[()]
        raise ValueError(f"tree{place} is {node!r:.80}, which save never writes")

    def _instance(self, name: str, nodes: dict[str, Any], place: str) -> Any:
        cls = self._class(name)
        fields = dataclasses.fields(cls)
        for extra in sorted(nodes.keys() - {field.name for field in fields}):
            raise ValueError(f"tree{place} has {extra!r}, which {name} does not have")
        values = {}
        for field in fields:
            where = f"{place}.{field.name}"
            if field.name in nodes:
                values[field.name] = self.node(nodes[field.name], where)
                _check_field(field, values[field.name], f"tree{where}")
            # A field that was added after the file was written has its default.
            elif field.default is field.default_factory is dataclasses.MISSING:
                raise ValueError(f"tree{where}, which {name} needs, is missing")
        return cls(**values)

    def _class(self, name: str) -> type:
        """Class for a name in a file: an imported one of jaxrod's, or the user's."""
        if name not in self._classes:
            _import_core()
            self._classes = {**_own(), **self._given}
        if name in self._classes:
            return self._classes[name]
        hint = "a class of your own is given as load(path, classes=[...])"
        if name.startswith("jaxrod."):
            far = [f"import jaxrod.{n} first" for n in _FAR if n in name.split(".")]
            hint = ", or ".join([*far, "update jaxrod if the file is of a newer one"])
        raise UntrustedError(
            f"it has the class {name!r:.80}, which is none of those imported by jaxrod "
            f"{jaxrod.__version__}: {hint}"
        )

    def _taken(self, name: str) -> np.ndarray:
        """Removes an array from `arrays` and returns it: each occurs only once."""
        if name not in self.arrays:
            raise ValueError(f"it lacks {name:.80}.npy")
        return self.arrays.pop(name)

    def _jax_array(self, name: str, rest: Mapping[Any, Any]) -> Any:
        array = self._taken(name)
        if "key" in rest:
            return jax.random.wrap_key_data(jnp.asarray(array), impl=rest["key"])
        if array.dtype != jax.dtypes.canonicalize_dtype(array.dtype):
            self.wide = f"{array.dtype} numbers in {name}.npy"
            return array
        if "weak" not in rest:
            return jnp.asarray(array)
        # Only Python's own numbers become weak arrays; they have JAX's default width.
        with jax.enable_x64(array.dtype.itemsize == 8):
            zero = jnp.asarray(array.dtype.type(0).item())
            return jnp.broadcast_to(zero, array.shape).at[...].set(array)


def _import_core() -> None:
    """Imports all public names of jaxrod, except envs, training and viz."""
    for name in sorted({*dir(jaxrod)} - _FAR):
        # A namespace may lack an optional package.
        with contextlib.suppress(AttributeError):
            getattr(jaxrod, name)
