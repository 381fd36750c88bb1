"""Composition of a scene from a rod, effects and a method, with checks."""

from __future__ import annotations

from jaxrod.effects.base import Effect
from jaxrod.effects.held import check_held_once
from jaxrod.effects.memory import memory_fields
from jaxrod.effects.own_classes import check_own_class, check_own_loads
from jaxrod.effects.time import at_clock, clock_at, depends_on_time
from jaxrod.effects.unlikely import warn_of_thickness
from jaxrod.methods.consistent import Consistent
from jaxrod.methods.drag_kick import check_drag
from jaxrod.rods.rod import Rod
from jaxrod.scene import Method, Scene
from jaxrod.validation import check_kind, in_type, knows_constants


@knows_constants
def make_scene(rod: Rod, *effects: Effect, method: Method | None = None) -> Scene:
    """Makes a scene: a rod, the effects on it, and a method.

    Floating-point numbers of effects and of the method are converted to the rod's
    dtype.

    Args:
        rod: The rod.
        *effects: Effects on it, in the order in which they are applied.
        method: Method that steps it; by default `consistent()`. Others are
            `planar("xy")`, `torsion_free()`, `implicit()`, `pyelastica()` and
            `planar("xy", pyelastica())`.

    Raises:
        ValueError: If the scene does not fit the method, two effects hold the same
            node along the same axis, or the same element, or the loads of an effect
            do not fit the rod.
        TypeError: If an effect is not an `Effect`, the rod is not a `Rod`, or the
            method is not a `Method`. Also if the class of an effect is not a pytree,
            defines no hook, or has a method whose name is nearly that of a hook.
    """
    check_kind("rod", rod, Rod)
    for effect in effects:
        if not isinstance(effect, Effect):
            raise TypeError(
                f"effects must be jaxrod effects, got {type(effect).__name__}"
            )
        check_own_class(effect, Effect, "an effect")
    dtype = rod.rest_lengths.dtype
    listed = in_type(dtype, "effects", effects)
    # Only now: a number that the dtype cannot hold must raise before any warning.
    warn_of_thickness(rod)
    held = []
    for effect in effects:
        now = at_clock(effect, clock_at(0.0, dtype))
        now.check(rod)
        held += [(type(effect).__name__, part) for part in now.held(rod)]
    check_held_once(held, rod.n_elements)
    if method is None:
        method = Consistent()
    if not isinstance(method, Method):
        raise TypeError(
            "method must be one such as jaxrod.consistent() or jaxrod.planar('xy'), "
            f"got {method!r}"
        )
    method = in_type(dtype, "method", method)
    scene = Scene(rod, listed, method)
    for effect in scene.at(0.0).effects:
        check_own_loads(effect, rod)
    _check_evolution(scene)
    check_drag(scene)
    method.check(scene.at(0.0))
    if scene.evolves:
        # Values that are zero now may leave the plane or act about the axis later.
        method.check(scene.stirred)
    return scene


def _check_evolution(scene: Scene) -> None:
    """Raises ValueError if an effect must not depend on time or have memory."""
    for effect in scene.evolving_effects:
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
    if scene.evolves:
        scene.method.check_evolving(scene)
