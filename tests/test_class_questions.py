"""Code that asks what class an object is becomes less, never more."""

from collections import Counter
from pathlib import Path

from class_questions import counted, questions

ROOT = Path(__file__).resolve().parents[1]
MOST = {
    "class": 29,
    "compared classes": 3,
    "compared laws": 0,
    "hasattr": 14,
    "leading axes": 1,
}
"""Numbers of questions in the folder jaxrod. When `class` was first counted it was
142."""
MOST_IN_SYSTEMS = 4
"""Questions of classes in jaxrod/systems: checks of input, and one equality."""


def test_no_more_questions_are_asked():
    found = counted(ROOT)["all of jaxrod"]
    assert {kind: n for kind, n in found.items() if n > MOST[kind]} == {}


def test_systems_ask_members_and_couplings_and_not_their_classes():
    found = counted(ROOT)["jaxrod/systems"]
    assert found["class"] <= MOST_IN_SYSTEMS
    assert found["leading axes"] == 0


def test_questions_are_counted():
    source = """
if isinstance(member, RigidBodies | Other) or hasattr(member, "rod"):
    pass
if type(a) is Scene or scene.method.law == "pyelastica":
    pass
if member.rod.rest_lengths.ndim > 1 or isinstance(x, int):
    pass
"""
    kinds = Counter(kind for _, kind in questions(source, {"RigidBodies", "Scene"}))
    assert kinds == {
        "class": 1,
        "hasattr": 1,
        "compared classes": 1,
        "compared laws": 1,
        "leading axes": 1,
    }
