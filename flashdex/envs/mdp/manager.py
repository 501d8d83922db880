"""Applies a recipe's rewards and terminations to the state after a step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.envs.config import EnvConfig
from flashdex.envs.mdp.rewards import weighted_sum
from flashdex.envs.mdp.step import Step, StepResult, TermContext
from flashdex.envs.mdp.term import Gate, Term, registry, terms_of
from flashdex.envs.reference import gather_own
from flashdex.envs.transforms.contact import contact_code
from flashdex.geometry.rotation import quat_angle
from flashdex.hands.kinematics import HandKinematics

Bound = tuple[Term, Callable[[Step], Tensor]]


class TermManager:
    """Rewards, and failures with the hands that are blamed for them.

    An ``evaluation`` rewards everything, but ends nothing except on bad numbers.
    """

    def __init__(
        self,
        context: TermContext,
        config: EnvConfig,
        kinematics: HandKinematics,
        *,
        evaluation: bool = False,
    ) -> None:
        self.context, self.kinematics = context, kinematics
        self.weights: dict[str, float] = {}
        self.rewards: dict[str, Bound] = {}
        self.on_failure: dict[str, Bound] = {}
        self.terminations: dict[str, Bound] = {}
        for name, (term, options) in terms_of("rewards", config.rewards).items():
            self.weights[name] = options.pop("weight")
            group = self.on_failure if term.on_failure else self.rewards
            group[name] = term, term.bind(context, options)
        chosen = terms_of("terminations", config.terminations)
        for name, (term, options) in chosen.items():
            if term.in_evaluation or not evaluation:
                self.terminations[name] = term, term.bind(context, options)
        order = list(registry("rewards").values())
        gated = [(name, term) for name, (term, _) in self.rewards.items() if term.gate]
        gated.sort(key=lambda item: order.index(item[1]))
        self.gates: dict[str, Gate] = {n: t.gate for n, t in gated if t.gate}
        self._task = next((n for n, gate in self.gates.items() if gate == "task"), None)

    @property
    def reward_names(self) -> list[str]:
        """Rewards in the order in which they are summed."""
        return [*self.rewards, *self.on_failure]

    def reset(self, mask: Tensor) -> None:
        """Let terms forget what they know of worlds that start anew, (N,) bool."""
        groups = (self.rewards, self.on_failure, self.terminations)
        for call in [call for group in groups for _, call in group.values()]:
            if (reset := getattr(call, "reset", None)) is not None:
                reset(mask)

    def __call__(
        self,
        state: TensorDictBase,
        ref: TensorDictBase,
        *,
        action: Tensor,
        target: Tensor,
        motion: Tensor,
        frame: Tensor,
        steps: Tensor,
    ) -> tuple[StepResult, Tensor]:
        """Score the state after a step; see `Step` for the arguments.

        Returns:
            What the step was worth, and the contact codes (N, 2, L, 7).
        """
        kin = self.kinematics(state[keys.JOINT_POS], state[keys.JOINT_VEL])
        bank = self.context.bank
        own = gather_own(state[keys.OBJECT_POSE], bank.hand_slot[motion])
        active = bank.hand_active[motion]
        step = Step(
            *(self.context, state, kin, ref, action, target, motion, frame, steps),
            own_pos=own[..., :3],
            own_quat=own[..., 3:],
            active=active,
            present=bank.has_object[motion],
            failed=torch.zeros_like(active),
        )
        return self._score(step), contact_code(state[keys.CONTACT], kin)

    def _score(self, step: Step) -> StepResult:
        # A diverged world earns nothing, but still pays for failing.
        terms = self._values(self.rewards, step)
        step.task = None if self._task is None else terms[self._task]
        causes: dict[str, Tensor] = {}
        for name, (term, call) in self.terminations.items():
            judged = step.present if term.needs_object else step.active
            causes[name] = call(step) & judged
            step.failed = step.failed | causes[name]
        terms |= self._values(self.on_failure, step)
        reward = weighted_sum(
            terms, self.weights, step_dt=self.context.step_dt, whole=self.on_failure
        )
        pos_error = (step.own_pos - step.ref["own_pos"]).norm(dim=-1)
        return StepResult(
            reward=torch.nan_to_num(reward) * step.active,
            reward_terms=terms,
            failed=step.failed,
            terminations=causes,
            object_pos_error=pos_error * step.present,
            object_rot_error=quat_angle(step.own_quat, step.ref["own_quat"])
            * step.present,
            active=step.active,
            motion=step.motion,
            frame=step.frame,
        )

    @staticmethod
    def _values(group: dict[str, Bound], step: Step) -> dict[str, Any]:
        """Raw values; those of hands without the object they need are 0."""
        values = {}
        for name, (term, call) in group.items():
            value = torch.nan_to_num(call(step))
            values[name] = value * step.present if term.needs_object else value
        return values
