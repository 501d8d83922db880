"""The tracking environment: worlds that follow reference motions, as a TorchRL env."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Size, Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from flashdex import keys
from flashdex.envs.config import EnvConfig
from flashdex.envs.mdp.actions import joint_target, lowpass, lowpass_alpha
from flashdex.envs.mdp.assist import AssistConfig, AssistSchedule
from flashdex.envs.mdp.manager import TermManager
from flashdex.envs.mdp.resets import ResetDraw, draw_reset, reset_state
from flashdex.envs.mdp.samplers import SAMPLERS, MotionSampler
from flashdex.envs.mdp.step import StepResult, TermContext
from flashdex.envs.physics.base import Physics
from flashdex.envs.reference import ReferenceBank, stack_hands
from flashdex.envs.scene.wrench import ObjectWrench, hold_share
from flashdex.envs.transforms.contact import CODE_WIDTH, contact_code
from flashdex.hands.kinematics import HandKinematics
from flashdex.hands.spec import HandSpec

# Below this many worlds a thread, waking the threads costs more than they save; beside
# the physics engine's own threads a barrier can even wait for the scheduler.
WORLDS_A_THREAD = 1024


FLAGS = (keys.DONE, keys.TERMINATED, keys.TRUNCATED)


@contextmanager
def few_threads(num_envs: int) -> Iterator[None]:
    """Run the block with at most one torch thread for every 1,024 worlds."""
    before = torch.get_num_threads()
    torch.set_num_threads(max(1, min(before, num_envs // WORLDS_A_THREAD)))
    try:
        yield
    finally:
        torch.set_num_threads(before)


def state_spec(num_envs: int, joints: int, slots: int, links: int) -> Composite:
    """Compact state of N worlds, as ``flashdex.keys`` lists it.

    Joints (wrist included) and links are those of one hand, slots those of a world.
    """
    n, whole = num_envs, torch.int64
    leaves = {
        keys.JOINT_POS: Unbounded(Size((n, 2, joints))),
        keys.JOINT_VEL: Unbounded(Size((n, 2, joints))),
        keys.JOINT_TARGET: Unbounded(Size((n, 2, joints))),
        keys.OBJECT_POSE: Unbounded(Size((n, slots, 7))),
        keys.OBJECT_VEL: Unbounded(Size((n, slots, 6))),
        keys.CONTACT: Unbounded(Size((n, 2, links, CODE_WIDTH)), dtype=torch.int8),
        keys.MOTION: Unbounded(Size((n, 1)), dtype=whole),
        keys.FRAME: Unbounded(Size((n, 1)), dtype=whole),
        keys.ATTEMPT: Binary(1, Size((n, 1)), dtype=torch.bool),
    }
    return Composite(leaves, shape=(n,))


class TrackingEnv(EnvBase):
    """Batched, batch-locked, with partial resets; emits the compact state.

    Worlds ``0 .. num_attempts - 1`` always start at frame 0 without assist and without
    reset noise: their finished episodes are attempts. Actions are
    ``("left", "action")`` and ``("right", "action")`` in [-1, 1]; per hand are also
    ``reward``, ``failed`` and the raw ``reward_terms`` by name (0 after a reset);
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

    def __init__(
        self,
        physics: Physics,
        bank: ReferenceBank,
        hands: dict[keys.Side, HandSpec],
        config: EnvConfig,
        *,
        step_dt: float,
        seed: int = 0,
        evaluation: bool = False,
    ) -> None:
        n, device = physics.num_envs, physics.device
        super().__init__(device=device, batch_size=torch.Size([n]))
        self.physics, self.bank, self.hands, self.config = physics, bank, hands, config
        self.step_dt = step_dt
        # Looking at a flag is free on the cpu; a device would have to be waited for.
        self.is_host_device = device.type == "cpu"
        self.group_map, self.num_envs = {side: [side] for side in keys.SIDES}, n
        self.num_attempts = n if evaluation else round(config.attempt_share * n)
        self.attempt = torch.arange(n, device=device) < self.num_attempts
        self.kinematics = HandKinematics(hands).to(device)
        self.joint_range = stack_hands(hands, "joint_range").to(device)
        context = TermContext(
            *(bank, n, step_dt, self.joint_range),
            tip_radius=stack_hands(hands, "tip_radius").to(device),
        )
        self.terms = TermManager(
            context, config, self.kinematics, evaluation=evaluation
        )
        # Some five hundred small operations; compiled they are a few kernels.
        self._score: Callable[..., tuple[StepResult, Tensor]] = self.terms
        if config.compile:
            self._score = torch.compile(self.terms.__call__, fullgraph=True)
        self.sampler, self.attempt_sampler = (
            MotionSampler(
                bank.num_motions, converted_weight=SAMPLERS[name], device=device
            )
            for name in (config.sampler, "unconverted")
        )
        self._alpha = lowpass_alpha(config.wrist_lowpass_hz, step_dt)
        scale = [config.wrist_pos_scale] * 3 + [config.wrist_rot_scale] * 3
        self._wrist_scale = torch.tensor(scale, device=device)
        self.assist: AssistSchedule | None = None
        if config.assist is not None and config.assist.enabled and not evaluation:
            self.assist = AssistSchedule(config.assist)
        self._max_steps = round(config.max_seconds / step_dt)
        whole = {"dtype": torch.long, "device": device}
        self.motion = torch.zeros(n, **whole)
        self.frame = torch.ones(n, **whole)
        self.steps = torch.zeros(n, **whole)
        self.forced_motion: Tensor | None = None
        self.target_override: Callable[[TrackingEnv], Tensor] | None = None
        self._filter = torch.zeros(n, 2, 6, device=device)
        self._target = torch.zeros(n, 2, self.joint_range.shape[1], device=device)
        shape = (n, 2, hands["left"].num_links, CODE_WIDTH)
        self._contact = torch.zeros(shape, dtype=torch.int8, device=device)
        # Of the last step, by hand.
        names = len(self.terms.reward_names)
        self._reward_terms = torch.zeros(2, names, n, 1, device=device)
        self._failed = torch.zeros(n, 2, dtype=torch.bool, device=device)
        self._last_step: StepResult | None = None
        self._make_specs()
        self.generator = torch.Generator(device)
        self.set_seed(seed)
        self.redraw_assist()

    @property
    def max_episode_steps(self) -> int:
        """Steps of the longest episode."""
        return min(int(self.bank.length.max()) - 1, self._max_steps)

    def _make_specs(self) -> None:
        n, joints = self.num_envs, self.joint_range.shape[1]
        one = Size((n, 1))
        state = state_spec(n, joints, self.bank.num_slots, self.hands["left"].num_links)
        actions, rewards = Composite(shape=(n,)), Composite(shape=(n,))
        for side in keys.SIDES:
            actions[keys.action(side)] = Bounded(-1.0, 1.0, Size((n, joints)))
            rewards[keys.reward(side)] = Unbounded(one)
            state[keys.failed(side)] = Binary(1, one, dtype=torch.bool)
            for name in self.terms.reward_names:
                state[keys.reward_term(side, name)] = Unbounded(one)
        flags = {name: Binary(1, one, dtype=torch.bool) for name in FLAGS}
        self.observation_spec, self.action_spec = state, actions
        self.reward_spec = rewards
        self.full_done_spec = Composite(flags, shape=(n,))

    @property
    def last_step(self) -> StepResult:
        """What the last step was worth."""
        assert self._last_step is not None, "no step yet"
        return self._last_step

    def put_action(self, td: TensorDictBase, action: Tensor) -> None:
        """Write the actions of both hands, (N, 2, J), from any device into ``td``."""
        for i, side in enumerate(keys.SIDES):
            td.set(keys.action(side), action[:, i].to(self.device))

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(0 if seed is None else seed)

    def redraw_assist(self) -> None:
        """Draw each world's assist gains from the present level."""
        n = self.num_envs
        self.assist_kp = self.assist_kv = torch.zeros(n, device=self.device)
        if self.assist is not None and self.assist.active:
            kp, kv = self.assist.draw(n, self.generator)
            self.assist_kp = torch.where(self.attempt, 0.0, kp)
            self.assist_kv = torch.where(self.attempt, 0.0, kv)

    def _reset(
        self, tensordict: TensorDictBase | None = None, **kwargs: Any
    ) -> TensorDictBase:
        mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        asked = None if tensordict is None else tensordict.get("_reset", None)
        if asked is not None:
            mask = asked.reshape(self.num_envs)
        return self.reset_worlds(mask)

    def reset_worlds(self, mask: Tensor) -> TensorDict:
        """Begin new episodes in some worlds; what the coming step starts from.

        The same as ``reset`` of the worlds marked in ``_reset``, without the checks
        of TorchRL, which wait for the device.

        Args:
            mask: worlds to reset, (N,) bool.

        Returns:
            State and flags of all worlds, batch (N,).
        """
        with few_threads(self.num_envs):
            return self._reset_worlds(mask)

    def _reset_worlds(self, mask: Tensor) -> TensorDict:
        draw = self._draw()
        start = reset_state(draw, self.bank, self.joint_range)
        self.physics.reset(mask, draw.motion, **start)
        self.motion = torch.where(mask, draw.motion, self.motion)
        # The state of frame s is written; the next step is scored on s + 1.
        self.frame = torch.where(mask, draw.frame + 1, self.frame)
        self.steps = torch.where(mask, 0, self.steps)
        rows = mask[:, None, None]
        self._filter = torch.where(rows, 0.0, self._filter)
        self._target = torch.where(rows, start["joint_pos"], self._target)
        self.terms.reset(mask)
        state = self.physics.state()
        self._contact = self._contact.clone()
        ids = mask.nonzero().squeeze(-1) if self.is_host_device else slice(None)
        kin = self.kinematics(state[keys.JOINT_POS][ids], None)
        code = contact_code(state[keys.CONTACT][ids], kin)
        if not self.is_host_device:
            code = torch.where(rows.unsqueeze(-1), code, self._contact)
        self._contact[ids] = code
        self._failed = self._failed & ~mask.unsqueeze(-1)
        self._reward_terms = torch.where(mask[:, None], 0.0, self._reward_terms)
        out = self._observation(state)
        for name in FLAGS:
            out[name] = torch.zeros_like(mask).unsqueeze(-1)
        return out

    def _draw(self) -> ResetDraw:
        motion = self.forced_motion
        if motion is None:
            free = self.sampler.sample(self.num_envs, self.generator)
            tried = self.attempt_sampler.sample(self.num_envs, self.generator)
            motion = torch.where(self.attempt, tried, free)
        every = torch.ones_like(self.attempt)
        return draw_reset(
            motion,
            self.attempt if self.config.rsi else every,
            self.attempt,
            self.bank.length[motion],
            self.config.reset_noise,
            self.joint_range,
            self.generator,
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        with few_threads(self.num_envs):
            return self._step_worlds(tensordict)

    def _step_worlds(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = torch.stack([tensordict[keys.action(s)] for s in keys.SIDES], 1)
        action = torch.nan_to_num(action).clamp(-1.0, 1.0)
        ref = self.bank.at(self.motion, self.frame)
        self._act(action, ref)
        state = self.physics.state()
        self.steps = self.steps + 1
        scored = self.frame
        result, self._contact = self._score(
            state,
            ref,
            action=action,
            target=self._target,
            motion=self.motion,
            frame=scored,
            steps=self.steps,
        )
        self._last_step, self._failed = result, result.failed
        terms = torch.stack(list(result.reward_terms.values()))
        self._reward_terms = terms.permute(2, 0, 1).unsqueeze(-1)
        terminated = result.failed.any(-1, keepdim=True)
        ended = scored >= self.bank.length[self.motion] - 1
        truncated = (ended | (self.steps >= self._max_steps)).unsqueeze(-1)
        self.frame = scored + 1
        out = self._observation(state)
        for i, side in enumerate(keys.SIDES):
            out[keys.reward(side)] = result.reward[:, i : i + 1]
        out[keys.TERMINATED] = terminated
        out[keys.TRUNCATED] = truncated & ~terminated
        out[keys.DONE] = terminated | truncated
        return out

    def _act(self, action: Tensor, ref: TensorDictBase) -> None:
        fresh = self.steps == 0
        self._filter = lowpass(self._filter, action[..., :6], fresh, alpha=self._alpha)
        residual = self.config.finger_mode == "residual"
        self._target = joint_target(
            self._filter,
            action[..., 6:],
            ref["joint_target"],
            self.joint_range,
            wrist_scale=self._wrist_scale,
            finger_scale=self.config.finger_scale if residual else None,
        )
        if self.target_override is not None:
            self._target = self.target_override(self)
        self.physics.step(self._target, self._wrench(ref))

    def _wrench(self, ref: TensorDictBase) -> ObjectWrench | None:
        """What acts on the objects besides contact and gravity; None is nothing."""
        assist = self.assist if self.assist is not None and self.assist.active else None
        steps = self.config.reset_hold_s / self.step_dt
        hold = hold_share(self.steps, ~self.attempt, steps)
        holds = steps > 0 and (not self.is_host_device or bool(hold.any()))
        if assist is None and not holds:
            return None
        rows = self.bank.object_index[self.motion]
        limits = self.config.assist or AssistConfig()
        return ObjectWrench(
            ref_pose=torch.cat([ref["object_pos"], ref["object_quat"]], -1),
            ref_vel=torch.cat([ref["object_linvel"], ref["object_angvel"]], -1),
            mass=self.bank.mass[rows.clamp_min(0)],
            inertia=self.bank.inertia[rows.clamp_min(0)],
            present=rows >= 0,
            hold=hold,
            kp=self.assist_kp,
            kv=self.assist_kv,
            hold_stiffness=self.config.reset_hold_stiffness,
            torque_ratio=limits.torque_ratio,
            force_limit=limits.force_limit,
            torque_limit=limits.torque_limit,
            assists=assist is not None,
        )

    def _observation(self, state: TensorDictBase) -> TensorDict:
        out: dict[str, Any] = {
            keys.JOINT_POS: state[keys.JOINT_POS],
            keys.JOINT_VEL: state[keys.JOINT_VEL],
            keys.JOINT_TARGET: self._target,
            keys.OBJECT_POSE: state[keys.OBJECT_POSE],
            keys.OBJECT_VEL: state[keys.OBJECT_VEL],
            keys.CONTACT: self._contact,
            keys.MOTION: self.motion.unsqueeze(-1),
            keys.FRAME: self.frame.unsqueeze(-1),
            keys.ATTEMPT: self.attempt.unsqueeze(-1),
        }
        for i, side in enumerate(keys.SIDES):
            terms = self._reward_terms[i].unbind(0)
            out[side] = {
                keys.FAILED: self._failed[:, i : i + 1],
                keys.REWARD_TERMS: dict(
                    zip(self.terms.reward_names, terms, strict=True)
                ),
            }
        return TensorDict(out, batch_size=self.batch_size)
