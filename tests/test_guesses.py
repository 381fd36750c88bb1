"""Names that users of other tools guess are answered with the names to use."""

import copy
import pickle
import re
from importlib import import_module

import jax
import pytest

import jaxrod
import jaxrod.viz
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


def test_a_misspelt_name_is_answered_with_the_one_that_was_meant():
    with pytest.raises(AttributeError, match=r": is jaxrod\.straight_rod meant\?"):
        _ = jaxrod.straigth_rod
    with pytest.raises(AttributeError, match=r": is jaxrod\.systems\.ball_joint me"):
        _ = jaxrod.systems.ball_jont
    with pytest.raises(AttributeError, match=r": is jaxrod\.viz\.picture meant\?"):
        _ = jaxrod.viz.pictrue
    with pytest.raises(AttributeError, match=r": is jaxrod\.envs\.rollout meant\?"):
        _ = jaxrod.envs.rolout
