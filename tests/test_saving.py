"""Saved files: `jaxrod.load` returns what `jaxrod.save` was given, to the last bit."""

import dataclasses
import inspect
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from examples.loading import load as example
from extremes import pair_kinds, pair_scenes, pair_system_kinds, pair_systems
from extremes.pair_effects import MAKERS, Maker
from extremes.views import View, draws_of
from jaxrod import saving
from jaxrod.structure import STORABLE, pytree, static
from physics.numeric_arguments import FACTORIES
from physics.rods import arm
from public_names import PUBLIC

VERSION_1 = Path(__file__).parent / "version_1.jaxrod"


def check_same(found, wanted):
    """The same structure, and leaves of the same types and bits."""
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True)
    for one, other in pairs:
        assert type(one) is type(other)
        assert getattr(one, "dtype", None) == getattr(other, "dtype", None)
        assert getattr(one, "weak_type", None) == getattr(other, "weak_type", None)
        if not isinstance(one, jax.Array | np.ndarray | np.generic | float):
            assert one == other
            continue
        if jnp.issubdtype(getattr(one, "dtype", float), jax.dtypes.prng_key):
            one, other = jax.random.key_data(one), jax.random.key_data(other)
        assert np.shape(one) == np.shape(other)
        assert np.asarray(one).tobytes() == np.asarray(other).tobytes()


def check_kept(thing, folder, classes=()):
    """A thing is the same when it was saved and loaded; returns what was loaded."""
    path = folder / "thing.jaxrod"
    jaxrod.save(path, thing, overwrite=True)
    found = jaxrod.load(path, classes)
    check_same(found, thing)
    return found


SLOW = {"spline_couples", "scale_inertia", "stable_dt", "writhe", "twist", "link"}
"""Functions that compute for long; of what they make, other cases have all."""


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW))
        for name in FACTORIES
    ],
)
def test_what_every_public_factory_makes_is_kept(name, tmp_path):
    for case in FACTORIES[name]:
        given = dict(case)
        members = given.pop("members", ())
        check_kept(PUBLIC[name](*members, **given), tmp_path)


@pytest.mark.parametrize(
    "support",
    [
        *pair_kinds.SUPPORTS[1:],
        pytest.param(pair_kinds.SUPPORTS[0], marks=pytest.mark.slow),
    ],
)
def test_every_support_and_effect_is_kept(support, tmp_path):
    """With schedules where they are taken; without a support, there are all effects."""
    effects = tuple(MAKERS) if support == "none" else ("gravity", "wave")
    kind = pair_kinds.Kind("", support, effects, 5, False, "round", "even", True)
    draws, view = draws_of(3, 0), View()
    nodes, normal = pair_scenes.curve(draws[1], 5, straight=False, flat=False)
    given = pair_scenes.material(draws, view, "round", 5)
    rod, state = pair_scenes.rod_in(view, nodes, normal, False, given)
    maker = Maker(draws, view, kind, rod, state)
    check_kept((rod, state, maker.support(), maker.effects()), tmp_path)


