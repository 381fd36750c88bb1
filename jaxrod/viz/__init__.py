"""Visualisation of rods: an offline 3-D player, stills, films, learning curves.

It imports NumPy only. The functions that draw with matplotlib, which brings Pillow,
import it themselves. Those that evaluate a scene or a system import JAX.
"""

from typing import Any

from jaxrod.viz.curves import ReferenceScore, learning_curve
from jaxrod.viz.drawing import animation, film, frame, picture
from jaxrod.viz.page import html, save_html
from jaxrod.viz.replay import Replay, show
from jaxrod.viz.rods import Rods
from jaxrod.viz.shapes import Arrows, Cylinder, Mesh, Sphere

__all__ = [
    "Arrows",
    "Cylinder",
    "Mesh",
    "ReferenceScore",
    "Replay",
    "Rods",
    "Sphere",
    "animation",
    "bending",
    "film",
    "frame",
    "html",
    "learning_curve",
    "picture",
    "save_html",
    "show",
    "speed",
    "stretch",
    "twist_rate",
]

_MEASURES = ("bending", "speed", "stretch", "twist_rate")


def __getattr__(name: str) -> Any:
    """Imports `bending`, `speed`, `stretch` or `twist_rate` on use: they need JAX."""
    if name in _MEASURES:
        from jaxrod.viz import recorded

        return getattr(recorded, name)
    raise AttributeError(f"module 'jaxrod.viz' has no attribute {name!r}")
