"""The published grid as data: how many control steps, and what differs from defaults.

`GRID[case][algorithm]` names the control steps of a run and the settings that differ
from the learner's defaults in that case; docs/algorithms.md says what they mean and
why the defaults are what they are. `CLEAN` has what is planned otherwise in variants
"clean". Settings are the same for all seeds.

In Cases 3 and 4 the paper's samples are scarce (0.5 to 1 million control steps,
episodes of 3571): few environments, so that episodes end often, and many gradient
steps for a control step, above all for the value of states. benchmarks/paper/tried.md
has what was tried. In the library's physics the same arms are several times as fast
and no published number of control steps has to be kept to: more environments, longer
runs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

Settings = Mapping[str, int | float | bool | tuple[int, ...]]


@dataclasses.dataclass(frozen=True)
class Planned:
    """A run as it is planned.

    Attributes:
        steps: control steps.
        settings: what differs from the learner's defaults, by name.
    """

    steps: int
    settings: Settings = dataclasses.field(default_factory=dict)


_PLENTIFUL_TRPO: Settings = {
    "num_envs": 64,
    "rollout_steps": 128,
    "value_minibatches": 32,
    "value_learning_rate": 5e-4,
    "max_kl": 0.02,
    "final_max_kl": 0.002,
    "discount": 0.98,
}
_SCARCE_OFF_POLICY: Settings = {
    "num_envs": 8,
    "rollout_steps": 32,
    "gradient_steps": 128,
    "batch_size": 128,
    "buffer_size": 500_000,
}
_CLEAN_OFF_POLICY: Settings = {
    "num_envs": 32,
    "action_repeat": 5,
    "gradient_steps": 128,
    "batch_size": 128,
    "noise_correlation": 0.8,
}
_QUICK_ON_POLICY: Settings = {"num_envs": 8, "rollout_steps": 32, "hidden_sizes": (16,)}
_QUICK_OFF_POLICY: Settings = {
    "num_envs": 8,
    "gradient_steps": 16,
    "buffer_size": 20_000,
    "learning_starts": 500.0,
    "hidden_sizes": (16,),
}

GRID: Mapping[str, Mapping[str, Planned]] = {
    "tracking": {
        "ppo": Planned(10_000_000),
        "trpo": Planned(10_000_000, _PLENTIFUL_TRPO),
        "sac": Planned(4_000_000),
        "td3": Planned(4_000_000),
        "ddpg": Planned(4_000_000),
    },
    "reaching": {
        "ppo": Planned(10_000_000),
        "trpo": Planned(10_000_000, _PLENTIFUL_TRPO),
        "sac": Planned(3_000_000),
        "td3": Planned(3_000_000),
        "ddpg": Planned(3_000_000),
    },
    "structured": {
        "ppo": Planned(
            440_000,
            {
                "num_envs": 8,
                "action_repeat": 3,
                "rollout_steps": 170,
                "minibatches": 10,
                "final_learning_rate": 1e-4,
                "discount": 0.985,
                "trace_decay": 0.96,
            },
        ),
        "trpo": Planned(
            440_000,
            {
                "num_envs": 8,
                "action_repeat": 3,
                "rollout_steps": 170,
                "fisher_stride": 1,
                "value_epochs": 12,
                "value_minibatches": 10,
                "value_learning_rate": 5e-4,
                "initial_log_std": -0.4,
                "max_kl": 0.02,
                "final_max_kl": 0.002,
                "discount": 0.985,
                "trace_decay": 0.96,
                "short_steps": 370_000.0,
            },
        ),
        "sac": Planned(500_000, {**_SCARCE_OFF_POLICY, "noise_correlation": 0.95}),
        "td3": Planned(500_000, _SCARCE_OFF_POLICY),
        "ddpg": Planned(
            500_000,
            {
                **_SCARCE_OFF_POLICY,
                "noise_correlation": 0.95,
                "exploration_noise": 0.3,
            },
        ),
    },
    "unstructured": {
        "ppo": Planned(
            1_000_000,
            {
                "num_envs": 8,
                "rollout_steps": 512,
                "minibatches": 16,
                "discount": 0.995,
                "trace_decay": 0.98,
                "learning_rate": 3e-4,
                "final_learning_rate": 1e-4,
            },
        ),
        "trpo": Planned(
            1_000_000,
            {
                "num_envs": 8,
                "rollout_steps": 1024,
                "value_epochs": 16,
                "value_minibatches": 64,
                "value_learning_rate": 3e-4,
                "discount": 0.995,
            },
        ),
        "sac": Planned(500_000, {**_SCARCE_OFF_POLICY, "entropy_per_action": 0.0}),
        "td3": Planned(500_000, {**_SCARCE_OFF_POLICY, "exploration_noise": 0.5}),
        "ddpg": Planned(500_000, {**_SCARCE_OFF_POLICY, "exploration_noise": 0.5}),
    },
    # Not of the paper: to try things out.
    "trivial": {
        "ppo": Planned(40_000, _QUICK_ON_POLICY),
        "trpo": Planned(40_000, _QUICK_ON_POLICY),
        "sac": Planned(10_000, _QUICK_OFF_POLICY),
        "td3": Planned(10_000, _QUICK_OFF_POLICY),
        "ddpg": Planned(10_000, _QUICK_OFF_POLICY),
    },
}

_CLEAN_TD3: Settings = {
    **_CLEAN_OFF_POLICY,
    "exploration_noise": 0.3,
    "policy_learning_rate": 3e-4,
    "critic_learning_rate": 3e-4,
}
_CLEAN_PPO: Settings = {
    "action_repeat": 3,
    "rollout_steps": 64,
    "discount": 0.985,
    "trace_decay": 0.96,
}
CLEAN: Mapping[str, Mapping[str, Planned]] = {
    "structured": {
        "ppo": Planned(4_000_000, _CLEAN_PPO),
        "sac": Planned(2_000_000, {**_CLEAN_OFF_POLICY, "discount": 0.98}),
        "td3": Planned(2_000_000, {**_CLEAN_TD3, "discount": 0.98}),
    },
    "unstructured": {
        "ppo": Planned(4_000_000, _CLEAN_PPO),
        "sac": Planned(2_000_000, {**_CLEAN_OFF_POLICY, "entropy_per_action": 0.0}),
        "td3": Planned(6_000_000, {**_CLEAN_TD3, "exploration_decay": 0.9}),
    },
}


def planned(case: str, algorithm: str, variant: str | None = None) -> Planned:
    """Settings of a cell of the grid.

    Args:
        case: name of the task.
        algorithm: name of the learner.
        variant: of the task; None where it has none.

    Raises:
        KeyError: the grid has no such cell.
    """
    of_the_paper = GRID[case][algorithm]
    if variant != "clean":
        return of_the_paper
    return CLEAN.get(case, {}).get(algorithm, of_the_paper)
