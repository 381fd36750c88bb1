"""Looking at rods: an offline 3-D player, still pictures, learning curves.

Imports NumPy only; matplotlib is imported by the functions that draw with it.
"""

from jaxrod.viz.curves import learning_curve
from jaxrod.viz.drawing import animation, frame
from jaxrod.viz.page import html, save_html
from jaxrod.viz.paper import PaperResult, paper_result
from jaxrod.viz.replay import Replay
from jaxrod.viz.shapes import Cylinder, Sphere

__all__ = [
    "Cylinder",
    "PaperResult",
    "Replay",
    "Sphere",
    "animation",
    "frame",
    "html",
    "learning_curve",
    "paper_result",
    "save_html",
]
