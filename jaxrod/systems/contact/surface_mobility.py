r"""Mobility of the surface of rigid bodies, to bound the step that contact allows.

The balls of a shape (`jaxrod.systems.contact.sphere_cloud`) have the shape in their
convex hull. The mobility grows outwards, so its maximum is at a ball. Without friction
forces are normal to the surface. On a round body they pass through the centre of a
ball, which then is the end of the lever arm.

Other shapes are within `Body.bounding_radius`. If that is not known, the body is
assumed to be convex and of uniform density. Then it extends from its centre of mass by
at most $\sqrt{15\,s/m}$ in the direction of each principal axis, with the second
moment of mass $s$ along it (R. Kannan, L. Lovász and M. Simonovits, Discrete Comput.
Geom. 13 (1995) 541). Of a cone, this is the height of its tip.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxrod.geometry import vectors
from jaxrod.systems.contact.sphere_cloud import SphereCloud, spheres_of
from jaxrod.systems.members.parts import Parts, turning_mobility


def surface_mobility(
    bodies: Parts, *, rubs: bool, points: Array | None = None
) -> Float[Array, " k"]:
    """Largest velocity per impulse of a point on the surface of each body [1/kg].

    Args:
        bodies: Constants of the bodies, which have a shape.
        rubs: Whether forces have any direction; else they are normal to the surface.
        points: Contact points on the surface `(3, points)`, if there are any [m].
    """
    assert bodies.shape is not None
    turning = _turning(bodies, rubs)
    if points is not None:
        turning = jnp.maximum(turning, _of_balls(bodies, points, 0 * points[0]))
    return 1 / bodies.node_masses + turning


def _turning(bodies: Parts, rubs: bool) -> Array:
    assert bodies.shape is not None
    # Only the ends of a row of balls count, and only the corners of a box.
    cloud = spheres_of(bodies.shape, 2, 2)
    if cloud is not None:
        return _of_cloud(bodies, cloud, rubs)
    radius, least = bodies.shape.bounding_radius, jnp.min(bodies.inertias, axis=0)
    if radius is not None:
        return radius * radius / least
    spread = 0.5 * jnp.sum(bodies.inertias, axis=0)[None] - bodies.inertias
    spread = 15 * jnp.maximum(spread, 0) / bodies.node_masses[None]
    corner = vectors.split(jnp.sqrt(jnp.maximum(spread, jnp.finfo(spread.dtype).tiny)))
    return jnp.minimum(
        turning_mobility(bodies.inertias, corner), jnp.max(spread, axis=0) / least
    )


def _of_cloud(bodies: Parts, cloud: SphereCloud, rubs: bool) -> Array:
    normal = cloud.is_round and not rubs
    radii = jnp.zeros_like(cloud.radii) if normal else cloud.radii
    if cloud.rim_radii is None:
        return _of_balls(bodies, cloud.offsets, radii)
    # A rim is in a ball around its centre, and a ring of points at equal distance.
    rims = cloud.rim_radii
    arms = jnp.max(jnp.sum(cloud.offsets**2, axis=0) + rims * rims)
    return jnp.minimum(
        _of_balls(bodies, cloud.offsets, radii + rims),
        arms / jnp.min(bodies.inertias, axis=0),
    )


def _of_balls(bodies: Parts, centres: Array, radii: Array) -> Array:
    """Largest mobility by turning among balls, for each body [1/kg]."""
    x, y, z = (c[:, None] for c in centres)
    each = turning_mobility(bodies.inertias[:, None, :], (x, y, z), radii[:, None])
    return jnp.max(each, axis=0)
