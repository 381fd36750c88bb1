"""Learners: policies trained in compiled programs, between which the host looks on."""

if __name__ != "jaxrod.training":
    raise ImportError(
        "import jaxrod.training, not training: the folder is installed under it"
    )

from jaxrod.training.algorithm import (
    Algorithm,
    Metrics,
    algorithm_names,
    find_algorithm,
)
from jaxrod.training.evaluation import Evaluation, evaluate
from jaxrod.training.loop import train
from jaxrod.training.policy import Policy, load_policy, save_policy
from jaxrod.training.ppo import PPO, PPOConfig
from jaxrod.training.run import Result
from jaxrod.training.run_folder import RunFolder
from jaxrod.training.seeds import train_seeds

__all__ = [
    "PPO",
    "Algorithm",
    "Evaluation",
    "Metrics",
    "PPOConfig",
    "Policy",
    "Result",
    "RunFolder",
    "algorithm_names",
    "evaluate",
    "find_algorithm",
    "load_policy",
    "save_policy",
    "train",
    "train_seeds",
]
