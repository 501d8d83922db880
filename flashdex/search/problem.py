"""One motion as a problem of optimisation: scene, first state, actions, costs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flashdex import keys
from flashdex.envs.config import EnvConfig
from flashdex.envs.mdp.actions import joint_target
from flashdex.envs.mdp.resets import first_state
from flashdex.envs.physics.state_map import StateMap
from flashdex.envs.reference import ReferenceBank, stack_hands
from flashdex.envs.scene.perturbation import (
    PERTURBATION,
    control_range,
    worst_case,
)
from flashdex.envs.scene.scene import Scene
from flashdex.hands.gains import NUM_WRIST_JOINTS
from flashdex.hands.spec import HandSpec
from flashdex.search.simulate import FULL, MujocoC, Simulator, Worlds

TOUCH = 0.01  # m; nearer than this a recorded fingertip belongs on the object
_DRAWS = 9173  # of the perturbed worlds; the certificate draws others

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Trial:
    """What N sequences of H actions led to in K worlds."""

    object_pos: Array  # of each object, m, (N, K, H, O, 3)
    object_quat: Array  # (N, K, H, O, 4)
    tips: Array  # in the frame of each hand's object, m, (N, K, H, A, 5, 3)
    states: Array  # after each control step, (N, K, H, .)


class Problem:
    """One motion in its own scene.

    ``A`` hands take part, ``O`` objects are there, the motion has ``S`` control steps.
    Planning drops the contact sensors, which cost and change nothing.

    Args:
        bank: reference frames on the CPU, with the targets that actions are added to.
        hands: specs by side.
        states: map of the scene's states.
        scene: of the motion.
        row: of the motion.
        env: scales of the actions, which are residuals; the wrist's not filtered.
        decimation: physics steps a control step.
        simulator: tries samples; None is MuJoCo C.
    """

    def __init__(
        self,
        bank: ReferenceBank,
        hands: dict[keys.Side, HandSpec],
        states: StateMap,
        scene: Scene,
        row: int,
        *,
        env: EnvConfig,
        decimation: int,
        simulator: Simulator | None = None,
    ) -> None:
        self.hands, self.scene, self.row = hands, scene, row
        self._map, self._env, self._decimation = states, env, decimation
        longest = round(env.max_seconds * bank.fps)
        self.steps = min(int(bank.length[row]) - 1, longest)
        active = bank.hand_active[row].tolist()
        self.is_active: list[bool] = active
        self.active = [i for i in range(2) if active[i]]
        self.num_joints = bank.num_joints
        rows = torch.full((self.steps,), row)
        ref: Any = bank.at(rows, torch.arange(self.steps) + 1)
        self._target: Tensor = ref["joint_target"]  # (S, 2, J)
        self._range = stack_hands(hands, "joint_range")
        self.slots = [s for s, q in enumerate(bank.object_index[row]) if q >= 0]
        self.ref_pos: Array = ref["object_pos"][:, self.slots].double().numpy()
        self.ref_quat: Array = ref["object_quat"][:, self.slots].double().numpy()
        self.adr = np.array([scene.object_qpos(s) for s in self.slots], dtype=int)
        own = bank.has_object[row].tolist()
        self._own = [int(bank.hand_slot[row, i]) if own[i] else -1 for i in self.active]
        near = ref["tip_dist"][:, self.active].numpy() < TOUCH
        self.touch = near * np.array([s >= 0 for s in self._own])[:, None]
        start = first_state(bank, row, self._range)
        qpos, qvel, _ = states.write(rows[:1], **start)
        self.qpos0, self.qvel0 = qpos[0].numpy(), qvel[0].numpy()
        self.model = self._planning_model()
        self._truth = MujocoC(self.model, decimation)
        self._simulator = simulator or self._truth
        self.ref_tips = self._reference_tips(ref["joint_pos"])
        self.simulated = 0  # control steps so far
        self._worlds: dict[int, Worlds] = {}  # by their number

    def _planning_model(self) -> mujoco.MjModel:
        spec = mujoco.MjSpec.from_string(self.scene.xml)
        for sensor in list(spec.sensors):
            spec.delete(sensor)
        for hand, slot in zip(self.active, self._own, strict=True):
            for finger in keys.FINGERS if slot >= 0 else ():
                spec.add_sensor(
                    name=f"{hand}_{finger}",
                    type=mujoco.mjtSensor.mjSENS_FRAMEPOS,
                    objtype=mujoco.mjtObj.mjOBJ_SITE,
                    objname=f"{keys.SIDES[hand]}_pad_{finger}",
                    reftype=mujoco.mjtObj.mjOBJ_XBODY,
                    refname=f"object{slot}",
                )
        return spec.compile()

    def _tips(self, sensors: Array) -> Array:
        """Fingertips of the sensors' values (..., 15 a hand with an object)."""
        out = np.zeros((*sensors.shape[:-1], len(self.active), 5, 3))
        there = [i for i, slot in enumerate(self._own) if slot >= 0]
        out[..., there, :, :] = sensors.reshape(*sensors.shape[:-1], len(there), 5, 3)
        return out

    def _reference_tips(self, joints: Tensor) -> Array:
        """Fingertips of the reference joints in the objects' frames, (S, A, 5, 3)."""
        data, out = mujoco.MjData(self.model), []
        adr = [self.scene.joint_qpos(keys.SIDES[i]) for i in self.active]
        data.qpos[:] = self.qpos0
        for t in range(self.steps):
            for hand, at in zip(self.active, adr, strict=True):
                data.qpos[at] = joints[t, hand].numpy()
            for slot, at in enumerate(self.adr):
                data.qpos[at : at + 3] = self.ref_pos[t, slot]
                data.qpos[at + 3 : at + 7] = self.ref_quat[t, slot]
            mujoco.mj_forward(self.model, data)
            out.append(data.sensordata.copy())
        return self._tips(np.array(out))

    def spread(self, residual: Array) -> NDArray[np.float32]:
        """Actions of both hands (..., 2, J) of those that take part, (..., A, J)."""
        out = np.zeros((*residual.shape[:-2], 2, self.num_joints), np.float32)
        out[..., self.active, :] = residual
        return out

    @property
    def _scale(self) -> Tensor:
        """Size of each action, m or rad, (J,)."""
        env = self._env
        wrist = [env.wrist_pos_scale] * 3 + [env.wrist_rot_scale] * 3
        fingers = [env.finger_scale] * (self.num_joints - len(wrist))
        return torch.tensor(wrist + fingers)

    def residuals(self, ctrl: Array) -> NDArray[np.float32]:
        """Actions (T, 2, J) whose controls come nearest to any (T, nu), T <= S.

        Of an attempt in any other space of actions, with a filter or another
        feed-forward: what counts is the joint targets that it came to.
        """
        target = self._map.targets(torch.from_numpy(ctrl))
        found = (target - self._target[: len(ctrl)]) / self._scale
        return self.spread(found.clamp(-1, 1).numpy()[:, self.active])

    def controls(self, actions: NDArray[np.float32], first: int) -> Array:
        """Controls (N, H, nu) of actions (N, H, 2, J) from step ``first`` on."""
        n, steps = actions.shape[:2]
        flat = torch.from_numpy(actions).reshape(n * steps, 2, -1)
        ref = self._target[first : first + steps].repeat(n, 1, 1)
        scale = self._scale
        target = joint_target(
            flat[..., :6],
            flat[..., 6:],
            ref,
            self._range,
            wrist_scale=scale[:NUM_WRIST_JOINTS],
            finger_scale=self._env.finger_scale,
        )
        rows = torch.full((n * steps,), self.row)
        return self._map.controls(rows, target).numpy().reshape(n, steps, -1)

    def _full_state(self, model: mujoco.MjModel, qpos: Array) -> Array:
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos, self.qvel0
        state = np.empty(mujoco.mj_stateSize(model, FULL))
        mujoco.mj_getState(model, data, state, FULL)
        return state

    @cached_property
    def _bodies(self) -> Array:
        return np.array([self.model.body(f"object{s}").id for s in self.slots], int)

    def worlds(self, count: int) -> Worlds:
        """The nominal world and ``count - 1`` perturbed ones, always the same."""
        if count not in self._worlds:  # what plays them may keep them on its device
            self._worlds[count] = self._make_worlds(count)
        return self._worlds[count]

    def _make_worlds(self, count: int) -> Worlds:
        models, states = [self.model], [self._full_state(self.model, self.qpos0)]
        noise = np.zeros((count, self.steps, self.model.nu))
        for k in range(1, count):
            rng = np.random.default_rng([_DRAWS, k])
            model, qpos = worst_case(
                self.model, self.qpos0, self._bodies, self.adr, k - 1, seed=_DRAWS
            )
            width = control_range(model, self.controls(self._still(), 0)[0])
            noise[k] = rng.normal(size=noise[k].shape) * PERTURBATION.ctrl_noise * width
            models.append(model)
            states.append(self._full_state(model, qpos))
        return Worlds(models, np.stack(states), noise)

    def _still(self) -> NDArray[np.float32]:
        return np.zeros((1, self.steps, 2, self.num_joints), np.float32)

    def simulate(
        self, worlds: Worlds, actions: NDArray[np.float32], first: int = 0
    ) -> Trial:
        """Try actions (N, H, 2, J) in all worlds, from their states at ``first`` on.

        A single sequence is not tried but carried out: MuJoCo C plays it in any case.
        """
        ctrl = self.controls(actions, first)
        play = self._truth if len(actions) == 1 else self._simulator
        states, sensors = play(worlds, ctrl, first)
        self.simulated += states[..., 0].size
        return self.trial(states, sensors)

    def trial(self, states: Array, sensors: Array) -> Trial:
        """What a simulator found, (N, K, H, .) each, as objects and fingertips."""
        columns = 1 + self.adr[:, None] + np.arange(7)  # time stands first
        pose = states[..., columns]
        return Trial(pose[..., :3], pose[..., 3:], self._tips(sensors), states)

    def play(self, actions: NDArray[np.float32]) -> dict[str, NDArray[Any]]:
        """What actions (S, 2, J) lead to in the untouched scene, step by step.

        Returns:
            Of each control step: qpos, qvel, ctrl, wrench and action after it.
        """
        model = self.scene.model
        data, ctrl = mujoco.MjData(model), self.controls(actions[None], 0)[0]
        data.qpos[:], data.qvel[:] = self.qpos0, self.qvel0
        qpos = np.empty((len(ctrl), model.nq))
        qvel = np.empty((len(ctrl), model.nv))
        for t, row in enumerate(ctrl):
            data.ctrl[:] = row
            mujoco.mj_step(model, data, nstep=self._decimation)
            qpos[t], qvel[t] = data.qpos, data.qvel
        wrench = np.zeros((len(ctrl), self._map.num_slots, 6))
        return {
            **{"qpos": qpos, "qvel": qvel, "ctrl": ctrl, "wrench": wrench},
            "action": actions,
        }
