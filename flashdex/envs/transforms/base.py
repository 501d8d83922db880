"""Base of the observation transforms: one pure ``assemble`` behind three doors."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from flashdex import keys


class StateTransform(Transform):
    """A pure function of the compact state, the same online and on replay samples.

    The environment calls ``_call`` and ``_reset``; the policy input and the replay
    sample go through ``forward``, which treats a ``next`` entry alike. All three end in
    ``assemble``, so what the policy saw and what the learner sees cannot drift apart.

    Subclasses set ``in_keys`` and ``out_keys`` and write ``assemble``.
    """

    def assemble(self, td: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Compute the entries of ``out_keys`` from a compact state of batch (N,)."""
        raise NotImplementedError

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key, value in self.assemble(next_tensordict).items():
            next_tensordict.set(key, value)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Assemble a policy input, or both ends of a replay sample."""
        self._call(tensordict)
        after = tensordict.get("next", None)
        if after is not None and after.get(keys.JOINT_POS, None) is not None:
            self._call(after)
        return tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> Composite:
        """Declare ``out_keys`` by running ``assemble`` on a zero state."""
        if not isinstance(observation_spec, Composite):
            msg = "the compact state is a Composite of its entries"
            raise TypeError(msg)
        zeros = observation_spec.zero()
        for key, value in self.assemble(zeros).items():
            observation_spec[key] = Unbounded(
                shape=value.shape, dtype=value.dtype, device=observation_spec.device
            )
        return observation_spec


def assemble(transforms: list[Transform], td: TensorDictBase) -> TensorDictBase:
    """Run transforms on a shallow copy, so that nothing leaks into the caller's td.

    Args:
        transforms: in data-flow order.
        td: compact state, batch (N,).
    """
    td = td.copy()
    for transform in transforms:
        td = transform(td)
    return td
