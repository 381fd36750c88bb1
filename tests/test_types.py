"""Programs of users under `mypy --strict`, where jaxrod is installed."""

import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PARTS = ("jaxrod", "envs", "training", "pyproject.toml", "README.md", "LICENSE")

PROGRAM = '''
import dataclasses

import jax.numpy as jnp
import jaxrod
import jaxrod.envs
from jaxrod import extend


@extend.pytree
class TipSpring(extend.Effect):
    """Pulls the last node to a point."""

    point: extend.Leaf
    stiffness: extend.Leaf

    def loads(self, rod: jaxrod.Rod, motion: extend.Motion) -> extend.Loads:
        forces = [
            jnp.zeros_like(p).at[-1].set(self.stiffness * (self.point[k] - p[-1]))
            for k, p in enumerate(motion.position)
        ]
        return extend.Loads(forces=tuple(forces))


rod, state = jaxrod.straight_rod(
    10, length=1.0, radius=0.02, density=1000.0, youngs_modulus=1e6
)
goal = jaxrod.schedules.ramp(state.tip, state.tip + 0.1, duration=0.5)
scene = jaxrod.make_scene(rod, jaxrod.clamp(state), TipSpring(goal, 10.0))
dt = jaxrod.stable_dt(scene).dt
state = jaxrod.advance(scene, state, dt, 500)
heavier = dataclasses.replace(scene, rod=rod)
task = jaxrod.envs.make("tracking")
print(state.tip, task.action_size)
'''

MISTAKES = {
    "a misspelt keyword": ("radius=0.02", "radios=0.02", '"radios"'),
    "a wrong result": ("-> extend.Loads:", "-> jaxrod.Rod:", 'expected "Rod"'),
    "a misspelt attribute": ("state.tip,", "state.top,", '"top"'),
    "a text for a number": ("1.0, radius", '"1", radius', '"length"'),
    "a missing argument": ("TipSpring(goal, 10.0)", "TipSpring(goal)", '"stiffness"'),
    "a wrong name": ("jaxrod.advance(", "jaxrod.advanse(", '"advanse"'),
}


def installed(folder, *options):
    """The interpreter of a fresh environment with jaxrod beside what it needs."""
    source = folder / "source"
    source.mkdir()
    for part in PARTS:
        copy = shutil.copytree if (ROOT / part).is_dir() else shutil.copy2
        copy(ROOT / part, source / part)
    venv.create(folder / "venv", symlinks=True)
    python = folder / "venv" / "bin" / "python"
    (packages,) = (folder / "venv" / "lib").glob("python*/site-packages")
    needed = Path(pytest.__file__).parents[1]
    (packages / "needed.pth").write_text(f"{needed}\n")
    where = [sys.executable, "-m", "pip", "--python", python, "install", "-q"]
    alone = ["--no-deps", "--no-build-isolation", "--ignore-installed"]
    subprocess.run([*where, *alone, *options, source], check=True)
    return python


def complaints(python, program):
    """The report of mypy on a program."""
    folder = python.parents[2]
    (folder / "program.py").write_text(program)
    options = ["--strict", "--python-executable", python, "--cache-dir", ".cache"]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *options, "program.py"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode in (0, 1), done.stderr
    return done.stdout if done.returncode else ""


@pytest.mark.slow
@pytest.mark.parametrize("way", ["editable", "wheel"])
def test_documented_programs_are_clean_and_mistakes_are_found(tmp_path, way):
    options = {
        "editable": ["--config-settings", "editable_mode=strict", "-e"],
        "wheel": [],
    }
    python = installed(tmp_path, *options[way])
    assert complaints(python, PROGRAM) == ""
    for name, (right, wrong, words) in MISTAKES.items():
        assert right in PROGRAM, name
        found = complaints(python, PROGRAM.replace(right, wrong))
        assert words in found, f"{name}: {found}"