def test_every_method_is_kept(tmp_path):
    for name in dict.fromkeys(pair_kinds.METHODS):
        kind = pair_kinds.Kind(name, "none", (), 3, True, "round", "none", False)
        check_kept(pair_scenes.method_of(kind), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_random_systems_are_kept(seed, tmp_path):
    kind = pair_system_kinds.random_system(np.random.default_rng(seed))
    check_kept(pair_systems.system_in(View(), kind, seed), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["snake", "gripper", "octopus", "tendon_arm", "cilia", "knot", "flagella"]
)
def test_scenes_of_examples_are_kept(name, tmp_path):
    check_kept(example(name).build(), tmp_path)


def placeholder(field):
    """A value for a field: an array, or a text where it is static."""
    if field.default is not dataclasses.MISSING:
        return field.default
    return "word" if field.metadata.get("static") else jnp.arange(3)


def test_every_class_of_the_core_is_kept(tmp_path):
    """Its fields hold arrays, whatever they are meant for."""
    saving._import_core()
    own = saving._own()
    made = [
        cls(**{field.name: placeholder(field) for field in dataclasses.fields(cls)})
        for cls in own.values()
        if not inspect.isabstract(cls)
    ]
    check_kept(made, tmp_path)
    assert len(made) > 150
    public = {cls for cls in PUBLIC.values() if cls in STORABLE}
    assert public <= {*own.values()}, "names of public classes are unique"


def test_leaves_keep_their_types(tmp_path):
    """Also those of Python, of NumPy, weak ones, and random keys."""
    weak = jnp.asarray(0.1)
    with jax.enable_x64(False):
        single = jnp.asarray(0.1)
    check_kept(
        {
            "python": (True, 2, 10**30, -0.0, 0.1, float("inf"), "ü\ud800\n", None),
            "nests": [[], (), {}, [(1,), {"a b/..": [2.0]}]],
            "names": {
                k: np.full(2, i) for i, k in enumerate(("a b", "a.b", "a/b", ""))
            },
            "not finite": jnp.asarray([np.nan, np.inf, -np.inf, -0.0, 5e-324]),
            "numpy": [np.arange(6).reshape(2, 3).T, np.zeros((0, 2), ">f4")],
            "scalars": [np.float64(0.1), np.float32(0.1), np.bool_(True), np.int8(3)],
            "kinds": [jnp.zeros(2, kind) for kind in "?bBhHiIlLefdFD"],
            "weak": [weak, single, jnp.asarray(3), jnp.broadcast_to(weak, (2, 3))],
            "keys": [jax.random.key(3), jax.random.split(jax.random.key(0), 4)],
        },
        tmp_path,
    )
    nan = tmp_path / "nan.jaxrod"
    jaxrod.save(nan, float("nan"))
    assert np.isnan(jaxrod.load(nan))


def swinging():
    """A clamped arm under a load that rises, and its state."""
    rod, state = arm(4)
    load = jaxrod.end_load(jaxrod.schedules.ramp((0.0, 0.0, 0.0), (0.1, 0.0, 0.2), 0.1))
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), load, jaxrod.gravity())
    return scene, state


@pytest.mark.slow
def test_a_loaded_scene_takes_the_same_steps(tmp_path):
    scene, state = swinging()
    other, start = check_kept((scene, state), tmp_path)
    wanted = jaxrod.advance(scene, state, 1e-4, 20)
    check_same(jaxrod.advance(other, start, 1e-4, 20), wanted)
    assert float(jnp.abs(wanted.velocities).max()) > 0


@pytest.mark.slow
def test_results_are_kept(tmp_path):
    scene, state = swinging()
    check_kept(jaxrod.rollout(scene, state, 1e-4, 6, every=3), tmp_path)
    moment = scene.at(1.0)
    check_kept(jaxrod.equilibrium(moment, state), tmp_path)
    check_kept(jaxrod.health(moment, state, 1e-4), tmp_path)
    system = jaxrod.make_system({"arm": moment})
    check_kept(jaxrod.rollout(system, {"arm": state}, 1e-4, 4, every=2), tmp_path)
    check_kept(jaxrod.systems.settled(system, {"arm": state}, max_steps=10), tmp_path)


def test_a_fresh_process_reads_a_file_by_load_alone(tmp_path):
    """Modules of the classes are not imported there before."""
    kind = pair_system_kinds.random_system(np.random.default_rng(3))
    system, *_ = pair_systems.system_in(View(), kind, 3)
    check_kept({"system": system, "muscle": PUBLIC["gaussian_force"](0.3)}, tmp_path)
    program = (
        "import sys, jax, jaxrod; jax.config.update('jax_enable_x64', True)\n"
        "found = jaxrod.load(sys.argv[1])\n"
        "print(type(found['muscle']).__name__, *found['system'].members)\n"
        "assert 'jaxrod.training' not in sys.modules\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, tmp_path / "thing.jaxrod"],
        capture_output=True,
        text=True,
    )
    assert done.stdout.split() == ["GaussianForce", *system.members], done.stderr


@pytree
class Breeze(jaxrod.extend.Effect):
    """Pushes all nodes."""

    force: jaxrod.extend.Leaf
    words: tuple[str, ...] = static(default=())


def another_breeze():
    """Another class of the same name, as another program may have."""
    return pytree(type("Breeze", (jaxrod.extend.Effect,), {}))


