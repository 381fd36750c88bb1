"""Names that users of other tools guess are answered with the names to use."""

import copy
import pickle
import re
from importlib import import_module

import jax
import pytest

import jaxrod
import jaxrod.viz
from jaxrod import training
from jaxrod.cli.settings import configure
from jaxrod.model import GUESSES
from jaxrod.rods.rod import Rod, RodState

ROD, STATE = jaxrod.straight_rod(
    2, length=1.0, radius=0.05, density=1000.0, youngs_modulus=1e6
)
SCENE = jaxrod.make_scene(ROD, jaxrod.gravity())
PLACES = {"Rod": ROD, "RodState": STATE, "Model": SCENE}
HINTS = {"Rod": Rod._hints, "RodState": RodState._hints, "Model": GUESSES} | {
    module: import_module(module)._GUESSES
    for module in ("jaxrod", "jaxrod.systems", "jaxrod.viz", "jaxrod.envs")
}
SYSTEM = jaxrod.make_system({"rod": SCENE})


def owner(place):
    return PLACES[place] if place in PLACES else import_module(place)


@pytest.mark.parametrize(
    ("place", "guess", "answer"),
    [
        ("jaxrod.systems", "hinge", "jaxrod.systems.hinge_joint"),
        ("jaxrod.viz", "plot", "jaxrod.viz.show"),
        ("Rod", "x", "state.positions"),
        ("RodState", "position", "state.positions"),
        ("jaxrod", "CosseratRod", "jaxrod.straight_rod"),
        ("jaxrod", "OneEndFixedBC", "jaxrod.clamp"),
        ("jaxrod", "pin", "jaxrod.pin_support"),
        ("jaxrod", "integrate", "jaxrod.advance"),
        ("jaxrod", "mj_step", "jaxrod.step"),
        ("jaxrod", "floor", "jaxrod.contact(jaxrod.shapes.plane())"),
        ("RodState", "position_collection", "state.positions"),
        ("RodState", "qpos", "state.positions"),
        ("RodState", "qvel", "state.velocities"),
        ("Rod", "kappa", "jaxrod.strains(rod, state)"),
        ("Model", "step", "jaxrod.step(scene, state, dt)"),
        ("jaxrod.envs", "get_environment", "jaxrod.envs.make"),
        ("jaxrod.systems", "connect", "jaxrod.systems.tie"),
    ],
)
def test_a_guess_is_answered_with_the_name_to_use(place, guess, answer):
    with pytest.raises(AttributeError, match=rf"{guess}'.*{re.escape(answer)}"):
        getattr(owner(place), guess)


def test_a_system_answers_as_a_scene_does():
    with pytest.raises(AttributeError, match=r"'System'.*jaxrod\.advance\(scene"):
        _ = SYSTEM.advance


@pytest.mark.parametrize("place", HINTS)
def test_a_hint_names_what_exists_and_a_guess_does_not(place):
    for guess, hint in HINTS[place].items():
        with pytest.raises(AttributeError, match=re.escape(hint)):
            getattr(owner(place), guess)
        names = re.findall(r"\b(?:jaxrod|state|rod)(?:\.\w+)+", hint)
        assert names, f"{guess}: {hint} gives no name"
        for name in names:
            value = {"jaxrod": jaxrod, "state": STATE, "rod": ROD}
            first, *others = name.split(".")
            found = value[first]
            for part in others:
                found = getattr(found, part)
        assert ". " not in hint and not hint.endswith("."), "one sentence, as a message"


def test_other_names_fail_as_ever():
    for thing in (ROD, STATE, SCENE, SYSTEM, jaxrod.systems, jaxrod.envs):
        assert not hasattr(thing, "qwertz") and not hasattr(thing, "__qwertz__")
    with pytest.raises(AttributeError, match="'RodState' object has no attribute 'pp'"):
        _ = STATE.pp


def test_an_error_inside_a_property_keeps_its_message():
    """For example in a state of placeholders, as JAX makes them."""
    placeholders = jax.tree.map(lambda _: object(), STATE)
    with pytest.raises(AttributeError, match="'object' object has no attribute"):
        _ = placeholders.layout


