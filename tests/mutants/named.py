"""Faults planted by name: wrong numbers that tests once let pass, or nearly."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Named:
    """One fault: a text that stands once in a file, and what is put there."""

    name: str
    about: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]
    """Files to try first."""


NAMED = (
    Named(
        "m01",
        "glue: turning dashpot without its length",
        "jaxrod/systems/joints/glue.py",
        "damping=self.turning_damping * lengths",
        "damping=self.turning_damping",
        ("tests/systems/test_glue.py",),
    ),
    Named(
        "m02",
        "hinge: motor twice as strong",
        "jaxrod/systems/joints/hinges.py",
        "vectors.scale(0.5 * self.motor",
        "vectors.scale(1.0 * self.motor",
        ("tests/systems/test_hinges.py",),
    ),
    Named(
        "m03",
        "elastic joint: dashpot's couple on the second in the first's frame",
        "jaxrod/systems/joints/elastic_joints.py",
        "on_b = to_material(frame_b, pull)",
        "on_b = to_material(frame_a, pull)",
        ("tests/systems/test_connections.py", "tests/systems/test_welds.py"),
    ),
    Named(
        "m04",
        "off-policy: an episode cut short taken as ended by the task",
        "training/algorithms/off_policy.py",
        "terminated=outcome.terminated,",
        "terminated=outcome.terminated | outcome.truncated,",
        ("tests/training/test_sac.py", "tests/training/test_td3.py"),
    ),
    Named(
        "m05",
        "SHAC: the value after the task has ended counts",
        "training/algorithms/shac.py",
        "jnp.where(done, jnp.where(terminated, 0, value), later)",
        "jnp.where(done, value, later)",
        ("tests/training/test_shac.py",),
    ),
    Named(
        "m06",
        "muscle across: exponent of its speed",
        "jaxrod/actuation/muscles.py",
        "return along**-0.5 if self.across else along",
        "return along**-1.0 if self.across else along",
        ("tests/physics/test_force_velocity.py",),
    ),
    Named(
        "m07",
        "tendon: friction by the pieces from before an eyelet, not beyond",
        "jaxrod/actuation/tendons.py",
        "jnp.cumsum(rates[:, ::-1], axis=1)[:, ::-1][:, 1:]",
        "jnp.cumsum(rates[:, ::-1], axis=1)[:, ::-1][:, :-1]",
        ("tests/physics/test_actuation_closed_forms.py",),
    ),
    Named(
        "m08",
        "magnet: stability bound without the slope of the field",
        "jaxrod/actuation/magnets.py",
        "elements=moment * (size + slope * rod.rest_lengths)",
        "elements=moment * size",
        ("tests/physics/test_actuation_closed_forms.py",),
    ),
    Named(
        "m09",
        "pose spring: sign of the power of turning",
        "jaxrod/systems/joints/pose_springs.py",
        "power + vectors.dot(turn, spin)",
        "power - vectors.dot(turn, spin)",
        ("tests/systems/test_pose_springs.py",),
    ),
    Named(
        "m10",
        "cross-entropy method: one elite too many",
        "jaxrod/control/trajectories/sampling.py",
        "jnp.sort(costs)[elites - 1]",
        "jnp.sort(costs)[elites]",
        ("tests/control/test_sampling.py",),
    ),
    Named(
        "m11",
        "lanes: the last of equal extremes",
        "jaxrod/lanes/jaxpr/reductions.py",
        'better = "gt" if',
        'better = "ge" if',
        ("tests/lanes/test_primitives.py",),
    ),
    Named(
        "m12",
        "body with nodes: inertia not about the common centre",
        "jaxrod/systems/members/rigid_stepper.py",
        "carried.second, matrices.scale(mass, matrices.outer(centre, centre))",
        "carried.second, matrices.scale(0 * mass, matrices.outer(centre, centre))",
        ("tests/systems/test_connections.py",),
    ),
    Named(
        "m13",
        "replay: the newest is never drawn",
        "training/algorithms/replay.py",
        "key, (batches, per_env), 0, replay.size, jnp.int32",
        "key, (batches, per_env), 0, replay.size - 1, jnp.int32",
        ("tests/training/test_replay.py",),
    ),
    Named(
        "m14",
        "iLQR: held controls not moved on",
        "jaxrod/control/trajectories/ilqr.py",
        "moved = rest + by_control @ jnp.where(held, change, 0)",
        "moved = rest + 0 * by_control @ jnp.where(held, change, 0)",
        ("tests/control/test_ilqr.py",),
    ),
    Named(
        "m15",
        "driven end: reaction without the node's inertia",
        "jaxrod/effects/driven.py",
        "force + inertia if is_held else force",
        "force if is_held else force",
        ("tests/physics/test_driven.py",),
    ),
    Named(
        "m16",
        "normalisation: spread between means dropped",
        "training/normalisation.py",
        "+ weight * (1 - weight) * difference**2",
        "+ 0 * weight * (1 - weight) * difference**2",
        ("tests/training/test_normalisation.py",),
    ),
    Named(
        "m17",
        "wound chamber: twist at rest left out",
        "jaxrod/actuation/chambers.py",
        "twist = strains.rotations[2][None, :] - inverse",
        "twist = strains.rotations[2][None, :] - 0 * inverse",
        ("tests/physics/test_actuation_closed_forms.py",),
    ),
    Named(
        "m18",
        "contact of rods: lever of friction on the second",
        "jaxrod/systems/contact/penalty_contact.py",
        "other_turn = vectors.cross(rub, arms[1])",
        "other_turn = vectors.cross(rub, arms[0])",
        ("tests/systems/test_crossing_contact.py",),
    ),
    Named(
        "m19",
        "moving contact: speed of the surface without its turning",
        "jaxrod/contacts/moving.py",
        "vectors.subtract(velocity, vectors.cross(turning, arm))",
        "vectors.subtract(velocity, vectors.cross(turning, vectors.scale(0, arm)))",
        ("tests/physics/test_moving_contact.py",),
    ),
    Named(
        "m20",
        "moving contact: forces not turned back",
        "jaxrod/contacts/moving.py",
        "return Loads(to_world(self._axes, loads.forces), loads.couples)",
        "return Loads(loads.forces, loads.couples)",
        ("tests/physics/test_moving_contact.py",),
    ),
    Named(
        "m21",
        "moving contact: power without that of the moment",
        "jaxrod/contacts/moving.py",
        "power = power + vectors.dot(moment, turning)",
        "power = power + 0 * vectors.dot(moment, turning)",
        ("tests/physics/test_moving_contact.py",),
    ),
    Named(
        "m22",
        "moving contact: spin as in the world",
        "jaxrod/contacts/moving.py",
        "vectors.subtract(motion.spin, carried)",
        "vectors.subtract(motion.spin, vectors.scale(0, carried))",
        ("tests/physics/test_moving_contact.py",),
    ),
    Named(
        "m23",
        "moving contact: springs of static friction remember places of the world",
        "jaxrod/contacts/moving.py",
        "self.touching.after_step(rod, self.seen(rod, motion), dt)",
        "self.touching.after_step(rod, motion, dt)",
        ("tests/physics/test_moving_contact.py",),
    ),
    Named(
        "m24",
        "moving contact: the body turns about the origin",
        "jaxrod/contacts/moving.py",
        "(position, vectors.split(self.place.position))",
        "(position, vectors.split(self.place.position - self.about))",
        ("tests/physics/test_moving_contact.py",),
    ),
    Named(
        "m25",
        "moving contact: energy of the springs where the bodies were at first",
        "jaxrod/contacts/moving.py",
        "return self.touching.energy(rod, self._seen_state(state))",
        "return self.touching.energy(rod, state)",
        ("tests/physics/test_moving_contact.py",),
    ),
    Named(
        "m26",
        "insert: the socket that is touched stays where it was made",
        "envs/soft_bodies/held_cable.py",
        "return dataclasses.replace(self, scene=scene)",
        "return self",
        ("tests/envs/test_insert.py",),
    ),
    Named(
        "m27",
        "insert: a tip at any angle is in the socket",
        "envs/tasks/insert.py",
        "(seen.depth >= DEEP) & (seen.angle <= STRAIGHT)",
        "(seen.depth >= DEEP)",
        ("tests/envs/test_insert.py",),
    ),
    Named(
        "m28",
        "past actions: each is one control step too old",
        "envs/randomised.py",
        "jnp.concatenate([newest[None], past[:-1]])",
        "jnp.concatenate([past[:1], past[:-1]])",
        ("tests/envs/test_randomised.py",),
    ),
)
