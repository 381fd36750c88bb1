"""A message for a process that the runtime aborts without asking Python.

If another process of a program is lost, JAX's runtime writes many lines and aborts, and
no handler of Python's runs any more. `faulthandler` needs no interpreter. It notifies a
small process that was started before, which then prints the message.
"""

from __future__ import annotations

import faulthandler
import subprocess
import sys
from typing import IO

# The last line before the fault is the message. Output of faults other than aborts is
# passed on unchanged, with its lines of Python.
_LISTENER = """
import signal, sys
for name in ("SIGINT", "SIGTERM", "SIGHUP"):
    if hasattr(signal, name):
        signal.signal(getattr(signal, name), signal.SIG_IGN)
sentence = fault = ""
for line in sys.stdin:
    if fault or line.startswith("Fatal Python error"):
        fault += line
        if fault.rstrip() == "Fatal Python error: Aborted":
            break
    else:
        sentence = line
if fault:
    sys.stderr.write(sentence if "Aborted" in fault.partition("\\n")[0] else fault)
"""


class LastWords:
    """Prints a message if this process aborts; nothing if it ends in another way."""

    def __init__(self) -> None:
        """Starts the listening process, unless `faulthandler` is in use already."""
        self._to: IO[str] | None = None
        if faulthandler.is_enabled():
            return
        listener = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _LISTENER],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
        )
        # The listener outlives this process, and nobody waits for it.
        listener.returncode = 0
        self._to = listener.stdin
        assert self._to
        faulthandler.enable(self._to, all_threads=False)

    def __call__(self, sentence: str) -> None:
        """Sets the message to print from now on, one line."""
        if self._to:
            try:
                self._to.write(sentence.replace("\n", " ") + "\n")
                self._to.flush()
            except OSError:  # The listener was ended: JAX's lines have to do.
                faulthandler.disable()
                self._to = None
