"""Public functions and classes have examples in their docstrings, which run.

So do the examples of methods.
"""

import doctest
import functools
import inspect
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

import jaxrod
from jaxrod.lanes.choice import lane_mode

ROOT = Path(__file__).resolve().parent.parent
REFERENCE = runpy.run_path(str(ROOT / "docs" / "reference_pages.py"))
# What the reference tells readers to assume is what the examples are run with.
ASSUMED = REFERENCE["ASSUMED"]
PACKAGES = ("jaxrod", *REFERENCE["PACKAGES"])

# Names without an example, and why.
WITHOUT = {
    "jaxrod.ThinBodyWarning": "a warning, which is seen and not called",
    "jaxrod.UnlikelyWarning": "a warning, which is seen and not called",
    "jaxrod.UnstableStepWarning": "a warning, which is seen and not called",
    "jaxrod.control.UnreachableTargetWarning": "a warning, seen and not called",
}

# Names whose examples take more than about a second of processor time, without that
# which several of them share: the first of them pays for all (the first steps of
# `scene`, its health).
SLOW = {
    "jaxrod.contact",
    "jaxrod.driven",
    "jaxrod.Equilibrium",
    "jaxrod.equilibrium",
    "jaxrod.frequency_changes",
    "jaxrod.highest_frequency",
    "jaxrod.hinge_support",
    "jaxrod.internal_damping",
    "jaxrod.laplacian_filter",
    "jaxrod.moving_contact",
    "jaxrod.natural_frequencies",
    "jaxrod.near_contact",
    "jaxrod.planar",
    "jaxrod.resample",
    "jaxrod.rollout",
    "jaxrod.scale_inertia",
    "jaxrod.short_wave_damping",
    "jaxrod.sticking_contact",
    "jaxrod.tune",
    "jaxrod.Tuned",
    "jaxrod.use_lanes",
    "jaxrod.actuation.chamber",
    "jaxrod.actuation.cubic_force",
    "jaxrod.actuation.Muscle",
    "jaxrod.actuation.muscle",
    "jaxrod.actuation.wound_chamber",
    "jaxrod.actuation.WoundChamber",
    "jaxrod.assemblies.braid",
    "jaxrod.assemblies.bundle",
    "jaxrod.assemblies.cilia",
    "jaxrod.assemblies.nest",
    "jaxrod.assemblies.net",
    "jaxrod.assemblies.octopus",
    "jaxrod.assemblies.tree",
    "jaxrod.topology.crossed",
    "jaxrod.topology.crossings",
    "jaxrod.topology.link",
    "jaxrod.topology.writhe",
    "jaxrod.tradeoff.measure",
    "jaxrod.tradeoff.prepare",
    "jaxrod.tradeoff.Measurement",
    "jaxrod.tradeoff.Reference",
    "jaxrod.tradeoff.reference",
    "jaxrod.tradeoff.slam",
    "jaxrod.tradeoff.swing",
    "jaxrod.control.adam",
    "jaxrod.control.codesign",
    "jaxrod.control.cross_entropy",
    "jaxrod.control.Fit",
    "jaxrod.control.Fit.forecast",
    "jaxrod.control.Fit.undetermined",
    "jaxrod.control.Fit.z",
    "jaxrod.control.fit",
    "jaxrod.control.Forecast",
    "jaxrod.control.ilqr",
    "jaxrod.control.least_squares",
    "jaxrod.control.levenberg_marquardt",
    "jaxrod.control.Linearisation",
    "jaxrod.control.linearise",
    "jaxrod.control.local_coordinates",
    "jaxrod.control.LocalCoordinates",
    "jaxrod.control.match_shape",
    "jaxrod.control.mppi",
    "jaxrod.control.Reach",
    "jaxrod.control.reach",
    "jaxrod.control.ShapeMatch",
    "jaxrod.control.Solution",
    "jaxrod.control.estimation.Horizon",
    "jaxrod.control.estimation.moving_horizon",
    "jaxrod.control.estimation.Update",
    "jaxrod.control.estimation.update",
    "jaxrod.envs.actuated_arm",
    "jaxrod.envs.brax_env.BraxEnv",
    "jaxrod.envs.brax_env.patched_jax",
    "jaxrod.envs.EpisodeRecord",
    "jaxrod.envs.VectorEnvironment",
    "jaxrod.envs.VectorEnvironment.reset",
    "jaxrod.envs.VectorEnvironment.step",
    "jaxrod.envs.VectorStep",
    "jaxrod.envs.goal_env.GoalEnv",
    "jaxrod.sensors.accelerometer",
    "jaxrod.sensors.contact_force",
    "jaxrod.sensors.gyroscope",
    "jaxrod.sensors.image_markers",
    "jaxrod.sensors.section_curvature",
    "jaxrod.sensors.strain_gauge",
    "jaxrod.systems.glue",
    "jaxrod.systems.Neighbours",
    "jaxrod.systems.neighbours",
    "jaxrod.systems.pose_spring",
    "jaxrod.systems.ring",
    "jaxrod.systems.rod_contact",
    "jaxrod.systems.free_body",
    "jaxrod.systems.Settled",
    "jaxrod.systems.settled",
    "jaxrod.systems.SystemHealth",
    "jaxrod.systems.SystemReactions",
    "jaxrod.training.evaluate",
    "jaxrod.training.restore_policy",
    "jaxrod.training.Result",
    "jaxrod.training.train",
    "jaxrod.training.train_seeds",
    "jaxrod.training.with_noise",
    "jaxrod.materials.plastic_bending",
    "jaxrod.twin.identify",
    "jaxrod.twin.Twin",
    "jaxrod.twin.Twin.compare",
    "jaxrod.viz.animation",
    "jaxrod.viz.bending",
}