def test_classes_of_your_own_are_given_to_load(tmp_path):
    scene, _ = swinging()
    breeze = Breeze(jnp.ones(3), ("light", "warm"))
    mine = dataclasses.replace(scene, effects=(*scene.effects, breeze))
    check_kept(mine, tmp_path, [Breeze])
    path = tmp_path / "thing.jaxrod"
    with pytest.raises(
        ValueError, match=r"thing\.jaxrod: it has the class 'Breeze'.*classes="
    ):
        jaxrod.load(path)
    with pytest.raises(ValueError, match=r"decorated with jaxrod\.extend\.pytree"):
        jaxrod.load(path, [dict])
    with pytest.raises(ValueError, match="two Breeze"):
        jaxrod.load(path, [Breeze, another_breeze()])
    with pytest.raises(ValueError, match=r"thing\[1\] is a Breeze.*two classes share"):
        jaxrod.save(path, [breeze, another_breeze()()], overwrite=True)


def test_a_field_that_is_younger_than_the_file_has_its_default(tmp_path):
    path = tmp_path / "old.jaxrod"
    jaxrod.save(path, Breeze(jnp.ones(3), ("old",)))

    @pytree
    class Young(jaxrod.extend.Effect):
        force: jaxrod.extend.Leaf
        words: tuple[str, ...] = static(default=())
        gusts: float = 0.5
        names: tuple[str, ...] = static(default_factory=lambda: ("fresh",))

    @pytree
    class Needy(jaxrod.extend.Effect):
        force: jaxrod.extend.Leaf
        gusts: float
        words: tuple[str, ...] = static(default=())

    @pytree
    class Poor(jaxrod.extend.Effect):
        force: jaxrod.extend.Leaf

    for cls in (Young, Needy, Poor):
        cls.__name__ = "Breeze"
    found = jaxrod.load(path, [Young])
    assert (found.words, found.gusts, found.names) == (("old",), 0.5, ("fresh",))
    with pytest.raises(ValueError, match=r"tree\.gusts, which Breeze needs"):
        jaxrod.load(path, [Needy])
    with pytest.raises(ValueError, match="'words', which Breeze does not have"):
        jaxrod.load(path, [Poor])


def test_a_file_of_version_1_is_read():
    """It was written when the format was new, by `save(VERSION_1, of_version_1())`."""
    found, made = jaxrod.load(VERSION_1), of_version_1()
    assert jax.tree.structure(found) == jax.tree.structure(made)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(made), strict=True):
        assert type(one) is type(other)
        if not isinstance(one, str):
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def of_version_1():
    """Something of everything."""
    scene, state = swinging()
    return {
        "scene": scene,
        "state": state,
        "joint": jaxrod.systems.spring(
            ("one", "tip"),
            ("two", "base"),
            state={"one": state, "two": state},
            stiffness=10.0,
        ),
        "rest": ([1, 2.5, None, True], np.float32(0.1), np.arange(3), jnp.asarray(2.0)),
    }


def test_what_no_file_can_hold_is_refused_by_its_place(tmp_path):
    path = tmp_path / "thing.jaxrod"
    flow = lambda point, parameters: 0.1 * point
    drag = jaxrod.fluids.stokes_drag(1.0, 2.0, flow=jaxrod.fluids.flow_field(flow))
    thing, own = [drag], dataclasses.make_dataclass("Own", ["x"])
    refused = [
        (thing, r"thing\[0\]\.flow\.function is <function .*pytree.*classes="),
        ({"a": len}, r"thing\['a'\] is <built-in"),
        ({1: 2.0}, "thing must have strings as keys, got 1"),
        ([{1}], r"thing\[0\] is \{1\}, a set"),
        ([own(3)], "a Own"),
        (Breeze(1.0, words=["loud"]), r"thing\.words must be hashable"),
        (Breeze(np.array("x")), r"thing\.force must be numbers"),
        (np.array([None]), "numbers of one of NumPy's own types, got object"),
        (jnp.ones(2, jnp.bfloat16), "got bfloat16"),
        (1j, "a complex"),
        (jax.ShapeDtypeStruct((2,), float), "a ShapeDtypeStruct"),
    ]
    for wrong, words in refused:
        with pytest.raises(ValueError, match=words):
            jaxrod.save(path, wrong)
    with pytest.raises(
        ValueError, match=r"thing\[0\] must be known, not traced by jax"
    ):
        jax.jit(lambda x: jaxrod.save(path, [x]))(1.0)
    assert not [*tmp_path.iterdir()]


