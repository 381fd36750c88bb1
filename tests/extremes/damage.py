"""Ways of damaging a file of a run."""

import io
import json
import pickle
import shutil
import zipfile

import numpy as np

GENERATOR_SEED = 7


class Malicious:
    """Leaves a mark where it is unpickled."""

    def __init__(self, marker):
        self.marker = str(marker)

    def __reduce__(self):
        return open, (self.marker, "w")


def replaced_by(content):
    """The file is something else."""
    return lambda file: file.write_bytes(content)


def cut(fraction):
    """The file ends too early."""

    def damage(file):
        content = file.read_bytes()
        file.write_bytes(content[: int(len(content) * fraction)])

    return damage


def flipped(bits):
    """Some bits of the file are others."""

    def damage(file):
        random = np.random.default_rng(GENERATOR_SEED + bits)
        content = bytearray(file.read_bytes())
        for place in random.integers(len(content), size=bits):
            content[place] ^= 1 << int(random.integers(8))
        file.write_bytes(content)

    return damage


def overwritten(file):
    """The middle of the file is noise."""
    content = bytearray(file.read_bytes())
    third = len(content) // 3
    noise = np.random.default_rng(GENERATOR_SEED).bytes(third)
    content[third : 2 * third] = noise
    file.write_bytes(content)


def appended(more):
    """There is more at the end."""

    def damage(file):
        with file.open("ab") as stream:
            stream.write(more)

    return damage


def a_folder(file):
    """A folder lies where the file should be."""
    file.unlink()
    file.mkdir()
    (file / "mine.txt").write_text("mine")


def a_broken_link(file):
    """The file is a link to nowhere."""
    file.unlink()
    file.symlink_to(file.parent / "nowhere")


def missing(file):
    """The file is gone."""
    file.unlink()


def pickled(file):
    """The file is a pickle that leaves a mark if it is read."""
    file.write_bytes(pickle.dumps(Malicious(file.parent / "unpickled")))


WHOLE = {
    "missing": missing,
    "empty": replaced_by(b""),
    "cut to half": cut(0.5),
    "cut to nine tenths": cut(0.9),
    "without its last byte": lambda f: f.write_bytes(f.read_bytes()[:-1]),
    "noise": replaced_by(np.random.default_rng(0).bytes(400)),
    "zeros": lambda f: f.write_bytes(bytes(len(f.read_bytes()))),
    "noise in the middle": overwritten,
    "3 bits flipped": flipped(3),
    "50 bits flipped": flipped(50),
    "a pickle": pickled,
    "a folder": a_folder,
    "a broken link": a_broken_link,
}
"""Damages that any file can have."""

AS_TEXT = {
    "null": replaced_by(b"null"),
    "a list": replaced_by(b"[]"),
    "an empty object": replaced_by(b"{}"),
    "a word": replaced_by(b'"x"'),
    "a number": replaced_by(b"1e999"),
    "not a number": replaced_by(b"NaN"),
    "nested too deeply": replaced_by(b"[" * 100_000),
    "in UTF-16": lambda f: f.write_bytes(f.read_text().encode("utf-16")),
    "with a byte order mark": lambda f: f.write_bytes(b"\xef\xbb\xbf" + f.read_bytes()),
    "twice": lambda f: f.write_bytes(2 * f.read_bytes()),
}
"""Damages of text files, JSON above all."""

WRONG = (
    None,
    True,
    -1,
    0,
    1.5,
    1e30,
    10**40,
    10**12,
    "",
    "x",
    "\x1b[2J\x1b]0;owned\x07",
    "../../etc/passwd",
    [],
    {},
    {"name": "x"},
    [[]],
    [10**9],
    float("nan"),
    float("inf"),
)
"""Values that an entry of a JSON file may wrongly have."""


def with_a_key_twice(file):
    """The first entry is there once more, with another value."""
    text = file.read_text()
    name = next(iter(json.loads(text)))
    file.write_text(f'{text.rstrip()[:-1]}, "{name}": "x"}}')


def entries(file):
    """Damages of a JSON file, entry by entry, two levels deep."""
    content = json.loads(file.read_text())
    for path in _paths(content):
        yield f"without {'.'.join(path)}", _changed(path)
        for value in WRONG:
            if not _same(_entry(content, path), value):
                yield f"{'.'.join(path)} = {value!r}", _changed(path, value)


def _paths(content):
    for name, value in content.items():
        yield (name,)
        if isinstance(value, dict):
            yield from ((name, inner) for inner in value)


def _entry(content, path):
    for name in path:
        content = content[name]
    return content


def _same(a, b):
    return type(a) is type(b) and a == b


def _changed(path, *value):
    def damage(file):
        content = json.loads(file.read_text())
        inner = _entry(content, path[:-1])
        if value:
            inner[path[-1]] = value[0]
        else:
            del inner[path[-1]]
        file.write_text(json.dumps(content))

    return damage


def arrays(file):
    """Damages of a `.npz` file, array by array."""
    with np.load(file) as stored:
        names = list(stored.files)
    for name in names:
        for what, change in ARRAYS.items():
            yield f"{name}: {what}", _rewritten(name, change)
    yield "another array", _rewritten("mine", lambda array: np.zeros(3))
    yield "a member that is no array", _with_member


ARRAYS = {
    "gone": lambda array: None,
    "of text": lambda array: np.full(array.shape, "x"),
    "complex": lambda array: np.ones(array.shape, complex),
    "of one axis more": lambda array: array[None],
    "flat": lambda array: np.append(array.ravel(), array.ravel()),
    "empty": lambda array: array.ravel()[:0],
    "whole numbers": lambda array: np.ones(array.shape, np.int8),
}


