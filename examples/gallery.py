"""The gallery: shows one scene, or runs all and writes docs/gallery.md.

Each scene is a module in this folder. It has `build() -> model, state, dt`,
`run(share) -> replay, measured, reference`, a text NUMBER that describes the two
numbers, and a view LOOK for the picture. The words of the page are in gallery.toml.
`python examples/gallery.py --help` lists the options.
"""

import argparse
import ast
import importlib
import json
import pathlib
import re
import textwrap
import time
import tomllib
import types

import jax
import numpy as np

import jaxrod

HERE = pathlib.Path(__file__).parent
DOCS = HERE.parent / "docs"
RECORDS = DOCS / "gallery" / "records.json"
WORDS = tomllib.loads((HERE / "gallery.toml").read_text())
LESSONS = WORDS.pop("lessons")
SCENES = tuple(name for names in LESSONS.values() for name in names)
# Numbers that show the change of a scene, from its replay.
SEEN = {
    # Distance of a tip from its root over the length of an arm.
    "octopus": lambda replay: np.linalg.norm(
        np.subtract(*replay.rods[0].positions[-1, 0, [-1, 0]]) / 0.2
    ),
    # Height of the highest node [mm].
    "nest": lambda replay: 1e3 * replay.rods[0].positions[-1, ..., 2].max(),
}
HEAD = """\
# Gallery

Each scene is a program of at most 80 lines, which compares one number with a known
value. Run it from a checkout: it writes a picture and a replay to the folder `runs`.
Then make the suggested change and run it again. On the site each picture is a
[replay](pictures.md) that you can turn, stop and slow down.

`python examples/gallery.py` wrote this page.
"""


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


def draw(name, replay, look):
    """Writes the picture of a scene and its recording, from which the site plays."""
    path = DOCS / "gallery" / f"{name}.png"
    size = {"width": 720, "height": 480, "small": True}
    jaxrod.viz.picture(replay, path=path, **size, **look)
    rate = WORDS[name].get("frames_per_second", 30)
    page = jaxrod.viz.html(replay, frames_per_second=rate)
    found = re.findall(r'id="(header|data)">(.*?)</script>', page, re.DOTALL)
    path.with_suffix(".json").write_text(json.dumps(dict(found)) + "\n")


def changed(name):
    """The program of a scene, after the change that the page suggests."""
    source, (old, new) = (HERE / f"{name}.py").read_text(), WORDS[name]["change"]
    if source.count(old) != 1:
        raise ValueError(f"{old!r} is not once in examples/{name}.py")
    module = types.ModuleType(name)
    exec(compile(source.replace(old, new), name, "exec"), vars(module))
    return module


def measure(name):
    """Runs a scene, draws it and returns its numbers."""
    scene = importlib.import_module(name)
    model, state, dt = scene.build()
    replay, measured, reference = scene.run()
    draw(name, replay, scene.LOOK)
    found = {"measured": measured, "reference": reference, "step_ms": 1e3 * dt}
    found["steps_per_second"] = rate(model, state, dt)
    if "{changed}" in WORDS[name]["then"] or name in SEEN:
        other, found["changed"], _ = changed(name).run()
    if name in SEEN:
        found["seen"], found["seen_changed"] = map(SEEN[name], (replay, other))
    return {key: float(f"{number:.4g}") for key, number in found.items()}


def lines(name):
    """The lines of a scene's program that show its idea."""
    source = (HERE / f"{name}.py").read_text()
    function, *wanted = WORDS[name]["code"]
    (body,) = [
        f.body for f in ast.parse(source).body if vars(f).get("name") == function
    ]

    def makes(line):
        targets = line.targets if isinstance(line, ast.Assign) else ()
        names = {ast.unparse(target).strip("()") for target in targets}
        return names | ({"return"} if isinstance(line, ast.Return) else set())

    kept = [line for line in body[1:] if not wanted or makes(line) & {*wanted}]
    if wanted and {name for line in kept for name in makes(line)} != {*wanted}:
        raise ValueError(f"{function} in examples/{name}.py lacks some of {wanted}")
    whole = source.splitlines()
    shown = [part for k in kept for part in whole[k.lineno - 1 : k.end_lineno]]
    return textwrap.dedent("\n".join(shown))


def title(name):
    """The heading of a scene."""
    return WORDS[name].get("title", name.replace("_", " ").capitalize())


def thumbnail(name):
    """A small picture of a scene that leads to its part; the site shows its name."""
    anchor = title(name).lower().replace(" ", "-")
    picture = f'<img src="gallery/{name}.png" width="200" alt="{WORDS[name]["alt"]}">'
    return f'<a href="#{anchor}" title="{title(name)}">{picture}</a>'


def written(number):
    """A number of a record, with four digits unless it is a round one.

    Records have four digits, but a zero at the end is lost: 0.4230 is 0.423 there.
    """
    text = f"{number:g}"
    digits = text.partition("e")[0].replace(".", "").lstrip("-0")
    return f"{number:#.4g}" if "." in text and len(digits) == 3 else text


def entry(name, words, numbers):
    """A scene's part of the page, from its words and its numbers."""
    steps, step = numbers["steps_per_second"], numbers["step_ms"]
    motion = float(f"{1e-3 * steps * step:.2g}")
    shown = {key: written(number) for key, number in numbers.items()}
    return f"""
### {title(name)}

{words["caption"]}

![{words["alt"]}](gallery/{name}.png)

**Idea.** {words["idea"]}

```python
{lines(name)}
```

**Check.** {words["number"].format(**shown)}

**Change it.** {words["then"].format(**shown)}

`python examples/{name}.py` runs it ([program](../examples/{name}.py)). One second of
processor time suffices for {steps:,.0f} steps of {step:.3g} ms, or {motion:g} s of
motion.
"""


def page():
    """The page, from the words and the records."""
    records = json.loads(RECORDS.read_text())
    parts = [HEAD]
    for lesson, names in LESSONS.items():
        parts.append(f"\n{lesson}:\n\n" + "\n".join(map(thumbnail, names)) + "\n")
    for lesson, names in LESSONS.items():
        parts.append(f"\n## {lesson}\n")
        parts += [entry(name, WORDS[name], records[name]) for name in names]
    return "".join(parts)


if __name__ == "__main__":
    jaxrod.configure_cpu()
    parser = argparse.ArgumentParser(description="Writes docs/gallery.md.")
    parser.add_argument("scenes", nargs="*", default=SCENES, help="scenes to run")
    parser.add_argument("--words", action="store_true", help="run no scene")
    parser.add_argument("--pictures", action="store_true", help="keep the numbers")
    asked = parser.parse_args()
    if asked.pictures:
        for name in asked.scenes:
            scene = importlib.import_module(name)
            draw(name, scene.run()[0], scene.LOOK)
    for name in () if asked.words or asked.pictures else asked.scenes:
        records = json.loads(RECORDS.read_text()) | {name: measure(name)}
        RECORDS.write_text(json.dumps(records, indent=1) + "\n")
    (DOCS / "gallery.md").write_text(page())
