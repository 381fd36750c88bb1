"""The lock of a folder: one process at a time, and none when that is gone."""

import errno
import os
import signal
import subprocess
import sys

import pytest

from jaxrod.training.runs import owned_folder
from jaxrod.training.runs.owned_folder import FolderInUseError, only_process

HOLD = """
import pathlib, sys, time
from jaxrod.training.runs.owned_folder import only_process
with only_process(pathlib.Path(sys.argv[1])):
    print("holds", flush=True)
    time.sleep(600)
"""


@pytest.mark.slow
def test_a_second_process_is_refused_until_the_first_is_gone_however_it_went(tmp_path):
    folder = tmp_path / "run"
    command = [sys.executable, "-c", HOLD, str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout.readline() == "holds\n"
        refused = rf"run is in use by process {first.pid} on \S+: wait"
        with pytest.raises(FolderInUseError, match=refused), only_process(folder):
            pytest.fail("two at once")
        first.send_signal(signal.SIGKILL)
        first.wait()
    # The file is still there, and nobody holds it.
    assert (folder / owned_folder.LOCK).exists()
    (folder / "something").touch()
    with only_process(folder):
        assert (folder / owned_folder.LOCK).read_text().startswith(f"{os.getpid()} ")
    assert [file.name for file in folder.iterdir()] == ["something"]


def test_a_folder_made_for_nothing_is_removed_again(tmp_path):
    with pytest.raises(RuntimeError), only_process(tmp_path / "a" / "b"):
        raise RuntimeError
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]
    (tmp_path / "c").mkdir()
    with only_process(tmp_path / "c"):
        pass
    assert (tmp_path / "c").exists(), "it was there before"


def test_a_lock_that_was_removed_while_one_waited_for_it_is_not_enough(
    tmp_path, monkeypatch
):
    """Whoever has the lock removes its file; a third one may have made it anew."""
    real, third = owned_folder._lock, []

    def late(handle):
        if not third:
            (tmp_path / owned_folder.LOCK).unlink()
            third.append(os.open(tmp_path / owned_folder.LOCK, os.O_RDWR | os.O_CREAT))
            real(third[0])
        real(handle)

    monkeypatch.setattr(owned_folder, "_lock", late)
    with pytest.raises(FolderInUseError), only_process(tmp_path):
        pytest.fail("two at once")
    os.close(third[0])


def test_a_file_system_without_locks_is_told_of(tmp_path, monkeypatch):
    def unknown(handle):
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(owned_folder, "_lock", unknown)
    with (
        pytest.warns(owned_folder.UnlockedFolderWarning, match="has no locks"),
        only_process(tmp_path),
    ):
        pass