# Modules that need a library which may be missing, and the reason of a skip.
NEEDS_A_LIBRARY = {
    "jaxrod.envs.brax_env": "the brax extra is not installed",
    "jaxrod.envs.stable_baselines": "the sb3 extra is not installed",
    "jaxrod.envs.torch_env": "PyTorch is not installed",
}

# Methods and properties that most users call, by class.
METHODS = {
    "jaxrod.Scene": (
        "with_effect kinetic_energy potential_energy momentum angular_momentum "
        "with_memory total_energy at"
    ),
    "jaxrod.Rod": (
        "n_elements length element_masses node_masses joint_stiffness "
        "arc_length_midpoints kinetic_energy momentum angular_momentum"
    ),
    "jaxrod.RodState": "directors tip",
    "jaxrod.System": "states_by_name with_members kinetic_energy momentum",
    "jaxrod.systems.RigidBodies": "kinetic_energy momentum",
    "jaxrod.actuation.Tendon": "cable_lengths cable_tensions",
    "jaxrod.control.Fit": "z forecast undetermined",
    "jaxrod.control.Parameters": "flat named values searched",
    "jaxrod.viz.Replay": "from_nodes from_rollout from_states together",
    "jaxrod.envs.Randomisation": "record from_record",
    "jaxrod.envs.VectorEnvironment": "reset step",
    "jaxrod.training.MLPPolicy": "__call__",
    "jaxrod.training.Algorithm": "checked",
    "jaxrod.training.RunFolder": "finished",
    "jaxrod.envs.gymnax_env.GymnaxEnv": "reset",
    "jaxrod.twin.Twin": "compare",
}

# Names whose examples must come before JAX computes: each has a process of its own.
OWN_PROCESS = {
    "jaxrod.configure_cpu",
}


def names_of(package):
    """Full names and things: public functions and classes of a package, not modules."""
    return {
        f"{package}.{name}": thing
        for name, thing in REFERENCE["public"](package).items()
        if callable(thing) and f"{package}.{name}" not in WITHOUT
    }


def with_methods(name, thing):
    """A thing and, of a class, the public methods and properties that jaxrod wrote."""
    yield name, thing
    if not inspect.isclass(thing):
        return
    parts = {}
    for base in reversed(thing.__mro__):
        if base.__module__.partition(".")[0] in ("jaxrod", REFERENCE["__name__"]):
            parts |= vars(base)
    for method, written in parts.items():
        is_public = method[0] != "_" or method == "__call__"
        if is_public and not inspect.isclass(written):
            yield f"{name}.{method}", written


def examples():
    """Tests of all docstrings with examples; what has two names is run once."""
    seen = set()
    for package in sorted(PACKAGES):
        for public, thing in names_of(package).items():
            for name, part in with_methods(public, thing):
                text = part.__doc__ or ""
                if ">>>" in text and id(part) not in seen:
                    slow = [pytest.mark.slow] if name in SLOW | OWN_PROCESS else []
                    yield pytest.param(name, text, id=name, marks=slow)
                seen.add(id(part))


@pytest.fixture(autouse=True)
def lanes_as_before():
    mode = lane_mode()
    yield
    jaxrod.use_lanes(mode)


@functools.cache
def assumed():
    names = {}
    exec(ASSUMED, names)
    return names


def faults_of(name, text, names):
    """The report of the examples in a text that print something else."""
    report = []
    test = doctest.DocTestParser().get_doctest(text, dict(names), name, name, 0)
    doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test, out=report.append)
    return "".join(report)


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_has_an_example(package):
    bare = [n for n, thing in names_of(package).items() if not has_example(thing)]
    assert not bare


@pytest.mark.parametrize("name", METHODS)
def test_methods_that_most_users_call_have_an_example(name):
    package, _, public = name.rpartition(".")
    parts = dict(with_methods(name, REFERENCE["public"](package)[public]))
    listed = METHODS[name].split()
    bare = [part for part in listed if not has_example(parts[f"{name}.{part}"])]
    assert not bare


def has_example(thing):
    doc = inspect.cleandoc(thing.__doc__ or "")
    return ">>>" in doc.partition("\nExample:\n")[2]


@pytest.mark.default_precision
@pytest.mark.parametrize(("name", "text"), [*examples()])
def test_examples_print_what_they_say(name, text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # some of them write files
    for module, reason in NEEDS_A_LIBRARY.items():
        if name.startswith(module):
            pytest.importorskip(module, reason=reason)
    if name in OWN_PROCESS:
        program = f"""
import doctest
{ASSUMED.partition("rod, state =")[0]}
doctest.run_docstring_examples({name}, globals())
"""
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True
        )
        assert (done.returncode, done.stdout) == (0, ""), done.stdout + done.stderr
    else:
        faults = faults_of(name, text, assumed())
        assert not faults, faults


@pytest.mark.default_precision
def test_wrong_examples_are_seen():
    assert not faults_of("sum", ">>> 1 + 1\n2\n", {})
    assert "Got:\n    2" in faults_of("sum", ">>> 1 + 1\n3\n", {})
    assert "NameError" in faults_of("sum", ">>> one\n1\n", {})


def test_exceptions_name_what_exists():
    every = {
        name
        for package in PACKAGES
        for public, thing in REFERENCE["public"](package).items()
        for name, _ in with_methods(f"{package}.{public}", thing)
    }
    assert {*WITHOUT, *SLOW, *OWN_PROCESS} <= every
