"""What the training loop asks of an algorithm, and the register of algorithms."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from flashdex.algorithms.config import AlgoConfig

if TYPE_CHECKING:
    from torchrl.envs.transforms import Transform

    from flashdex.envs.reference import ReferenceBank


@dataclass(frozen=True, kw_only=True)
class TaskSpec:
    """What a learner is told of the task that it is built for.

    Attributes:
        example: one state of every world, batch (N,), on ``device``.
        action_dim: actions of one hand J, or of the environment A.
        vector_steps: budget of the run, steps of all worlds together.
        seed: of networks, exploration and replay.
        device: where the learner lives.
        bank: reference frames, on ``device``; None without motions.
        transforms: observation transforms in data-flow order.
    """

    example: TensorDictBase
    action_dim: int
    vector_steps: float
    seed: int
    device: torch.device
    bank: ReferenceBank | None = None
    transforms: list[Transform] = field(default_factory=list)


class Learner(ABC):
    """An algorithm: acts, stores what comes of it, and learns; knows no simulator.

    Actions, rewards and flags are (N, 2, J), (N, 2) and (N, 1) where two hands act, and
    (N, A), (N, 1) and (N, 1) on stock environments.

    Attributes:
        config_class: schema of the algorithm's part of a recipe.
        tasks: kinds of recipes that it can train.
        immutable_keys: recipe keys that give networks and statistics their meaning,
            which a running run may not change.
        has_replay: it learns from a buffer of ``config.buffer_size`` rows.
        is_off_policy: it may learn between acting and storing the outcome; an
            on-policy learner must not change before the rollout is complete.
        buffer: its replay buffer, a `RowBuffer`; None without one.
        last_update: what the last update was fed with, if that is kept; see ``redo``.
    """

    config_class: ClassVar[type[AlgoConfig]] = AlgoConfig
    tasks: ClassVar[tuple[str, ...]] = ("retarget",)
    immutable_keys: ClassVar[tuple[str, ...]] = (
        "algo.kind",
        "algo.groups",
        "algo.v_max",
    )
    has_replay: ClassVar[bool] = False
    is_off_policy: ClassVar[bool] = False
    device: torch.device
    buffer: Any = None
    last_update: dict[str, Any] | None = None

    @abstractmethod
    def __init__(self, config: Any, spec: TaskSpec) -> None: ...

    @property
    @abstractmethod
    def updates(self) -> int:
        """Updates performed so far."""

    @property
    @abstractmethod
    def num_rows(self) -> int:
        """Transitions at hand to learn from."""

    @property
    def num_dropped(self) -> int:
        """Transitions so far that were not finite; may wait for the device."""
        return 0

    @abstractmethod
    def act(self, state: TensorDictBase, *, explore: bool = True) -> Tensor:
        """Actions in states, batch (N,); attempt worlds act deterministically.

        Args:
            state: of two hands compact, with the ``attempt`` flag.
            explore: False makes every world deterministic.
        """

    @abstractmethod
    def process_step(
        self,
        state: TensorDictBase,
        action: Tensor,
        reward: Tensor,
        next_state: TensorDictBase,
        terminated: Tensor,
        done: Tensor,
    ) -> None:
        """Take in one vector step; ``next_state`` is that before any reset."""

    @abstractmethod
    def num_updates(self) -> int:
        """Updates to perform now; asked once after every vector step."""

    @abstractmethod
    def update(self) -> TensorDict:
        """One update; returns its metrics, with the same keys every time."""

    def redo(self, update: dict[str, Any]) -> TensorDict:
        """Perform an update again on the batch and with the draws of ``last_update``.

        Raises:
            NotImplementedError: the learner keeps none.
        """
        raise NotImplementedError

    @abstractmethod
    def forget_episodes(self) -> None:
        """Drop what belongs to unfinished episodes: after a resume they are gone."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """A copy of all that an exact continuation needs, tensors and plain values."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore ``state_dict``."""

    def metrics(self) -> dict[str, float]:
        """What a record of a stock environment says of the learner."""
        return {}

    @classmethod
    def conflicts(cls, config: Any, budget: int, worlds: dict[str, int]) -> list[str]:
        """One line for each thing in a recipe that does not fit together.

        Args:
            config: algorithm part of the recipe.
            budget: env steps of the run.
            worlds: their number, by the recipe key that gives it.
        """
        problems = []
        if config.lr_final > config.lr:
            problems.append(
                f"algo.lr_final: {config.lr_final} is above algo.lr={config.lr}"
            )
        if len(config.future_channels) != 3 or min(config.future_channels) < 1:
            problems.append(
                f"algo.future_channels: expected three positive numbers, found "
                f"{config.future_channels}"
            )
        return problems

    @classmethod
    def gentler(cls, config: Any) -> str:
        """Overrides that halve the learning rate, ``key=value`` words."""
        return f"algo.lr={config.lr / 2:g} algo.lr_final={config.lr_final / 2:g}"

    @classmethod
    def row_count(cls, config: Any, num_envs: int) -> int:
        """Transitions it keeps at most: those of the buffer or of a rollout."""
        return config.buffer_size

    @classmethod
    def batch_rows(cls, config: Any, num_envs: int) -> int:
        """Transitions that one gradient step reads."""
        return config.batch_size


ALGORITHMS: dict[str, type[Learner]] = {}
"""Those registered so far; `flashdex.algorithms.known_algorithms` loads ours, too."""
L = TypeVar("L", bound=Learner)


def register(kind: str) -> Callable[[type[L]], type[L]]:
    """Let recipes name a learner by ``algo.kind``.

    Example:
        >>> @register("nothing")  # doctest: +SKIP
        ... class Nothing(Learner): ...
    """

    def add(learner: type[L]) -> type[L]:
        ALGORITHMS[kind] = learner
        return learner

    return add


def config_class(kind: object) -> type[AlgoConfig]:
    """Schema of ``algo`` for a kind; that of the built-in ones where it is unknown."""
    learner = ALGORITHMS.get(str(kind))
    return AlgoConfig if learner is None else learner.config_class


def snapshot(state: Any) -> Any:
    """Copy of a nested state on the CPU that shares no memory with the original."""
    if isinstance(state, Tensor):
        return state.detach().to("cpu", copy=True)
    if isinstance(state, dict):
        out = copy.copy(state)  # keeps the version notes of a module's state
        out.update({key: snapshot(value) for key, value in state.items()})
        return out
    if isinstance(state, list | tuple):
        return type(state)(snapshot(value) for value in state)
    return state
