"""No file makes `jaxrod.load` run code, fill the memory, or end in wordless errors."""

import io
import json
import os
import pickle
import struct
import sys
import zipfile

import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod

TREE = "structure.json"


@pytest.fixture
def path(tmp_path):
    """A good file."""
    path = tmp_path / "pull.jaxrod"
    thing = [jaxrod.end_load(force=(1.0, 0.0, 2.0)), np.array([True, False]), 0.5]
    jaxrod.save(path, thing)
    return path


def members_of(path):
    with zipfile.ZipFile(path) as archive:
        return {info.filename: archive.read(info) for info in archive.infolist()}


def write(path, members, how=zipfile.ZIP_STORED):
    """Writes pairs of names and bytes; `zipfile` warns where a name is there twice."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name), content, how)


def npy(array=None, *, header=None, version=b"\x01\x00", data=b""):
    """Bytes of a `.npy` member: of an array, or of any header."""
    if header is None:
        file = io.BytesIO()
        np.save(file, array, allow_pickle=True)
        return file.getvalue()
    text = header.encode() + b"\n"
    return b"\x93NUMPY" + version + struct.pack("<H", len(text)) + text + data


def header(shape="(3,)", descr="'<f8'", by_columns=False):
    return f"{{'descr': {descr}, 'fortran_order': {by_columns}, 'shape': {shape}, }}"


class Bomb:
    """Unpickling it makes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (self.path,)


FORCE, TRUTHS = "0.force.npy", "1.npy"
EYE = np.ones(3)
ARRAYS = {
    "pickled objects": (npy(np.array([Bomb("made")], object)), "must|pickle|object"),
    "a plain pickle": (pickle.dumps(Bomb("made")), "magic"),
    "an object array without its pickle": (npy(header=header(descr="'|O'")), "object"),
    "terabytes in a header": (
        npy(header=header("(1000000000000,)"), data=b"\0" * 24),
        r"must have 8000000000000 bytes for float64\[1000000000000\], got 24",
    ),
    "more numbers than there can be": (
        npy(header=header(f"({2**62}, {2**62})"), data=b"\0" * 24),
        "bytes for",
    ),
    "an empty array with a size beyond all": (
        npy(header=header(f"({2**62}, {2**62}, 0)")),
        "",
    ),
    "fewer bytes than the shape": (npy(EYE)[:-8], "must have 24 bytes.*got 16"),
    "more bytes than the shape": (npy(EYE) + b"\0" * 8, "must have 24 bytes.*got 32"),
    "another dtype than its bytes": (
        npy(header=header(descr="'<f4'"), data=EYE.tobytes()),
        r"must have 12 bytes for float32\[3\], got 24",
    ),
    "negative sizes": (npy(header=header("(-1, -3)"), data=EYE.tobytes()), "bytes for"),
    "texts": (npy(np.array(["abc"])), "<U3 numbers"),
    "records": (npy(np.zeros(1, "i4,f4")), "numbers or an order"),
    "dates": (npy(np.array(["2020-01-01"], "M8[D]")), "datetime64"),
    "columns first": (npy(np.asfortranarray(np.ones((2, 2)))), "an order that save"),
    "code for a header": (npy(header="__import__('os').mkdir('made')"), ""),
    "code for a dtype": (npy(header=header(descr="__import__('os')")), ""),
    "a deep header": (npy(header="(" * 5000 + ")" * 5000), ""),
    "another version of npy": (npy(header=header(), version=b"\x09\x00"), "npy format"),
    "half a header": (npy(EYE)[:40], ""),
    "nothing": (b"", ""),
}


@pytest.mark.parametrize("what", ARRAYS)
def test_hostile_arrays_are_refused(path, what, monkeypatch):
    monkeypatch.chdir(path.parent)
    content, words = ARRAYS[what]
    write(path, (members_of(path) | {FORCE: content}).items())
    with pytest.raises(ValueError, match=rf"pull\.jaxrod is damaged: .*({words})"):
        jaxrod.load(path)
    assert not (path.parent / "made").exists()


