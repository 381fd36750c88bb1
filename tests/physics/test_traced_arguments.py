"""Every number that a factory takes may be traced, alone or inside tuples."""

import inspect
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from jaxrod.tradeoff.resampling import resampled

MATERIAL = {
    "radius": 0.05,
    "density": 1e3,
    "youngs_modulus": 1e6,
    "shear_modulus": 4e5,
    "shear_correction": 0.9,
}
ROD, STATE = jaxrod.straight_rod(3, length=1.2, **MATERIAL)
SCENE = jaxrod.make_scene(ROD, jaxrod.clamp(STATE))
BENT = ((0.0, 0.1, 0.1, 0.3), (0.0, 0.0, 1.0, 1.2), (0.0, 1.0, 1.1, 2.0))
FRAMES = np.asarray(jaxrod.rod_along(BENT, **MATERIAL)[1].directors).tolist()
SIDES = ((1.0, 0.5, 0.2), (0.3, 1.0, 0.1), (0.2, 0.1, 1.0))
BALL = jaxrod.sphere((0.0, 0.0, 0.0), 0.1)

HEAD, OF_HEAD = jaxrod.rigid_body(jaxrod.sphere((0.0, 0.1, 1.3), 0.1), density=1e3)
TOGETHER = {"rod": STATE, "head": OF_HEAD}
JOINED = {"a": ("rod", "finish"), "b": ("head",), "state": TOGETHER}
FELLOW = replace(STATE, positions=STATE.positions + 0.02)
TOUCH = {
    "stiffness": 1e3,
    "damping": 2.0,
    "friction": 0.3,
    "friction_drag": 4.0,
    "onset": 0.02,
}

