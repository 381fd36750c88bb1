"""The gallery: shows one scene, or runs all and writes docs/gallery.md.

Each scene is a module here with `build() -> model, state, dt`, `run(share) -> replay,
measured, reference`, a NUMBER as text and how to LOOK at it. The words of the page are
in gallery.toml. `python examples/gallery.py --help` lists what it can run.
"""

import argparse
import importlib
import json
import pathlib
import time
import tomllib

import jax

import jaxrod

SCENES = tuple(
    "octopus snake plectoneme flagella cilia tendon_arm pneumatic_arm gripper knot "
    "nest catheter".split()
)
HEAD = """\
# Gallery

Each scene is a program of at most 80 lines. It checks one number against a known value.
Run it from a checkout: it writes a picture and a replay to the folder `runs`. Open the
replay in any browser, and turn, stop and slow the motion there.

`python examples/gallery.py` wrote this page. Speeds are per second of processor time.

"""
DOCS = pathlib.Path(__file__).parents[1] / "docs"
RECORDS = DOCS / "gallery" / "records.json"


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


def measure(name):
    """Runs a scene, draws its picture and returns its numbers."""
    scene = importlib.import_module(name)
    model, state, dt = scene.build()
    replay, measured, reference = scene.run()
    picture, look = DOCS / "gallery" / f"{name}.png", scene.LOOK
    jaxrod.viz.picture(replay, path=picture, width=720, height=480, small=True, **look)
    found = {"measured": measured, "reference": reference, "step_ms": 1e3 * dt}
    found["steps_per_second"] = rate(model, state, dt)
    return {key: float(f"{number:.4g}") for key, number in found.items()}


def entry(name, words, numbers):
    """A scene's part of the page, from its words and its numbers."""
    steps, step = numbers["steps_per_second"], numbers["step_ms"]
    motion = float(f"{1e-3 * steps * step:.2g}")
    shown = {key: f"{number:g}" for key, number in numbers.items()}
    return f"""\
## {name.replace("_", " ").capitalize()}

![{words["alt"]}](gallery/{name}.png)

{words["moves"]}

**Idea.** {words["learn"]}

**Check.** {words["number"].format(**shown)}

`python examples/{name}.py` ([program](../examples/{name}.py)). {steps:,.0f} steps of
{step:.3g} ms per second: {motion:g} s of motion.

"""


def page():
    """The page, from the words and the records."""
    words = tomllib.loads(pathlib.Path(__file__).with_name("gallery.toml").read_text())
    records = json.loads(RECORDS.read_text())
    parts = [entry(name, words[name], records[name]) for name in SCENES]
    return (HEAD + "".join(parts)).rstrip() + "\n"


if __name__ == "__main__":
    jaxrod.configure_cpu()
    parser = argparse.ArgumentParser(description="Writes docs/gallery.md.")
    parser.add_argument("scenes", nargs="*", default=SCENES, help="scenes to run")
    parser.add_argument("--words", action="store_true", help="run no scene")
    asked = parser.parse_args()
    for name in () if asked.words else asked.scenes:
        records = json.loads(RECORDS.read_text()) | {name: measure(name)}
        RECORDS.write_text(json.dumps(records, indent=1) + "\n")
    (DOCS / "gallery.md").write_text(page())
