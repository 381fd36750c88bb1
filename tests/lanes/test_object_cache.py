"""Machine code on disk: found again, compiled anew where it is damaged or not there."""

import logging
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from jaxrod.lanes.llvm.machine_code import keeps_objects

PROGRAM = """
import time
import jax
jax.config.update("jax_enable_x64", True)
import jaxrod
from lanes import scenes
from jaxrod.lanes.llvm import machine_code
rod, state = scenes.arm(4)
scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity())
dt = 0.5 * jaxrod.stable_dt(scene).dt
jaxrod.use_lanes("always")
run = jax.vmap(lambda v: jaxrod.advance(scene, state, dt * v, 5).positions)
print(repr(float(run(jax.numpy.linspace(0.5, 1.0, 9)).sum())))
assert jaxrod.lane_choices()[-1].taken
"""


class Engine:
    """What an engine is told."""

    def set_object_cache(self, keep, kept):
        self.keep, self.kept = keep, kept


@pytest.fixture
def folder(tmp_path):
    """The folder for compiled programs, for one test."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "programs"))
    yield tmp_path / "programs"
    jax.config.update("jax_compilation_cache_dir", before)


def engine_of(key):
    engine = Engine()
    keeps_objects(engine, key)
    return engine


def test_what_is_kept_is_found_by_its_key_alone(folder):
    first = engine_of("one")
    assert first.kept(None) is None
    first.keep(None, b"code")
    assert engine_of("one").kept(None) == b"code"
    assert engine_of("another").kept(None) is None


@pytest.mark.parametrize("damage", ["cut", "changed", "empty"])
def test_damaged_code_is_not_taken(folder, damage):
    engine_of("one").keep(None, b"code" * 10)
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    changed = whole[:-1] + bytes([whole[-1] ^ 1])
    file.write_bytes({"cut": whole[:-3], "changed": changed, "empty": b""}[damage])
    assert engine_of("one").kept(None) is None


def test_a_folder_that_cannot_be_written_does_no_harm(folder):
    folder.parent.joinpath("programs").write_text("a file, not a folder")
    engine_of("one").keep(None, b"code")
    assert engine_of("one").kept(None) is None


needs_modes = pytest.mark.skipif(
    not hasattr(os, "getuid"), reason="Windows has no owners and modes to look at"
)


@needs_modes
def test_nothing_is_taken_from_a_shared_folder_and_it_is_told_once(folder, caplog):
    engine_of("one").keep(None, b"code")
    folder.chmod(0o777)
    with caplog.at_level(logging.WARNING, "jaxrod.lanes"):
        # Without a cache the engine compiles: nothing stops.
        assert not hasattr(engine_of("one"), "kept")
        assert not hasattr(engine_of("two"), "keep")
    (record,) = caplog.records
    assert "programs is writable by others (mode 0777)" in record.getMessage()
    assert "\n" not in record.getMessage()


@needs_modes
@pytest.mark.parametrize("change", ["mode", "link", "pipe"])
def test_a_file_that_others_may_have_written_is_not_taken(folder, change, tmp_path):
    engine_of("one").keep(None, b"code")
    (file,) = folder.iterdir()
    assert file.stat().st_mode & 0o777 == 0o600
    if change == "mode":
        file.chmod(0o666)
    else:
        file.rename(tmp_path / "moved")
        file.symlink_to(tmp_path / "moved") if change == "link" else os.mkfifo(file)
    assert engine_of("one").kept(None) is None


@needs_modes
def test_the_folder_is_made_for_this_user_alone(folder):
    engine_of("one").keep(None, b"code")
    assert folder.stat().st_mode & 0o777 == 0o700


def test_without_a_folder_nothing_is_kept(folder):
    jax.config.update("jax_compilation_cache_dir", None)
    assert not hasattr(engine_of("one"), "keep")


@pytest.mark.slow
def test_a_second_process_takes_the_code_of_the_first(tmp_path):
    root = Path(__file__).parents[2]
    paths = os.pathsep.join((str(root / "tests"), str(root)))
    programs = tmp_path / "programs"
    env = os.environ | {
        "PYTHONPATH": paths,
        "JAX_COMPILATION_CACHE_DIR": str(programs),
    }

    def said():
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM],
            env=env,
            cwd=root,
            capture_output=True,
            text=True,
            check=True,
        )
        return done.stdout

    first = said()
    (file,) = programs.glob("jaxrod-lanes-*")
    code, written = file.read_bytes(), file.stat().st_mtime_ns
    assert said() == first
    assert file.stat().st_mtime_ns == written
    # Damaged, it is compiled and written anew.
    file.write_bytes(code[:-100])
    assert said() == first
    assert file.read_bytes() == code
