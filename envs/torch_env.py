"""A batch of environments that takes and gives tensors of PyTorch.

`TorchBatch` is the batch. `RslRlVecEnv` and `SkrlEnv` show it to RSL-RL and to skrl
under the names that these libraries use. Tensors and JAX arrays share memory by DLPack.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

try:
    import torch
except ModuleNotFoundError as missing:
    if missing.name != "torch":
        raise
    raise ModuleNotFoundError(
        "jaxrod.envs.torch_env needs PyTorch; install it with: pip install torch",
        name="torch",
    ) from missing

from jaxrod.envs.gymnasium_batch import Batch
from jaxrod.envs.protocol import Environment

__all__ = ["RslRlVecEnv", "SkrlEnv", "TorchBatch"]


class TorchBatch:
    """`jaxrod.envs.VectorEnvironment` with tensors of PyTorch in and out.

    All results of a step are views of one tensor for each dtype, which shares memory
    with the arrays that JAX computed. Nobody else has them: a caller may keep them and
    write into them. Actions are shared too if JAX can use them as they are: contiguous,
    of the dtype of the observations, on the device of the batch and, on CPUs, at a
    multiple of 64 bytes, as PyTorch allocates. Others are copied.

    Attributes:
        env: The environment.
        num_envs: Number of environments.
        device: Device of all tensors.
        observation: Current observations, shape (num_envs, observation_size).
        observation_space: Space of the observation of one environment.
        action_space: Space of the action of one environment.

    Example:
        >>> import torch
        >>> from jaxrod.envs.torch_env import TorchBatch
        >>> batch = TorchBatch("trivial", num_envs=3)
        >>> step = batch.step(torch.zeros(3, 1))
        >>> tuple(step.observation.shape), step.truncated.tolist()
        ((3, 1), [False, False, False])
    """

    def __init__(
        self,
        task: str | Environment,
        num_envs: int,
        *,
        seed: int = 0,
        params: Any = None,
        **options: Any,
    ) -> None:
        """Makes the batch and starts all episodes.

        Args:
            task: A task for `jaxrod.envs.make`, or an environment.
            num_envs: Number of environments, at least 1.
            seed: Seed; equal seeds give equal episodes.
            params: Parameters shared by the batch; None for the environment's defaults.
            **options: Passed to `jaxrod.envs.make`, for example `variant="clean"`.

        Raises:
            ValueError: An argument does not fit.
        """
        self._batch = Batch(task, num_envs, None, params, options)
        self.env = self._batch.env
        self.num_envs = num_envs
        self.observation_space = self._batch.observation_space
        self.action_space = self._batch.action_space
        self.device = self.reset(seed).device

    def reset(self, seed: int) -> torch.Tensor:
        """Starts all episodes.

        Args:
            seed: Seed; equal seeds give equal episodes.

        Returns:
            First observations, shape (num_envs, observation_size).
        """
        self._batch.reset(seed)
        self.observation = _tensor(self._batch.started().observation)
        return self.observation

    def step(self, actions: torch.Tensor) -> Any:
        """Advances all environments by one control step.

        Args:
            actions: In [-1, 1], shape (num_envs, action_size).

        Returns:
            The results, a `jaxrod.envs.VectorStep` whose leaves are tensors.

        Raises:
            ValueError: The actions have another shape.
        """
        given = actions.detach().to(self.observation).contiguous()
        step: Any = self._batch.advance(jax.dlpack.from_dlpack(given), _tensor)
        self.observation = step.observation
        return step

    @property
    def elapsed(self) -> torch.Tensor:
        """Control steps of every running episode, a copy; may be set, to end it early.

        An episode ends when its number reaches `env.episode_length`.
        """
        return torch.from_numpy(np.array(self._batch.started().elapsed)).to(self.device)

    @elapsed.setter
    def elapsed(self, elapsed: torch.Tensor) -> None:
        """Sets the clocks of all running episodes, shape (num_envs,)."""
        self._batch.set_elapsed(elapsed.cpu().numpy())


class RslRlVecEnv:
    """A batch with the interface of RSL-RL's `VecEnv`, for its runners.

    Actions are clipped to [-1, 1], because RSL-RL draws them from a Gaussian. Ends by
    the time limit or by a health flag are in `extras["time_outs"]`, and
    `extras["log"]` has the means of the environment's scalars.

    Attributes:
        batch: The batch.
        cfg: Task and size, which RSL-RL writes to its logs.

    Example:
        >>> from jaxrod.envs.torch_env import RslRlVecEnv, TorchBatch
        >>> env = RslRlVecEnv(TorchBatch("trivial", num_envs=3))
        >>> env.num_envs, env.num_actions, env.max_episode_length
        (3, 1, 20)
    """

    def __init__(self, batch: TorchBatch) -> None:
        """Shows a batch to RSL-RL, whose next step is the first."""
        self.batch = batch
        self.num_envs = batch.num_envs
        self.num_actions = batch.env.action_size
        self.max_episode_length = batch.env.episode_length
        self.device = batch.device
        self.cfg = {"task": batch.env.name, "num_envs": batch.num_envs}

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Control steps of every running episode; RSL-RL sets them to random ones."""
        return self.batch.elapsed

    @episode_length_buf.setter
    def episode_length_buf(self, elapsed: torch.Tensor) -> None:
        """Sets the clocks of all running episodes, shape (num_envs,)."""
        self.batch.elapsed = elapsed

    def get_observations(self) -> Any:
        """Current observations, a `TensorDict` with one group, "policy"."""
        from tensordict import TensorDict

        return TensorDict(
            {"policy": self.batch.observation}, [self.num_envs], device=self.device
        )

    def step(
        self, actions: torch.Tensor
    ) -> tuple[Any, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advances all environments by one control step.

        Args:
            actions: Any numbers, shape (num_envs, num_actions).

        Returns:
            Observations, rewards, flags of ended episodes, and `extras`.
        """
        step = self.batch.step(actions.clamp(-1, 1))
        extras = {
            "time_outs": step.truncated & ~step.terminated,
            "log": {f"/{name}": v.float().mean() for name, v in step.info.items()},
        }
        done = step.terminated | step.truncated
        return self.get_observations(), step.reward, done, extras


class SkrlEnv:
    """A batch with the interface of skrl's wrappers of environments.

    skrl takes it as it is, without `wrap_env`. Actions are clipped to [-1, 1], because
    skrl draws them from a Gaussian.

    Attributes:
        batch: The batch.
        num_envs: Number of environments.
        num_agents: Always 1.
        device: Device of all tensors.
        observation_space: Space of the observation of one environment.
        action_space: Space of the action of one environment.
        state_space: Always None: skrl learns from the observation alone.

    Example:
        >>> import torch
        >>> from jaxrod.envs.torch_env import SkrlEnv, TorchBatch
        >>> env = SkrlEnv(TorchBatch("trivial", num_envs=3))
        >>> observations, _ = env.reset()
        >>> observations, rewards, *_ = env.step(torch.zeros(3, 1))
        >>> tuple(rewards.shape)
        (3, 1)
    """

    num_agents = 1
    state_space = None

    def __init__(self, batch: TorchBatch) -> None:
        """Shows a batch to skrl, whose next step is the first."""
        self.batch = batch
        self.num_envs = batch.num_envs
        self.device = batch.device
        self.observation_space = batch.observation_space
        self.action_space = batch.action_space

    def reset(self) -> tuple[torch.Tensor, dict[str, Any]]:
        """Returns the current observations and no information.

        Episodes restart by themselves, in the step in which they end.
        """
        return self.batch.observation, {}

    def step(
        self, actions: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advances all environments by one control step.

        Args:
            actions: Any numbers, shape (num_envs, action_size).

        Returns:
            Observations; rewards, terminations and truncations, (num_envs, 1); and the
            environment's scalars.
        """
        step = self.batch.step(actions.clamp(-1, 1))
        columns = (
            flag.view(-1, 1) for flag in (step.reward, step.terminated, step.truncated)
        )
        reward, terminated, truncated = columns
        return step.observation, reward, terminated, truncated, step.info

    def state(self) -> None:
        """Returns None: skrl learns from the observation alone."""

    def render(self) -> None:
        """Draws nothing."""

    def close(self) -> None:
        """Does nothing: no resource is open."""


def _tensor(array: jax.Array) -> torch.Tensor:
    """Tensor that shares the memory of an array, once it is computed."""
    return torch.from_dlpack(jax.block_until_ready(array))
