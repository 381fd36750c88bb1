"""One of two processes of a run killed at random moments.

    PYTHONPATH=tests python tests/extremes/host_kills.py --kills 20

Two processes train one run. One of them, at random, is killed (SIGKILL) at a random
moment: before they have found each other, while they compile, train, write, or end. The
other has to stop within 60 s, with an exit code that is not zero and with a sentence of
jaxrod's that says why, unless it had come to its end. Then the run goes on: in turn in
two processes, in one with two devices, and in one with one device. It has to come to
its end; with two devices, as one that was left in peace, to the last bit.
"""

import argparse
import collections
import os
import random
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from extremes import kills

RUN = ["trivial", "--num-envs", "16", "--set", "rollout_steps=32"]
RUN += ["--set", "hidden_sizes=16", "--set", "epochs=2", "--set", "minibatches=2"]
RUN += ["--no-replay", *kills.OFTEN]
WITHIN = 60
"""The other process stops in so many seconds."""
WIDE = ("before the folder", "compiling", "training")
"""Moments that last: the kill comes somewhere in them."""
SENTENCE = re.compile(r"^jaxrod( train)?: .*\b(lost|processes)\b.*\.?$", re.MULTILINE)


def train(folder, devices, steps, *words):
    """A process that trains."""
    words = ["train", *RUN, "--steps", steps, "--devices", str(devices), *words]
    return subprocess.Popen(
        [sys.executable, "-m", "jaxrod", *words, "--out", str(folder)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def pair(folder, steps, *words):
    """Two processes that train together, each on one device."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    words = [*words, "--distributed", "--coordinator", address, "--processes", "2"]
    return [train(folder, 1, steps, *words, "--process-id", str(k)) for k in (0, 1)]


def ended(processes):
    """Waits for processes; what is wrong with how they ended."""
    said = [process.communicate(timeout=600)[1] for process in processes]
    codes = [process.returncode for process in processes]
    return f"codes {codes}: {said}" if any(codes) else ""


def moment(folder):
    """What the run was at, as its folder shows it."""
    if not (folder / "config.json").exists():
        return "before the folder"
    if any(folder.rglob("*.partial")):
        return "writing"
    if (folder / "summary.json").exists():
        return "ending"
    progress = folder / "progress.csv"
    under_way = progress.exists() and len(progress.read_text().splitlines()) > 1
    return "training" if under_way else "compiling"


def kill_one(folder, steps, wanted, chance):
    """Kills one of two; when, how long the other took to stop, what is wrong."""
    processes = pair(folder, steps)
    victim = chance.randrange(2)
    other = processes[1 - victim]
    while moment(folder) != wanted and processes[victim].poll() is None:
        time.sleep(0.001)
    until = time.monotonic() + chance.uniform(0, 3) * (wanted in WIDE)
    while time.monotonic() < until and processes[victim].poll() is None:
        time.sleep(0.001)
    when = moment(folder)
    processes[victim].kill()
    killed = time.monotonic()
    try:
        _, said = other.communicate(timeout=3 * WITHIN)
    except subprocess.TimeoutExpired:
        other.kill()
        return when, 3 * WITHIN, f"did not stop: {other.communicate()[1][-800:]}"
    took = time.monotonic() - killed
    processes[victim].communicate()
    where = f"{when}, process {victim}"
    if other.returncode == 0:
        whole = (folder / "summary.json").exists()
        return where, took, "" if whole else f"code 0 without a result: {said[-800:]}"
    if took > WITHIN:
        return where, took, f"stopped after {took:.0f} s: {said[-800:]}"
    if not SENTENCE.search(said):
        return where, took, f"code {other.returncode}, no sentence: {said[-2000:]}"
    return where, took, ""


def go_on(folder, steps, how):
    """Resumes a run, or begins it where it had not begun; what is wrong."""
    words = ["--resume"] if (folder / "config.json").exists() else []
    if how == "two processes":
        return ended(pair(folder, steps, *words))
    devices = 2 if how == "two devices" else 1
    return ended([train(folder, devices, steps, *words)])


def main():
    """Prints what was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--steps", default="64k")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    chance, faults, longest = random.Random(options.seed), 0, 0.0
    moments = ["before the folder", "compiling", "training", "writing", "ending"]
    moments.insert(3, "training")
    ways = ["two processes", "two devices", "one device"]
    counts = collections.Counter()
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", tempfile.mkdtemp())
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    with tempfile.TemporaryDirectory() as there:
        whole = Path(there) / "whole"
        wrong = ended([train(whole, 2, options.steps)])
        assert not wrong, wrong
        sound = kills.result(whole)
        for k in range(options.kills):
            folder = Path(there) / "killed"
            wanted = moments[k % len(moments)]
            how = ways[(k + k // len(moments)) % len(ways)]
            where, took, wrong = kill_one(folder, options.steps, wanted, chance)
            wrong = wrong or go_on(folder, options.steps, how)
            if not wrong and how == "one device":
                counts["to the end"] += 1
            elif not wrong:
                found = kills.result(folder)
                wrong = ", ".join(kills.differences(found, sound))
                if "files" in wrong:
                    wrong += f": {sorted(set(found[-1]) ^ set(sound[-1]))}"
                counts["equal to the last bit"] += not wrong
            faults, longest = faults + bool(wrong), max(longest, took)
            print(f"{k + 1}. {where}: {took:.1f} s; {how}: {wrong or 'as it should'}")
            sys.stdout.flush()
            shutil.rmtree(folder, ignore_errors=True)
    ends = ", ".join(f"{count} {name}" for name, count in counts.items())
    print(f"{options.kills} kills, at most {longest:.0f} s; {ends}; {faults} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
