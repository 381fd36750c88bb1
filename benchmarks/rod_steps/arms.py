"""The arms that `jaxrod benchmark` steps, and the program that steps them.

The arm is that of `benchmarks.rod_steps.pyelastica`: 20 elements, clamped, damped, bent
by a couple on every element. Every arm of a batch has couples of its own, as in
reinforcement learning; here they are equal, so that the arms must stay equal.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int

from benchmarks.rod_steps.pyelastica import DAMPING_RATE, ELEMENT_COUPLE, TIME_STEP
from jaxrod.effects.actuation import ElementCouples
from jaxrod.effects.clamps import clamp, fixed_end
from jaxrod.effects.loads import exponential_damping
from jaxrod.methods.laws import IN_SPACE, Law
from jaxrod.rods.factories import straight_rod
from jaxrod.rods.rod import RodState
from jaxrod.scene import Scene, make_scene
from jaxrod.stepping.runs import advance

N_ELEMENTS = 20
_AXIS = "arm"

AdvanceArms = Callable[[RodState, int], RodState]


def arms(batch: int, law: Law) -> tuple[Scene, Float[Array, "batch 3 n"], RodState]:
    """The scene without its actuation, couples [N m] and states of all arms."""
    rod, state = straight_rod(
        N_ELEMENTS, length=1.0, radius=0.05, density=1000.0, youngs_modulus=1e7
    )
    held = clamp(state) if law == "consistent" else fixed_end(state)
    scene = make_scene(
        rod, held, exponential_damping(DAMPING_RATE), method=IN_SPACE[law]
    )
    couples = jnp.zeros((batch, 3, N_ELEMENTS)).at[:, 0].set(ELEMENT_COUPLE)
    states = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (batch, *leaf.shape)), state
    )
    return scene, couples, states


def advance_arms(
    scene: Scene,
    couples: Float[Array, "batch 3 n"],
    states: RodState,
    dt: Float[Array, ""],
    n_steps: Int[Array, ""],
) -> RodState:
    """Advances a batch of arms, each bent by its own couples; this is timed."""

    def one(couples: Float[Array, "3 n"], state: RodState) -> RodState:
        effects = (*scene.effects, ElementCouples(couples))
        actuated = dataclasses.replace(scene, effects=effects)
        return advance(actuated, state, dt, n_steps)

    if couples.shape[0] > 1:
        return jax.vmap(one)(couples, states)
    alone = one(couples[0], jax.tree.map(lambda leaf: leaf[0], states))
    return jax.tree.map(lambda leaf: leaf[None], alone)


def compile_arms(
    scene: Scene,
    couples: Float[Array, "batch 3 n"],
    states: RodState,
    devices: Sequence[jax.Device],
) -> AdvanceArms:
    """Compiles `advance_arms`; each device loops over its share.

    Returns:
        `(states, n_steps) -> states`; it waits until the result is there.
    """
    mesh = jax.make_mesh(
        (len(devices),), (_AXIS,), axis_types=(AxisType.Auto,), devices=devices
    )
    repeated, shared = PartitionSpec(), PartitionSpec(_AXIS)
    program = jax.shard_map(
        advance_arms,
        mesh=mesh,
        in_specs=(repeated, shared, shared, repeated, repeated),
        out_specs=shared,
        check_vma=False,
    )
    dt = jnp.asarray(TIME_STEP, states.positions.dtype)
    scene, dt = jax.device_put((scene, dt), NamedSharding(mesh, repeated))
    couples, states = jax.device_put((couples, states), NamedSharding(mesh, shared))
    counts = NamedSharding(mesh, repeated)
    one = jax.device_put(jnp.int32(1), counts)
    compiled = jax.jit(program).lower(scene, couples, states, dt, one).compile()

    def run(states: RodState, n_steps: int) -> RodState:
        states = jax.device_put(states, NamedSharding(mesh, shared))
        count = jax.device_put(jnp.int32(n_steps), counts)
        return jax.block_until_ready(compiled(scene, couples, states, dt, count))

    return run


def even_share(batch: int, n_devices: int) -> int:
    """The largest number of devices, up to `n_devices`, that divides the batch."""
    return max(k for k in range(1, n_devices + 1) if batch % k == 0)
