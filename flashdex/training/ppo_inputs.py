"""From compact states to what PPO's networks read: assembled and normalised."""

from __future__ import annotations

from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs.transforms import Transform

from flashdex import keys
from flashdex.envs.transforms.compiled import Assembly
from flashdex.modules.gaussian_policy import RunningNorm
from flashdex.training.hand_groups import HandGroups

CHUNK = 4096  # rows assembled at once


class PPOInputs:
    """Observation and future window with running statistics of both.

    Args:
        transforms: observation transforms in data-flow order.
        groups: how the hands are divided.
        example: one compact state, batch (N,), that fixes the sizes.
        compile: compile the assembly.
    """

    def __init__(
        self,
        transforms: list[Transform],
        groups: HandGroups,
        example: TensorDictBase,
        *,
        compile: bool = False,
    ) -> None:
        self.transforms, self.groups = transforms, groups
        self.show = Assembly(transforms, compile=compile)
        shown = Assembly(transforms)(example)
        wanted = (keys.OBSERVATION, keys.FUTURE)
        self.keys = [k for k in wanted if shown.get(k, None) is not None]
        self.observation_dim = shown[keys.OBSERVATION].shape[-1]
        self.future_shape: tuple[int, int] | None = None
        if keys.FUTURE in self.keys:
            channels, frames = shown[keys.FUTURE].shape[1:]
            self.future_shape = (channels, frames)
        norms = {key: RunningNorm(shown[key].shape[1]) for key in self.keys}
        self.norms = nn.ModuleDict(norms).to(example[keys.JOINT_POS].device)

    @property
    def fitted(self) -> bool:
        """Whether the statistics have seen any row."""
        return bool(self.norm(keys.OBSERVATION).count > 0)

    def norm(self, key: str) -> RunningNorm:
        """Statistics of one input."""
        norm = self.norms[key]
        assert isinstance(norm, RunningNorm)
        return norm

    def raw(self, state: TensorDictBase) -> TensorDict:
        """Inputs of compact states (B,), and the mask of the groups, (B, G).

        A row that is not finite has its mask off.
        """
        parts = []
        for chunk in state.split(CHUNK):
            shown = self.show(chunk)
            row: dict[str, Tensor] = {key: shown[key] for key in self.keys}
            mask = self.groups.mask(shown[keys.GROUP_MASK])
            for value in row.values():
                mask = mask & value.flatten(1).isfinite().all(-1, keepdim=True)
            row[keys.GROUP_MASK] = mask
            parts.append(TensorDict(row, chunk.batch_size))
        return cast(TensorDict, torch.cat(parts))

    @torch.no_grad()
    def scaled(self, raw: TensorDictBase) -> TensorDict:
        """Normalised inputs, (B,)."""
        # NaN would outlive a mask or a termination: 0 x NaN is NaN.
        values = {k: torch.nan_to_num(self.norm(k)(raw[k])) for k in self.keys}
        return TensorDict(values, raw.batch_size)

    def __call__(self, state: TensorDictBase) -> TensorDict:
        """Normalised inputs of compact states, (B,)."""
        return self.scaled(self.raw(state))

    def track(self, raw: TensorDictBase) -> None:
        """Merge rows into the statistics; those without any group are left out."""
        used = raw[keys.GROUP_MASK].any(-1)
        for key in self.keys:
            self.norm(key).update(raw[key][used])

    def state_dict(self) -> dict[str, Any]:
        """The statistics."""
        return self.norms.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore ``state_dict``."""
        self.norms.load_state_dict(state)
