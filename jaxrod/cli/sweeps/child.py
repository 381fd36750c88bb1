"""Program that runs a command and stops when the process that started it is gone.

`python -P child.py WORDS` acts like `jaxrod WORDS`, but it also reads its standard
input. When that ends, because the process at the other end of the pipe has closed it or
has died, the command saves and stops as after Ctrl-C.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
from pathlib import Path

BROKEN = 70
"""Exit code after an unexpected error, which is a fault of jaxrod."""


def _follow() -> None:
    """Waits for the end of standard input, then sends SIGTERM to this process."""
    while os.read(0, 1024):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def main() -> int:
    """Runs the jaxrod command in the words of this process; returns its exit code."""
    threading.Thread(target=_follow, daemon=True).start()
    try:
        from jaxrod import cli

        return cli.main(sys.argv[1:])
    except Exception:
        traceback.print_exc()
        return BROKEN


if __name__ == "__main__":
    # This package, regardless of the folder in which the command was started.
    sys.path.insert(0, str(Path(__file__).resolve().parents[3]))
    sys.exit(main())
