"""Stock Gymnasium environments as a batched TorchRL environment of float32 tensors."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Size, Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from flashdex import keys
from flashdex.envs.config import GymConfig
from flashdex.envs.tracking import FLAGS
from flashdex.errors import FlashdexError, MissingExtraError


class GymEnv(EnvBase):
    """N copies of one environment, stepped in this process.

    Nothing is reset on its own, so that the observation of a step is the true one also
    where an episode ends. ``truncated`` is the step limit and nothing else; it is set
    also where the observation is not finite, from which nothing could go on.

    Args:
        config: names the environment.
        num_envs: worlds N.
        seed: of their starts; world i takes ``seed + i``, at every reset of all.

    Raises:
        FlashdexError: the environment does not exist, cannot be made, has other than
            flat observations and bounded continuous actions, or no step limit.
        MissingExtraError: gymnasium is not installed.
    """

    is_host_device = True

    def __init__(self, config: GymConfig, *, num_envs: int, seed: int) -> None:
        super().__init__(device=torch.device("cpu"), batch_size=Size([num_envs]))
        self.num_envs, self.seed = num_envs, seed
        self._env = _make_vector_env(config, num_envs)
        self._check_spaces(config)
        self._check_limit(config)
        self.observation_dim: int = self._env.single_observation_space.shape[0]
        self.action_dim: int = self._env.single_action_space.shape[0]
        n = num_envs
        observed = Unbounded(Size((n, self.observation_dim)))
        self.observation_spec = Composite({keys.OBSERVATION: observed}, shape=(n,))
        self.action_spec = Bounded(-1.0, 1.0, Size((n, self.action_dim)))
        self.reward_spec = Unbounded(Size((n, 1)))
        flags = {name: Binary(1, Size((n, 1)), dtype=torch.bool) for name in FLAGS}
        self.full_done_spec = Composite(flags, shape=(n,))

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

    def _set_seed(self, seed: int | None) -> None:
        self.seed = 0 if seed is None else seed

    def _reset(
        self, tensordict: TensorDictBase | None = None, **kwargs: Any
    ) -> TensorDictBase:
        asked = None if tensordict is None else tensordict.get("_reset", None)
        if asked is not None:
            return self.reset_worlds(asked.reshape(self.num_envs))
        observation, _ = self._env.reset(seed=self.seed)
        return self._root(observation)

    def reset_worlds(self, mask: Tensor) -> TensorDict:
        """Begin new episodes in some worlds.

        Args:
            mask: worlds to reset, (N,) bool, at least one of them true.

        Returns:
            Observation and flags of all worlds, batch (N,).
        """
        observation, _ = self._env.reset(options={"reset_mask": mask.numpy()})
        return self._root(observation)

    def _root(self, observation: np.ndarray) -> TensorDict:
        flags = self.full_done_spec.zero()
        return TensorDict(
            {keys.OBSERVATION: _tensor(observation), **flags}, self.batch_size
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict[keys.ACTION].detach().numpy()
        observation, reward, terminated, truncated, _ = self._env.step(action)
        ended, seen = _column(terminated), _tensor(observation)
        lost = ~seen.isfinite().all(-1, keepdim=True)
        # An environment may fail in the very step that reaches the limit.
        cut = (_column(truncated) | lost) & ~ended
        step = {
            keys.OBSERVATION: seen,
            keys.REWARD: _tensor(reward).unsqueeze(-1),
            keys.TERMINATED: ended,
            keys.TRUNCATED: cut,
            keys.DONE: ended | cut,
        }
        return TensorDict(step, self.batch_size)

    def put_action(self, td: TensorDictBase, action: Tensor) -> None:
        """Write actions (N, A) in [-1, 1] into ``td``."""
        td.set(keys.ACTION, action)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free the worlds."""
        self._env.close()
        super().close(raise_if_closed=raise_if_closed)


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
