"""PyElastica does what reference.py says it does."""

import elastica
import numpy as np
import pytest

from pyelastica import reference, scenes
from pyelastica.reference import Loads, simulate


def cross(a, b):
    return np.cross(a, b, axis=0)


def apply(matrices, vectors):
    return np.einsum("ijk,jk->ik", matrices, vectors)


class OneStep:
    """The ten steps at the top of reference.py, in NumPy."""

    def __init__(self, scene):
        self.scene = scene
        spec = scene.spec
        self.rest = np.linalg.norm(np.diff(spec.positions, axis=1), axis=0)
        area = np.pi * spec.radii**2
        second = area**2 / (4 * np.pi)
        density = np.broadcast_to(spec.density, area.shape)
        element_mass = density * area * self.rest
        self.mass = np.pad(element_mass, (0, 1)) / 2 + np.pad(element_mass, (1, 0)) / 2
        self.inertia = density * self.rest * np.stack([second, second, 2 * second])
        E, G = spec.youngs_modulus, spec.shear_modulus
        shear = 27 / 28 * G * area
        self.stretch = np.stack([shear, shear, E * area])
        bend = np.stack([E * second, E * second, 2 * G * second]) * self.rest
        self.joint = (self.rest[1:] + self.rest[:-1]) / 2
        self.bend = (bend[:, 1:] + bend[:, :-1]) / (2 * self.joint)
        self.rest_curvature = self.curvature(spec.directors)
        blend = (self.mass[1:] + self.mass[:-1]) / 2
        blend[0] += self.mass[0] / 2
        blend[-1] += self.mass[-1] / 2
        g, h = scene.deprecated_damping, scene.dt
        self.slow = np.exp(-(g + scene.damping_rate) * h)
        self.slow_spin = np.exp(-g * h * blend / self.inertia)
        self.slow_spin_uniform = np.exp(-scene.damping_rate * h)

    def curvature(self, Q):
        turn = np.einsum("ijk,ljk->ilk", Q[..., 1:], Q[..., :-1])
        angle = np.arccos(np.clip(np.einsum("iik->k", turn) / 2 - 0.5, -1, 1)) + 1e-14
        skew = np.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0],
                         turn[1, 0] - turn[0, 1]])  # fmt: skip
        return -angle / (2 * np.sin(angle)) * skew / self.joint

    def drift(self, x, Q, v, w):
        h = self.scene.dt / 2
        turns = [scenes.rotation(h * w[:, k]) for k in range(w.shape[1])]
        Q = np.stack([turn @ Q[..., k] for k, turn in enumerate(turns)], axis=-1)
        x = x + h * v
        if self.scene.clamped:
            x[:, 0] = self.scene.spec.positions[:, 0]
            Q[..., 0] = self.scene.spec.directors[..., 0]
        return x, Q

    def __call__(self, x, Q, v, w):
        x, Q = self.drift(x, Q, v, w)
        n = Q.shape[-1]
        edge = np.diff(x, axis=1)
        length = np.linalg.norm(edge, axis=0) + 1e-14
        tangent = apply(Q, edge / length)
        e = length / self.rest
        eps = (length[1:] + length[:-1]) / 2 / self.joint
        strain = e * tangent - np.array([[0.0], [0.0], [1.0]])
        stress = self.stretch * strain
        lab = np.einsum("jik,jk->ik", Q, stress) / e
        kappa = self.curvature(Q)
        couple = self.bend * (kappa - self.rest_curvature)
        bend = couple / eps**3
        arch = cross(kappa, couple) * self.joint / eps**3
        rate = np.sum(edge * np.diff(v, axis=1), axis=0) / (length * self.rest)
        spin = self.inertia * w / e

        def difference(a):
            return np.pad(a, ((0, 0), (0, 1))) - np.pad(a, ((0, 0), (1, 0)))

        def average(a):
            return (np.pad(a, ((0, 0), (0, 1))) + np.pad(a, ((0, 0), (1, 0)))) / 2

        force = difference(lab)
        torque = (
            difference(bend)
            + average(arch)
            + cross(tangent, stress) * self.rest
            + cross(spin, w)
            + spin * rate / e
        )
        loads = self.scene.loads
        force = force + np.outer(loads.gravity, self.mass)
        force[:, -1] += loads.end_force
        share = np.full(n + 1, 1 / n)
        share[[0, -1]] /= 2
        force += np.outer(loads.uniform_force, share)
        torque[:, -1] += Q[..., -1] @ loads.end_couple
        torque += loads.element_couples
        v = v + self.scene.dt * force / self.mass
        w = w + self.scene.dt * e * torque / self.inertia
        if self.scene.clamped:
            v[:, 0] = 0.0
            w[:, 0] = 0.0
        v = v * self.slow
        w = w * self.slow_spin**e * self.slow_spin_uniform
        x, Q = self.drift(x, Q, v, w)
        return x, Q, v, w


