"""Compiled programs kept on disk: the same numbers, whatever becomes of the files."""

import os
import random
import re
import subprocess
import sys
from pathlib import Path

import jax
import pytest

import jaxrod
from jaxrod import cli
from jaxrod.installation import backend, doctor, program_cache
from jaxrod.private_folders import shared_with

REFUSED = "Error reading persistent compilation cache entry"

# The tip of a swinging rod, to the last bit; programs from the cache, and compiled.
PROGRAM = """
import os, sys
import jax
import numpy as np
import jaxrod
jaxrod.configure_cpu(1)
counted = {"hits": 0, "misses": 0}
def count(name, **_):
    kind = name.rpartition("cache_")[2]
    if name.startswith("/jax/compilation_cache/cache_") and kind in counted:
        counted[kind] += 1
jax.monitoring.register_event_listener(count)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
rod, start = jaxrod.straight_rod(
    8, length=1.0, radius=0.05, density=1000.0, youngs_modulus=1e7
)
scene = jaxrod.make_scene(rod, jaxrod.clamp(start), jaxrod.gravity())
state = jaxrod.advance(scene, start, 1e-4, 200)
print(np.asarray(state.tip).tobytes().hex(), counted["hits"], counted["misses"])
"""


def started(folder):
    kept = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS")
    environment = {name: os.environ[name] for name in os.environ if name not in kept}
    environment |= {"JAXROD_CACHE": str(folder), "TF_CPP_MIN_LOG_LEVEL": "3"}
    return subprocess.Popen(
        [sys.executable, "-W", "always", "-c", PROGRAM],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def ended(process):
    """The tip, hits, misses, and what was said."""
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    tip, hits, misses = out.split()
    return tip, int(hits), int(misses), err


@pytest.fixture
def as_before():
    """Leaves JAX's settings as they are."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def test_each_processor_has_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    here = program_cache.default_folder()
    assert here.parent == tmp_path / "jaxrod"
    assert here == program_cache.default_folder()
    monkeypatch.setattr(program_cache, "processor_features", lambda: "another")
    assert program_cache.default_folder() not in (here, here.parent)
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert program_cache.default_folder().parent == Path.home() / ".cache" / "jaxrod"


def test_the_features_are_those_of_one_core(monkeypatch):
    core = "processor : {}\nmodel name : Quick\ncpu MHz : {}\nflags : fpu vme\n\n"
    text = core.format(0, 1234.5) + core.format(1, 2345.6)
    monkeypatch.setattr(Path, "read_text", lambda self: text)
    found = program_cache.processor_features()
    assert found.count("Quick") == found.count("flags: fpu vme") == 1
    assert "MHz" not in found


@pytest.mark.parametrize(
    ("word", "asked"),
    [("", None), ("0", False), ("1", True), (" 1 ", True), ("here", "here")],
)
def test_the_variable_says_no_yes_where_or_nothing(word, asked, monkeypatch):
    monkeypatch.setenv("JAXROD_CACHE", word)
    assert program_cache.asked_for() == asked


def test_a_folder_that_jax_was_given_stays(as_before, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(program_cache, "without_checksum", lambda: False)
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "given"))
    assert program_cache.keep_programs() == tmp_path / "given"
    assert program_cache.keep_programs(tmp_path / "other") == tmp_path / "other"
    jax.config.update("jax_compilation_cache_dir", None)
    assert program_cache.keep_programs() == program_cache.default_folder()
    own = Path(jax.config.jax_compilation_cache_dir)
    assert own.parent == program_cache.default_folder()


def test_nothing_is_kept_without_a_checksum(as_before, tmp_path, monkeypatch):
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setattr(program_cache, "without_checksum", lambda: True)
    with pytest.warns(program_cache.UncheckedCacheWarning, match="zstandard"):
        assert program_cache.keep_programs(tmp_path) is None
    assert jax.config.jax_compilation_cache_dir is None


@pytest.mark.parametrize("cache", ["", 3, 1.5, [True]])
def test_what_is_no_folder_is_refused_in_words(cache):
    with pytest.raises(ValueError, match="cache must be True, False or a folder"):
        jaxrod.configure_cpu(1, cache=cache)


@pytest.mark.parametrize("inside", [(), ("below",)])
def test_a_file_in_the_place_of_the_folder_is_refused_by_its_name(
    as_before, inside, tmp_path, monkeypatch
):
    monkeypatch.setattr(program_cache, "without_checksum", lambda: False)
    taken = tmp_path / "taken"
    taken.write_text("something else")
    with pytest.raises(ValueError, match=r"cannot make the folder.*taken"):
        program_cache.keep_programs(taken.joinpath(*inside))
    assert taken.read_text() == "something else"


SHARED = pytest.mark.skipif(
    not hasattr(os, "getuid"), reason="Windows has no owners and modes to look at"
)


@SHARED
def test_a_folder_that_others_write_to_is_refused_and_the_run_goes_on(
    as_before, tmp_path, monkeypatch
):
    monkeypatch.setattr(program_cache, "without_checksum", lambda: False)
    jax.config.update("jax_compilation_cache_dir", None)
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    said = "neither kept nor taken .*shared is writable by others \\(mode 0777\\)"
    with pytest.warns(program_cache.SharedCacheWarning, match=said):
        assert program_cache.keep_programs(shared) is None
    assert jax.config.jax_compilation_cache_dir is None


def test_a_folder_that_is_made_is_for_this_user_alone(as_before, tmp_path, monkeypatch):
    monkeypatch.setattr(program_cache, "without_checksum", lambda: False)
    made = program_cache.keep_programs(tmp_path / "a" / "b")
    if os.name == "posix":
        assert [one.stat().st_mode & 0o777 for one in (made, made.parent)] == [
            0o700
        ] * 2


@SHARED
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda folder: folder.chmod(0o755), None),
        (lambda folder: folder.chmod(0o700), None),
        (lambda folder: folder.rmdir(), None),
        (lambda folder: folder.parent.chmod(0o1777), None),
        (lambda folder: folder.chmod(0o770), "kept is writable by others .mode 0770"),
        (lambda folder: folder.chmod(0o702), "kept is writable by others .mode 0702"),
        (lambda folder: folder.parent.chmod(0o777), "above, above it, is writable"),
        (lambda folder: folder.parent.chmod(0o770), "above, above it, is writable"),
        (lambda folder: linked(folder), "kept is a link to"),
    ],
)
def test_owner_and_mode_are_looked_at_as_ssh_does(change, said, tmp_path):
    folder = tmp_path / "above" / "kept"
    folder.mkdir(parents=True, mode=0o700)
    folder.parent.chmod(0o755)
    change(folder)
    found = shared_with(folder)
    assert found is None if said is None else re.search(said, found)


@SHARED
def test_a_folder_of_another_user_is_refused(tmp_path, monkeypatch):
    me = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: me + 1)
    assert f"belongs to user {me}, not" in shared_with(tmp_path)


def test_where_there_are_no_modes_nothing_is_looked_at(tmp_path, monkeypatch):
    tmp_path.chmod(0o777)
    monkeypatch.delattr(os, "getuid", raising=False)
    assert shared_with(tmp_path) is None


def linked(folder):
    folder.rmdir()
    (folder.parent / "real").mkdir(mode=0o700)
    folder.symlink_to(folder.parent / "real")


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("garbage", "got 'garbage', which is not a readable file"),
        ("/nowhere/flags", "got '/nowhere/flags', which is not a readable file"),
        ("-x=1", "got '-x=1' among them"),
        ("--xla_cpu_enable_fast_math=false garbage", "got 'garbage' among them"),
        ("--xla_dump_to='/tmp", "No closing quotation"),
    ],
)
def test_xla_flags_that_are_none_are_refused_before_jax_starts(
    flags, said, monkeypatch
):
    """XLA itself would end the process, or leave them out without a word."""
    monkeypatch.setenv("XLA_FLAGS", flags)
    monkeypatch.setattr(backend, "_backend_is_running", lambda: False)
    with pytest.raises(ValueError, match=f"XLA_FLAGS must be options .*{said}"):
        jaxrod.configure_cpu(1)


@pytest.mark.parametrize(
    "flags",
    [
        "",
        "  ",
        "--xla_cpu_enable_fast_math",
        "--xla_that_a_later_release_has=1  --another=2",
        "--xla_dump_to='/tmp/a b' --xla_dump_hlo_as_text",
    ],
)
def test_flags_that_only_xla_can_judge_are_left_to_it(flags, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", flags)
    assert backend.given_options() == flags.strip()


def test_a_file_of_xla_flags_is_read(monkeypatch, tmp_path):
    """With options of jaxrod's beside it, its name would be no name of a file."""
    (tmp_path / "flags").write_text("--xla_a=1\n--xla_b=2\n")
    monkeypatch.setenv("XLA_FLAGS", str(tmp_path / "flags"))
    assert backend.given_options() == "--xla_a=1 --xla_b=2"


def test_a_home_folder_may_be_short(as_before, tmp_path, monkeypatch):
    monkeypatch.setattr(program_cache, "without_checksum", lambda: False)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert program_cache.keep_programs("~/kept") == tmp_path / "kept"


def test_xla_is_silenced_only_where_it_raises_false_alarms(monkeypatch):
    level = "TF_CPP_MIN_LOG_LEVEL"
    monkeypatch.setenv(level, "")
    program_cache.silence_false_alarms()
    assert os.environ[level] == "", "too late: JAX is loaded"
    monkeypatch.delitem(sys.modules, "jaxlib")
    for release, said in (("0.12.0.1", ""), ("0.10.1", "3")):
        monkeypatch.setattr(
            program_cache.metadata, "version", lambda name, said=release: said
        )
        program_cache.silence_false_alarms()
        assert os.environ[level] == said
    monkeypatch.setenv(level, "1")
    program_cache.silence_false_alarms()
    assert os.environ[level] == "1"


checked = pytest.mark.skipif(
    program_cache.without_checksum(), reason="nothing is kept without a checksum"
)


@checked
@pytest.mark.slow
def test_a_second_process_compiles_nothing_and_computes_the_same(tmp_path):
    first = ended(started(tmp_path))
    second = ended(started(tmp_path))
    assert first[1] == 0 < first[2]
    assert second[1:3] == (first[2], 0)
    assert first[0] == second[0] == ended(started(0))[0]
    assert REFUSED not in second[3]


@checked
@pytest.mark.slow
def test_damaged_files_are_told_and_cost_time_only(tmp_path):
    tip, _, misses, _ = ended(started(tmp_path))
    files = sorted(file for file in tmp_path.rglob("*-cache"))
    assert len(files) == misses
    rng = random.Random(0)
    for k, file in enumerate(files):
        content = bytearray(file.read_bytes())
        at = rng.randrange(len(content))
        if k % 3 == 0:
            content[at] ^= 1 << rng.randrange(8)
        else:  # As a process leaves it that is killed while it writes.
            content = content[: at if k % 3 == 1 else 0]
        file.write_bytes(content)
    again, _, _, said = ended(started(tmp_path))
    assert again == tip
    assert said.count(REFUSED) == misses


@checked
@pytest.mark.slow
def test_processes_that_fill_one_folder_at_once_compute_the_same(tmp_path):
    both = [started(tmp_path), started(tmp_path)]
    tips = {ended(process)[0] for process in both}
    tip, _, misses, said = ended(started(tmp_path))
    assert tips == {tip}
    assert misses == 0
    assert REFUSED not in said


@checked
@pytest.mark.slow
def test_the_command_keeps_what_it_compiled(tmp_path):
    words = ["train", "trivial", "--steps", "2k", "--num-envs", "8"]
    words += ["--set", "rollout_steps=32", "--no-replay", "--json", "--out"]
    kept = ("JAX_COMPILATION_CACHE_DIR", "JAXROD_CACHE", "TF_CPP_MIN_LOG_LEVEL")
    environment = {name: os.environ[name] for name in os.environ if name not in kept}
    environment["XDG_CACHE_HOME"] = str(tmp_path / "caches")
    policies, said = [], []
    for name in ("first", "second"):
        done = subprocess.run(
            [sys.executable, "-m", "jaxrod", *words, str(tmp_path / name)],
            env=environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        policies.append((tmp_path / name / "policy" / "policy.npz").read_bytes())
        said.append(done.stderr)
    assert policies[0] == policies[1]
    assert list((tmp_path / "caches" / "jaxrod").rglob("*-cache"))
    assert "AOT" not in said[1]


def test_the_help_names_the_variable():
    assert "JAXROD_CACHE=0" in cli.EPILOG


@pytest.fixture
def kept_in(as_before, tmp_path, monkeypatch):
    """A folder of caches of which nothing is known, and no setting."""
    monkeypatch.setattr(program_cache, "without_checksum", lambda: False)
    monkeypatch.setattr(program_cache, "_is_loud", lambda: False)
    monkeypatch.delenv("JAXROD_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    jax.config.update("jax_compilation_cache_dir", None)
    return program_cache.default_folder()


def processes_of(folder):
    return sorted(folder.glob("jaxrod-process-*"))


def test_programs_are_kept_where_nobody_says_otherwise(kept_in):
    assert program_cache.keep_programs(asked=False) == kept_in
    (own,) = processes_of(kept_in)
    assert jax.config.jax_compilation_cache_dir == str(own)
    assert own.stat().st_mode & 0o777 == 0o700 or os.name != "posix"
    # A second call in the same process changes nothing.
    assert program_cache.keep_programs(asked=False) == kept_in
    assert processes_of(kept_in) == [own]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda m: m.setenv("JAXROD_CACHE", "0"), "JAXROD_CACHE is 0"),
        (
            lambda m: m.setattr(program_cache, "without_checksum", lambda: True),
            "zstandard",
        ),
        (lambda m: m.setattr(program_cache, "_is_loud", lambda: True), "false alarm"),
    ],
)
def test_where_programs_cannot_be_kept_nothing_is_said_but_by_doctor(
    kept_in, change, why, monkeypatch
):
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "")
    change(monkeypatch)
    assert program_cache.keep_programs(asked=False) is None
    assert jax.config.jax_compilation_cache_dir is None
    assert not kept_in.exists()
    found = doctor.check_program_cache()
    assert found.ok and why in found.advice


