"""A network in the twin of the tentacle, which learns what the fitted arm lacks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxrod
from jaxrod import extend, twin

UNITS, SCALE, WIDEST = 4, 2e-2, 10.0
"""Hidden units, scale of the energy per length [J/m] and of curvature [1/m]."""
NOISE, PRIOR = 3e-3, {"inner": 1.0, "outer": 0.1}
"""Standard deviations of a coordinate [m], and of weights about their start [1]."""


@extend.pytree
class LearnedEnergy(jaxrod.actuation.SectionLoad):
    """Energy of bending by a network of arc length and both curvatures."""

    inner: extend.Leaf
    """Weights of arc length, the two curvatures and one, for each hidden unit."""
    outer: extend.Leaf
    """Weights of the hidden units."""

    def stored(self, rod: Any, strains: Any) -> jax.Array:
        """Stored energy [J]; zero for a straight rod."""
        one, two, _ = (angle[1:-1] for angle in strains.rotations)
        place = 2 * jnp.cumsum(rod.rest_lengths)[:-1] / rod.length - 1
        bent = [angle / (rod.joint_lengths * WIDEST) for angle in (one, two)]
        along, first, second, shift = self.inner.T[..., None]
        straight = along * place[None] + shift
        hidden = jnp.tanh(straight + first * bent[0][None] + second * bent[1][None])
        more = jnp.sum(self.outer[:, None] * (hidden - jnp.tanh(straight)), axis=0)
        return SCALE * jnp.sum(rod.joint_lengths * more)


def start() -> dict[str, np.ndarray]:
    """Weights with which the network adds nothing."""
    draw = np.random.default_rng(0)
    return {"inner": draw.normal(size=(UNITS, 4)), "outer": np.zeros(UNITS)}


def poses(found: twin.Twin, inputs: Any, weights: Mapping[str, Any]) -> jax.Array:
    """Markers but the one at the origin, under each of the inputs [m]."""
    arm, values = found.arm, found.values

    def pose(one: jax.Array) -> jax.Array:
        pulls = arm.tensions(values, one)
        scene, state = arm.scene(values, lambda numbers: pulls[numbers])
        rest = jaxrod.equilibrium(scene.with_effect(LearnedEnergy(**weights)), state)
        points = arm.points(scene, rest.state, values)[1:]
        return jnp.where(rest.converged, points, jnp.nan)

    return jax.vmap(pose)(jnp.asarray(inputs))


def learn(found: twin.Twin, recordings: Sequence[twin.Recording]) -> dict[str, Any]:
    """Weights that agree best with the recordings and with their prior."""
    inputs = np.stack([one.inputs[0] for one in recordings])
    seen = np.stack([one.points[0, 1:] for one in recordings])
    begin = start()
    fitted = jaxrod.control.fit(
        lambda p: {"markers": poses(found, inputs, p)} | p,
        {"markers": seen} | begin,
        begin,
        noise={"markers": NOISE} | PRIOR,
        logarithmic=False,
        iterations=15,
    )
    return dict(fitted.values)


def errors(
    found: twin.Twin, weights: Any, recordings: Sequence[twin.Recording]
) -> np.ndarray:
    """Distances of the markers from prediction, a row for each recording [m]."""
    inputs = np.stack([one.inputs[0] for one in recordings])
    seen = np.stack([one.points[0, 1:] for one in recordings])
    away = np.asarray(jax.jit(lambda w: poses(found, inputs, w))(weights)) - seen
    return np.linalg.norm(away, axis=-1)
