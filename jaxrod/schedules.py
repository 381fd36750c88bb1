"""Numbers that change with time: ramps, sines, tables, and schedules of your own."""

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
