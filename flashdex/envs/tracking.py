"""The tracking environment: worlds that follow reference motions, as a TorchRL env."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from flashdex import keys
from flashdex.envs.actions import joint_target, lowpass, lowpass_alpha
from flashdex.envs.assist import AssistSchedule, assist_wrench
from flashdex.envs.contact import CODE_WIDTH, encode_contact
from flashdex.envs.features import gather_own
from flashdex.envs.judge import Judge, Outcome
from flashdex.envs.physics.base import Physics, WrenchFn
from flashdex.envs.reference import ReferenceBank
from flashdex.envs.reset import ResetDraw, draw_reset, reset_state
from flashdex.envs.samplers import SAMPLERS, UnconvertedSampler
from flashdex.geometry.rotation import quat_rotate_inverse
from flashdex.hands.kinematics import HandKinematics
from flashdex.hands.spec import HandSpec
from flashdex.recipe import EnvConfig


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


class TrackingEnv(EnvBase):
    """Batched, batch-locked, with partial resets; emits the compact state only.

    Worlds ``0 .. num_attempts - 1`` always start at frame 0 without assist and without
    reset noise: their finished episodes are attempts. Actions are
    ``("left", "action")`` and ``("right", "action")`` in [-1, 1]; rewards are per hand;
    ``done``, ``terminated`` and ``truncated`` stand at the root only.

    Args:
        physics: engine with ``num_envs`` worlds.
        bank: reference frames.
        hands: hand specs by side.
        config: environment part of the recipe.
        step_dt: control step, s.
        seed: of resets and motions.
        evaluation: no terminations, every world an attempt.
    """

    batch_locked = True

    def __init__(
        self,
        physics: Physics,
        bank: ReferenceBank,
        hands: dict[str, HandSpec],
        config: EnvConfig,
        *,
        step_dt: float,
        seed: int = 0,
        evaluation: bool = False,
    ) -> None:
        n = physics.num_envs
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([n]))
        self.physics, self.bank, self.hands, self.config = physics, bank, hands, config
        self.step_dt = step_dt
        self.group_map = {side: [side] for side in keys.SIDES}
        self.num_envs = n
        self.num_attempts = n if evaluation else round(config.attempt_share * n)
        self.attempt = torch.arange(n) < self.num_attempts
        self.kinematics = HandKinematics(hands)
        ranges = [torch.as_tensor(hands[s].joint_range) for s in keys.SIDES]
        self.joint_range = torch.stack(ranges).float()
        self.judge = Judge(
            bank, hands, config, step_dt=step_dt, num_envs=n, evaluation=evaluation
        )
        self.sampler = SAMPLERS[config.sampler](bank.num_motions)
        self.attempt_sampler = UnconvertedSampler(bank.num_motions)
        self._alpha = lowpass_alpha(config.wrist_lowpass_hz, step_dt)
        scale = [config.wrist_pos_scale] * 3 + [config.wrist_rot_scale] * 3
        self._wrist_scale = torch.tensor(scale)
        self.assist: AssistSchedule | None = None
        if config.assist is not None and config.assist.enabled and not evaluation:
            self.assist = AssistSchedule(config.assist)
        self._max_steps = round(config.max_seconds / step_dt)
        self.motion = torch.zeros(n, dtype=torch.long)
        self.frame = torch.ones(n, dtype=torch.long)
        self.steps = torch.zeros(n, dtype=torch.long)
        self.forced_motion: Tensor | None = None
        self.target_override: Callable[[TrackingEnv], Tensor] | None = None
        self._filter = torch.zeros(n, 2, 6)
        self._target = torch.zeros(n, 2, self.joint_range.shape[1])
        self.info: StepInfo | None = None
        self._make_specs()
        self.generator = torch.Generator()
        self.set_seed(seed)
        self.redraw_assist()

    def _make_specs(self) -> None:
        n, joints = self.num_envs, self.joint_range.shape[1]
        slots, links = self.bank.num_slots, self.hands["left"].num_links
        whole = {"dtype": torch.int64}
        self.observation_spec = Composite(
            {
                keys.JOINT_POS: Unbounded((n, 2, joints)),
                keys.JOINT_VEL: Unbounded((n, 2, joints)),
                keys.JOINT_TARGET: Unbounded((n, 2, joints)),
                keys.OBJECT_POSE: Unbounded((n, slots, 7)),
                keys.OBJECT_VEL: Unbounded((n, slots, 6)),
                keys.CONTACT: Unbounded((n, 2, links, CODE_WIDTH), dtype=torch.int8),
                keys.MOTION: Unbounded((n, 1), **whole),
                keys.FRAME: Unbounded((n, 1), **whole),
                keys.ATTEMPT: Binary(1, (n, 1), dtype=torch.bool),
            },
            shape=(n,),
        )
        one = Bounded(-1.0, 1.0, (n, joints))
        self.action_spec = Composite(
            {s: Composite({keys.ACTION: one.clone()}, shape=(n,)) for s in keys.SIDES},
            shape=(n,),
        )
        reward = Unbounded((n, 1))
        self.reward_spec = Composite(
            {
                s: Composite({keys.REWARD: reward.clone()}, shape=(n,))
                for s in keys.SIDES
            },
            shape=(n,),
        )
        flag = Binary(1, (n, 1), dtype=torch.bool)
        names = (keys.DONE, keys.TERMINATED, keys.TRUNCATED)
        self.full_done_spec = Composite({k: flag.clone() for k in names}, shape=(n,))

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(0 if seed is None else seed)

    def redraw_assist(self) -> None:
        """Draw each world's assist gains from the present level."""
        n = self.num_envs
        self.assist_kp, self.assist_kv = torch.zeros(n), torch.zeros(n)
        if self.assist is not None and self.assist.active:
            kp, kv = self.assist.draw(n, self.generator)
            self.assist_kp = torch.where(self.attempt, torch.zeros(n), kp)
            self.assist_kv = torch.where(self.attempt, torch.zeros(n), kv)

    def _reset(
        self, tensordict: TensorDictBase | None = None, **kwargs: Any
    ) -> TensorDictBase:
        mask = torch.ones(self.num_envs, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict.keys():
            mask = tensordict["_reset"].reshape(self.num_envs)
        ids = mask.nonzero().squeeze(-1)
        if len(ids):
            draw = self._draw(ids)
            state = reset_state(draw, self.bank, self.joint_range)
            self.physics.reset(ids, draw.motion, **state)
            self.motion[ids] = draw.motion
            # The state of frame s is written; the next step is scored on s + 1.
            self.frame[ids] = draw.frame + 1
            self.steps[ids] = 0
            self._filter[ids] = 0.0
            self._target[ids] = state["joint_pos"]
            self.judge.reset(ids)
        out = self._observation(self.physics.state())
        for key in (keys.DONE, keys.TERMINATED, keys.TRUNCATED):
            out[key] = torch.zeros(self.num_envs, 1, dtype=torch.bool)
        return out

    def _draw(self, ids: Tensor) -> ResetDraw:
        attempt = self.attempt[ids]
        motion = self.sampler.sample(len(ids), self.generator)
        tried = self.attempt_sampler.sample(len(ids), self.generator)
        motion = torch.where(attempt, tried, motion)
        if self.forced_motion is not None:
            motion = self.forced_motion[ids]
        return draw_reset(
            motion,
            attempt if self.config.rsi else torch.ones_like(attempt),
            attempt,
            self.bank.length[motion],
            self.config.reset_noise,
            self.joint_range,
            self.generator,
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = torch.stack([tensordict[keys.action(s)] for s in keys.SIDES], 1)
        action = torch.nan_to_num(action).clamp(-1.0, 1.0)
        ref = self.bank.at(self.motion, self.frame)
        self._apply(action, ref)
        state = self.physics.state()
        self.steps += 1
        kin = self.kinematics(state[keys.JOINT_POS], state[keys.JOINT_VEL])
        outcome = self.judge(state, kin, ref, action, self._target, self.motion, self.steps)
        scored = self.frame.clone()
        self.info = StepInfo(outcome, scored, self.motion.clone())
        terminated = outcome.blame.any(-1, keepdim=True)
        ended = scored >= self.bank.length[self.motion] - 1
        truncated = (ended | (self.steps >= self._max_steps)).unsqueeze(-1)
        self.frame = scored + 1
        out = self._observation(state)
        for i, side in enumerate(keys.SIDES):
            out[keys.reward(side)] = outcome.reward[:, i : i + 1]
        out[keys.TERMINATED] = terminated
        out[keys.TRUNCATED] = truncated & ~terminated
        out[keys.DONE] = terminated | truncated
        return out

    def _apply(self, action: Tensor, ref: TensorDictBase) -> None:
        fresh = self.steps == 0
        self._filter = lowpass(self._filter, action[..., :6], fresh, alpha=self._alpha)
        residual = self.config.finger_mode == "residual"
        self._target = joint_target(
            self._filter,
            action[..., 6:],
            ref["joint_pos"],
            self.joint_range,
            wrist_scale=self._wrist_scale,
            finger_scale=self.config.finger_scale if residual else None,
        )
        if self.target_override is not None:
            self._target = self.target_override(self)
        self.physics.step(self._target, self._wrench(ref))

    def _wrench(self, ref: TensorDictBase) -> WrenchFn | None:
        if self.assist is None or not self.assist.active:
            return None
        c = self.assist.config
        ref_pose = torch.cat([ref["object_pos"], ref["object_quat"]], -1)
        ref_vel = torch.cat([ref["object_linvel"], ref["object_angvel"]], -1)
        rows = self.bank.object_index[self.motion]
        inertia = self.bank.inertia[rows.clamp_min(0)]
        present = (rows >= 0).unsqueeze(-1)

        def wrench(pose: Tensor, vel: Tensor) -> Tensor:
            values = assist_wrench(
                pose,
                vel,
                ref_pose,
                ref_vel,
                inertia,
                self.assist_kp,
                self.assist_kv,
                torque_ratio=c.torque_ratio,
                force_limit=c.force_limit,
                torque_limit=c.torque_limit,
            )
            return torch.where(present, values, torch.zeros_like(values))

        return wrench

    def _observation(self, state: TensorDictBase) -> TensorDict:
        kin = self.kinematics(state[keys.JOINT_POS], None)
        wrench = state[keys.CONTACT]
        force = quat_rotate_inverse(kin["link_quat"], wrench[..., :3])
        lever = wrench[..., 3:] - kin["link_pos"]
        code = encode_contact(force, quat_rotate_inverse(kin["link_quat"], lever))
        out = {
            keys.JOINT_POS: state[keys.JOINT_POS],
            keys.JOINT_VEL: state[keys.JOINT_VEL],
            keys.JOINT_TARGET: self._target.clone(),
            keys.OBJECT_POSE: state[keys.OBJECT_POSE],
            keys.OBJECT_VEL: state[keys.OBJECT_VEL],
            keys.CONTACT: code,
            keys.MOTION: self.motion.clone().unsqueeze(-1),
            keys.FRAME: self.frame.clone().unsqueeze(-1),
            keys.ATTEMPT: self.attempt.clone().unsqueeze(-1),
        }
        return TensorDict(out, batch_size=self.batch_size)

    def own_objects(self, state: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Pose (N, 2, 7) and velocity (N, 2, 6) of each hand's own object."""
        slot = self.bank.hand_slot[self.motion]
        pose = gather_own(state[keys.OBJECT_POSE], slot)
        return pose, gather_own(state[keys.OBJECT_VEL], slot)
