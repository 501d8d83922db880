"""What a reward or a termination reads of a step, and what comes of it."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.envs.reference import ReferenceBank, gather_own


@dataclass(frozen=True)
class TermContext:
    """What does not change from step to step."""

    bank: ReferenceBank  # reference frames and object tables
    num_envs: int  # worlds N
    step_dt: float  # control step, s
    joint_range: Tensor  # lower and upper limits, (2, J, 2)
    tip_radius: Tensor  # m, (2, 5)


@dataclass
class Step:
    """One control step of N worlds and both hands, after the physics."""

    context: TermContext  # what does not change
    state: TensorDictBase  # engine state, batch (N,), see `Physics.state`
    kin: TensorDictBase  # forward kinematics of the state
    ref: TensorDictBase  # reference frame the step is scored on
    action: Tensor  # raw actions, (N, 2, J)
    target: Tensor  # position targets, (N, 2, J)
    motion: Tensor  # motion rows, (N,)
    frame: Tensor  # of the motion, (N,)
    steps: Tensor  # control steps since the reset, this one included, (N,)
    own_pos: Tensor  # each hand's own object, world, m, (N, 2, 3)
    own_quat: Tensor  # (N, 2, 4)
    active: Tensor  # hand takes part, (N, 2) bool
    present: Tensor  # hand takes part and has an object, (N, 2) bool
    # hands that ended the episode, (N, 2) bool; known to `on_failure` terms
    failed: Tensor
    # value of the first reward with the gate "task", (N, 2); known to terminations
    task: Tensor | None = None

    @property
    def bank(self) -> ReferenceBank:
        """Reference frames and object tables."""
        return self.context.bank

    @property
    def own_vel(self) -> Tensor:
        """Own object's velocities, world, m/s and rad/s, (N, 2, 6)."""
        slot = self.bank.hand_slot[self.motion]
        return gather_own(self.state[keys.OBJECT_VEL], slot)

    @property
    def object_row(self) -> Tensor:
        """Row of each hand's object in the tables, (N, 2) int64."""
        return self.bank.hand_object[self.motion]


@dataclass
class StepResult:
    """What a step was worth, for the learner, the logs and the ledger."""

    reward: Tensor  # (N, 2)
    reward_terms: dict[str, Tensor]  # raw value of each reward, (N, 2)
    failed: Tensor  # hands that ended the episode by failure, (N, 2) bool
    terminations: dict[str, Tensor]  # hands that each termination blames, (N, 2) bool
    object_pos_error: Tensor  # own object to reference, m, (N, 2)
    object_rot_error: Tensor  # rad, (N, 2)
    active: Tensor  # hand takes part, (N, 2) bool
    motion: Tensor  # of each world during the step, (N,)
    frame: Tensor  # that each world was scored on, (N,)
