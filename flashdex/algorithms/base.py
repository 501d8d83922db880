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
from flashdex.algorithms.footprint import Footprint, Networks

if TYPE_CHECKING:
    from torchrl.envs.transforms import Transform

    from flashdex.envs.reference import ReferenceBank


@dataclass(frozen=True, kw_only=True)
class TaskSpec:
    """What a learner is told of the task that it is built for."""

    example: TensorDictBase  # one state of every world, batch (N,), on ``device``
    action_dim: int  # actions of one hand J, or of the environment A
    vector_steps: float  # budget of the run, steps of all worlds together
    seed: int  # of networks, exploration and replay
    device: torch.device  # where the learner lives
    bank: ReferenceBank | None = None  # on ``device``; None without motions
    transforms: list[Transform] = field(default_factory=list)  # in data-flow order


class Learner(ABC):
    """An algorithm: acts, stores what comes of it, and learns; knows no simulator.

    Actions, rewards and flags are (N, 2, J), (N, 2) and (N, 1) where two hands act, and
    (N, A), (N, 1) and (N, 1) on stock environments.
    """

    config_class: ClassVar[type[AlgoConfig]] = AlgoConfig
    tasks: ClassVar[tuple[str, ...]] = ("retarget",)  # recipes that it can train
    # Recipe keys that give networks and statistics their meaning; they stay in a run.
    immutable_keys: ClassVar[tuple[str, ...]] = (
        "algo.kind",
        "algo.groups",
        "algo.v_max",
    )
    has_replay: ClassVar[bool] = False  # learns from ``config.buffer_size`` rows
    # It may learn between acting and storing the outcome; an on-policy learner must
    # not change before the rollout is complete.
    is_off_policy: ClassVar[bool] = False
    device: torch.device
    buffer: Any = None  # its `RowBuffer`, if any
    last_update: dict[str, Any] | None = None  # its batch and draws, if kept

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
        """Actions in states, batch (N,), of two hands compact with ``attempt`` flag.

        Attempt worlds act deterministically, without ``explore`` all do.
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

    def rehearse(self, config: Any, state: TensorDictBase) -> Footprint:
        """Memory that the algorithm takes, nothing where it does not tell.

        ``config`` is that of the run; the learner is a narrow copy with some rows.
        """
        return Footprint(Networks(0, 0, 0), 0, lambda size: (0, 0.0))

    def metrics(self) -> dict[str, float]:
        """What a record of a stock environment says of the learner."""
        return {}

    @classmethod
    def conflicts(cls, config: Any, budget: int, worlds: dict[str, int]) -> list[str]:
        """One line for each thing in a recipe that does not fit together.

        ``budget`` is in env steps; ``worlds`` their number, by the key that gives it.
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
        return config.buffer_size if cls.has_replay else 0

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
