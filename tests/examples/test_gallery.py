"""The scenes of the gallery: each runs, shows itself and comes near its number."""

import json
import math

import numpy as np
import pytest

from examples.loading import FOLDER, load
from jaxrod.viz import html

GALLERY = load("gallery")
SCENES = GALLERY.SCENES
DOCS = FOLDER.parent / "docs"
# How far from what it should be a scene may be that ran to its end, relatively; the
# octopus' and the nest's are nothing, and are measured in lengths and in radii.
WHOLE = {
    "octopus": 1e-6,
    "snake": 0.02,
    "plectoneme": 1e-3,
    "flagella": 0.03,
    "cilia": 0.01,
    "tendon_arm": 5e-3,
    "pneumatic_arm": 5e-3,
    "gripper": 0.03,
    "knot": 0.03,
    "nest": 0.1,
    "catheter": 0.05,
}


def test_every_scene_has_its_picture_and_its_part_of_the_page():
    page = (DOCS / "gallery.md").read_text()
    assert set(WHOLE) == set(SCENES)
    for name in SCENES:
        assert f"python examples/{name}.py" in page
        picture = DOCS / "gallery" / f"{name}.png"
        assert 10_000 < picture.stat().st_size < 150_000


def test_the_page_is_what_words_and_records_make():
    """`python examples/gallery.py --words` writes it."""
    assert (DOCS / "gallery.md").read_text() == GALLERY.page()
    for name, record in json.loads(GALLERY.RECORDS.read_text()).items():
        off = abs(record["measured"] - record["reference"])
        assert off <= WHOLE[name] * (abs(record["reference"]) or 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_a_scene_runs_shortly_and_shows_itself(name):
    scene = load(name)
    replay, measured, reference = scene.run(0.5)
    assert math.isfinite(measured) and math.isfinite(reference)
    for rods in replay.rods:
        moved = np.ptp(rods.positions, axis=0).max()
        # All but the drawn way of a tip.
        still = rods.name == "way of the tip"
        assert still or moved > 0.02 * np.ptp(rods.positions[0], axis=(0, 1)).max()
    assert scene.LOOK.get("field") in {None, *replay.fields}
    assert len(html(replay)) > 50_000


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_a_whole_scene_comes_near_its_number(name):
    _, measured, reference = load(name).run()
    assert abs(measured - reference) <= WHOLE[name] * (abs(reference) or 1)
