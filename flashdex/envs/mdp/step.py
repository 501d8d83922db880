"""What a reward or a termination reads of a step, and what comes of it."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.envs.reference import ReferenceBank, gather_own


@dataclass(frozen=True)
class TermContext:
    """What does not change from step to step.

    Attributes:
        bank: reference frames and object tables.
        num_envs: worlds N.
        step_dt: control step, s.
        lead_s: how far targets run ahead of the reference, s, (2, J) or ().
        joint_range: lower and upper limits, (2, J, 2).
        tip_radius: m, (2, 5).
    """

    bank: ReferenceBank
    num_envs: int
    step_dt: float
    lead_s: Tensor
    joint_range: Tensor
    tip_radius: Tensor


@dataclass
class Step:
    """One control step of N worlds and both hands, after the physics.

    Attributes:
        context: what does not change.
        state: engine state, batch (N,), see `Physics.state`.
        kin: forward kinematics of the state.
        ref: reference frame the step is scored on.
        action: raw actions, (N, 2, J).
        target: position targets, (N, 2, J).
        motion: motion rows, (N,).
        frame: of the motion, (N,).
        steps: control steps since the reset, this one included, (N,).
        own_pos: each hand's own object, world, m, (N, 2, 3).
        own_quat: (N, 2, 4).
        active: hand takes part, (N, 2) bool.
        present: hand takes part and has an object, (N, 2) bool.
        failed: hands that ended the episode, (N, 2) bool; known to `on_failure` terms.
        task: value of the first reward with the gate "task", (N, 2); known to
            terminations.
    """

    context: TermContext
    state: TensorDictBase
    kin: TensorDictBase
    ref: TensorDictBase
    action: Tensor
    target: Tensor
    motion: Tensor
    frame: Tensor
    steps: Tensor
    own_pos: Tensor
    own_quat: Tensor
    active: Tensor
    present: Tensor
    failed: Tensor
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

    @property
    def leading_joint_pos(self) -> Tensor:
        """Reference joints ahead by the lag of the wrist servos, (N, 2, J)."""
        return self.ref["joint_pos"] + self.context.lead_s * self.ref["joint_vel"]


@dataclass
class StepResult:
    """What a step was worth, for the learner, the logs and the ledger.

    Attributes:
        reward: (N, 2).
        reward_terms: raw value of each reward, (N, 2).
        failed: hands that ended the episode by failure, (N, 2) bool.
        terminations: hands that each termination blames, (N, 2) bool.
        object_pos_error: own object to reference, m, (N, 2).
        object_rot_error: rad, (N, 2).
        active: hand takes part, (N, 2) bool.
        motion: of each world during the step, (N,).
        frame: that each world was scored on, (N,).
    """

    reward: Tensor
    reward_terms: dict[str, Tensor]
    failed: Tensor
    terminations: dict[str, Tensor]
    object_pos_error: Tensor
    object_rot_error: Tensor
    active: Tensor
    motion: Tensor
    frame: Tensor
