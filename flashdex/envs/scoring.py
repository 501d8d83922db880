"""What follows a physics step: kinematics, judgement, contact codes."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.envs.contact import contact_code
from flashdex.envs.judge import Judge, Outcome
from flashdex.hands.kinematics import HandKinematics


class Scoring:
    """Turns an engine's state into an outcome and contact codes.

    It is some five hundred small operations; compiled they are a few kernels, which
    is what a GPU wants.

    Args:
        judge: reward terms and terminations.
        kinematics: forward kinematics of both hands.
        compile: make one graph of it: a minute or more at the first step.
        backend: of the compiler.
    """

    def __init__(
        self,
        judge: Judge,
        kinematics: HandKinematics,
        *,
        compile: bool = False,
        backend: str = "inductor",
    ) -> None:
        self.judge, self.kinematics = judge, kinematics
        self._call: Any = self.pure
        if compile:
            self._call = torch.compile(self.pure, fullgraph=True, backend=backend)

    def __call__(
        self,
        state: TensorDictBase,
        action: Tensor,
        ref: TensorDictBase,
        target: Tensor,
        motion: Tensor,
        steps: Tensor,
    ) -> tuple[Outcome, Tensor]:
        """Score a state; see ``Judge`` for the arguments.

        Returns:
            The outcome, and the contact codes (N, 2, L, 7).
        """
        return self._call(state, action, ref, target, motion, steps)

    def pure(
        self,
        state: TensorDictBase,
        action: Tensor,
        ref: TensorDictBase,
        target: Tensor,
        motion: Tensor,
        steps: Tensor,
    ) -> tuple[Outcome, Tensor]:
        """The same, one operation after the other."""
        kin = self.kinematics(state[keys.JOINT_POS], state[keys.JOINT_VEL])
        outcome = self.judge(state, kin, ref, action, target, motion, steps)
        return outcome, contact_code(state[keys.CONTACT], kin)
