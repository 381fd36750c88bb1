"""Training one cell in a process of its own, watched from here.

A process per cell, because what JAX compiled and holds for one cell is of no use to
the next and is given back only by the end of a process; and because a cell that runs
out of memory then takes nothing else with it. One at a time, on all devices.
"""

from __future__ import annotations

import csv
import fcntl
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from jaxrod.training.interruption import Interruption

POLL_SECONDS = 0.5
LOCK_SECONDS = 120.0
"""How long to wait for a cell whose grid was killed to save and stop [s]."""

LAUNCHER = (sys.executable, "-m", "jaxrod.cli._child")


@contextmanager
def only_one(folder: Path, say: Callable[[str], None]) -> Iterator[int]:
    """Holds the lock of a folder of runs; yields it, for children to hold it too.

    Raises:
        ValueError: another grid, or a cell it left behind, holds it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
    try:
        began, waiting = time.monotonic(), False
        while True:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() - began > LOCK_SECONDS:
                    raise ValueError(
                        f"another `jaxrod reproduce` runs in {folder.parent}"
                    ) from None
                if not waiting:
                    say(f"waiting for another `jaxrod reproduce` in {folder.parent}")
                    waiting = True
                time.sleep(POLL_SECONDS)
        yield lock
    finally:
        os.close(lock)


def run_process(
    words: Sequence[str],
    log: Path,
    *,
    lock: int,
    interruption: Interruption,
    look: Callable[[], None],
) -> int:
    """Runs `jaxrod WORDS` to its end.

    The first Ctrl-C lets it save and stop, a second one kills it.

    Args:
        words: the command.
        log: file that what it says is added to.
        lock: as `only_one` yields it.
        interruption: whether to stop.
        look: called now and then.

    Returns:
        Its exit code, negative for a signal.
    """
    with log.open("a", encoding="utf-8") as said:
        said.write(f"$ jaxrod {shlex.join(words)}\n")
        said.flush()
        # A session of its own: the terminal's Ctrl-C must come from here, once.
        process = subprocess.Popen(
            [*LAUNCHER, *words],
            stdin=subprocess.PIPE,
            stdout=said,
            stderr=said,
            start_new_session=True,
            pass_fds=(lock,),
        )
    assert process.stdin is not None
    told = False
    try:
        while process.poll() is None:
            if interruption.asked and not told:
                process.stdin.close()
                told = True
            look()
            time.sleep(POLL_SECONDS)
    finally:
        if process.poll() is None:
            process.kill()
        process.stdin.close()
        process.wait()
    return process.returncode


def last_words(log: Path) -> str:
    """The last line that a process said."""
    lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "")


def last_row(progress: Path) -> dict[str, str] | None:
    """The last complete row of a progress.csv, None before any."""
    try:
        with progress.open("rb") as file:
            head = file.readline().decode()
            file.seek(max(file.tell(), file.seek(0, os.SEEK_END) - 8192))
            lines = file.read().decode(errors="replace").split("\n")
    except FileNotFoundError:
        return None
    if len(lines) < 2 or not lines[-2]:
        return None
    names, values = next(csv.reader([head])), next(csv.reader([lines[-2]]))
    return dict(zip(names, values, strict=True)) if len(names) == len(values) else None
