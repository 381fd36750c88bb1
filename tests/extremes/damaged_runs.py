"""Every file of a run damaged in every way, and what the commands make of it.

    PYTHONPATH=tests python tests/extremes/damaged_runs.py

A trial damages one copy of a run and asks for one command. Either the command refuses
in one sentence that names what is damaged, changes nothing and exits with 2; or what
it makes is the same as without the damage. Nothing that is not jaxrod's is ever lost.
"""

import argparse
import contextlib
import hashlib
import io
import json
import re
import shutil
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

import jaxrod
from extremes import damage
from jaxrod import cli
from jaxrod.training.progress import ProgressBar

RUN = ["trivial", "--num-envs", "8", "--set", "rollout_steps=16"]
RUN += ["--set", "hidden_sizes=8", "--set", "epochs=2", "--set", "minibatches=2"]
STEPS, STOPPED_AT = 16_384 * 3, 16_384 * 2

FOREIGN = ("notes.txt", "policy/thesis.txt", "checkpoints/my_model.pt")
"""What somebody else keeps in the folder."""

COMMANDS = {
    "evaluate": ("evaluate", "{}", "--episodes", "2", "--json"),
    "render": ("render", "{}"),
    "resume": ("train", "trivial", "--resume", "--out", "{}", "--json"),
    "overwrite": ("train", *RUN, "--steps", "2k", "--overwrite", "--out", "{}"),
}
READ_BY = {
    "config.json": ("evaluate", "render", "resume", "overwrite"),
    "summary.json": ("resume",),
    "progress.csv": ("render", "resume"),
    "episodes.csv": ("resume",),
    "policy.json": ("evaluate", "render"),
    "policy.npz": ("evaluate", "render"),
    "checkpoint": ("resume",),
}
"""Which commands read a file."""


NOTHING_YET = re.compile("no learning curve: .*(logged anything yet|got none)")

UNKNOWABLE = {
    "a third of the rows",
    "a row less",
    "a row less in the middle",
    "a row twice",
    "a row more",
    "two rows exchanged",
    "a cell that is empty",
    "another number",
    "not a number",
    "a column more",
    "a column less",
    "cut to half",
    "cut to nine tenths",
}
"""What progress.csv alone does not tell; whoever draws it has nothing else."""


def call(*words):
    """Runs a command: exit code, what it printed, and what it said of errors."""
    out, err = io.StringIO(), io.StringIO()
    before = jaxrod.configure_cpu
    jaxrod.configure_cpu = lambda devices=None: None
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            with warnings.catch_warnings():
                warnings.simplefilter("default")
                code = cli.main([str(word) for word in words])
    except SystemExit as stopped:
        code = stopped.code
    finally:
        jaxrod.configure_cpu = before
    return code, out.getvalue(), err.getvalue()


def make_run(folder, seed=3, stopped=True):
    """Makes a run with two checkpoints, stopped or finished."""
    real = ProgressBar.update

    def interrupted(bar, done, *args):
        real(bar, done, *args)
        if stopped and done >= STOPPED_AT:
            import signal

            signal.raise_signal(signal.SIGINT)

    ProgressBar.update = interrupted
    try:
        words = ["--steps", STEPS, "--seed", seed, "--checkpoint-seconds", 0]
        code, _, err = call("train", *RUN, *words, "--out", folder)
    finally:
        ProgressBar.update = real
    assert code == (130 if stopped else 0), err
    if stopped:
        for name in FOREIGN:
            (folder / name).write_text(f"mine: {name}")


def contents(folder):
    """Every file of a folder and a digest of what it holds."""
    return {
        str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).digest()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


def outcome(command, folder, printed):
    """What a command has made, as far as it may not depend on time."""
    if command == "evaluate":
        return json.loads(printed)["returns"]
    if command == "render":
        picture = folder / "learning_curve.png"
        return picture.exists() and hashlib.sha256(picture.read_bytes()).hexdigest()
    if command == "overwrite":
        return json.loads((folder / "summary.json").read_text())["final_score"]
    summary = json.loads((folder / "summary.json").read_text())
    with np.load(folder / "policy" / "policy.npz") as stored:
        policy = {name: stored[name].tolist() for name in stored.files}
    table = (folder / "episodes.csv").read_text()
    kept = ("final_score", "evaluation_score", "env_steps", "episodes", "seed")
    return [policy, table, [summary[name] for name in kept]]