def test_copies_and_pickles_need_no_state_to_be_looked_up():
    for thing in (copy.deepcopy(STATE), copy.copy(STATE)):
        assert thing.positions.shape == (3, 3)
    assert pickle.loads(pickle.dumps(ROD)).n_elements == 2


@pytest.mark.parametrize(
    ("space", "misspelt", "name"),
    [
        ("jaxrod", "straigth_rod", "straight_rod"),
        ("jaxrod.systems", "ball_jont", "ball_joint"),
        ("jaxrod.viz", "pictrue", "picture"),
        ("jaxrod.envs", "rolout", "rollout"),
        ("jaxrod.shapes", "cilinder", "cylinder"),
        ("jaxrod.control", "levenberg_marquart", "levenberg_marquardt"),
        ("jaxrod.control.estimation", "moving_horizont", "moving_horizon"),
        ("jaxrod.training", "tarin", "train"),
        ("jaxrod.extend", "Efect", "Effect"),
    ],
)
def test_a_misspelt_name_is_answered_with_the_one_that_was_meant(space, misspelt, name):
    with pytest.raises(AttributeError) as raised:
        getattr(import_module(space), misspelt)
    end = f"has no attribute {misspelt!r}: did you mean {space}.{name}?"
    assert str(raised.value) == f"module {space!r} {end}"


@pytest.mark.parametrize("space", [*sorted(jaxrod._NAMESPACES), "control.estimation"])
def test_every_namespace_answers_a_misspelt_name(space):
    module = import_module(f"jaxrod.{space}")
    for name in getattr(module, "__all__", []):
        if len(name) > 4:
            with pytest.raises(AttributeError, match=r": did you mean jaxrod\..*\?$"):
                getattr(module, f"{name}q")
    if hasattr(module, "__all__"):
        with pytest.raises(AttributeError, match=rf"help\(jaxrod.{space}\) lists"):
            _ = module.qwertz


@pytest.mark.parametrize(
    ("thing", "misspelt", "name"),
    [
        (SCENE, "total_enery", "total_energy"),
        (SYSTEM, "kinetic_enrgy", "kinetic_energy"),
        (SYSTEM, "couplngs", "couplings"),
        (STATE, "positons", "positions"),
        (ROD, "n_elemets", "n_elements"),
    ],
)
def test_a_misspelt_attribute_is_answered_with_the_one_that_was_meant(
    thing, misspelt, name
):
    end = rf"has no attribute '{misspelt}': did you mean '{name}'\?$"
    with pytest.raises(AttributeError, match=end):
        getattr(thing, misspelt)


def test_a_misspelt_setting_task_option_or_algorithm_is_answered_first():
    guesses = {
        "lerning_rate": lambda: configure(training.PPOConfig(), {}, ["lerning_rate=1"]),
        "trackng": lambda: jaxrod.envs.make("trackng"),
        "episode_lenght": lambda: jaxrod.envs.make("tracking", episode_lenght=5),
        "pp0": lambda: training.find_algorithm("pp0"),
    }
    meant = {
        "lerning_rate": "learning_rate",
        "trackng": "tracking",
        "episode_lenght": "episode_length",
        "pp0": "ppo",
    }
    for misspelt, call in guesses.items():
        with pytest.raises(ValueError) as raised:
            call()
        beginning, found, _ = str(raised.value).partition(
            f"did you mean {meant[misspelt]!r}?"
        )
        assert found and len(beginning) < 50, str(raised.value)


def test_what_is_nothing_like_a_name_gets_the_list():
    with pytest.raises(ValueError, match=r"qwertz.*learning_rate"):
        configure(training.PPOConfig(), {}, ["qwertz=1"])
    with pytest.raises(ValueError, match=r"tracking.*qwertz"):
        jaxrod.envs.make("qwertz")
    with pytest.raises(ValueError, match=r"qwertz.*episode_length"):
        jaxrod.envs.make("tracking", qwertz=5)
    with pytest.raises(ValueError, match=r"ppo.*qwertz"):
        training.find_algorithm("qwertz")


@pytest.mark.parametrize("space", ["control", "envs", "systems", "training", "viz"])
def test_dir_lists_all_names(space):
    """Those that are imported on use, too, so that an editor can complete them."""
    module = getattr(jaxrod, space)
    assert set(module.__all__) <= set(dir(module))
