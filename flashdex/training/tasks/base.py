"""What is trained: everything in which one kind of recipe differs from another."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from tensordict import TensorDictBase
from torch import Tensor

from flashdex.algorithms.base import Learner
from flashdex.errors import RunError
from flashdex.training.session import SessionStart

if TYPE_CHECKING:
    from flashdex.training.trainer import Trainer


class Task(Protocol):
    """A session calls all down to ``begin`` and ``close``, the loop the rest."""

    worlds_key: ClassVar[str]  # recipe key of the number of worlds
    evaluated_keys: ClassVar[tuple[str, ...]]  # of a checkpoint to be evaluated
    resumed_keys: ClassVar[tuple[str, ...]]  # of one to be gone on from
    state_keys: ClassVar[tuple[str, ...]]  # entries of a state that a learner reads
    # An off-policy learner learns while the physics steps, on the rows before that
    # step; otherwise after it.
    updates_during_step: ClassVar[bool]
    recipe: Any
    env: Any  # from ``prepare`` on
    record_due: bool = False  # write a record after this step

    @property
    def note(self) -> str:
        """What was achieved, in a few words."""
        ...

    @property
    def num_results(self) -> int:
        """Grows with what a record would tell besides env steps."""
        ...

    @property
    def rows_meaning(self) -> str:
        """What replay rows depend on; rows of another meaning are dropped."""
        ...

    @classmethod
    def open(cls, recipe: Any, run_dir: Path | None = None) -> Task:
        """Load what a recipe names; with a run directory, to train in it."""
        ...

    def make_env(self, *, num_envs: int | None = None) -> Any:
        """Make an environment, with as many worlds as the recipe says when None."""
        ...

    def make_learner(self, env: Any) -> Learner:
        """Make the algorithm of the recipe."""
        ...

    def check_inputs(self, run_dir: Path) -> None:
        """Refuse what is not what the run began with, by content."""

    def prepare(self, run_dir: Path, env: Any) -> None:
        """Open what may refuse a session."""

    def begin(self, start: SessionStart, state: dict[str, Any] | None) -> None:
        """Open the rest; ``state`` is the checkpoint that is gone on from."""

    def after_reset(self) -> None:
        """Some worlds have begun new episodes."""

    def after_physics(self, trainer: Trainer, action: Tensor, done: Tensor) -> None:
        """The environment has stepped; the learner may still be at work."""

    def rewards(self, after: TensorDictBase) -> Tensor:
        """Rewards as the learner takes them, of the state after a step."""
        ...

    def after_step(self, trainer: Trainer, after: TensorDictBase) -> None:
        """The step is stored; ``after`` is the state before any reset."""

    def metrics(self, trainer: Trainer) -> dict[str, float]:
        """What a record says of the task."""
        ...

    def end_reason(self) -> str:
        """Why the run may end now, empty when it may not."""
        return ""

    def settle(self, trainer: Trainer) -> RunError | None:
        """Finish what is in line; the error that made it impossible."""
        ...

    def finish(self, trainer: Trainer, why: str) -> None:
        """The loop has ended; a last record follows."""

    def state_dict(self) -> dict[str, Any]:
        """The task's entries of a checkpoint."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore ``state_dict`` from a whole checkpoint."""

    def evaluate(self, learner: Learner, env_steps: int) -> dict[str, Any]:
        """Scores of a learner after so many env steps, as JSON."""
        ...

    def close(self, *, wait: bool) -> None:
        """Free everything; ``wait`` finishes what is in line first."""