FACTORIES = {
    "straight_rod": [
        {
            "n_elements": 3,
            "length": 1.2,
            "start": (0.1, 0.2, 0.3),
            "direction": (1.0, -2.0, 0.5),
            "normal": (0.3, 0.2, 2.0),
            **MATERIAL,
        },
        {
            "n_elements": 3,
            "length": 1.2,
            "direction": (1.0, -2.0, 0.5),
            **MATERIAL,
            "radius": (0.06, 0.03),
            "shear_modulus": None,
            "poisson_ratio": (0.1, 0.2, 0.3),
        },
    ],
    "rod_along": [
        {"positions": BENT, "normal": (0.0, 1.0, 0.2), **MATERIAL},
        {
            "positions": BENT,
            **MATERIAL,
            "shear_modulus": None,
            "poisson_ratio": 0.3,
        },
        {"positions": BENT, "directors": FRAMES, **MATERIAL},
    ],
    "gravity": [{"acceleration": (1.0, 2.0, 3.0)}],
    "end_load": [{"force": (1.0, 2.0, 3.0), "couple": (4.0, 5.0, 6.0)}],
    "uniform_load": [
        {"force_per_length": (1.0, 2.0, 3.0), "couple_per_length": (4.0, 5.0, 6.0)}
    ],
    "exponential_damping": [
        {"translational_rate": 3.0, "rotational_rate": 2.0},
        {"translational_rate": 3.0},
    ],
    "internal_damping": [{"relaxation_time": 0.1}],
    "short_wave_damping": [{"rate": 10.0}],
    "circle": [{"radius": 0.1}],
    "tube": [{"outer_radius": 0.1, "inner_radius": 0.05}],
    "rectangle": [{"width": 0.1, "height": 0.05}],
    "ellipse": [{"half_width": 0.1, "half_height": 0.05}],
    "ramp": [{"first": (1.0, 2.0), "last": (3.0, 4.0), "duration": 2.0, "start": 0.5}],
    "sine": [{"amplitude": 2.0, "period": 0.3, "mean": 1.0, "phase": 0.2}],
    "table": [{"times": (0.0, 1.0), "values": ((1.0, 2.0), (3.0, 4.0))}],
    "hinge": [{"state": STATE, "axis": (0.0, 2.0, 1.0)}],
    "driven": [
        {
            "state": STATE,
            "displacement": (0.0, 0.1, 0.0),
            "axis": (0.0, 2.0, 1.0),
            "angle": 0.3,
        }
    ],
    "sphere": [{"centre": (1.0, 2.0, 3.0), "radius": 0.5}],
    "capsule": [{"start": (1.0, 2.0, 3.0), "end": (0.0, 0.0, 1.0), "radius": 0.5}],
    "cylinder": [{"start": (1.0, 2.0, 3.0), "end": (0.0, 0.0, 1.0), "radius": 0.5}],
    "plane": [{"point": (1.0, 2.0, 3.0), "normal": (0.0, 0.5, 1.0)}],
    "box": [
        {
            "centre": (1.0, 2.0, 3.0),
            "half_lengths": (1.0, 2.0, 3.0),
            "orientation": (1.0, 0.5, 0.0, 0.0),
        }
    ],
    "contact": [
        {
            "bodies": BALL,
            "stiffness": 1e3,
            "damping": 2.0,
            "friction": 0.3,
            "friction_drag": 4.0,
            "onset": 0.02,
        },
        {
            "bodies": BALL,
            "stiffness": 1e3,
            "friction": (0.3, 0.2, 0.4),
            "friction_drag": 4.0,
            "stick_ratio": 1.5,
        },
    ],
    "implicit": [{"spectral_radius": 0.5, "tolerance": 1e-4}],
    "control_spline": [
        {"controls": 4, "length": 1.2},
        {"controls": (0.2, 0.4, 0.7, 1.0), "length": 1.2},
    ],
    "spline_couples": [
        {
            "rod": ROD,
            "spline": jaxrod.control_spline(2, 1.2),
            "controls": ((1.0, 2.0), (3.0, 4.0), (5.0, 6.0)),
            "couple_density": (1.0, 2.0, 3.0),
        }
    ],
    "travelling_wave": [
        {
            "rod": ROD,
            "amplitude": amplitude,
            "period": 0.3,
            "wavelength": 0.7,
            "axis": (1.0, 2.0, 0.5),
            "phase": 0.2,
            "ramp_up": 0.4,
        }
        for amplitude in (2.0, (0.0, 1.0, 2.0, 0.5))
    ],
    "muscle_torques": [
        {
            "rod": ROD,
            "amplitude": (0.1, 1.0, 2.0, 0.5),
            "period": 0.3,
            "wave_number": 7.0,
            "direction": (1.0, 2.0, 0.5),
            "phase_shift": 0.2,
            "ramp_up_time": 0.4,
        }
    ],
    "muscle": [
        {
            "rod": ROD,
            "force": (3.0, 4.0),
            "activation": 0.5,
            "offsets": ((0.01, 0.0), (0.0, 0.02)),
        }
    ],
    "gaussian_force": [{"width": 0.3}],
    "helical_offsets": [
        {"rod": ROD, "radius": 0.03, "turns": 1.5, "angles": (0.2, 1.0)}
    ],
    "chamber": [{"rod": ROD, "pressure": 1e4, "area": 1e-4, "offsets": (0.01, 0.02)}],
    "wound_chamber": [
        {
            "rod": ROD,
            "pressure": 1e4,
            "radius": 0.02,
            "angle": -0.7,
            "offsets": (0.01, 0.02),
        }
    ],
    "tendon": [
        {
            "rod": ROD,
            "offsets": (0.01, 0.02),
            "tension": 3.0,
            "anchor": (0.0, 0.1, -0.2),
            "friction": 0.3,
            "slip_speed": 0.02,
        },
        {
            "rod": ROD,
            "offsets": (0.01, 0.02),
            "length": 0.7,
            "stiffness": 100.0,
            "onset": 0.01,
        },
    ],
    "active_shape": [
        {"rod": ROD, "curvature": (1.0, 2.0, 0.5), "strain": (0.1, 0.2, 0.3)}
    ],
    "magnetisation": [
        {"rod": ROD, "moment_per_length": (1.0, 2.0, 0.5), "field": (0.1, 0.2, 0.3)}
    ],
    "linear_field": [
        {
            "flux_density": (0.1, 0.2, 0.3),
            "gradient": ((1.0, 0.2, 0.1), (0.2, 1.0, 0.3), (0.1, 0.3, -2.0)),
            "extent": 2.0,
        }
    ],
    "stokes_drag": [
        {"along": 1.0, "across": 2.0, "turning": 0.1, "flow": (0.1, 0.2, 0.3)}
    ],
    "quadratic_drag": [
        {"density": 1e3, "across": 1.1, "along": 0.1, "flow": (0.1, 0.2, 0.3)}
    ],
    "slender_cylinder": [{"viscosity": 1.1, "length": 2.0, "radius": 0.1}],
    "slender_body_drag": [{"viscosity": 1.1}],
    "buoyancy": [{"density": 1e3, "acceleration": (0.1, 0.2, -9.0), "added_mass": 0.5}],
    "with_added_mass": [{"rod": ROD, "density": 1e3, "coefficient": 0.9}],
    "rigid_body": [
        {
            "mass": 2.0,
            "inertia": (1.0, 1.1, 1.2),
            "position": (1.0, 2.0, 3.0),
            "orientation": (1.0, 0.2, 0.3, 0.1),
            "velocity": (1.0, 2.0, 3.0),
            "angular_velocity": (1.0, 2.0, 3.0),
        },
        {"shape": BALL, "density": 1e3},
    ],
    "spring": [
        {
            **JOINED,
            "stiffness": 10.0,
            "damping": 1.0,
            "at": ((0.0, 0.01, 1.2), (0.0, 0.1, 1.25)),
        }
    ],
    "ball_joint": [
        {**JOINED, "stiffness": 10.0, "damping": 1.0, "at": (0.1, 0.2, 1.1)}
    ],
    "hinge_joint": [
        {
            **JOINED,
            "axis": (0.1, 0.2, 0.9),
            "stiffness": 10.0,
            "axis_stiffness": 1.0,
            "damping": 0.1,
            "axis_damping": 0.2,
            "motor": 0.3,
            "at": (0.1, 0.2, 1.1),
        }
    ],
    "rigid_joint": [
        {
            **JOINED,
            "stiffness": 10.0,
            "turning_stiffness": 1.0,
            "damping": 0.1,
            "turning_damping": 0.2,
            "at": (0.1, 0.2, 1.1),
        }
    ],
    "body_contact": [{"rod": "rod", "body": "head", **TOUCH}],
    "rod_contact": [{"members": ("one", "two"), **TOUCH}],
    "crossing_contact": [{"members": ("one", "two"), **TOUCH}],
    "rigid_contact": [
        {
            "members": ("one", "two"),
            "points": {"one": ((0.1, 0.2), (0.3, 0.4), (0.5, 0.6))},
            **TOUCH,
        }
    ],
    "glue": [
        {
            "a": "rod",
            "b": "fellow",
            "state": {"rod": STATE, "fellow": FELLOW},
            "stiffness": 10.0,
            "turning_stiffness": 1.0,
            "damping": 0.1,
            "turning_damping": 0.2,
        }
    ],
    "pose_spring": [
        {
            "place": JOINED["a"],
            "state": JOINED["state"],
            "stiffness": 10.0,
            "damping": 0.1,
            "turning_stiffness": 1.0,
            "turning_damping": 0.2,
            "position": (0.1, 0.2, 0.3),
            "orientation": (1.0, 0.2, 0.3, 0.1),
            "displacement": (0.1, 0.2, 0.1),
            "axis": (0.1, 0.2, 0.9),
            "angle": 0.3,
            "at": (0.1, 0.2, 1.1),
        }
    ],
    "neighbour_lists": [{"skin": 0.5}],
    "limit_rate": [
        {"applied": (1.0, 2.0), "commanded": (1.5, -3.0), "largest_change": (1.0, 0.5)}
    ],
    "with_angular_velocities": [
        {
            "rod": ROD,
            "state": STATE,
            "angular_velocities": ((1.0, 2.0, 3.0), (1.0, 0.0, 0.0), (0.0, 2.0, 0.0)),
        }
    ],
    "rollout_times": [{"dt": 1e-3, "n_steps": 4, "every": 2}],
    "stable_dt": [{"scene": SCENE, "safety": 0.5}],
    "scale_inertia": [{"scene": SCENE, "dt": 1e-3}],
    "twist": [{"curve": BENT, "normals": SIDES}],
    "writhe": [{"curve": BENT, "ends": "next_tangent", "extension": 2.0}],
    "link": [
        {
            "curve": BENT,
            "normals": SIDES,
            "offset": 0.1,
            "ends": "next_tangent",
            "extension": 2.0,
        }
    ],
}
ELSEWHERE = {
    # Runs: their step is traced in test_compilation and test_gradients.
    "step",
    "advance",
    "rollout",
    "equilibrium",
    "health",
    # Made on the host alone; it says so.
    "ring",
}


