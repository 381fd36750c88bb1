"""Trade-off of speed and accuracy, measured: the cost and the error of a setting.

`tune` finds the cheapest setting of a scene within a tolerance. `measure` gives the
cost and the error of one setting. In a checkout `jaxrod tradeoff` shows the whole
trade-off of one of `SCENES`, next to PyElastica's.
"""

from jaxrod.tradeoff.measure import Measurement, Reference, measure, reference
from jaxrod.tradeoff.problem import Problem, problem_of
from jaxrod.tradeoff.scenes import SCENES, rope, slam, swing, tracking_arm
from jaxrod.tradeoff.setting import Setting, prepare
from jaxrod.tradeoff.tuning import Tuned, tune

__all__ = [
    "SCENES",
    "Measurement",
    "Problem",
    "Reference",
    "Setting",
    "Tuned",
    "measure",
    "prepare",
    "problem_of",
    "reference",
    "rope",
    "slam",
    "swing",
    "tracking_arm",
    "tune",
]
