"""Clocks that can be stopped, and one core for a process."""

from __future__ import annotations

import os
import time

import numpy as np


class Clocks:
    """Wall-clock and processor time that can be stopped."""

    def __init__(self) -> None:
        """Starts both clocks."""
        self.passed = np.zeros(2)
        self.go()

    def go(self) -> None:
        """Continues."""
        self.began = self._now()

    def stop(self) -> None:
        """Stops."""
        self.passed = self.passed + self._now() - self.began

    def read(self) -> tuple[float, float]:
        """Seconds that both clocks have run."""
        wall, cpu = self.passed + self._now() - self.began
        return float(wall), float(cpu)

    @staticmethod
    def _now() -> np.ndarray:
        return np.array([time.perf_counter(), time.process_time()])


def pin_to_one_core() -> None:
    """Keeps this process, and those it starts, on one core where the system can."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