def numeric_arguments(name):
    """The arguments of a public function that are numbers or arrays of them."""
    parameters = inspect.signature(getattr(jaxrod, name)).parameters.values()
    kinds = ("Numbers", "ArrayLike", "Float[", "Timed")
    return [
        p.name
        for p in parameters
        if any(kind in str(p.annotation) for kind in kinds)
        and "Callable" not in str(p.annotation)
    ]


CASES = [
    pytest.param(name, case, argument, id=f"{name}-{argument}-{k}")
    for name, cases in FACTORIES.items()
    for k, case in enumerate(cases)
    for argument in numeric_arguments(name)
    if case.get(argument) is not None and not isinstance(case[argument], int)
]


def test_every_numeric_argument_is_among_the_cases():
    functions = [n for n in jaxrod.__all__ if inspect.isfunction(getattr(jaxrod, n))]
    wanted = {(n, a) for n in functions for a in numeric_arguments(n)}
    wanted = {pair for pair in wanted if pair[0] not in ELSEWHERE}
    assert wanted == {tuple(case.values[::2]) for case in CASES}


def built(name, case, argument, change):
    """Real numbers of what a factory makes, one argument changed number by number."""
    leaves, tree = jax.tree.flatten(case[argument])
    leaves = [change(k, leaf) for k, leaf in enumerate(leaves)]
    changed = {argument: jax.tree.unflatten(tree, leaves)}
    given = case | changed
    # What a function takes by position alone.
    members = given.pop("members", ())
    made = jax.tree.leaves(getattr(jaxrod, name)(*members, **given))
    return [leaf for leaf in made if jnp.issubdtype(leaf.dtype, jnp.floating)]