class Attack:
    """A run to damage, and what the commands make of it undamaged."""

    def __init__(self, folder):
        """Makes the runs in a folder."""
        self.folder = folder
        self.run = folder / "run"
        make_run(self.run)
        make_run(folder / "other", seed=4, stopped=False)
        self.copy = folder / "copy"
        self.sound = {}
        for command in COMMANDS:
            code, printed, err = self._attempt(command)
            assert code == 0, err
            self.sound[command] = outcome(command, self.copy, printed)

    def _attempt(self, command, spoil=lambda folder: None):
        shutil.rmtree(self.copy, ignore_errors=True)
        shutil.copytree(self.run, self.copy)
        spoil(self.copy)
        self.before = contents(self.copy)
        return call(*(word.format(self.copy) for word in COMMANDS[command]))

    def trials(self):
        """All of them: the damage in words, what does it, the file, the command."""
        for file in sorted(self.run.rglob("*")):
            name = str(file.relative_to(self.run))
            if not file.is_file() or name in FOREIGN:
                continue
            kind = "checkpoint" if "checkpoints" in name else file.name
            for command in READ_BY.get(kind, ()):
                for what, spoil in damage.of(file):
                    yield f"{name}: {what}", _on(name, spoil), file.name, command
        for what, spoil in damage.of_folders(self.folder / "other"):
            for command in ("evaluate", "render", "resume"):
                yield what, spoil, None, command

    def fault(self, what, spoil, named, command):
        """What is wrong with how a command bears a damage; None if nothing is."""
        try:
            code, printed, err = self._attempt(command, spoil)
        except BaseException as error:
            return f"{type(error).__name__} escaped: {error}"
        after = contents(self.copy)
        lost = [name for name in FOREIGN if name in self.before]
        lost = [name for name in lost if after.get(name) != self.before[name]]
        if lost or (self.copy / "unpickled").exists() or _mine_lost(self.copy, named):
            return f"lost or run: {lost}"
        if "Traceback" in err or code not in (0, 2):
            return f"code {code}: {err[-300:]}"
        if re.search(
            r"[\x00-\x09\x0b-\x1f\x7f-\x9f]", re.sub(r"\r", "", printed + err)
        ):
            return f"raw control characters: {err!r}"
        if code == 0:
            made = outcome(command, self.copy, printed)
            said = command == "render" and NOTHING_YET.search(err)
            drawn = command == "render" and what.partition(": ")[2] in UNKNOWABLE
            same = made == self.sound[command] or said or drawn
            return None if same else "accepted, and something else came of it"
        said = [line for line in err.splitlines() if line.startswith("jaxrod ")]
        if len(said) != 1 or len(said[0]) > 1500:
            return f"not one sentence: {err[-300:]}"
        if str(self.copy) not in said[0] or (named and named not in said[0]):
            return f"does not name {named}: {said[0]}"
        changed = {name for name, was in self.before.items() if after.get(name) != was}
        if command == "render":
            changed -= {"learning_curve.png"}
        if changed:
            return f"refused, but changed {sorted(changed)}"
        return None


def _mine_lost(copy, named):
    """Whether the file in a folder that stands for a file is gone."""
    return any(
        file.name == named and file.is_dir() and not (file / "mine.txt").exists()
        for file in copy.rglob("*")
    )


def _on(name, spoil):
    return lambda folder: spoil(folder / name)


def main():
    """Prints every fault, and how many trials there were."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="of which damages and commands")
    parser.add_argument("--every", type=int, default=1, help="leave some out")
    options = parser.parse_args()
    jaxrod.configure_cpu(1)
    began, faults = time.monotonic(), 0
    with tempfile.TemporaryDirectory() as folder:
        attack = Attack(Path(folder))
        trials = [t for t in attack.trials() if options.only in f"{t[3]} {t[0]}"]
        trials = trials[:: options.every]
        for what, spoil, named, command in trials:
            found = attack.fault(what, spoil, named, command)
            if found:
                faults += 1
                print(f"{command}, {what}: {found}", flush=True)
    took = time.monotonic() - began
    print(f"{len(trials)} trials, {faults} faults, {took:.0f} s")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
