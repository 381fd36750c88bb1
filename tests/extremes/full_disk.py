"""Runs of `jaxrod train` whose files may not grow beyond some bytes.

    python tests/extremes/full_disk.py

A limit on the size of files (RLIMIT_FSIZE) stands for a full disk: a write beyond it
fails. Each run has to end with a status other than 0 and one sentence that names the
file, without a traceback and without files half written. Resumed without the limit it
ends as a run that was left in peace: the same policy to the last bit. So does a folder
in which nothing can be made.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

LIMITS = (0, 300, 3_000, 10_000, 30_000)
"""Largest size of a file [bytes]."""
RUN = ["trivial", "--steps", "200k", "--num-envs", "16", "--set", "rollout_steps=32"]
RUN += ["--set", "hidden_sizes=16", "--devices", "1", "--checkpoint-seconds", "0"]


def trained(folder: str, *words: str, limit: int | None = None) -> tuple[int, str]:
    """The status and the last words of a run."""

    def limited() -> None:
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    done = subprocess.run(
        [sys.executable, "-m", "jaxrod", "train", *RUN, *words, "--out", folder],
        capture_output=True,
        text=True,
        preexec_fn=limited,
    )
    return done.returncode, done.stderr


def policy(folder: str) -> dict[str, bytes]:
    """The numbers of a policy."""
    with np.load(Path(folder) / "policy" / "policy.npz") as stored:
        return {name: stored[name].tobytes() for name in stored.files}


def faults_of(limit: int, folder: str, whole: dict[str, bytes]) -> list[str]:
    """Faults of a run under a limit, and of the runs after it."""
    faults = []
    status, words = trained(folder, limit=limit)
    print(f"{limit} bytes: status {status}: {words.strip()[-300:]}", flush=True)
    if "Traceback" in words:
        faults.append(f"{limit} bytes: a traceback")
    if list(Path(folder).rglob("*.partial")):
        faults.append(f"{limit} bytes: files half written")
    if status == 0:
        return faults if policy(folder) == whole else [*faults, f"{limit} bytes: other"]
    begun = (Path(folder) / "config.json").exists()
    status, words = trained(folder, *["--resume"] * begun)
    if status or policy(folder) != whole:
        faults.append(f"{limit} bytes: does not go on: {status} {words[-300:]}")
    return faults


def main() -> int:
    """Tries all limits and a folder in which nothing can be made."""
    with tempfile.TemporaryDirectory() as place:
        status, words = trained(f"{place}/whole")
        assert status == 0, words
        whole, faults = policy(f"{place}/whole"), []
        for limit in LIMITS:
            faults += faults_of(limit, f"{place}/{limit}", whole)
        status, words = trained("/proc/jaxrod/run")
        print(f"no folder can be made: status {status}: {words.strip()[-300:]}")
        if status == 0 or "Traceback" in words:
            faults.append("a folder that cannot be made")
    print(f"{len(LIMITS) + 1} tried, {len(faults)} faults", *faults, sep="\n")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