def slope_of(name, case, argument):
    """A function of how much every number of an argument is changed, and its parts."""

    def leaves(amount):
        change = lambda k, leaf: leaf * (1 + amount * (1 + 0.3 * k))
        return built(name, case, argument, change)

    # What is smaller than a thousandth in these cases is rounding.
    scales = [max(np.max(np.abs(leaf), initial=0), 1e-3) for leaf in leaves(0.0)]

    def total(amount):
        # Weights make no two results cancel.
        parts = [
            jnp.sum(jnp.sin(1 + jnp.arange(leaf.size)) * jnp.ravel(leaf)) / scale
            for leaf, scale in zip(leaves(amount), scales, strict=True)
        ]
        return sum(parts)

    return total


@pytest.mark.parametrize(("name", "case", "argument"), CASES)
def test_every_number_may_be_traced(name, case, argument):
    """Alone, beside numbers that are known, and under a gradient; nothing compiled."""
    first = lambda factor: built(
        name, case, argument, lambda k, leaf: leaf * factor if k == 0 else leaf
    )
    known, traced = first(1.0), jax.eval_shape(first, 1.0)
    kinds = [(leaf.shape, leaf.dtype) for leaf in traced]
    assert kinds == [(leaf.shape, leaf.dtype) for leaf in known]
    assert jax.eval_shape(jax.grad(slope_of(name, case, argument)), 0.0).shape == ()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "case", "argument"), CASES)
def test_a_traced_number_does_what_a_known_one_does(name, case, argument):
    first = lambda factor: built(
        name, case, argument, lambda k, leaf: leaf * factor if k == 0 else leaf
    )
    # Frames with one number changed are none.
    factor = 1.0 if argument == "directors" else 1.001
    for got, want in zip(jax.jit(first)(factor), first(factor), strict=True):
        scale = np.max(np.abs(want), initial=1e-4)
        np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-9 * scale)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "case", "argument"),
    [case for case in CASES if case.values[2] != "directors"],
)
def test_gradients_are_those_of_central_differences(name, case, argument):
    total = slope_of(name, case, argument)
    slope = jax.jit(jax.grad(total))(0.0)
    step = 1e-5
    finite = (total(step) - total(-step)) / (2 * step)
    np.testing.assert_allclose(slope, finite, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("straight_rod", {"n_elements": 3, "length": 1.0, **MATERIAL}),
        ("control_spline", {"controls": 3}),
        ("highest_frequency", {"scene": SCENE, "state": STATE, "size": 3}),
        ("natural_frequencies", {"scene": SCENE, "state": STATE, "n_modes": 3}),
        ("equilibrium", {"scene": SCENE, "state": STATE, "max_iterations": 3}),
        ("implicit", {"max_iterations": 3}),
        ("rollout", {"scene": SCENE, "state": STATE, "dt": 1e-4, "n_steps": 3}),
        ("rollout_times", {"dt": 1e-4, "n_steps": 4, "every": 2}),
        ("contact", {"bodies": BALL, "stiffness": 1.0, "points_per_element": 2}),
    ],
)
def test_traced_structure_is_refused_by_name(name, arguments):
    for argument, value in arguments.items():
        if not isinstance(value, int):
            continue
        call = lambda n, k=argument: getattr(jaxrod, name)(**arguments | {k: n})
        with pytest.raises(ValueError, match=argument):
            jax.jit(call)(value)


@pytest.mark.parametrize(
    "look",
    [
        lambda scene: jaxrod.natural_frequencies(scene, STATE),
        lambda scene: resampled(scene, STATE, 6),
        lambda scene: jaxrod.tune(scene, STATE),
    ],
)
def test_what_works_on_the_host_alone_says_so(look):
    with pytest.raises(ValueError, match=r"traced by jax\.jit"):
        jax.jit(look)(SCENE)