def _rewritten(name, change):
    def damage(file):
        with np.load(file) as stored:
            content = {key: stored[key] for key in stored.files}
        found = change(content.get(name))
        content.pop(name, None)
        if found is not None:
            content[name] = found
        stream = io.BytesIO()
        np.savez(stream, **content)
        file.write_bytes(stream.getvalue())

    return damage


def _with_member(file):
    with zipfile.ZipFile(file, "a") as archive:
        archive.writestr("notes.txt", "mine")


def numbers(file):
    """Damages of the numbers of a policy."""
    with np.load(file) as stored:
        names = [name for name in stored.files if stored[name].dtype.kind == "f"]
    for name in names:
        for value in (np.nan, np.inf):
            yield (
                f"{name}: {value}",
                _rewritten(name, lambda a, value=value: np.full_like(a, value)),
            )
    for name in ("observation_variance", "observation_count", "observation_limit"):
        yield f"{name}: negative", _rewritten(name, lambda a: -1 - np.abs(a))


def _lines(change):
    def damage(file):
        lines = file.read_text().splitlines(keepends=True)
        file.write_text("".join(change(lines)))

    return damage


def _with_cell(value):
    def change(lines):
        row = lines[1].split(",")
        return [lines[0], ",".join([row[0], value, *row[2:]]), *lines[2:]]

    return _lines(change)


TABLES = {
    "no head": _lines(lambda lines: lines[1:]),
    "the head alone": _lines(lambda lines: lines[:1]),
    "a third of the rows": _lines(lambda lines: lines[: len(lines) // 3]),
    "a row less": _lines(lambda lines: lines[:-1]),
    "a row less in the middle": _lines(lambda lines: lines[:3] + lines[4:]),
    "a row twice": _lines(lambda lines: [*lines[:3], lines[2], *lines[3:]]),
    "two rows exchanged": _lines(
        lambda lines: [*lines[:1], *lines[2:3], *lines[1:2], *lines[3:]]
    ),
    "the head twice": _lines(lambda lines: lines[:1] + lines),
    "a torn row at the end": appended(b"12,3"),
    "a row more": _lines(lambda lines: [*lines, lines[-1]]),
    "a torn row in the middle": _lines(
        lambda lines: [lines[0], lines[1][:2] + "\n", *lines[2:]]
    ),
    "a cell of text": _with_cell("x"),
    "a cell that is empty": _with_cell(""),
    "another number": _with_cell("123456.5"),
    "not a number": _with_cell("nan"),
    "a column more": _lines(lambda lines: [f"{line[:-1]},1\n" for line in lines]),
    "a column less": _lines(
        lambda lines: [line.rpartition(",")[0] + "\n" for line in lines]
    ),
    "ends of lines as on Windows": lambda f: f.write_bytes(
        f.read_bytes().replace(b"\n", b"\r\n")
    ),
    "an open quote": _lines(lambda lines: [lines[0], '"' + lines[1], *lines[2:]]),
    "a byte that is no text": _lines(lambda lines: [lines[0], "\x00" + lines[1]]),
}
"""Damages of CSV files."""


def of(file):
    """All damages of a file, as pairs of words and a function of the file."""
    yield from WHOLE.items()
    if file.suffix in (".json", ".csv"):
        yield from AS_TEXT.items()
    if file.suffix == ".json":
        yield "a key twice", with_a_key_twice
        yield from entries(file)
    if file.suffix == ".csv":
        yield from TABLES.items()
    if file.suffix == ".npz":
        yield from arrays(file)
        if file.name == "policy.npz":
            yield from numbers(file)


def of_folders(run):
    """Damages of a run that are not of one file: pairs of words and a function."""

    def without(name):
        return lambda folder: shutil.rmtree(folder / name)

    def stray(folder):
        (folder / "checkpoints" / "999").mkdir()

    def stray_file(folder):
        (folder / "checkpoints" / "0000000999.npz").write_text("torn")

    def renamed(folder):
        files = sorted((folder / "checkpoints").glob("*.npz"))
        files[-1].rename(files[-1].with_name("0000000999.npz"))

    def exchanged(folder):
        files = sorted((folder / "checkpoints").glob("*.npz"))
        newest = files[-1].read_bytes()
        files[-1].write_bytes(files[0].read_bytes())
        files[0].write_bytes(newest)

    def all_torn(folder):
        for file in (folder / "checkpoints").glob("*.npz"):
            file.write_bytes(file.read_bytes()[:100])

    def newest_gone(folder):
        sorted((folder / "checkpoints").glob("*.npz"))[-1].unlink()

    def from_another(name):
        def damage(folder):
            there = folder / name
            if there.is_dir():
                shutil.rmtree(there)
                shutil.copytree(run / name, there)
            else:
                shutil.copy(run / name, there)

        return damage

    yield "no checkpoints", without("checkpoints")
    yield "no policy", without("policy")
    yield "a stray folder among the checkpoints", stray
    yield "a stray file among the checkpoints", stray_file
    yield "the newest checkpoint renamed", renamed
    yield "the checkpoints exchanged", exchanged
    yield "all checkpoints torn", all_torn
    yield "the newest checkpoint gone", newest_gone
    names = ("config.json", "summary.json", "progress.csv", "episodes.csv")
    for name in (*names, "checkpoints", "policy"):
        yield f"{name} of another run", from_another(name)
