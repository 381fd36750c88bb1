"""Ctrl-C handling that lets the current chunk of updates finish."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any


class Interruption:
    """Turns SIGINT and SIGTERM into a request to stop, while the context lasts.

    The first signal sets `requested`; a second one raises KeyboardInterrupt. Outside
    the main thread, where Python allows no handlers, nothing changes.
    """

    def __init__(self, log: Callable[[str], None]) -> None:
        """Prepares the handlers, which only act within the context.

        Args:
            log: Function called at the first signal with a message for the user.
        """
        self.requested = False
        self._log = log
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Interruption:
        """Installs the handlers of SIGINT and SIGTERM."""
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Restores the previous signal handlers."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        self._log("finishing this chunk and saving; once more to stop at once")
