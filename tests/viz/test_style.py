"""The style of charts: colours can be told apart by all readers, and read on white."""

import itertools

import matplotlib as mpl
import numpy as np
import pytest

from jaxrod.viz import style

# Machado, Oliveira and Fernandes (2009), severity 1, for linear RGB.
SIGHTS = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
}
TO_XYZ = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)


def linear(colour):
    """Linear red, green and blue of "#rrggbb" [1]."""
    c = np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def seen(colour, sight):
    """CIELAB of a colour as a reader with this sight sees it."""
    rgb = np.clip(np.sum(SIGHTS[sight] * linear(colour), axis=1), 0, 1)
    x, y, z = np.sum(TO_XYZ * rgb, axis=1) / np.sum(TO_XYZ, axis=1)
    f = [t ** (1 / 3) if t > 0.008856 else 7.787 * t + 16 / 116 for t in (x, y, z)]
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def nearest(colours, sight):
    """Smallest difference of two of the colours, CIE76."""
    pairs = itertools.combinations([seen(colour, sight) for colour in colours], 2)
    return min(np.linalg.norm(a - b) for a, b in pairs)


@pytest.mark.parametrize("sight", SIGHTS)
def test_curves_can_be_told_apart(sight):
    assert nearest(style.COLOURS, sight) > 18
    # Red and green of one lightness cannot.
    assert (nearest(("#b45309", "#15803d"), sight) > 40) == (sight == "normal")


@pytest.mark.parametrize("colour", style.COLOURS)
def test_curves_are_dark_enough_for_white(colour):
    light = float(np.sum(TO_XYZ[1] * linear(colour)))
    assert 1.05 / (light + 0.05) > 3


def test_charts_are_white_and_quiet_whatever_the_settings_of_the_reader():
    with mpl.rc_context({"figure.facecolor": "black"}):
        figure, panels = style.charts(6, 3, rows=2, columns=3)
    assert figure.get_facecolor() == (1, 1, 1, 1)
    assert panels.shape == (2, 3)
    for axes in panels.flat:
        assert not axes.spines["top"].get_visible()
        assert axes.plot([0, 1])[0].get_color() == style.BLUE
