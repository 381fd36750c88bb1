r"""Kicks with drag: exact along and across the rod, at any decay rate.

At fixed configuration, with the acceleration $a$ by all loads held constant, a
component of the velocity relative to the fluid obeys $\dot w = a - g w - q |w| w$. Its
solution after a time $h$ is, with $T = \tanh(\kappa)\, h/\kappa$ and
$\kappa^2 = h^2 (g^2/4 + q |a|)$,

$$w(h) = \frac{(1 - \tfrac12 g T)\, w + T a}{1 + \tfrac12 g T + q |w| T},$$

exact if $a$ and $w$ have the same direction or either vanishes: the decay is
$w/(1 + q|w|h)$, the terminal speed $\sqrt{a/q}$, and with $q = 0$ it is the exponential
decay of `Kick`. Across the rod $a$ and $w$ may have any directions in a plane. There
the component of $a$ across $w$ is also multiplied by $1 + \tfrac12 q |w| T$, which
makes the step second order. No step is too large: nothing overshoots the terminal
velocity, so drag does not limit the step.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxrod.effects.base import Effect
from jaxrod.effects.own_classes import trial_motion
from jaxrod.geometry import vectors
from jaxrod.geometry.rotations import directors
from jaxrod.geometry.vectors import Vec3
from jaxrod.loaded_rod import LoadedRod, damping_rates
from jaxrod.methods.verlet import Kick
from jaxrod.rods.drag import Drag, node_tangents, relative_velocity
from jaxrod.rods.motion import Motion


def has_drag(effect: Effect) -> bool:
    """Whether an effect defines `Effect.drag`, decay in a surrounding fluid."""
    return type(effect).drag is not Effect.drag


def without_drag(scene: LoadedRod) -> LoadedRod:
    """Scene without its effect with drag, which is not integrated as a load."""
    if not any(map(has_drag, scene.effects)):
        return scene
    left = tuple(effect for effect in scene.effects if not has_drag(effect))
    return replace(scene, effects=left)


def drag_on(scene: LoadedRod, motion: Motion) -> Drag | None:
    """Drag rates of the scene's effect with drag; `None` if there is no such effect.

    Raises:
        ValueError: If several effects have drag.
    """
    found = [effect for effect in scene.effects if has_drag(effect)]
    if len(found) > 1:
        names = " and ".join(type(effect).__name__ for effect in found)
        raise ValueError(f"a scene must have at most one effect with drag, got {names}")
    return found[0].drag(scene.rod, motion) if found else None


def drag_kick(
    scene: LoadedRod, motion: Motion, forces: Vec3, couples: Vec3, dt: Array
) -> tuple[Vec3, Vec3] | None:
    """Velocities and angular momenta after a kick with drag; `None` without drag.

    Args:
        scene: The scene.
        motion: Configuration and rates of the rod; spins are angular momenta.
        forces: All other forces on the nodes, world frame [N].
        couples: All other couples on the elements, world frame [N m].
        dt: Step size [s].
    """
    drag = drag_on(scene, motion)
    if drag is None:
        return None
    damping = damping_rates(scene)
    relative = relative_velocity(motion, drag)
    drive = vectors.scale(1 / scene.rod.node_masses, forces)
    along, across = drag.along, drag.across
    if damping is not None:
        along, across = along + damping[0], across + damping[0]
        if drag.flow is not None:
            # Damping acts on the velocity itself, not on that relative to the flow.
            drive = vectors.subtract(drive, vectors.scale(damping[0], drag.flow))
    change = _change(
        relative,
        drive,
        node_tangents(motion),
        (along, drag.along_per_speed),
        (across, drag.across_per_speed),
        dt,
    )
    velocity = vectors.add(motion.velocity, change)
    turning = drag.turning
    if damping is not None:
        own = (0.0, 0.0) if turning is None else turning
        turning = own[0] + damping[1], own[1] + damping[1]
    if turning is None:
        return velocity, vectors.add(motion.spin, vectors.scale(dt, couples))
    about, tilting = turning
    axis = directors(motion.orientation)[2]
    turn = _change(motion.spin, couples, axis, (about, None), (tilting, None), dt)
    return velocity, vectors.add(motion.spin, turn)


Rates = tuple[Array, Array | None]
"""Decay rate g [1/s] and its increase per speed q [1/m], as in w' = -(g + q |w|) w;
`None` instead of q if it is zero."""


def _change(
    rate: Vec3, drive: Vec3, axis: Vec3, along: Rates, across: Rates, dt: Array
) -> Vec3:
    """Change over a step of v = `rate` by v' = drive - (g + q |v|) v, drive constant.

    Components along and across the axis have different decay rates (g, q).
    """
    on_rate, on_drive = vectors.dot(axis, rate), vectors.dot(axis, drive)
    rate = vectors.subtract(rate, vectors.scale(on_rate, axis))
    drive = vectors.subtract(drive, vectors.scale(on_drive, axis))
    if along[1] is None:
        gain, loss = _decay(along[0], dt)
    else:
        # Not `abs`: JAX gives it the slope one at zero.
        way = jnp.sign(on_rate)
        speed, size = way * on_rate, jnp.sign(on_drive) * on_drive
        gain, loss = _riccati(along, speed, size, way * on_drive, dt)
    change = vectors.scale(gain * on_drive - loss * on_rate, axis)
    if across[1] is None:
        gain, loss = _decay(across[0], dt)
    else:
        speed = vectors.safe_norm(rate)
        forward = vectors.dot(rate, drive) / speed
        gain, loss = _riccati(across, speed, vectors.safe_norm(drive), forward, dt)
    gained, lost = vectors.scale(gain, drive), vectors.scale(loss, rate)
    return vectors.add(change, vectors.subtract(gained, lost))


def _decay(rate: Array, dt: Array) -> tuple[Array, Array]:
    """Gain (1 - exp(-g dt)) / g [s], loss 1 - exp(-g dt) [1], for the decay rate g."""
    kick = Kick.create(None, rate, dt)
    assert kick.loss is not None
    return kick.gain, kick.loss


def _riccati(
    rates: Rates, speed: Array, size: Array, forward: Array, dt: Array
) -> tuple[Array, Array]:
    """Factors gain [s] and loss [1] in w(h) - w = gain a - loss w, with drive a.

    They solve w' = a - g w - q |w| w over a step with constant a.

    Args:
        rates: Decay rate g, and its increase per speed q.
        speed: Norm of the decaying vector w.
        size: Norm of the drive a.
        forward: Component of the drive in the direction of w.
        dt: Step size [s].
    """
    linear, growth = rates
    assert growth is not None
    time = dt * _tanh_ratio(dt * dt * (0.25 * linear * linear + growth * size))
    faster = growth * speed
    share = time / (1 + time * (0.5 * linear + faster))
    lean = 0.5 * time * growth * forward
    return share * (1 + 0.5 * time * faster), share * (linear + faster + lean)


def _tanh_ratio(square: Array) -> Array:
    """Ratio tanh(x) / x as a function of the square of x, smooth at zero."""
    small = square < 1e-3
    root = jnp.sqrt(jnp.where(small, 1, square))
    series = 1 - square * (1 / 3 - square * (2 / 15 - square * (17 / 315)))
    return jnp.where(small, series, jnp.tanh(root) / root)


def check_drag(scene: LoadedRod) -> None:
    """Raises ValueError for two effects with drag, or drag without a stable step."""
    now = scene.at(0.0)
    found = jax.eval_shape(lambda: drag_on(now, trial_motion(scene.rod)))
    limited = scene.method.explicit and not scene.method.solves_drag
    if limited and found is not None and found.grows_with_speed:
        raise ValueError(
            "drag that grows with the square of the speed has no stable step in "
            f"{scene.method!r}, which treats it as a load: use consistent(), planar(), "
            "torsion_free() or implicit()"
        )