@pytest.mark.fast_sets(1)
@pytest.mark.parametrize("seed", range(8))
def test_one_step_is_what_the_documentation_says(seed):
    scene = scenes.random_scene(seed)
    steps = 50
    motion = simulate(**vars(scene), steps=steps)
    step = OneStep(scene)
    v, w = scene.velocities.copy(), scene.angular_velocities.copy()
    if scene.clamped:
        v[:, 0] = 0.0
        w[:, 0] = 0.0
    state = (scene.spec.positions, scene.spec.directors, v, w)
    for _ in range(steps):
        state = step(*state)
    got = (motion.positions, motion.directors, motion.velocities)
    for mine, theirs in zip(state, got, strict=False):
        np.testing.assert_allclose(mine, theirs[-1], rtol=0, atol=1e-11)
    np.testing.assert_allclose(
        state[3], motion.angular_velocities[-1], rtol=0, atol=1e-9
    )


def test_random_scenes_cover_both_ends_and_both_dampers():
    drawn = [scenes.random_scene(seed) for seed in range(8)]
    assert {scene.clamped for scene in drawn} == {True, False}
    assert {scene.damping_rate > 0 for scene in drawn} == {True, False}
    assert len({scene.spec.n_elements for scene in drawn}) >= 5
    for scene in drawn:
        length = np.linalg.norm(np.diff(scene.spec.positions, axis=1), axis=0).sum()
        assert length == pytest.approx(1.0)
        assert 2 <= scene.spec.n_elements <= 60


def test_a_curved_rod_is_stress_free_only_when_its_strains_are_passed():
    spec = scenes.random_scene(0, n_elements=6).spec
    still = simulate(spec, dt=1e-5, steps=20)
    np.testing.assert_allclose(still.positions[-1], spec.positions, atol=1e-14)
    default = reference.RodSpec(**{**vars(spec), "rest_curvatures": np.zeros((3, 5))})
    moving = simulate(default, dt=1e-5, steps=20)
    assert np.max(np.abs(moving.positions[-1] - spec.positions)) > 1e-10


def test_a_constant_end_force_acts_in_full_from_the_first_step():
    spec = scenes.random_scene(1, n_elements=4).spec
    motion = simulate(
        spec, dt=1e-6, steps=1, loads=Loads(end_force=np.array([1.0, 0, 0]))
    )
    mass = reference.reference_rod(spec).mass[-1]
    assert motion.velocities[0, 0, -1] == pytest.approx(1e-6 / mass, rel=1e-9)


def test_finalising_damps_initial_velocities_once():
    """Why `simulate` sets velocities after `finalize` and not before."""
    rod = reference.reference_rod(scenes.random_scene(2, n_elements=3).spec)
    rod.velocity_collection[...] = 1.0
    simulator = reference.Simulator()
    simulator.append(rod)
    simulator.dampen(rod).using(
        elastica.AnalyticalLinearDamper, uniform_damping_constant=1.0, time_step=0.5
    )
    simulator.finalize()
    np.testing.assert_allclose(rod.velocity_collection, np.exp(-0.5))
