"""Trade-off of speed and accuracy, measured: the cost and the error of a setting.

`tune` finds the cheapest setting of a scene within an allowed error. `measure` gives
the cost and the error of one setting. In a checkout `jaxrod tradeoff` shows the whole
trade-off of one of `SCENES`, next to PyElastica's.
"""

from jaxrod.tradeoff.measure import (
    Measurement,
    Reference,
    Setting,
    measure,
    prepare,
    reference,
)
from jaxrod.tradeoff.scenes import SCENES, rope, slam, swing, tracking_arm
from jaxrod.tradeoff.tuning import Tuned, tune
from jaxrod.tradeoff.workload import Workload, workload_of

__all__ = [
    "SCENES",
    "Measurement",
    "Reference",
    "Setting",
    "Tuned",
    "Workload",
    "measure",
    "prepare",
    "reference",
    "rope",
    "slam",
    "swing",
    "tracking_arm",
    "tune",
    "workload_of",
]
