"""jaxrod: soft, slender rods as differentiable, batchable JAX functions.

A rod is a pytree, a step is a pure function, a thousand arms are `jax.vmap` of one.

    rod, state = jaxrod.straight_rod(20, length=1.0, radius=0.05, density=1000.0,
                                     youngs_modulus=1e7)
    scene = jaxrod.make_scene(rod, jaxrod.clamp(state), jaxrod.gravity())
    dt = jaxrod.stable_dt(scene).dt
    state = jaxrod.advance(scene, state, dt, 1000)

Environments are in `jaxrod.envs`, learners and optimisers in `jaxrod.training`,
drawing in `jaxrod.viz`; none of them is imported here.
"""

from jaxrod._jax_version import require_sound_jax
from jaxrod.actuation import (
    ControlSpline,
    ElementCouples,
    control_spline,
    limit_rate,
    spline_couples,
)
from jaxrod.backend import configure_cpu
from jaxrod.effects import (
    Clamp,
    Effect,
    EndLoad,
    ExponentialDamping,
    FixedEnd,
    Gravity,
    UniformLoad,
    clamp,
    end_load,
    exponential_damping,
    fixed_end,
    gravity,
    uniform_load,
)
from jaxrod.elasticity import stored_energy, strains
from jaxrod.factories import rod_along, straight_rod, unstressed
from jaxrod.health import Health, health
from jaxrod.motion import Loads, Motion
from jaxrod.rod import Rod, RodState, angular_velocities, with_angular_velocities
from jaxrod.scene import (
    Scene,
    angular_momentum,
    kinetic_energy,
    make_scene,
    momentum,
    potential_energy,
    total_energy,
)
from jaxrod.stability import StableStep, stable_dt
from jaxrod.stepping import (
    UnstableStepWarning,
    advance,
    rollout,
    rollout_times,
    step,
)

require_sound_jax()

__version__ = "0.1.0"

__all__ = [
    "Clamp",
    "ControlSpline",
    "Effect",
    "ElementCouples",
    "EndLoad",
    "ExponentialDamping",
    "FixedEnd",
    "Gravity",
    "Health",
    "Loads",
    "Motion",
    "Rod",
    "RodState",
    "Scene",
    "StableStep",
    "UniformLoad",
    "UnstableStepWarning",
    "advance",
    "angular_momentum",
    "angular_velocities",
    "clamp",
    "configure_cpu",
    "control_spline",
    "end_load",
    "exponential_damping",
    "fixed_end",
    "gravity",
    "health",
    "kinetic_energy",
    "limit_rate",
    "make_scene",
    "momentum",
    "potential_energy",
    "rod_along",
    "rollout",
    "rollout_times",
    "spline_couples",
    "stable_dt",
    "step",
    "stored_energy",
    "straight_rod",
    "strains",
    "total_energy",
    "uniform_load",
    "unstressed",
    "with_angular_velocities",
]
