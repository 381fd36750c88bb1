"""Measures the trade-off of speed and accuracy: cost and error of settings of a run.

`tune` finds the cheapest setting of a scene within an allowed error. `measure` gives
the cost and the error of one setting. `reductions` tells what a model can leave out.
In a checkout, `jaxrod tradeoff` shows the trade-off for one of `SCENES`, next to that
of PyElastica.
"""

from functools import partial
from typing import TYPE_CHECKING

import jaxrod.spelling
from jaxrod.tradeoff.measure import (
    Measurement,
    Reference,
    Setting,
    measure,
    prepare,
    reference,
)
from jaxrod.tradeoff.reductions import Reduction, reductions
from jaxrod.tradeoff.tuning import Tuned, tune
from jaxrod.tradeoff.workload import (
    SCENES,
    Workload,
    rope,
    slam,
    swing,
    tracking_arm,
    workload_of,
)

__all__ = [
    "SCENES",
    "Measurement",
    "Reduction",
    "Reference",
    "Setting",
    "Tuned",
    "Workload",
    "measure",
    "prepare",
    "reductions",
    "reference",
    "rope",
    "slam",
    "swing",
    "tracking_arm",
    "tune",
    "workload_of",
]

if not TYPE_CHECKING:
    __getattr__ = partial(jaxrod.spelling.no_such_name, __name__)