def test_files_are_replaced_only_when_they_are_ours(tmp_path):
    path = tmp_path / "thing.jaxrod"
    jaxrod.save(path, 1)
    first = path.read_bytes()
    with pytest.raises(FileExistsError, match="overwrite=True"):
        jaxrod.save(path, 2)
    with pytest.raises(ValueError, match="a builtin"):
        jaxrod.save(path, len, overwrite=True)
    assert path.read_bytes() == first
    jaxrod.save(path, 1, overwrite=True)
    assert path.read_bytes() == first, "the same thing gives the same bytes"
    jaxrod.save(path, 2, overwrite=True)
    assert jaxrod.load(path) == 2
    others = [tmp_path / name for name in ("text", "arrays.npz", "link", "folder")]
    others[0].write_text("mine")
    np.savez(others[1], x=np.ones(3))
    others[2].symlink_to(path)
    others[3].mkdir()
    for other in (*others, tmp_path / "dangling"):
        if other.name == "dangling":
            other.symlink_to(tmp_path / "nowhere")
        with pytest.raises(ValueError, match=rf"{other.name} exists, and"):
            jaxrod.save(other, 3, overwrite=True)
    assert others[0].read_text() == "mine" and jaxrod.load(path) == 2
    assert not os.path.lexists(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError):
        jaxrod.save(tmp_path / "lacking" / "thing.jaxrod", 1)


def test_numpy_alone_reads_the_arrays(tmp_path):
    scene, state = swinging()
    path = tmp_path / "arm.jaxrod"
    jaxrod.save(path, {"scene": scene, "state": state})
    with np.load(path, allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["state.positions"], state.positions)
        np.testing.assert_array_equal(arrays["scene.rod.radii"], scene.rod.radii)


def test_64_bits_are_not_rounded_on_the_way(tmp_path):
    path = tmp_path / "thing.jaxrod"
    jaxrod.save(path, [jnp.ones(3), np.ones(2)])
    with jax.enable_x64(False):
        with pytest.raises(ValueError, match=r"thing\.jaxrod has float64 numbers in 0"):
            jaxrod.load(path)
        jaxrod.save(path, np.ones(2), overwrite=True)
        assert jaxrod.load(path).dtype == np.float64


@pytest.mark.parametrize("wide", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_scene_in_another_precision_steps(wide):
    scene, state = swinging()
    wanted = jaxrod.advance(scene, state, 1e-4, 20)
    narrow, start = jaxrod.astype((scene, state), jnp.float32)
    assert {leaf.dtype.name for leaf in jax.tree.leaves(narrow)} <= {"float32", "int32"}
    if wide:
        narrow, start = jaxrod.astype((narrow, start), jnp.float64)
    found = jaxrod.advance(narrow, start, 1e-4, 20)
    assert found.positions.dtype == (jnp.float64 if wide else jnp.float32)
    np.testing.assert_allclose(found.positions, wanted.positions, atol=1e-6)


def test_astype_converts_floating_numbers_alone():
    tree = {
        "count": jnp.arange(2),
        "word": "x",
        "python": 0.5,
        "key": jax.random.key(0),
        "numbers": np.array([1.0, np.nan, -np.inf]),
        "weak": jnp.asarray(0.1),
    }
    found = jaxrod.astype(tree, jnp.float32)
    same = ("count", "word", "python", "key")
    assert all(found[name] is tree[name] for name in same)
    assert found["numbers"].dtype == found["weak"].dtype == jnp.float32
    np.testing.assert_array_equal(found["numbers"], tree["numbers"])
    back = jaxrod.astype(found, jnp.float64)
    check_same(jaxrod.astype(back, jnp.float32), found)
    traced = jax.eval_shape(lambda x: jaxrod.astype(x, jnp.float32), jnp.ones(3))
    assert traced.dtype == jnp.float32
    with pytest.raises(ValueError, match=r"tree\['a'\]\[0\] must be between.*1e\+300"):
        jaxrod.astype({"a": [jnp.asarray(1e300)]}, jnp.float32)
    with pytest.raises(ValueError, match="dtype must be float32 or float64, got int32"):
        jaxrod.astype(tree, jnp.int32)


def test_the_page_states_the_error_of_flax():
    """And shows the way around it, which test_snippets.py runs."""
    serialization = pytest.importorskip("flax.serialization")
    _, state = jaxrod.straight_rod(
        2, length=1.0, radius=0.05, density=1000.0, youngs_modulus=1e6
    )
    with pytest.raises(TypeError) as raised:
        serialization.to_bytes(state)
    page = Path(__file__).parents[1] / "docs" / "saving.md"
    assert str(raised.value) in " ".join(page.read_text().split())
