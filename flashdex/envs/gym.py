"""Stock Gymnasium environments as worlds of float32 tensors."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from flashdex.envs.config import GymConfig
from flashdex.errors import FlashdexError, MissingExtraError


@dataclass(frozen=True)
class GymStep:
    """What one vector step yields, before any reset.

    Attributes:
        observation: after the step, the last one of an episode included, (N, D).
        reward: (N, 1).
        terminated: the environment ended the episode, (N, 1) bool.
        truncated: the step limit did, and nothing else, (N, 1) bool; set also where
            the observation is not finite, from which nothing could go on.
    """

    observation: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor

    @property
    def done(self) -> Tensor:
        """Either end of an episode, (N, 1) bool."""
        return self.terminated | self.truncated


class GymWorlds:
    """N copies of one environment, stepped in this process.

    Nothing is reset on its own, so that the observation of a step is the true one also
    where an episode ends.

    Args:
        config: names the environment.
        num_envs: worlds N.
        seed: of their starts; world i takes ``seed + i``.

    Raises:
        FlashdexError: the environment does not exist, cannot be made, has other than
            flat observations and bounded continuous actions, or no step limit.
        MissingExtraError: gymnasium is not installed.
    """

    def __init__(self, config: GymConfig, *, num_envs: int, seed: int) -> None:
        self.num_envs, self.seed = num_envs, seed
        self._env = _make_vector_env(config, num_envs)
        self._check_spaces(config)
        self._check_limit(config)
        self.observation_dim: int = self._env.single_observation_space.shape[0]
        self.action_dim: int = self._env.single_action_space.shape[0]

    def _check_spaces(self, config: GymConfig) -> None:
        seen, acted = self._env.single_observation_space, self._env.single_action_space
        shape = getattr(seen, "shape", None)
        if shape is None or len(shape) != 1 or seen.dtype.kind != "f":
            raise FlashdexError(
                f"gym.env_id: {config.env_id} observes {seen}; only flat vectors of "
                "numbers are supported."
            )
        if not _is_continuous(acted):
            raise FlashdexError(
                f"gym.env_id: {config.env_id} acts by {acted}; only continuous actions "
                "(a flat Box) are supported."
            )

    def _check_limit(self, config: GymConfig) -> None:
        own = self._env.spec.max_episode_steps
        if config.max_episode_steps is None and own is None:
            raise FlashdexError(
                f"gym.max_episode_steps: {config.env_id} has no step limit of its own, "
                "so that an episode, and with it an evaluation, might never end. Set "
                "gym.max_episode_steps=1000, say."
            )

    def reset(self) -> Tensor:
        """Start every world from its seed; observations, (N, D)."""
        observation, _ = self._env.reset(seed=self.seed)
        return _tensor(observation)

    @torch.no_grad()
    def step(self, action: Tensor) -> GymStep:
        """Step every world.

        Args:
            action: (N, A) in [-1, 1].
        """
        observation, reward, terminated, truncated, _ = self._env.step(action.numpy())
        ended, seen = _column(terminated), _tensor(observation)
        lost = ~seen.isfinite().all(-1, keepdim=True)
        return GymStep(
            observation=seen,
            reward=_tensor(reward).unsqueeze(-1),
            terminated=ended,
            # An environment may fail in the very step that reaches the limit.
            truncated=(_column(truncated) | lost) & ~ended,
        )

    def reset_done(self, done: Tensor) -> Tensor:
        """Restart the worlds whose episode ended.

        Args:
            done: (N, 1) bool, at least one of them true.

        Returns:
            Observations of all worlds, (N, D).
        """
        mask = done.squeeze(-1).numpy()
        observation, _ = self._env.reset(options={"reset_mask": mask})
        return _tensor(observation)

    def close(self) -> None:
        """Free the worlds."""
        self._env.close()


def _make_vector_env(config: GymConfig, num_envs: int) -> Any:
    """The vector environment that resets nothing on its own."""
    try:
        import gymnasium
        from gymnasium.vector import AutoresetMode
    except ImportError as error:
        raise MissingExtraError("gymnasium", extra="gym") from error
    limit = config.max_episode_steps
    with _quiet():
        try:
            return gymnasium.make_vec(
                config.env_id,
                num_envs=num_envs,
                vectorization_mode="sync",
                vector_kwargs={"autoreset_mode": AutoresetMode.DISABLED},
                wrappers=[_rescale] if config.rescale_actions else [],
                **({} if limit is None else {"max_episode_steps": limit}),
            )
        except gymnasium.error.Error as error:
            raise FlashdexError(
                f"gym.env_id: '{config.env_id}' cannot be made: {error} List what "
                'there is: python -c "import gymnasium; gymnasium.pprint_registry()"'
            ) from error
        except ImportError as error:
            raise FlashdexError(
                f"gym.env_id: '{config.env_id}' needs a package that is missing: "
                f"{error}"
            ) from error


def _rescale(env: Any) -> Any:
    """Wrap an environment so that [-1, 1] spans its action bounds."""
    from gymnasium.wrappers import RescaleAction

    space = env.action_space
    if not _is_continuous(space):
        return env  # refused with its own message
    if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        raise FlashdexError(
            f"gym.rescale_actions: the actions {space} have no bounds that [-1, 1] "
            "could be mapped onto. Set gym.rescale_actions=false."
        )
    one = np.ones(1, dtype=space.dtype)[0]
    return RescaleAction(env, -one, one)


def _is_continuous(space: Any) -> bool:
    shape = getattr(space, "shape", None)
    return shape is not None and len(shape) == 1 and space.dtype.kind == "f"


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep notes on old versions and old model files to itself.

    The published curves are those of the ``-v4`` environments, on purpose.
    """
    before: Callable[[str], None] | None = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*out of date.*")
            yield
    finally:
        mujoco.set_mju_user_warning(before)


def _tensor(array: np.ndarray) -> Tensor:
    return torch.from_numpy(array.astype(np.float32))


def _column(flags: np.ndarray) -> Tensor:
    return torch.from_numpy(flags.astype(bool)).unsqueeze(-1)
