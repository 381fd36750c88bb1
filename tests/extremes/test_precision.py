"""Single precision beside double, and runs so long that any bias would show."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrod
from physics.rods import arm


def test_weak_damping_is_not_biased_in_single_precision(record):
    """Multiplied by what is left, rates would be 7e-5 off in the end."""
    rod, state = arm(2, dtype=jnp.float32)
    moving = jaxrod.RodState(**vars(state) | {"velocities": state.velocities + 1})
    scene = jaxrod.make_scene(rod, jaxrod.exponential_damping(1.7))
    after = jaxrod.advance(scene, moving, 1e-4, 10_000)
    across = after.velocities[:2]  # Along the rod there is noise of axial forces.
    record(
        "Decay in float32 by damping of 1.7e-4 per step over 1e4 steps, relative error",
        "exp(-g t)",
        np.max(np.abs(np.asarray(across, np.float64) / np.exp(-1.7) - 1)),
        at_most=1e-5,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "steps",
    [100_000, pytest.param(10_000_000, marks=pytest.mark.slow)],
)
def test_long_runs_do_not_drift(steps, dtype, record):
    """A free rod that shakes and turns about a centre at rest; both precisions."""
    rod, state = arm(3, dtype=dtype)
    state = jaxrod.RodState(
        **vars(state)
        | {
            "velocities": jnp.asarray([[0.5], [-0.3], [0.1]], dtype)
            * jnp.asarray([[2, -1, -1, 2]], dtype)
        }
    )
    state = jaxrod.with_angular_velocities(
        rod, state, jnp.asarray([[1.0], [2.0], [3.0]], dtype) * jnp.ones((3, 3), dtype)
    )
    if dtype == jnp.float32:
        state = jaxrod.compensated(state)
    scene = jaxrod.make_scene(rod)
    dt = jaxrod.stable_dt(scene, 0.3).dt

    @jax.jit
    def run(start):
        def block(s, _):
            s = jaxrod.advance(scene, s, dt, jnp.asarray(steps // 20))
            norm = jnp.sqrt(jnp.sum(s.orientations**2, axis=0))
            return s, (
                jnp.max(jnp.abs(norm - 1)),
                rod.momentum(s),
                rod.angular_momentum(s),
                scene.total_energy(s),
            )

        return jax.lax.scan(block, start, length=20)[1]

    norms, momenta, spins, energies = (np.asarray(a, np.float64) for a in run(state))
    single = dtype == jnp.float32
    name = f"{steps:.0e} steps, {dtype}"
    record(
        f"Length of quaternions after {name}",
        "1",
        norms.max(),
        at_most=3e-7 if single else 1e-12,
    )
    # Little is left of the whole: the rod bends to and fro about a centre at rest.
    arms = np.linalg.norm(state.positions, axis=0)
    speeds = np.linalg.norm(state.velocities, axis=0)
    whole = float(np.sum(np.asarray(rod.node_masses) * arms * speeds))
    drift = np.linalg.norm(spins - spins[0], axis=1).max() / whole
    record(
        f"Angular momentum, drift over {name}, relative to the sum of its absolute "
        "parts",
        "conservation",
        drift,
        at_most=1e-4 if single else 1e-12,
    )
    record(
        f"That drift over the unit round-off times sqrt(steps), {name}",
        "rounding of the loads, without bias: about 1 or less",
        drift / (0.5 * float(jnp.finfo(dtype).eps) * np.sqrt(steps)),
        at_most=2,
    )
    assert np.abs(momenta - momenta[0]).max() < (1e-2 if single else 1e-9)
    # No trend: the last quarter is like the first.
    first, last = energies[:5].mean(), energies[-5:].mean()
    assert abs(last / first - 1) < (0.05 if single else 1e-3)
