"""A copy of the tree in a temporary folder, in which faults are planted and tested."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

NEEDED = ("jaxrod", "envs", "training", "tests", "benchmarks", "examples", "docs")
FAILED = re.compile(r"^(?:FAILED|ERROR) (\S.*?)(?: - |$)", re.MULTILINE)


@dataclass(frozen=True)
class Run:
    """The outcome of some tests."""

    outcome: str
    """passed, failed, or no end: the time ran out."""
    test: str = ""
    """The first that failed."""


class Copy:
    """A tree to plant faults in; the checkout is never touched."""

    def __init__(self, root: Path) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="planted-faults-")
        self.root = Path(self._folder.name) / "tree"
        for name in NEEDED:
            shutil.copytree(
                root / name, self.root / name, ignore=shutil.ignore_patterns("__pyc*")
            )
        for path in root.iterdir():
            if path.is_file() and not path.name.startswith("."):
                shutil.copy2(path, self.root / path.name)
        # As they are installed: inside the package.
        for name in ("envs", "training"):
            (self.root / "jaxrod" / name).symlink_to(f"../{name}")
        self._compiled = Path(self._folder.name) / "compiled"

    def close(self) -> None:
        """Removes it."""
        self._folder.cleanup()

    def imports_itself(self) -> bool:
        """Whether tests there import the copy, and not what is installed."""
        made = subprocess.run(
            [sys.executable, "-c", "import jaxrod.training as t; print(t.__file__)"],
            cwd=self.root,
            env=self._environment(),
            capture_output=True,
            text=True,
        )
        return made.stdout.strip().startswith(str(self.root))

    def _environment(self) -> dict[str, str]:
        return os.environ | {
            "PYTHONPATH": str(self.root),
            "JAXROD_TESTS_COMPILED": str(self._compiled),
            "PYTHONDONTWRITEBYTECODE": "",
        }

    @contextmanager
    def planted(self, file: str, source: str):
        """With another text in a file, for a while."""
        path = self.root / file
        before = path.read_text()
        try:
            self._write(path, source)
            yield
        finally:
            self._write(path, before)

    @staticmethod
    def _write(path: Path, text: str) -> None:
        path.write_text(text)
        # Compiled files are told by size and second alone.
        for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
            compiled.unlink()

    def run(self, tests: list[str], limit: float) -> Run:
        """The fast tests of some files, or single ones, until the first failure."""
        self._compiled.mkdir(exist_ok=True)
        process = subprocess.Popen(
            [
                *(sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow"),
                *("-p", "no:cacheprovider", "--tb=no", "-rfE", *tests),
            ],
            cwd=self.root,
            env=self._environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        said = _said(process, limit)
        if said is None:
            # What was being written may be half of a program.
            shutil.rmtree(self._compiled, ignore_errors=True)
            return Run("no end")
        # 5: there is no fast test among them.
        if process.returncode in (0, 5):
            return Run("passed")
        found = FAILED.search(said)
        if found is None and process.returncode > 0:
            raise RuntimeError(f"pytest could not run {tests}:\n{said[-2000:]}")
        return Run("failed", found[1] if found else f"signal {-process.returncode}")


def _said(process: subprocess.Popen, limit: float) -> str | None:
    """Output of a process; `None` if it is killed after the limit."""
    waited = 0
    try:
        while True:
            try:
                return process.communicate(timeout=1)[0]
            except subprocess.TimeoutExpired:
                # Counted: this program may have been stopped for a while meanwhile.
                waited += 1
                if waited >= limit:
                    return None
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
