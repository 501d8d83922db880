"""Scores a step: reward terms, failures and whom they are charged to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.envs.config import EnvConfig
from flashdex.envs.mdp import rewards, terminations
from flashdex.envs.mdp.options import build_options
from flashdex.envs.reference import ReferenceBank
from flashdex.envs.transforms.contact_code import contact_code
from flashdex.envs.transforms.features import gather_own, tip_distance
from flashdex.geometry.rotation import quat_angle
from flashdex.hands.kinematics import HandKinematics
from flashdex.hands.spec import HandSpec


@dataclass
class Outcome:
    """One judged step.

    Attributes:
        reward: (N, 2).
        terms: raw value of each reward term, (N, 2).
        blame: hand that ended the episode by failure, (N, 2) bool.
        causes: blame of each termination by name, (N, 2) bool.
        object_pos_error: own object to reference, m, (N, 2).
        object_rot_error: rad, (N, 2).
        active: hand takes part, (N, 2) bool.
    """

    reward: Tensor
    terms: dict[str, Tensor]
    blame: Tensor
    causes: dict[str, Tensor]
    object_pos_error: Tensor
    object_rot_error: Tensor
    active: Tensor


@dataclass
class StepInfo:
    """What the last step was made of, for logging and for the ledger.

    Attributes:
        outcome: rewards, blame and errors of the step.
        frame: frame each world was scored on, (N,).
        motion: motion of each world during the step, (N,).
    """

    outcome: Outcome
    frame: Tensor
    motion: Tensor


class Judge:
    """Applies the recipe's reward terms and terminations to states after a step.

    Args:
        bank: reference frames and object tables.
        hands: hand specs by side.
        config: environment part of the recipe.
        step_dt: control step, s.
        num_envs: worlds N.
        lead_s: how far targets run ahead of the reference, s, (2, J) or ().
        evaluation: judge errors and rewards, but end nothing except on bad numbers.
    """

    def __init__(
        self,
        bank: ReferenceBank,
        hands: dict[keys.Side, HandSpec],
        config: EnvConfig,
        *,
        step_dt: float,
        num_envs: int,
        lead_s: Tensor,
        evaluation: bool = False,
    ) -> None:
        self.bank, self.step_dt, self.lead_s = bank, step_dt, lead_s
        self.rewards = build_options("rewards", config.rewards)
        self.terminations = build_options("terminations", config.terminations)
        if evaluation:
            keep = {"sanity"} & set(self.terminations)
            self.terminations = {k: self.terminations[k] for k in keep}
        self.weights = {name: o.weight for name, o in self.rewards.items()}
        ranges = [torch.as_tensor(hands[s].joint_range) for s in keys.SIDES]
        device = bank.table.device
        ranges = torch.stack(ranges).float().to(device)
        self.joint_span = ranges[..., 1] - ranges[..., 0]
        radii = [torch.as_tensor(hands[s].tip_radius) for s in keys.SIDES]
        self.tip_radius = torch.stack(radii).float().to(device)
        if "object_points" in self.rewards:
            rho = self.rewards["object_points"].rho
            self.points = rewards.rescale_points(bank.points, bank.radius, rho=rho)
        self.object_sum = torch.zeros(num_envs, 2, device=device)

    def reset(self, mask: Tensor) -> None:
        """Forget the running sums of worlds that start anew, (N,) bool."""
        self.object_sum = torch.where(mask.unsqueeze(-1), 0.0, self.object_sum)

    def __call__(
        self,
        state: TensorDictBase,
        kin: TensorDictBase,
        ref: TensorDictBase,
        action: Tensor,
        target: Tensor,
        motion: Tensor,
        steps: Tensor,
    ) -> Outcome:
        """Judge the state after a step against the frame it was scored on.

        Args:
            state: engine state, batch (N,).
            kin: forward kinematics of ``state``.
            ref: reference frame.
            action: raw actions, (N, 2, J).
            target: position targets, (N, 2, J).
            motion: motion rows, (N,).
            steps: control steps since the reset, this one included, (N,).
        """
        slot = self.bank.hand_slot[motion]
        own = gather_own(state[keys.OBJECT_POSE], slot)
        active = self.bank.hand_active[motion]
        present = self.bank.has_object[motion]
        terms = self._finite_terms(kin, ref, own, action, target, motion)
        for name in ("object_points", "object_pose", "fingertip_distance"):
            if name in terms:
                terms[name] = terms[name] * present
        task = terms.get("object_points", terms.get("object_pose"))
        if task is not None:
            self.object_sum = self.object_sum + torch.nan_to_num(task)
        causes = self._causes(state, kin, ref, own, active, present, steps)
        blame = torch.zeros_like(active)
        for cause in causes.values():
            blame = blame | cause
        if "failure" in self.weights:
            terms["failure"] = blame.float()
        reward = rewards.weighted_sum(terms, self.weights, step_dt=self.step_dt)
        reward = torch.nan_to_num(reward) * active
        return Outcome(
            reward=reward,
            terms=terms,
            blame=blame,
            causes=causes,
            object_pos_error=(own[..., :3] - ref["own_pos"]).norm(dim=-1) * present,
            object_rot_error=quat_angle(own[..., 3:], ref["own_quat"]) * present,
            active=active,
        )

    def _finite_terms(self, *args: Any) -> dict[str, Tensor]:
        """Reward terms; a diverged world earns nothing, but still pays for failing."""
        return {k: torch.nan_to_num(v) for k, v in self._terms(*args).items()}

    def _terms(
        self,
        kin: TensorDictBase,
        ref: TensorDictBase,
        own: Tensor,
        action: Tensor,
        target: Tensor,
        motion: Tensor,
    ) -> dict[str, Tensor]:
        pos, quat = own[..., :3], own[..., 3:]
        ref_pos, ref_quat = ref["own_pos"], ref["own_quat"]
        rows = self.bank.hand_object[motion]
        out: dict[str, Tensor] = {}
        for name, o in self.rewards.items():
            match name:
                case "object_points":
                    error = rewards.object_points_error(
                        self.points[rows], pos, quat, ref_pos, ref_quat, top_k=o.top_k
                    )
                    out[name] = rewards.exp_kernel(error, sigma=o.sigma)
                case "object_pose":
                    out[name] = rewards.object_pose_exp(
                        pos,
                        quat,
                        ref_pos,
                        ref_quat,
                        beta_pos=o.beta_pos,
                        beta_rot=o.beta_rot,
                    )
                case "fingertip_distance":
                    distance = tip_distance(
                        kin, pos, quat, rows, self.bank.sdf, self.tip_radius
                    )
                    out[name] = rewards.fingertip_distance_exp(
                        distance, ref["tip_dist"], sigma=o.sigma
                    )
                case "wrist_pos":
                    out[name] = rewards.wrist_pos_error_exp(
                        kin["wrist_pos"], ref["wrist_pos"], scale=o.scale
                    )
                case "wrist_rot":
                    out[name] = rewards.wrist_rot_error_exp(
                        kin["wrist_quat"], ref["wrist_quat"], scale=o.scale
                    )
                case "fingertip_pos":
                    out[name] = rewards.fingertip_pos_error_exp(
                        kin["tip_pos"], ref["tip_pos"], scale=o.scale
                    )
                case "behaviour_cloning":
                    leading = ref["joint_pos"] + self.lead_s * ref["joint_vel"]
                    out[name] = rewards.behaviour_cloning_exp(
                        target, leading, self.joint_span, scale=o.scale
                    )
                case "action_l2":
                    out[name] = rewards.action_l2(action)
        return out

    def _causes(
        self,
        state: TensorDictBase,
        kin: TensorDictBase,
        ref: TensorDictBase,
        own: Tensor,
        active: Tensor,
        present: Tensor,
        steps: Tensor,
    ) -> dict[str, Tensor]:
        out: dict[str, Tensor] = {}
        for name, o in self.terminations.items():
            match name:
                case "object_dropped":
                    fell = terminations.object_dropped(
                        own[..., :3], ref["own_pos"], distance=o.distance
                    )
                    out[name] = fell & present
                case "early_reset":
                    out[name] = terminations.early_reset(
                        self.object_sum,
                        steps,
                        present,
                        threshold=o.threshold,
                        window=o.window,
                    )
                case "fingertip_off":
                    off = terminations.fingertip_off(
                        kin["tip_pos"],
                        ref["tip_pos"],
                        steps,
                        distance=o.distance,
                        grace=o.grace,
                    )
                    out[name] = off & active
                case "sanity":
                    bad = terminations.sanity(
                        state[keys.JOINT_VEL],
                        kin["link_linvel"],
                        state[keys.OBJECT_VEL],
                        state["bad"],
                        max_link_speed=o.max_link_speed,
                        max_joint_speed=o.max_joint_speed,
                        max_object_speed=o.max_object_speed,
                        max_object_spin=o.max_object_spin,
                    )
                    out[name] = bad & active
        return out


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
