"""Composing a scene from a rod, effects and a method, with checks in words."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxrod.effects.base import Effect
from jaxrod.effects.memory import memory_fields, remembers
from jaxrod.effects.time import at_clock, at_largest, clock_at, depends_on_time
from jaxrod.effects.trial_motion import trial_motion
from jaxrod.methods.consistent import Consistent
from jaxrod.methods.drag_kick import drag_on
from jaxrod.methods.planar import Planar
from jaxrod.methods.planar_verlet import PLANES
from jaxrod.rods.rod import Rod
from jaxrod.scene import Method, Scene
from jaxrod.validation import check_held, check_kind, is_traced


def make_scene(rod: Rod, *effects: Effect, method: Method | None = None) -> Scene:
    """A scene: a rod and all that acts on it.

    Floating-point numbers of effects and of the method are converted to the rod's type.

    Args:
        rod: The rod.
        *effects: Effects on it, in the order in which they are applied.
        method: Method that steps it; by default `consistent()`. Others are
            `planar("xy")`, `torsion_free()`, `implicit()`, `pyelastica()` and
            `planar("xy", pyelastica())`.

    Raises:
        ValueError: If the scene is not one for the method.
        TypeError: If an effect is not an `Effect`, the rod is not a `Rod`, or the
            method is not a `Method`.
    """
    check_kind("rod", rod, Rod)
    for effect in effects:
        if not isinstance(effect, Effect):
            raise TypeError(
                f"effects must be jaxrod effects, got {type(effect).__name__}"
            )
        at_clock(effect, clock_at(0.0, rod.rest_lengths.dtype)).check(rod)
    if method is None:
        method = Consistent()
    if not isinstance(method, Method):
        raise TypeError(
            "method must be one such as jaxrod.consistent() or jaxrod.planar('xy'), "
            f"got {method!r}"
        )
    dtype = rod.rest_lengths.dtype
    listed = _in_type(dtype, "effects", tuple(effects))
    method = _in_type(dtype, "method", method)
    scene = Scene(rod, listed, method)
    _check_evolution(scene)
    _check_drag(scene)
    method.check(scene.at(0.0))
    if scene.evolves:
        # Zero now may be out of the plane or about the axis later.
        method.check(scene.stirred)
    return scene


def _check_evolution(scene: Scene) -> None:
    """Raises where an effect may not depend on time or remember."""
    for effect in scene.effects:
        if not (depends_on_time(effect) or remembers((effect,))):
            continue
        name = type(effect).__name__
        memories = [getattr(effect, field) for field in memory_fields(effect)]
        if depends_on_time(memories):
            raise ValueError(
                f"what {name} remembers begins with a number, not with a schedule"
            )
        if type(effect).damping_rates is not Effect.damping_rates:
            raise ValueError(
                f"damping rates are worked out once, but {name}, which has some, "
                "depends on time or remembers"
            )
        if isinstance(scene.method, Planar) and _leaves(effect, scene):
            raise ValueError(
                f"a scene in the {scene.method.plane} plane needs what is driven to be "
                f"free across it, but {name} holds all axes: give it "
                f'axes="{"".join(sorted(scene.method.plane))}"'
            )
        if not scene.method.twist and at_largest(effect).wall(scene.rod) is not None:
            raise ValueError(
                f"torsion_free() needs walls that stand still, but {name} depends on "
                "time or remembers; another method has no such needs"
            )


def _check_drag(scene: Scene) -> None:
    """Raises where several effects have drag, or its growth with speed has no bound."""
    now = scene.at(0.0)
    found = jax.eval_shape(lambda: drag_on(now, trial_motion(scene.rod)))
    limited = scene.method.explicit and not scene.method.solves_drag
    if limited and found is not None and found.grows_with_speed:
        raise ValueError(
            "drag that grows with the square of the speed has no stable step in "
            f"{scene.method!r}, which takes it for a load: use consistent(), planar(), "
            "torsion_free() or implicit()"
        )


def _leaves(effect: Effect, scene: Scene) -> bool:
    """Whether an effect puts nodes out of the plane of a scene or back into it."""
    assert isinstance(scene.method, Planar)
    out = PLANES[scene.method.plane][2]
    touched = []

    def look() -> None:
        motion = trial_motion(scene.rod)
        now = at_clock(effect, clock_at(0.0, scene.rod.rest_lengths.dtype))
        placed = now.constrain(scene.rod, motion).position[out]
        touched.append(placed is not motion.position[out])

    jax.eval_shape(look)
    return touched[0]


def _in_type(dtype: Any, name: str, tree: Any) -> Any:
    """Effects or a method with their real numbers in the rod's type."""

    def cast(path: Any, leaf: Any) -> Array:
        array = jnp.asarray(leaf)
        if not jnp.issubdtype(array.dtype, jnp.floating):
            return array
        if not is_traced(array) and array.dtype != dtype:
            where = f"{name}{jax.tree_util.keystr(path)}"
            check_held(where, np.asarray(array, np.float64), "", dtype)
        return array.astype(dtype)

    return jax.tree_util.tree_map_with_path(cast, tree)
