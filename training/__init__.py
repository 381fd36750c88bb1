"""Training of policies: learning algorithms, runs, evaluation and export."""

if __name__ != "jaxrod.training":
    raise ImportError(
        "import jaxrod.training, not training: the folder is installed as it"
    )

from functools import partial
from typing import TYPE_CHECKING

import jaxrod.spelling

try:
    from jaxrod.training.algorithm import (
        DEVICE_AXIS,
        Algorithm,
        Metrics,
        algorithm_names,
        find_algorithm,
        mean_over_devices,
        steps_per_update,
    )
    from jaxrod.training.algorithms.dagger import DAGGER, DAggerConfig
    from jaxrod.training.algorithms.off_policy import OffPolicyConfig
    from jaxrod.training.algorithms.on_policy import OnPolicyConfig, warm_start
    from jaxrod.training.algorithms.ppo import PPO, PPOConfig
    from jaxrod.training.algorithms.sac import SAC, SACConfig
    from jaxrod.training.algorithms.shac import SHAC, SHACConfig
    from jaxrod.training.algorithms.td3 import DDPG, TD3, DDPGConfig, TD3Config
    from jaxrod.training.algorithms.trpo import TRPO, TRPOConfig
    from jaxrod.training.evaluation import Evaluation, evaluate
    from jaxrod.training.exporting.exports import export_c, export_onnx
    from jaxrod.training.networks import NetworkPolicy, RecurrentPolicy
    from jaxrod.training.policy import (
        MLPPolicy,
        NoisyPolicy,
        Policy,
        load_policy,
        save_policy,
        with_noise,
    )
    from jaxrod.training.runs.folder import RunFolder
    from jaxrod.training.runs.loop import train, train_seeds
    from jaxrod.training.runs.resuming import restore_policy, untrained_policy
    from jaxrod.training.runs.run import Result
    from jaxrod.training.settings import LearnerConfig
except ModuleNotFoundError as missing:
    package = (missing.name or "").partition(".")[0]
    if package not in ("flax", "optax", "orbax"):
        raise
    raise ModuleNotFoundError(
        f'jaxrod.training needs {package}; install it with: pip install "jaxrod[rl]"',
        name=missing.name,
    ) from missing

__all__ = [
    "DAGGER",
    "DDPG",
    "DEVICE_AXIS",
    "PPO",
    "SAC",
    "SHAC",
    "TD3",
    "TRPO",
    "Algorithm",
    "DAggerConfig",
    "DDPGConfig",
    "Evaluation",
    "LearnerConfig",
    "MLPPolicy",
    "Metrics",
    "NetworkPolicy",
    "NoisyPolicy",
    "OffPolicyConfig",
    "OnPolicyConfig",
    "PPOConfig",
    "Policy",
    "RecurrentPolicy",
    "Result",
    "RunFolder",
    "SACConfig",
    "SHACConfig",
    "TD3Config",
    "TRPOConfig",
    "algorithm_names",
    "evaluate",
    "export_c",
    "export_onnx",
    "find_algorithm",
    "load_policy",
    "mean_over_devices",
    "restore_policy",
    "save_policy",
    "steps_per_update",
    "train",
    "train_seeds",
    "untrained_policy",
    "warm_start",
    "with_noise",
]

if not TYPE_CHECKING:
    __getattr__ = partial(jaxrod.spelling.no_such_name, __name__)
