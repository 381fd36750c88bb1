"""Visualisation of rods: 3-D player, live page, stills, films, learning curves.

It imports NumPy only. The functions that draw with matplotlib, which brings Pillow,
import it themselves. Those that evaluate a scene or a system import JAX.
"""

from importlib import import_module
from typing import Any

import jaxrod.spelling
from jaxrod.viz.curves import ReferenceScore, learning_curve
from jaxrod.viz.drawing import animation, film, frame, picture
from jaxrod.viz.page import html, save_html
from jaxrod.viz.replay import Replay, show
from jaxrod.viz.rods import Rods
from jaxrod.viz.shapes import Arrows, Cylinder, Mesh, Sphere

__all__ = [
    "Arrows",
    "Cylinder",
    "Live",
    "Mesh",
    "ReferenceScore",
    "Replay",
    "Rods",
    "Slider",
    "Sphere",
    "Target",
    "animation",
    "bending",
    "film",
    "frame",
    "html",
    "learning_curve",
    "live",
    "picture",
    "save_html",
    "show",
    "speed",
    "stretch",
    "twist_rate",
]

_MODULE_OF = {
    **dict.fromkeys(("bending", "speed", "stretch", "twist_rate"), "recorded"),
    **dict.fromkeys(("Slider", "Target"), "handles"),
    **dict.fromkeys(("Live", "live"), "interactive"),
}
"""Modules of the names that need JAX, which are imported on use."""

_GUESSES = {
    **dict.fromkeys(
        ("animate", "play", "plot", "render", "view", "viewer"),
        "jaxrod.viz.show plays states, and jaxrod.viz.live simulates in real time",
    ),
    **dict.fromkeys(("movie", "save_video", "video"), "it is jaxrod.viz.film"),
    **dict.fromkeys(("image", "save_image"), "it is jaxrod.viz.picture"),
}
"""Hints for names that users of other tools guess, by the guess."""


def __getattr__(name: str) -> Any:
    """Imports a name that needs JAX on use."""
    if name in _MODULE_OF:
        return getattr(import_module(f"jaxrod.viz.{_MODULE_OF[name]}"), name)
    jaxrod.spelling.no_such_name(__name__, name)


def __dir__() -> list[str]:
    return sorted({*__all__, *globals()})
