"""The graph of single numbers: what is folded, and what is not."""

import numpy as np
import pytest

from jaxrod.lanes.graph import FIXED, UNIFORM, VARYING, Graph


@pytest.fixture
def graph():
    return Graph()


def test_the_same_operation_is_one_node(graph):
    a, b = graph.inputs(0, (2,), "f32", VARYING)
    assert graph.add("mul", (a, b), "f32") == graph.add("mul", (b, a), "f32")
    assert graph.add("sub", (a, b), "f32") != graph.add("sub", (b, a), "f32")


def test_known_numbers_are_worked_out_in_their_own_precision(graph):
    third = graph.constant(1 / 3, "f32")
    total = graph.add("add", (third, third), "f32")
    assert graph.value(total) == np.float32(1 / 3) + np.float32(1 / 3)


@pytest.mark.parametrize(
    ("operation", "number"), [("add", 0.0), ("mul", 1.0), ("sub", 0.0), ("div", 1.0)]
)
def test_what_changes_nothing_is_left_out(graph, operation, number):
    (a,) = graph.inputs(0, (1,), "f64", VARYING)
    known = graph.constant(number, "f64")
    assert graph.add(operation, (int(a), known), "f64") == a


def test_the_sign_of_zero_tells_constants_apart(graph):
    assert graph.constant(0.0, "f64") != graph.constant(-0.0, "f64")


def test_a_quotient_by_three_stays_a_quotient(graph):
    (a,) = graph.inputs(0, (1,), "f32", VARYING)
    by_three = graph.add("div", (int(a), graph.constant(3, "f32")), "f32")
    by_four = graph.add("div", (int(a), graph.constant(4, "f32")), "f32")
    assert graph.operations[by_three] == "div"
    assert graph.operations[by_four] == "mul"


def test_a_value_changes_as_often_as_what_it_is_made_of(graph):
    (shared,) = graph.inputs(0, (1,), "f32", UNIFORM)
    (own,) = graph.inputs(1, (1,), "f32", FIXED)
    (carry,) = graph.inputs(2, (1,), "f32", VARYING)
    square = graph.add("mul", (int(shared), int(shared)), "f32")
    both = graph.add("add", (square, int(own)), "f32")
    assert graph.rates[square] == UNIFORM
    assert graph.rates[both] == FIXED
    assert graph.rates[graph.add("add", (both, int(carry)), "f32")] == VARYING


def test_what_is_not_needed_is_not_in_the_program(graph):
    a, b = map(int, graph.inputs(0, (2,), "f32", VARYING))
    needed = graph.add("add", (a, b), "f32")
    graph.add("mul", (a, b), "f32")
    assert graph.needed([needed]) == [a, b, needed]
