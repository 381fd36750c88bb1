"""Inverse design: a rod whose equilibrium goes through markers."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from benchmarks.identification.run import Shapes
from jaxrod.control import match_shape


@pytest.mark.slow
def test_an_arm_takes_shapes_many_at_once_and_its_equilibrium_is_there():
    shapes = Shapes(20)
    keys = jax.random.split(jax.random.key(0), 3)
    targets = jax.vmap(shapes.target)(keys)
    found = jax.jit(jax.vmap(shapes.match))(targets)
    assert bool(jnp.all(found.converged))
    # An equilibrium of the scene that it says, found anew.
    one = jax.tree.map(lambda leaf: leaf[1], found)
    rest = jaxrod.equilibrium(one.scene, shapes.state)
    gap = rest.state.positions[:, 2::2] - targets[1]
    assert float(jnp.max(jnp.sqrt(jnp.sum(gap**2, axis=0)))) < 1e-3
    assert bool(rest.stable)
    assert float(jnp.max(jnp.abs(one.rest_curvature[2]))) == 0


@pytest.mark.slow
def test_stiffness_alone_is_found_where_it_is_what_has_changed():
    shapes = Shapes(5)
    softer = np.array([1.0, 1.0, 0.6, 0.6, 1.0])
    rod = shapes.scene.rod
    made = replace(
        rod,
        bend_twist_stiffness=rod.bend_twist_stiffness * softer[None],
        shear_stretch_stiffness=rod.shear_stretch_stiffness * softer[None],
    )
    scene = replace(shapes.scene, rod=made)
    target = jaxrod.equilibrium(scene, shapes.state).state.positions[:, 1:]
    found = match_shape(
        shapes.scene, shapes.state, target, range(1, 6), free=("stiffness",),
        max_error=1e-4,
    )  # fmt: skip
    assert bool(found.converged)
    assert float(found.error) < 1e-4
    before = jaxrod.equilibrium(shapes.scene, shapes.state).state.positions[:, 1:]
    assert float(jnp.max(jnp.abs(before - target))) > 2e-3
    assert float(jnp.mean(found.stiffness[2:4])) < 0.8
    assert float(jnp.max(jnp.abs(found.rest_curvature))) == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"free": ("colour",)}, "free must name"),
        ({"free": ()}, "free must name"),
        ({"nodes": (3, 2)}, "different and in order"),
        ({"nodes": (2, 9)}, "nodes must be at most 4"),
        ({"markers": np.zeros((2, 3))}, "markers must have shape"),
        ({"max_error": 0.0}, "max_error must be positive"),
    ],
)
def test_bad_arguments_are_refused(change, words):
    rod, state = jaxrod.straight_rod(
        4, length=1.0, radius=0.05, density=1e3, youngs_modulus=1e6
    )
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state))
    given = {"markers": np.zeros((3, 2)), "nodes": (2, 4)} | change
    with pytest.raises(ValueError, match=words):
        match_shape(scene, state, given.pop("markers"), given.pop("nodes"), **given)
