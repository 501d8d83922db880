"""Observations as a function of tensors, which a compiler can take in one piece."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs.transforms import Transform

from flashdex import keys
from flashdex.envs.transforms.base import StateTransform

OUTPUTS = (keys.OBSERVATION, keys.FUTURE, keys.GROUP_MASK)


class Assembly:
    """What the networks read of a compact state, by the transforms of a recipe.

    The same numbers as `flashdex.envs.transforms.base.assemble`, without TorchRL's
    steps from transform to transform and without the intermediate entries.

    Args:
        transforms: ``StateTransform`` in data-flow order; they are not changed.
        compile: make one graph of it: minutes at the first call and at the second size
            of the batch, fast from then on.
        backend: of the compiler.

    Raises:
        TypeError: a transform is no ``StateTransform``.
    """

    def __init__(
        self,
        transforms: Sequence[Transform],
        *,
        compile: bool = False,
        backend: str = "inductor",
    ) -> None:
        self.transforms: list[StateTransform] = []
        for transform in transforms:
            if not isinstance(transform, StateTransform):
                raise TypeError(f"{type(transform).__name__} is no StateTransform")
            self.transforms.append(transform)
        self._call: Any = self.pure
        if compile:
            self._call = torch.compile(self.pure, fullgraph=True, backend=backend)

    def __call__(self, state: TensorDictBase) -> TensorDict:
        """Observation, group mask and, where there is one, future window, (N,).

        Args:
            state: compact state, batch (N,); it is left alone.
        """
        shown = self._call({key: state.get(key) for key in keys.STATE})
        return TensorDict(shown, batch_size=state.batch_size)

    def pure(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """The same on plain tensors.

        Args:
            state: entries of ``keys.STATE``, (N, ...) each.
        """
        td = TensorDict(state, batch_size=state[keys.MOTION].shape[:1])
        for transform in self.transforms:
            entries: dict[NestedKey, Tensor] = transform.assemble(td)
            for key, value in entries.items():
                td.set(key, value)
        found = {key: td.get(key, None) for key in OUTPUTS}
        return {key: value for key, value in found.items() if value is not None}
