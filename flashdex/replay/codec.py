"""Packed replay rows: compact state as residuals to the reference, in half precision.

A row holds both ends of an n-step window. Positions are stored as differences to the
reference frame, which keeps them small: at 0.25 m a float16 step is 0.12 mm. Two XHands
with two objects take under 1 kB a row.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.envs.reference import ReferenceBank

_MAX_SPEED = 1000.0  # m/s or rad/s; beyond it the episode has ended as insane anyway


class RowCodec:
    """Packs n-step rows as residuals to the reference, and unpacks replay samples.

    Floats are stored as float16 if ``half``, as float32 otherwise.
    """

    def __init__(self, bank: ReferenceBank, *, half: bool = True) -> None:
        self.bank = bank
        self.dtype = torch.float16 if half else torch.float32
        joints, slots = bank.num_joints, bank.num_slots
        self._widths = [2 * joints] * 3 + [slots * 7, slots * 6]

    def pack(self, row: TensorDictBase) -> TensorDict:
        """Pack N rows of ``NStepAssembler``: (N,) of few wide leaves."""
        state, after = row.get("state"), row.get("next_state")
        packed = {
            "state": self._pack_state(state),
            "next_state": self._pack_state(after),
            "contact": state[keys.CONTACT].flatten(1),
            "next_contact": after[keys.CONTACT].flatten(1),
            "action": row.get("action").flatten(1).to(self.dtype),
            "reward": row["reward"],
            "flags": torch.cat([row["terminated"], row["steps"]], -1).to(torch.uint8),
            "index": torch.cat([state[keys.MOTION], state[keys.FRAME]], -1).int(),
        }
        return TensorDict(packed, batch_size=row.batch_size)

    def unpack(self, row: TensorDictBase) -> tuple[TensorDict, TensorDict]:
        """Unpack B sampled rows.

        Returns:
            Compact states, (2B,): first all at t, then all at the window's end; and the
            transition: action (B, 2 J), reward (B, 2), terminated (B, 1), steps (B, 1).
        """
        motion, frame = row["index"].long().split(1, -1)
        terminated, steps = row["flags"].split(1, -1)
        # One env step is one reference frame, so the window's end needs no column.
        frames = torch.cat([frame, frame + steps.long()])
        motions = torch.cat([motion, motion])
        packed = torch.cat([row["state"], row["next_state"]]).float()
        code = torch.cat([row["contact"], row["next_contact"]])
        state = self._unpack_state(packed, motions, frames)
        state[keys.CONTACT] = code.unflatten(-1, (2, -1, 7))
        transition = TensorDict(
            {
                keys.ACTION: row["action"].float(),
                keys.REWARD: row["reward"],
                keys.TERMINATED: terminated.bool(),
                keys.STEPS: steps.long(),
            },
            batch_size=row.batch_size,
        )
        return state, transition

    def _reference(self, motion: Tensor, frame: Tensor) -> tuple[Tensor, Tensor]:
        ref = self.bank.at(
            motion.squeeze(-1), frame.squeeze(-1), ("joint_pos", "object_pos")
        )
        return ref["joint_pos"], ref["object_pos"]

    def _pack_state(self, state: TensorDictBase) -> Tensor:
        joints, objects = self._reference(state[keys.MOTION], state[keys.FRAME])
        pose = state[keys.OBJECT_POSE].clone()
        pose[..., :3] -= objects
        parts = [
            state[keys.JOINT_POS] - joints,
            state[keys.JOINT_TARGET] - joints,
            state[keys.JOINT_VEL].clamp(-_MAX_SPEED, _MAX_SPEED),
            pose,
            state[keys.OBJECT_VEL].clamp(-_MAX_SPEED, _MAX_SPEED),
        ]
        flat = torch.cat([p.flatten(1) for p in parts], -1)
        return torch.nan_to_num(flat).to(self.dtype)

    def _unpack_state(
        self, packed: Tensor, motion: Tensor, frame: Tensor
    ) -> TensorDict:
        joints, objects = self._reference(motion, frame)
        pos, target, vel, pose, object_vel = packed.split(self._widths, -1)
        pose = pose.unflatten(-1, (-1, 7))
        quat = torch.nn.functional.normalize(pose[..., 3:], dim=-1)
        state = {
            keys.JOINT_POS: pos.unflatten(-1, (2, -1)) + joints,
            keys.JOINT_TARGET: target.unflatten(-1, (2, -1)) + joints,
            keys.JOINT_VEL: vel.unflatten(-1, (2, -1)),
            keys.OBJECT_POSE: torch.cat([pose[..., :3] + objects, quat], -1),
            keys.OBJECT_VEL: object_vel.unflatten(-1, (-1, 6)),
            keys.MOTION: motion,
            keys.FRAME: frame,
        }
        return TensorDict(state, batch_size=[len(packed)])


def row_bytes(packed: TensorDictBase) -> int:
    """Bytes of one packed row."""
    return sum(v[0].numel() * v.element_size() for v in packed.values(True, True))


class RowPatch:
    """Puts copies of sound rows in the place of bad ones, and counts those.

    As many rows leave as come in, so the host need not know how many are bad: asking
    the device would stall it at every vector step. A bad row becomes a copy of the
    nearest sound row before it, else of the first sound one; where a whole step is bad,
    of a sound row of an earlier step. Before there is any, it is a blank row, 0 in all
    leaves but 1 in ``ones``.

    Example:
        >>> patch = RowPatch(torch.device("cpu"))
        >>> rows = TensorDict({"x": torch.tensor([[1.0], [float("nan")], [3.0]])}, [3])
        >>> patch(rows, torch.tensor([True, False, True]))["x"].flatten().tolist()
        [1.0, 1.0, 3.0]
        >>> patch.count
        1
    """

    def __init__(self, device: torch.device, *, ones: Collection[str] = ()) -> None:
        self.ones = ones
        self._bad = torch.zeros((), dtype=torch.int64, device=device)
        self._spare: dict[str, Tensor] | None = None  # (1, ...) each

    @property
    def count(self) -> int:
        """Bad rows so far; waits for the device."""
        return int(self._bad)

    @count.setter
    def count(self, value: int) -> None:
        self._bad.fill_(value)

    def __call__(self, rows: TensorDict, good: Tensor) -> TensorDict:
        """Sound rows (N,), copies, for those of one step, sound where ``good``."""
        size = len(good)
        self._bad += (~good).sum()
        own = torch.arange(size, device=good.device)
        before = torch.where(good, own, -1).cummax(0).values
        # the last row is the spare one, for a step without any sound row
        first = torch.where(good, own, size).amin()
        donor = torch.where(before < 0, first, before)
        leaves: dict[str, Any] = dict(rows.items())
        spare = self._spare or self._blank(leaves)
        patched = {
            key: torch.cat([leaf, spare[key]]).index_select(0, donor)
            for key, leaf in leaves.items()
        }
        self._spare = {key: leaf[-1:].clone() for key, leaf in patched.items()}
        return TensorDict(patched, batch_size=[size])

    def _blank(self, leaves: dict[str, Tensor]) -> dict[str, Tensor]:
        return {
            k: torch.full_like(leaf[:1], k in self.ones) for k, leaf in leaves.items()
        }


def finite_rows(row: TensorDictBase) -> Tensor:
    """Rows of n-step windows that may be learnt from, (N,) bool.

    Reward, action and state are finite, and so is the state at the window's end unless
    the window ends in a true termination: nothing is bootstrapped from that one, and
    packing replaces what is not finite in it.
    """
    own = {k: row.get(k) for k in ("state", "action", "reward")}
    after = _all_finite(row.get("next_state")) | row.get("terminated").squeeze(-1)
    for value in own.values():
        after = after & _all_finite(value)
    return after


def _all_finite(value: Tensor | TensorDictBase) -> Tensor:
    leaves = value.values(True, True) if isinstance(value, TensorDictBase) else [value]
    floats = [leaf.flatten(1) for leaf in leaves if leaf.is_floating_point()]
    return torch.cat(floats, -1).isfinite().all(-1)
