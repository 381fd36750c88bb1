"""Speed for accuracy, measured: the cost and the error of a setting.

`tune` finds the cheapest setting of a scene that keeps a tolerance, `measure` says what
one setting costs. In a checkout `jaxrod tradeoff` lays out the whole trade of one of
`SCENES`, PyElastica beside it.
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
