"""Scenes, systems, states and other pytrees in one file: arrays and JSON, no code.

The file is a zip archive without compression, with one `.npy` member for each array and
`structure.json` for all else. docs/saving.md describes the format.
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
from jaxrod.structure import PYTREES

VERSION = 1
"""Version of the format; a new meaning gets a new number."""

_TREE = "structure.json"
_FLOATS = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}
"""Floats that JSON has no words for."""
_FAR = {"envs", "training", "viz"}
"""Namespaces that are not imported to look for a class."""


def save(path: str | os.PathLike[str], thing: Any, *, overwrite: bool = False) -> None:
    """Writes a scene, a system, a state or another pytree into one file.

    The file has arrays and JSON, and no code. A process that dies leaves no torn file.

    Args:
        path: The file; its folder must exist.
        thing: Classes of jaxrod and those decorated with `jaxrod.extend.pytree`, in
            any nest of dicts with texts as keys, tuples and lists, with arrays,
            numbers, texts and `None`.
        overwrite: Whether to replace a file that `save` has written. Anything else at
            that path, a link too, is never replaced.

    Raises:
        ValueError: If a part cannot be stored, such as a function; the message names
            its place. Or if there is something else at the path.
        FileExistsError: If there is a file that `save` has written, and `overwrite` is
            false.

    Example:
        >>> import os, tempfile, jaxrod
        >>> path = os.path.join(tempfile.mkdtemp(), "pull.jaxrod")
        >>> jaxrod.save(path, jaxrod.end_load(force=(0.0, 0.0, 2.0)))
        >>> jaxrod.load(path).force.tolist()
        [0.0, 0.0, 2.0]
    """
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
    """Reads what `save` has written, equal to the last bit.

    No file can make it import a module or run code: it makes instances of jaxrod's
    classes and of those given, and nothing else. It does not check whether the numbers
    make sense.

    Args:
        path: The file.
        classes: Classes of your own that may be in the file.

    Returns:
        What was saved. Arrays of JAX are on the default device.

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
    """Raises if there is something at a path that must not be replaced."""
    if not os.path.lexists(target):
        return
    try:
        if target.is_symlink():
            raise ValueError("it is a link")
        with reading(target):
            _contents(target)
    except (ValueError, OSError) as error:
        raise ValueError(
            f"{target} is there already, and jaxrod.save has not written it: choose "
            "another path, or remove it"
        ) from error
    if not overwrite:
        raise FileExistsError(
            f"{target} is there already: jaxrod.save(..., overwrite=True) replaces it"
        )


