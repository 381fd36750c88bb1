"""The gallery: shows one scene, or runs all and writes docs/gallery.md.

Each scene is a module here with `build() -> model, state, dt`, `run(share) -> replay,
measured, reference`, a NUMBER as text and how to LOOK at it. Run all with
`python examples/gallery.py`, or those that are named after it.
"""

import importlib
import inspect
import pathlib
import re
import sys
import time

import jax

import jaxrod

SCENES = (
    "octopus",
    "snake",
    "plectoneme",
    "flagella",
    "cilia",
    "tendon_arm",
    "pneumatic_arm",
    "gripper",
    "knot",
    "nest",
)
HEAD = """\
# Gallery

Scenes of the folder `examples`, each at most 80 lines. Every one prints a number with
what it should be, and leaves a picture and a replay that turns, offline, in `runs/`.
This page and its pictures are written by `python examples/gallery.py`; rates are steps
of the whole scene per second of processor time, on the machine that wrote it.

"""
DOCS = pathlib.Path(__file__).parents[1] / "docs"


def show(file, run, number, look):
    """Runs one scene; prints its number, writes its picture and its replay to runs/."""
    jaxrod.configure_cpu()
    name, folder = pathlib.Path(file).stem, pathlib.Path("runs")
    folder.mkdir(exist_ok=True)
    replay, measured, reference = run()
    print(f"{number}: {measured:.4g}, {reference:.4g}")
    jaxrod.viz.picture(replay, path=folder / f"{name}.png", **look)
    jaxrod.viz.save_html(replay, folder / f"{name}.html")
    print(f"{folder / name}.png, {folder / name}.html")


def rate(model, state, dt):
    """Steps per second of processor time."""
    steps, spent = 50, 0.0
    jax.block_until_ready(jaxrod.advance(model, state, dt, steps))
    while spent < 1.0:
        steps *= 2
        start = time.process_time()
        jax.block_until_ready(jaxrod.advance(model, state, dt, steps))
        spent = time.process_time() - start
    return steps / spent


def in_short(number):
    """Two digits, or all before the point."""
    return f"{number:.0f}" if number >= 10 else f"{number:.2g}"


def entry(name):
    """Runs a scene, draws its picture and returns its part of the page."""
    scene = importlib.import_module(name)
    model, state, dt = scene.build()
    replay, measured, reference = scene.run()
    picture = DOCS / "gallery" / f"{name}.png"
    picture.parent.mkdir(exist_ok=True)
    jaxrod.viz.picture(
        replay, path=picture, width=720, height=480, small=True, **scene.LOOK
    )
    steps = rate(model, state, dt)
    title, *_ = inspect.getdoc(scene).split("\n")
    return "\n".join(
        [
            f"## {title.rstrip('.')}\n",
            f"![{replay.title}](gallery/{name}.png)\n",
            f"`python examples/{name}.py`: {scene.NUMBER}:",
            f"**{measured:.4g}**, {reference:.4g}.",
            f"Steps of {1e3 * dt:.3g} ms, {steps:,.0f} of them per second of processor",
            f"time: {in_short(steps * dt)} s of motion.\n\n",
        ]
    )


def page(names):
    """Rewrites the page, and keeps the parts of other scenes."""
    file = DOCS / "gallery.md"
    old = re.split(r"^(?=## )", file.read_text(), flags=re.M) if file.exists() else []
    parts = {name: part for part in old for name in SCENES if f"/{name}.py" in part}
    for name in names:
        parts[name] = entry(name)
        file.write_text("".join([HEAD, *(parts[n] for n in SCENES if n in parts)]))
        print(parts[name])


if __name__ == "__main__":
    jaxrod.configure_cpu()
    page(sys.argv[1:] or SCENES)
