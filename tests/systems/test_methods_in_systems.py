"""One contract for members of every method: each coupling, with each hook of an effect.

Every effect uses one hook alone. What it does to a rod that a coupling joins to others
is the same in each method. What a method refuses is in a table of the documentation, by
the words that the message contains.
"""

import itertools
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.single_hooks import HOOKS
from systems.couplings_in_plane import COUPLINGS, made

# The programs run a few times: LLVM need not optimise them.
hurried = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
STEPS, DT = 40, 5e-5
ROUNDING = 4e-15  # of places of about a metre [m]


def with_scaled_inertia(scene):
    return jaxrod.scale_inertia(scene).scene


def with_coupled_masses(scene):
    return replace(scene, rod=replace(scene.rod, mass_matrix="higher_order"))


# The method, what is done to scenes, what to compare with, and how far what an effect
# does may be from there, of its size, beyond rounding: another law or integrator.
METHODS = {
    "planar": (jaxrod.planar("zx"), None, "consistent", 1e-9),
    "torsion_free": (jaxrod.torsion_free(), None, "consistent", 1e-9),
    "consistent": (jaxrod.consistent(), None, "consistent", 0.0),
    "pyelastica": (jaxrod.pyelastica(), None, "consistent", 0.05),
    "planar, pyelastica": (
        jaxrod.planar("zx", jaxrod.pyelastica()),
        None,
        "pyelastica",
        1e-9,
    ),
    "scale_inertia": (jaxrod.consistent(), with_scaled_inertia, "scale_inertia", 0.0),
    "planar, scale_inertia": (
        jaxrod.planar("zx"),
        with_scaled_inertia,
        "scale_inertia",
        1e-9,
    ),
    "implicit": (jaxrod.implicit(1.0), None, "consistent", 2e-3),
    "mass_matrix": (jaxrod.consistent(), with_coupled_masses, "mass_matrix", 0.0),
    "planar, mass_matrix": (
        jaxrod.planar("zx"),
        with_coupled_masses,
        "mass_matrix",
        1e-9,
    ),
}
PAGE = Path(__file__).parents[2] / "docs" / "choosing_a_method.md"


def refused():
    """The table of refusals: the words of the message, by method and coupling."""
    lines = PAGE.read_text(encoding="utf-8").partition("## In a system")[2].splitlines()
    rows = [[c.strip() for c in line.strip("|").split("|")] for line in lines]
    table = {}
    for row in rows:
        if len(row) != 4 or not row[0].startswith("`"):
            continue
        method, couplings, words, _ = row
        for coupling in couplings.split(","):
            name = coupling.replace("`", "").strip()
            table[method.strip("`()"), name] = words.strip("`")
    return table


REFUSED = refused()
PAIRS = list(itertools.product(METHODS, COUPLINGS))
FIRST = [("planar", "tie"), ("torsion_free", "weld"), ("torsion_free", "tie")]


def test_the_table_has_known_names_and_few_rows():
    assert REFUSED.keys() <= set(PAIRS)
    assert 0 < len(REFUSED) <= 0.09 * len(PAIRS)


def scenes(method, coupling):
    chosen, change, _, _ = METHODS[method]
    effects = [kind(jnp.zeros(())) for kind in HOOKS]
    return made(coupling, chosen, effects, change or (lambda scene: scene))


@cache
def consequences(method, coupling):
    """Places of all nodes without effects, and what each hook changes [m].

    Both are extrapolated to vanishing steps from two sizes of steps, since some hooks
    are of first order in some methods.
    """
    system, state = scenes(method, coupling)

    def places(sizes, dt, steps):
        effects = tuple(kind(size) for kind, size in zip(HOOKS, sizes, strict=True))
        one = replace(system.members["one"], effects=effects)
        acting = replace(system, members={**system.members, "one": one})
        end = jaxrod.advance(acting, state, dt, steps)
        return jnp.concatenate([end[k].positions for k in ("one", "two", "ball")], 1)

    sizes = jnp.asarray(np.concatenate([np.zeros((1, len(HOOKS))), np.eye(len(HOOKS))]))
    run = hurried(jax.vmap(places, in_axes=(0, None, None)))
    coarse, fine = (
        np.asarray(run(sizes, jnp.asarray(DT / share), jnp.asarray(STEPS * share)))
        for share in (1, 2)
    )
    without, *ends = 2 * fine - coarse
    return without, [end - without for end in ends]


def gap(one, other):
    """Largest difference at a node, of what is done there or of a tenth of the most."""
    change, size = (np.linalg.norm(a, axis=0) for a in (one - other, other))
    beyond = np.maximum(change - ROUNDING, 0)
    return np.max(beyond / np.maximum(size, 0.1 * np.max(size)))


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize(
    ("method", "coupling"), [*FIRST, *(pair for pair in PAIRS if pair not in FIRST)]
)
def test_a_member_does_what_the_full_model_does(method, coupling):
    words = REFUSED.get((method, coupling))
    if words is not None:
        with pytest.raises(ValueError, match=words):
            scenes(method, coupling)
        return
    _, _, like, close = METHODS[method]
    (places, found), (there, expected) = (
        consequences(name, coupling) for name in (method, like)
    )
    assert np.all(np.isfinite(places))
    assert np.max(np.abs(places - there)) <= max(1e-14, 1e-4 * close)
    for hook, one, other in zip(HOOKS, found, expected, strict=True):
        assert np.max(np.abs(other)) > 1e-8, f"{hook.__name__} does nothing"
        assert gap(one, other) <= close, hook.__name__
