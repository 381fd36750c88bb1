"""Bodies of the tasks are those that the documentation describes."""

from pathlib import Path

import numpy as np
import pytest

from jaxrod.envs.arm import soft_arm
from jaxrod.envs.soft_bodies import (
    gripper_body,
    held_cable,
    held_rope,
    octopus_body,
    snake_body,
)

PAGE = Path(__file__).parents[2] / "docs" / "tasks.md"
BODIES = {
    "snake": (snake_body, snake_body.RADIUS, snake_body.RADIUS),
    "octopus's arm": (octopus_body, *octopus_body.RADII),
    "gripper's finger": (gripper_body, gripper_body.RADIUS, gripper_body.RADIUS),
    "cable": (held_cable, held_cable.RADIUS, held_cable.RADIUS),
    "rope": (held_rope, held_rope.RADIUS, held_rope.RADIUS),
    "arm of `following`": (soft_arm, soft_arm.RADIUS, soft_arm.RADIUS),
}
"""Modules and the radii at base and tip [m], by the name on the page."""


@pytest.mark.parametrize("name", BODIES)
def test_a_body_is_the_one_on_the_page(name):
    (line,) = (
        row for row in PAGE.read_text().splitlines() if row.startswith(f"| {name} | ")
    )
    cells = line.strip("| ").split(" | ")[1:]
    written = [float(n.replace(",", "")) for c in cells for n in c.split(", ")]
    body, base, tip = BODIES[name]
    real = body.LENGTH, 1e3 * base, 1e3 * tip, body.DENSITY, 1e-3 * body.YOUNGS_MODULUS
    np.testing.assert_allclose(written, real, rtol=1e-12)
