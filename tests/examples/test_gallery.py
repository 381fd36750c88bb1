"""The scenes of the gallery: each runs, shows itself and comes near its number."""

import json
import math
import re

import numpy as np
import pytest

from examples.loading import FOLDER, load
from jaxrod.viz import Replay, html
from jaxrod.viz.page import page_of

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
    "driven_pendulum": 0.05,
    "soft_pendulum": 0.05,
    "lift": 0.02,
    "insert": 0.01,
}


def test_every_scene_has_its_picture_and_its_part_of_the_page():
    page = (DOCS / "gallery.md").read_text()
    assert set(WHOLE) == set(SCENES)
    assert {path.stem for path in (DOCS / "gallery").glob("*.png")} == set(SCENES)
    for name in SCENES:
        assert f"python examples/{name}.py" in page
        picture = DOCS / "gallery" / f"{name}.png"
        assert 10_000 < picture.stat().st_size < 150_000
        assert picture.with_suffix(".json").stat().st_size < 400_000


def test_the_page_is_what_words_and_records_make():
    """`python examples/gallery.py --words` writes it."""
    assert (DOCS / "gallery.md").read_text() == GALLERY.page()
    for name, record in json.loads(GALLERY.RECORDS.read_text()).items():
        off = abs(record["measured"] - record["reference"])
        assert off <= WHOLE[name] * (abs(record["reference"]) or 1)


@pytest.mark.parametrize(
    ("number", "text"),
    [(0.423, "0.4230"), (0.4227, "0.4227"), (0.08, "0.08"), (5.0, "5"), (105.0, "105")],
)
def test_two_numbers_of_a_sentence_have_as_many_digits(number, text):
    assert GALLERY.written(number) == text


@pytest.mark.parametrize("name", SCENES)
def test_the_site_plays_each_recording_in_the_player_of_today(name):
    recording = json.loads((DOCS / "gallery" / f"{name}.json").read_text())
    page = page_of(**recording)
    still = html(Replay.from_nodes(np.zeros((1, 2, 3)), 0.1, [0.0]))
    header = re.compile(r'id="header">(.*?)</script>', re.DOTALL)
    found, known = (json.loads(header.search(text)[1]) for text in (page, still))
    assert set(found) == set(known), "write it again: python examples/gallery.py"
    assert found["frames"] > 20 and found["title"]


def source(name):
    return (FOLDER / f"{name}.py").read_text()


@pytest.mark.parametrize("name", SCENES)
def test_the_suggested_change_is_a_change_of_the_program(name):
    old, new = GALLERY.WORDS[name]["change"]
    assert source(name).count(old) == 1
    compile(source(name).replace(old, new), name, "exec")
    numbers = json.loads(GALLERY.RECORDS.read_text())[name]
    for number in ("changed", "seen", "seen_changed"):
        shown = f"{{{number}}}" in GALLERY.WORDS[name]["then"]
        assert shown == (number in numbers)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_a_changed_scene_does_what_the_page_says(name, monkeypatch):
    # Scenes import the gallery by its name.
    monkeypatch.syspath_prepend(FOLDER)
    record = json.loads(GALLERY.RECORDS.read_text())[name]
    recorded = record.get("changed")
    replay, measured, reference = GALLERY.changed(name).run()
    if name in GALLERY.SEEN:
        seen = GALLERY.SEEN[name](replay)
        assert seen == pytest.approx(record["seen_changed"], rel=0.1)
        assert seen != pytest.approx(record["seen"], rel=0.2)
    if reference == 0:
        assert 0 <= measured <= WHOLE[name]
        return
    # Some are nothing, or far from a state that is reached for certain.
    assert measured == pytest.approx(recorded, rel=0.05, abs=1e-4)


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
