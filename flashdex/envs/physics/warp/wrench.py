"""The wrench on objects: a kernel before every substep, on tensors that stay put."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from flashdex.envs.physics.warp.model import require_warp
from flashdex.envs.scene.wrench import LIMITS, ObjectWrench

if TYPE_CHECKING:
    import mujoco

    from flashdex.envs.physics.state_map import StateMap

_TENSORS = ("ref_pose", "ref_vel", "mass", "inertia", "present", "hold", "kp", "kv")


class WrenchInput:
    """Copies of an ``ObjectWrench`` at fixed addresses; a kernel reads them."""

    def __init__(
        self, data: Any, model: mujoco.MjModel, state_map: StateMap, num_envs: int
    ) -> None:
        wp = require_warp()[0]
        device = state_map.parked.device
        slots, used = state_map.num_slots, state_map.num_used
        shapes = {
            "ref_pose": (slots, 7),
            "ref_vel": (slots, 6),
            "mass": (slots,),
            "inertia": (slots, 3, 3),
            "present": (slots,),
        }
        self._copies: dict[str, Tensor] = {}
        for name in _TENSORS:
            kind = torch.bool if name == "present" else torch.float32
            shape = (num_envs, *shapes.get(name, ()))
            self._copies[name] = torch.zeros(shape, dtype=kind, device=device)
        self._params = torch.zeros(len(LIMITS), device=device)
        self._values: list[float] = [0.0] * len(LIMITS)
        self.applied = torch.zeros(num_envs, slots, 6, device=device)
        bodies = [model.body(f"object{s}").id for s in range(used)]
        places = [
            state_map.qpos_of_object[:, 0],
            state_map.dof_of_object[:, 0],
            torch.tensor(bodies, device=device),
        ]
        self._dim = (num_envs, used)
        self._places = [wp.from_torch(p.int().contiguous()) for p in places]
        from flashdex.envs.physics.warp.kernels import vec7

        kinds = {"ref_pose": vec7, "ref_vel": wp.spatial_vector, "inertia": wp.mat33}
        inputs = [
            wp.from_torch(tensor, dtype=kinds.get(name))
            for name, tensor in self._copies.items()
        ]
        inputs.append(wp.from_torch(self._params))
        self._inputs = [data.qpos, data.qvel, *self._places, *inputs]
        self._outputs = [
            data.xfrc_applied,
            wp.from_torch(self.applied, wp.spatial_vector),
        ]

    def copy(self, wrench: ObjectWrench) -> None:
        """Take over the numbers of a control step."""
        for name, copy in self._copies.items():
            copy.copy_(getattr(wrench, name))
        for i, name in enumerate(LIMITS):
            value = getattr(wrench, name)
            if value != self._values[i]:
                self._params[i].fill_(value)
                self._values[i] = value

    def launch(self) -> None:
        """Write the wrench at the present object states into ``xfrc_applied``."""
        wp = require_warp()[0]
        from flashdex.envs.physics.warp.kernels import apply_wrench

        wp.launch(
            apply_wrench,
            dim=self._dim,
            inputs=self._inputs,
            outputs=self._outputs,
            device=self._inputs[0].device,
        )