def test_truth_values_are_truth_values(path):
    content = npy(header=header("(2,)", "'|b1'"), data=b"\x02\x01")
    write(path, (members_of(path) | {TRUTHS: content}).items())
    with pytest.raises(ValueError, match="neither 0 nor 1"):
        jaxrod.load(path)


def edited(edit):
    """A change of the tree of `structure.json`, which stands in a list."""

    def change(text):
        description = json.loads(text)
        edit(description["tree"])
        return json.dumps(description)

    return change


def put(value, where=2):
    return edited(lambda tree: tree.__setitem__(where, value))


def described(**entries):
    return lambda text: json.dumps(json.loads(text) | entries)


def instance(name, **fields):
    return {"class": name, "fields": fields}


FORCE_NODE = {"array": "0.force"}
STRUCTURES = {
    "a module's function": (put(instance("os.system", command="mkdir made")), "os.sys"),
    "an entry point": (put(instance("numpy:load", file="x")), "numpy:load"),
    "a module that is not imported": (put(instance("antigravity.Fly")), "antigravity"),
    "a path of jaxrod": (put(instance("jaxrod.saving._Reader", given={})), "_Reader"),
    "a class of another namespace": (
        put(instance("jaxrod.envs.Nothing")),
        r"import jaxrod\.envs first",
    ),
    "a builtin": (put(instance("object")), "the class 'object', which"),
    "a field that there is not": (
        edited(lambda tree: tree[0]["fields"].update(__class__=1)),
        "'__class__', which jaxrod.EndLoad does not have",
    ),
    "no field": (
        edited(lambda tree: tree[0]["fields"].pop("couple")),
        r"tree\[0\]\.couple, which jaxrod\.EndLoad needs, is missing",
    ),
    "an array in a static field": (
        edited(lambda tree: tree[0]["fields"].update(end=[1])),
        r"tree\[0\]\.end must be hashable",
    ),
    "an array that there is not": (put({"array": "../x"}), r"it lacks \.\./x\.npy"),
    "an array twice": (put(FORCE_NODE), r"lacks 0\.force\.npy"),
    "an array that nothing names": (put(0, 1), r"1\.npy, which structure\.json does"),
    "a key of no kind": (
        edited(lambda tree: tree.__setitem__(1, {"array": "1", "key": "os.system"})),
        "damaged",
    ),
    "an object of no kind": (put({"py/object": "os.system"}), r"tree\[2\] is \{'py"),
    "more in an object": (put({"tuple": [], "x": 1}), "never writes"),
    "a tuple of none": (put({"tuple": 3}), "never writes"),
    "a float of no kind": (put({"float": "1e5"}), "never writes"),
    "no tree": (lambda text: '{"format":"jaxrod","version":1,"jaxrod":"0"}', "'tree'"),
    "NaN": (lambda text: text.replace("0.5", "NaN"), "NaN is not JSON"),
    "a number beyond floats": (lambda text: text.replace("0.5", "1e999"), "is inf"),
    "a number of many digits": (lambda text: text.replace("0.5", "9" * 5000), "digits"),
    "a key twice": (lambda text: '{"format":"x",' + text[1:], "'format' twice"),
    "a deep nest": (lambda text: "[" * 99999 + "]" * 99999, "nested too deeply"),
    "no object": (lambda text: "[]", "not an object"),
    "half of it": (lambda text: text[: len(text) // 2], "damaged"),
    "no text": (lambda text: b"\xff\xfe\x00", "damaged"),
    "another format": (described(format="numpy"), "'format' must be one of jaxrod"),
    "a newer version": (
        described(version=2, jaxrod="9.1"),
        r"of version 2 of the format, written by jaxrod 9\.1: jaxrod \d.* up to 1$",
    ),
    "no version": (described(version="one"), "'version' must be a whole number"),
}


@pytest.mark.parametrize("what", STRUCTURES)
def test_hostile_structures_are_refused(path, what, monkeypatch):
    monkeypatch.chdir(path.parent)
    change, words = STRUCTURES[what]
    members = members_of(path)
    write(path, (members | {TREE: change(members[TREE].decode())}).items())
    with pytest.raises(ValueError, match=words) as caught:
        jaxrod.load(path)
    assert str(caught.value).startswith(str(path))
    assert not (path.parent / "made").exists()
    assert "antigravity" not in sys.modules


@pytest.mark.parametrize(
    "name", ["/etc/x.npy", "../x.npy", "a/b.npy", "x.py", "C:\\x.npy", "x.npy/", ""]
)
def test_members_with_other_names_are_refused(path, name):
    write(path, [*members_of(path).items(), (name, npy(EYE))])
    with pytest.raises(ValueError, match=r"pull\.jaxrod is damaged: it has a member"):
        jaxrod.load(path)


def test_a_member_twice_or_missing_is_refused(path):
    members = members_of(path)
    with pytest.warns(UserWarning, match="Duplicate name"):
        write(path, [*members.items(), (FORCE, npy(EYE))])
    with pytest.raises(ValueError, match="two members of one name"):
        jaxrod.load(path)
    for name in (TREE, FORCE):
        write(path, [pair for pair in members.items() if pair[0] != name])
        with pytest.raises(ValueError, match=rf"pull\.jaxrod is damaged: .*{name}"):
            jaxrod.load(path)


def test_no_member_is_larger_than_the_file(path):
    """Zip bombs are compressed, or members that share bytes."""
    members = members_of(path) | {FORCE: npy(np.zeros(10**6))}
    write(path, members.items(), zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 1e5
    with pytest.raises(ValueError, match="compressed members"):
        jaxrod.load(path)


def directory(path):
    """Bytes of a file, and where its first entry of the central directory begins."""
    content = bytearray(path.read_bytes())
    return content, content.index(b"PK\x01\x02")


def test_sizes_that_the_file_does_not_have_are_refused(path):
    content, entry = directory(path)
    for size in (2**31, len(content)):
        content[entry + 20 : entry + 28] = struct.pack("<II", size, size)
        path.write_bytes(content)
        with pytest.raises(ValueError, match="more bytes than the file"):
            jaxrod.load(path)


def test_encrypted_members_are_refused(path):
    content, entry = directory(path)
    content[entry + 8] |= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"pull\.jaxrod is damaged"):
        jaxrod.load(path)


def test_files_that_end_early_or_have_other_bytes_are_refused(path):
    """Cut anywhere, or one bit turned in what is read."""
    content = path.read_bytes()
    for size in range(0, len(content), 97):
        path.write_bytes(content[:size])
        with pytest.raises(ValueError, match=r"pull\.jaxrod is damaged"):
            jaxrod.load(path)
    for place in (content.index(b"jaxrod"), content.index(EYE[:1].tobytes())):
        turned = bytearray(content)
        turned[place] ^= 1
        path.write_bytes(turned)
        with pytest.raises(ValueError, match=r"pull\.jaxrod is damaged"):
            jaxrod.load(path)


def test_random_damage_ends_in_a_value_error_or_the_same_thing(path):
    """Bytes that say nothing, such as dates, may differ."""
    content, random = path.read_bytes(), np.random.default_rng(0)
    refused = 0
    for _ in range(300):
        turned = bytearray(content)
        for place in random.integers(len(content), size=random.integers(1, 4)):
            turned[place] = random.integers(256)
        path.write_bytes(turned)
        try:
            load, truths, half = jaxrod.load(path)
        except ValueError as error:
            assert str(path) in str(error)
            refused += 1
        else:
            np.testing.assert_array_equal(load.force, [1.0, 0.0, 2.0])
            assert truths.tolist() == [True, False] and half == 0.5
    assert refused > 200


def test_pipes_and_folders_are_not_read(path):
    os.mkfifo(path.parent / "pipe")
    with pytest.raises(ValueError, match="pipe is damaged: it is not a plain file"):
        jaxrod.load(path.parent / "pipe")
    with pytest.raises(IsADirectoryError):
        jaxrod.load(path.parent)
    with pytest.raises(FileNotFoundError):
        jaxrod.load(path.parent / "nothing")


def test_the_good_file_is_good(path):
    """So what the tests above refuse is what they changed."""
    write(path, members_of(path).items())
    load, truths, half = jaxrod.load(path)
    assert isinstance(load.force, jnp.ndarray) and half == 0.5 and truths[0]
