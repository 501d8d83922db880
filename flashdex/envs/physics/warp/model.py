"""The model and data of the warp engine: rows a world, and room for contacts."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import torch
from torch import Tensor

from flashdex.envs.scene.union import SceneUnion
from flashdex.errors import FlashdexError, MissingExtraError

if TYPE_CHECKING:
    from flashdex.envs.physics.config import PhysicsConfig

# Only read by sleeping, which no scene uses.
_UNREAD = {"dof_length"}


def require_warp() -> tuple[Any, Any]:
    """Import ``warp`` and ``mujoco_warp``.

    Raises:
        MissingExtraError: one of them is not installed.
    """
    try:
        import warp as wp

        # Else it prints a line a kernel; set before mujoco_warp starts it.
        wp.config.log_level = wp.LOG_WARNING
        import mujoco_warp as mjw
    except ModuleNotFoundError as error:
        raise MissingExtraError(str(error.name), extra="warp") from None
    wp.init()
    return wp, mjw


def warp_device() -> torch.device:
    """The CUDA device that torch uses, without one the CPU.

    Raises:
        MissingExtraError: warp is not installed.
    """
    require_warp()
    if not torch.cuda.is_available():
        return torch.device("cpu")
    return torch.device("cuda", torch.cuda.current_device())


def model_fields() -> dict[str, bool]:
    """Names of the model's arrays that mujoco_warp reads, and whether per world."""
    mjw = require_warp()[1]
    out = {}
    for field in dataclasses.fields(mjw.Model):
        shape = getattr(field.type, "shape", ())
        if shape and field.name not in _UNREAD:
            out[field.name] = shape[0] == "*"
    return out


class WorldRows:
    """The rows of the model that each world has of its own."""

    def __init__(
        self, union: SceneUnion, num_envs: int, room: Room, device: str
    ) -> None:
        wp, mjw = require_warp()
        _refuse_shared(union)
        host = union.model
        # mujoco_warp never resets a world that diverges, and has no such flag.
        host.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        # Mesh id -1 counts as absent only where there are two rows or more.
        sizes = {name: max(num_envs, 2) for name in union.rows}
        with wp.ScopedDevice(device):
            self.model = mjw.put_model(host, batch_sizes=sizes)
            self.data = mjw.make_data(
                host,
                nworld=num_envs,
                nconmax=room.contacts,
                nccdmax=room.convex,
                njmax=room.rows,
            )
            # Overflows are reported by take_overflow instead.
            self.model.opt.warn_overflow = 0
        # Once: from here on torch reads and writes these arrays on its own stream.
        wp.synchronize_device(device)
        self._views: list[tuple[Tensor, Tensor]] = []
        where = torch.device(wp.device_to_torch(device))
        for name, rows in union.rows.items():
            view = wp.to_torch(getattr(self.model, name))[:num_envs]
            table = torch.as_tensor(rows).to(where, view.dtype)
            self._views.append((view, table.reshape(len(rows), *view.shape[1:])))
        self._static = _static_geoms(host)
        self._geom_xpos = wp.to_torch(self.data.geom_xpos)
        self._geom_pos = wp.to_torch(self.model.geom_pos)[:num_envs]

    def write(self, mask: Tensor, motion: Tensor) -> None:
        """Give the worlds of ``mask`` (N,) the rows of their motions, (N,)."""
        for view, table in self._views:
            chosen = mask.reshape(-1, *[1] * (view.ndim - 1))
            view.copy_(torch.where(chosen, table[motion], view))
        # The engine computes the poses of fixed geoms only once, for one model.
        self._geom_xpos[:, self._static] = self._geom_pos[:, self._static]


def _static_geoms(model: mujoco.MjModel) -> slice:
    """Geoms of the world body, which come first."""
    return slice(0, int((model.geom_bodyid == 0).sum()))


def _refuse_shared(union: SceneUnion) -> None:
    per_world = model_fields()
    shared = [name for name in union.rows if not per_world[name]]
    static = _static_geoms(union.model)
    if "geom_quat" in union.rows:
        rows = union.rows["geom_quat"][:, static]
        if (rows != rows[:1]).any():
            shared.append("geom_quat of supports")
    if shared:
        raise FlashdexError(
            f"physics.engine=warp: {', '.join(shared)} differ between the motions of "
            "this collection, but warp worlds share them. Use physics.engine=cpu."
        )


@dataclass(frozen=True)
class Room:
    """Buffer sizes of one world; contacts are a pool that all worlds share."""

    contacts: int  # contact points, and pairs that the broad phase finds
    convex: int  # pairs of one kind that need the general convex collider
    rows: int  # constraint rows, of which each world has its own


def room_of(model: mujoco.MjModel, physics: PhysicsConfig) -> Room:
    """Room for four contacts of each geom that moves, and for all joint limits.

    Pairs that could touch are far more (1,657 for two hands and two objects of 16
    parts), but few do at a time. Half as many pairs need the convex collider, whose
    scratch memory is the largest of all buffers.
    """
    body = model.geom_bodyid
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    moving = int(((body > 0) & solid).sum())
    contacts = physics.nconmax or 4 * moving
    dims = int(model.geom_condim.max())
    limits = int(model.jnt_limited.sum() + (model.dof_frictionloss > 0).sum())
    rows = physics.njmax or 4 * moving * dims + limits
    return Room(contacts, max(contacts // 2, 1), rows)
