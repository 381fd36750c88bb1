"""Numbers that change with time: ramps, sines, tables, and schedules of your own."""

from functools import partial
from typing import TYPE_CHECKING

import jaxrod.spelling
from jaxrod.effects.time import (
    Clock,
    Ramp,
    Schedule,
    Sine,
    Table,
    ramp,
    sine,
    table,
    time,
)

__all__ = [
    "Clock",
    "Ramp",
    "Schedule",
    "Sine",
    "Table",
    "ramp",
    "sine",
    "table",
    "time",
]

if not TYPE_CHECKING:
    __getattr__ = partial(jaxrod.spelling.no_such_name, __name__)
