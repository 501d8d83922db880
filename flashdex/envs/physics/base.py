"""What the environment asks of a physics engine."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict
from torch import Tensor

from flashdex import keys
from flashdex.envs.physics.state_map import StateMap
from flashdex.envs.scene.scene import Scene, build_scenes
from flashdex.envs.scene.wrench import ObjectWrench
from flashdex.hands.spec import HandSpec
from flashdex.motions.library import MotionLibrary

if TYPE_CHECKING:
    from flashdex.envs.physics.config import PhysicsConfig


@dataclass(frozen=True)
class RawState:
    """What a rollout stores of the worlds, in the engine's own precision.

    The tensors may be views of the engine's memory: clone what is kept.
    """

    qpos: Tensor  # (N, nq), MuJoCo's layout of ``scenes``
    qvel: Tensor  # (N, nv)
    ctrl: Tensor  # (N, nu)
    # force and torque on each object slot in the last substep, world axes, (N, O, 6)
    wrench: Tensor


class Physics(ABC):
    """N worlds, each with the hands, objects and supports of its own motion.

    States are exchanged in the layout of ``flashdex.keys``: both hands and all
    object slots are always present; what a world lacks is zero (identity pose). All
    tensors are float32 on ``device``, and no call waits for the device.
    """

    def __init__(
        self,
        library: MotionLibrary,  # one scene is compiled for each of its motions
        hands: dict[keys.Side, HandSpec],
        physics: PhysicsConfig,
        num_envs: int,
        device: torch.device,  # where states live
        scenes: list[Scene] | None = None,  # of ``build_scenes``, where they are built
    ) -> None:
        self.num_envs, self.device = num_envs, device
        self.decimation = physics.decimation  # substeps of a control step
        self.step_dt = physics.timestep * physics.decimation  # control step, s
        # of each motion, of one layout
        self.scenes = scenes or build_scenes(library, hands, physics)
        self.map = StateMap(library, hands, self.scenes[0]).to(device)
        self._motion = torch.zeros(num_envs, dtype=torch.long, device=device)

    def reset(
        self,
        mask: Tensor,  # worlds to reset, (N,) bool
        motion: Tensor,  # motion rows, (N,)
        joint_pos: Tensor,  # (N, 2, J) m and rad
        joint_vel: Tensor,  # (N, 2, J)
        object_pose: Tensor,  # (N, O, 7), world
        object_vel: Tensor,  # (N, O, 6), linear and angular, world
    ) -> None:
        """Put the worlds of ``mask`` into the given states of their motions.

        All arguments have a row a world; the rows of other worlds are ignored.
        """
        self._motion.copy_(torch.where(mask, motion, self._motion))
        self._place(mask, joint_pos, joint_vel, object_pose, object_vel)

    @abstractmethod
    def _place(self, mask: Tensor, *state: Tensor) -> None:
        """Write the states of ``reset``; ``_motion`` is up to date."""

    @abstractmethod
    def step(self, target: Tensor, wrench: ObjectWrench | None = None) -> None:
        """Advance one control step (``decimation`` substeps).

        Args:
            target: joint position targets, (N, 2, J).
            wrench: acts on the objects, evaluated before every substep; None is none.
        """

    @abstractmethod
    def state(self) -> TensorDict:
        """Current joint_pos, joint_vel, object_pose, object_vel, contact, bad.

        ``contact`` holds the net force of the hand's object on each link and its
        point, world axes, (N, 2, L, 6), of the last substep; ``bad`` marks worlds whose
        numbers broke down since the last reset, (N,).
        """

    @abstractmethod
    def raw(self) -> RawState:
        """Current state as rollouts store it."""

    @abstractmethod
    def take_overflow(self) -> dict[str, int]:
        """Worlds that ran out of room since the last call, by kind; waits for them.

        What does not fit is dropped by the engine, so their physics is wrong: contacts
        or constraints are missing. Empty where nothing overflowed.
        """

    def _state(
        self, qpos: Tensor, qvel: Tensor, contact: Tensor, bad: Tensor
    ) -> TensorDict:
        """``Physics.state`` of flat states and the contact of hands that exist."""
        pos, vel, pose, object_vel = self.map.read(qpos, qvel, self._motion)
        out = {
            keys.JOINT_POS: pos,
            keys.JOINT_VEL: vel,
            keys.OBJECT_POSE: pose,
            keys.OBJECT_VEL: object_vel,
            keys.CONTACT: self.map.read_contact(contact, self._motion),
            "bad": bad,
        }
        return TensorDict(out, batch_size=[self.num_envs])
