"""The lock of a folder: one process at a time, and none when that is gone."""

import errno
import os
import signal
import subprocess
import sys
import threading

import pytest

from jaxrod.training import folder_lock
from jaxrod.training.folder_lock import FolderInUseError, only_process

HOLD = """
import pathlib, sys, time
from jaxrod.training.folder_lock import only_process
with only_process(pathlib.Path(sys.argv[1])):
    print("holds", flush=True)
    time.sleep(600)
"""


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
    assert (folder / folder_lock.NAME).exists()
    (folder / "something").touch()
    with only_process(folder):
        assert (folder / folder_lock.NAME).read_text().startswith(f"{os.getpid()} ")
    assert [file.name for file in folder.iterdir()] == ["something"]


def test_a_folder_made_for_nothing_is_removed_again(tmp_path):
    with pytest.raises(RuntimeError), only_process(tmp_path / "a" / "b"):
        raise RuntimeError
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]
    (tmp_path / "c").mkdir()
    with only_process(tmp_path / "c"):
        pass
    assert (tmp_path / "c").exists(), "it was there before"


def test_many_at_once_never_hold_it_together(tmp_path):
    """The file is removed at the end of each turn, under those who wait for it."""
    (tmp_path / "kept").touch()
    inside, most, turns = [], [], []

    def take_turns():
        for _ in range(200):
            try:
                with only_process(tmp_path):
                    inside.append(1)
                    most.append(len(inside))
                    inside.pop()
                    turns.append(1)
            except FolderInUseError:
                pass

    threads = [threading.Thread(target=take_turns) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert set(most) == {1}
    assert len(turns) > 4


def test_a_file_system_without_locks_is_told_of(tmp_path, monkeypatch):
    def unknown(handle):
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(folder_lock, "_lock", unknown)
    with (
        pytest.warns(folder_lock.UnlockedFolderWarning, match="has no locks"),
        only_process(tmp_path),
    ):
        pass
