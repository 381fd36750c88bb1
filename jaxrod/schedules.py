"""Numbers that change with time: ramps, sines, tables, and schedules of your own."""

from jaxrod.effects.schedules import Ramp, Sine, Table, ramp, sine, table, time
from jaxrod.effects.time import Clock, Schedule

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
