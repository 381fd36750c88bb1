"""Every number that a factory takes may be traced, alone or inside tuples."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.numeric_arguments import BALL, FACTORIES, MATERIAL, SCENE, STATE
from public_names import PUBLIC

ELSEWHERE = {
    # Runs: their step is traced in test_compilation and test_gradients.
    "step",
    "advance",
    "rollout",
    "equilibrium",
    "health",
    # Its tolerances are traced in test_settled.
    "settled",
    # It has the derivatives of a reading that is not rounded; traced in test_noise.
    "noisy",
    # Made on the host alone; it says so.
    "ring",
}


def numeric_arguments(name):
    """The arguments of a public function that are numbers or arrays of them."""
    parameters = inspect.signature(PUBLIC[name]).parameters.values()
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
    functions = [n for n, thing in PUBLIC.items() if inspect.isfunction(thing)]
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
    made = jax.tree.leaves(PUBLIC[name](*members, **given))
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


@pytest.mark.fast_sets(1)
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
        ("resample", {"scene": SCENE, "state": STATE, "n_elements": 6}),
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
        call = lambda n, k=argument: PUBLIC[name](**arguments | {k: n})
        with pytest.raises(ValueError, match=argument):
            jax.jit(call)(value)


@pytest.mark.parametrize(
    "look",
    [
        lambda scene: jaxrod.natural_frequencies(scene, STATE),
        lambda scene: jaxrod.resample(scene, STATE, 6),
        lambda scene: jaxrod.tune(scene, STATE),
    ],
)
def test_what_works_on_the_host_alone_says_so(look):
    with pytest.raises(ValueError, match=r"traced by jax\.jit"):
        jax.jit(look)(SCENE)