def test_doctor_says_where_programs_are_and_how_large(kept_in):
    kept_in.mkdir(parents=True, mode=0o700)
    (kept_in / "a-cache").write_bytes(bytes(2_000_000))
    assert "1 files, 2.0 MB of 1,000 MB in" in doctor.check_program_cache().detail


def test_a_process_adds_its_whole_files_when_it_ends(kept_in):
    kept_in.mkdir(parents=True, mode=0o700)
    (kept_in / "old-cache").write_bytes(b"old")
    own = program_cache._folder_of_this_process(kept_in)
    assert (own / "old-cache").read_bytes() == b"old"
    (own / "new-cache").write_bytes(b"new")
    (own / "tables").mkdir()
    assert not (kept_in / "new-cache").exists()
    program_cache._give_back(own, os.getpid() + 1)  # a child that was forked
    assert own.exists()
    (kept_in / "both-cache").write_bytes(b"first")
    (own / "both-cache").write_bytes(b"second")
    program_cache._give_back(own, os.getpid())
    assert sorted(file.name for file in kept_in.iterdir()) == [
        "both-cache",
        "new-cache",
        "old-cache",
    ]
    assert (kept_in / "both-cache").read_bytes() == b"first"


def test_what_was_not_used_for_longest_goes_and_folders_of_killed_processes_too(
    kept_in, monkeypatch
):
    monkeypatch.setattr(program_cache, "MOST_BYTES", 250)
    kept_in.mkdir(parents=True, mode=0o700)
    (kept_in / "mine.npz").write_bytes(bytes(500))  # not jaxrod's: never touched
    os.utime(kept_in / "mine.npz", (1e8, 1e8))
    for name, age in (("a", 3), ("b", 1), ("c", 2)):
        (kept_in / f"{name}-cache").write_bytes(bytes(100))
        os.utime(kept_in / f"{name}-cache", (1e9 - age, 1e9 - age))
    for name in ("jaxrod-process-killed", "jaxrod-process-alive", "else"):
        (kept_in / name).mkdir()
    for name in ("jaxrod-process-killed", "else"):
        os.utime(kept_in / name, (1e9, 1e9))
    own = program_cache._folder_of_this_process(kept_in)
    assert sorted(file.name for file in own.iterdir()) == ["b-cache", "c-cache"]
    assert {entry.name for entry in kept_in.iterdir()} == {
        *("b-cache", "c-cache", "jaxrod-process-alive", "else", "mine.npz"),
        own.name,
    }
