"""Looking at rods: an offline 3-D player, still pictures, learning curves."""

from jaxrod.viz.page import html, save_html
from jaxrod.viz.replay import Cylinder, Replay, Sphere

__all__ = ["Cylinder", "Replay", "Sphere", "html", "save_html"]
