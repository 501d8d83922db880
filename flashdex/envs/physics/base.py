"""What the environment asks of a physics engine."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from tensordict import TensorDict
from torch import Tensor

WrenchFn = Callable[[Tensor, Tensor], Tensor]
"""Object pose (N, O, 7) and velocity (N, O, 6) to a wrench (N, O, 6), world axes."""


class Physics(Protocol):
    """N worlds, each with the hands, objects and supports of its own motion.

    States are exchanged in the layout of ``flashdex.keys``: both hands and all
    object slots are always present; what a world lacks is zero (identity pose).
    """

    num_envs: int

    def reset(
        self,
        env_ids: Tensor,
        motion: Tensor,
        joint_pos: Tensor,
        joint_vel: Tensor,
        object_pose: Tensor,
        object_vel: Tensor,
    ) -> None:
        """Put worlds ``env_ids`` (n,) into the given states of their motions (n,).

        Args:
            env_ids: sorted world indices, (n,).
            motion: motion rows, (n,).
            joint_pos: (n, 2, J) m and rad.
            joint_vel: (n, 2, J).
            object_pose: (n, O, 7), world.
            object_vel: (n, O, 6), linear and angular, world.
        """
        ...

    def step(self, target: Tensor, wrench: WrenchFn | None = None) -> None:
        """Advance one control step (``decimation`` substeps).

        Args:
            target: joint position targets, (N, 2, J).
            wrench: applied to the objects before every substep; None applies none.
        """
        ...

    def state(self) -> TensorDict:
        """Current joint_pos, joint_vel, object_pose, object_vel, contact, bad.

        ``contact`` holds the net force and point of each link in world axes,
        (N, 2, L, 6), of the last substep; ``bad`` marks worlds whose numbers broke
        down since the last reset, (N,).
        """
        ...