def _contents(file: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Description and other members of a file.

    Members are not compressed, so they cannot have more bytes than the file.

    Raises:
        ValueError: If this is not a file of `save`.
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
    """Array of a member. Its size is compared with the bytes before it is made."""
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
    if dtype.kind == "b" and any(set(data) - {0, 1}):
        raise ValueError(f"{name} has truth values that are neither 0 nor 1")
    return np.frombuffer(data, dtype).reshape(shape)


def _name(cls: type) -> str:
    """Name of a class in files: without its module, which may change."""
    package, _, rest = cls.__module__.partition(".")
    if package != "jaxrod":
        return cls.__name__
    part = rest.partition(".")[0]
    return ".".join(["jaxrod", *[part] * (part in _FAR), cls.__name__])


def _own() -> dict[str, type]:
    """Classes of jaxrod that have been imported, without those that share a name."""
    found: dict[str, list[type]] = {}
    for cls in PYTREES:
        if (name := _name(cls)).startswith("jaxrod."):
            found.setdefault(name, []).append(cls)
    return {name: both[0] for name, both in found.items() if len(both) == 1}


def _given(classes: Iterable[type]) -> dict[str, type]:
    """Classes of the user by name."""
    found: dict[str, type] = {}
    for cls in classes:
        if not isinstance(cls, type) or cls not in PYTREES:
            raise ValueError(
                f"classes must be decorated with jaxrod.extend.pytree, got {cls!r:.80}"
            )
        if found.setdefault(_name(cls), cls) is not cls:
            raise ValueError(f"classes must have different names, got two {_name(cls)}")
    return found


def _check_static(cls: type, name: str, value: Any, where: str) -> None:
    """Raises unless the value of a static field can be part of a structure."""
    fields = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    if fields[name].metadata.get("static"):
        try:
            hash(value)
        except TypeError as error:
            raise ValueError(
                f"{where} is static and must be hashable, got {value!r:.80}"
            ) from error


class _Writer:
    """JSON for a tree, and its arrays by name."""

    def __init__(self) -> None:
        self.arrays: dict[str, np.ndarray] = {}
        self._named: dict[str, type] = {}

    def node(self, value: Any, place: str) -> Any:
        """JSON for a value. The value's place is for names and messages."""
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
                if type(key) is not str:
                    raise ValueError(f"thing{place} must have texts as keys: {key!r}")
            nodes = {k: self.node(v, f"{place}[{k!r}]") for k, v in value.items()}
            return {"dict": nodes}
        if isinstance(value, jax.Array):
            return self._jax_array(value, place)
        if kind is np.ndarray or isinstance(value, np.generic):
            tag = "numpy" if kind is np.ndarray else "scalar"
            return self._stored(tag, value, place)
        if kind in PYTREES:
            return self._instance(value, place)
        raise ValueError(
            f"thing{place} is {value!r:.80}, a {kind.__name__}, which a file of arrays "
            "and JSON cannot hold: put its numbers into a class decorated with "
            "jaxrod.extend.pytree, and pass that to jaxrod.load(path, classes=[...])"
        )

    def _instance(self, value: Any, place: str) -> dict[str, Any]:
        cls = type(value)
        name = _name(cls)
        own = name.startswith("jaxrod.") and _own().get(name) is not cls
        if own or self._named.setdefault(name, cls) is not cls:
            raise ValueError(
                f"thing{place} is a {name}, a name that two classes share: rename one"
            )
        nodes = {}
        for field in dataclasses.fields(cls):
            part, where = getattr(value, field.name), f"{place}.{field.name}"
            nodes[field.name] = self.node(part, where)
            _check_static(cls, field.name, part, f"thing{where}")
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
        """JSON for an array, which is kept under the name that it gives."""
        array = np.asarray(value, order="C")
        if array.dtype.kind == "V" and jnp.issubdtype(array.dtype, jnp.number):
            # bfloat16 and similar, which NumPy cannot write.
            more["dtype"] = array.dtype.name
            array = array.view(f"u{array.itemsize}")
        if array.dtype.kind not in "biufc":
            raise ValueError(f"thing{place} must have numbers, got {array.dtype}")
        name = re.sub(r"[^A-Za-z0-9_]+", ".", place).strip(".")[:80] or "value"
        while name in self.arrays:
            name = f"{name}_{len(self.arrays)}"
        self.arrays[name] = array
        return {kind: name, **more}


class _Reader:
    """Values for the JSON of a tree and its arrays."""

    def __init__(self, given: Mapping[str, type]) -> None:
        self.arrays: dict[str, np.ndarray] = {}
        self.wide = ""
        """An array that JAX would make narrower now."""
        self._given = given
        self._classes = {**_own(), **given}

    def node(self, node: Any, place: str) -> Any:
        """Value for JSON.

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
            case {"array": str(name), **rest} if rest.keys() <= {
                "weak",
                "key",
                "dtype",
            }:
                return self._jax_array(name, rest)
            case {"numpy": str(name), **rest} if rest.keys() <= {"dtype"}:
                return self._taken(name, rest).copy()
            case {"scalar": str(name), **rest} if rest.keys() <= {"dtype"}:
                return self._taken(name, rest)[()]
        raise ValueError(f"tree{place} is {node!r:.80}, which save never writes")

    def _instance(self, name: str, nodes: dict[str, Any], place: str) -> Any:
        cls = self._class(name)
        fields = dataclasses.fields(cls)  # type: ignore[arg-type]
        for extra in sorted(nodes.keys() - {field.name for field in fields}):
            raise ValueError(f"tree{place} has {extra!r}, which {name} does not have")
        values = {}
        for field in fields:
            where = f"{place}.{field.name}"
            if field.name in nodes:
                values[field.name] = self.node(nodes[field.name], where)
                _check_static(cls, field.name, values[field.name], f"tree{where}")
            # A field that is younger than the file has its default.
            elif field.default is field.default_factory is dataclasses.MISSING:
                raise ValueError(f"tree{where}, which {name} needs, is missing")
        return cls(**values)

    def _class(self, name: str) -> type:
        """Class of a name, which is looked up and never imported."""
        if name not in self._classes:
            _import_core()
            self._classes = {**_own(), **self._given}
        if name in self._classes:
            return self._classes[name]
        hint = f"if it is yours, call load(path, classes=[{name:.40}])"
        if name.startswith("jaxrod."):
            space = ".".join(name.split(".")[:2])
            hint = "it may be of a newer jaxrod"
            if space.removeprefix("jaxrod.") in _FAR:
                hint = f"import {space} before, or update jaxrod"
        raise UntrustedError(
            f"it has a {name:.80}, which is no class of jaxrod {jaxrod.__version__} "
            f"that is imported: {hint}"
        )

    def _taken(self, name: str, rest: Mapping[str, Any]) -> np.ndarray:
        """An array by its name, which may occur once."""
        if name not in self.arrays:
            raise ValueError(f"it lacks {name:.80}.npy")
        array = self.arrays.pop(name)
        if "dtype" not in rest:
            return array
        dtype = jnp.dtype(rest["dtype"])
        if dtype.kind != "V" or array.dtype != f"u{dtype.itemsize}":
            raise ValueError(f"{name}.npy cannot hold {dtype}")
        return array.view(dtype)

    def _jax_array(self, name: str, rest: Mapping[str, Any]) -> Any:
        array = self._taken(name, rest)
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
    """Imports all public names of the core, whatever the file says."""
    for name in sorted({*jaxrod.__all__, *jaxrod._NAMESPACES} - _FAR):
        # A namespace may lack an optional package.
        with contextlib.suppress(AttributeError):
            getattr(jaxrod, name)
