"""The observation blocks a recipe can name, each a thin door to one pure feature."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from flashdex import keys
from flashdex.envs.reference import ReferenceBank
from flashdex.envs.transforms import features
from flashdex.envs.transforms.base import StateTransform
from flashdex.envs.transforms.context import Block
from flashdex.hands.spec import HandSpec


class Proprioception(Block):
    """Palm pose, velocities, joints, fingertips, target error."""

    def features(self, td: TensorDictBase) -> Tensor:
        """See ``features.proprioception``."""
        return features.proprioception(
            td[keys.KIN], td[keys.JOINT_POS], td[keys.JOINT_VEL], td[keys.JOINT_TARGET]
        )


class ReferenceDelta(Block):
    """Next reference minus robot and object.

    Args:
        name: key under ``blocks``.
        used_hands: indices of the hands to keep.
        hands: specs of both sides, for the mapped links.
    """

    links: Tensor  # (2, Q)

    def __init__(
        self, name: str, used_hands: list[int], hands: dict[keys.Side, HandSpec]
    ) -> None:
        super().__init__(name, used_hands)
        links = [[link for link, _ in hands[s].keypoint_links] for s in keys.SIDES]
        self.register_buffer("links", torch.tensor(links))

    def features(self, td: TensorDictBase) -> Tensor:
        """See ``features.reference_delta``."""
        pos, quat = _own(td, "pos", "quat")
        return features.reference_delta(
            td[keys.KIN], td[keys.REF], pos, quat, self.links
        )


class ObjectState(Block):
    """Own object's pose and velocity in the wrist frame."""

    needs_object = True

    def features(self, td: TensorDictBase) -> Tensor:
        """See ``features.object_state``."""
        return features.object_state(td[keys.KIN], *_own(td, "pos", "quat", "vel"))


class ObjectPoints(Block):
    """Surface points now and next.

    Args:
        name: key under ``blocks``.
        bank: holds the points.
        num_points: first points of the farthest-point order.
    """

    needs_object = True
    points: Tensor  # object frame, m, (Q, P, 3)

    def __init__(self, name: str, bank: ReferenceBank, *, num_points: int) -> None:
        super().__init__(name, bank.used_hands)
        self.register_buffer("points", bank.points[:, :num_points])

    def features(self, td: TensorDictBase) -> Tensor:
        """See ``features.object_points``."""
        pos, quat, row = _own(td, "pos", "quat", "row")
        return features.object_points(
            td[keys.KIN], td[keys.REF], pos, quat, self.points[row]
        )


class SurfaceDistance(Block):
    """Signed distance and surface normal at palm and fingertips.

    Args:
        name: key under ``blocks``.
        bank: holds the distance grids.
        hands: specs of both sides, for the fingertip radii.
    """

    needs_object = True
    tip_radius: Tensor  # m, (2, 5)

    def __init__(
        self, name: str, bank: ReferenceBank, hands: dict[keys.Side, HandSpec]
    ) -> None:
        super().__init__(name, bank.used_hands)
        self.sdf = bank.sdf
        radii = [torch.as_tensor(hands[s].tip_radius) for s in keys.SIDES]
        self.register_buffer("tip_radius", torch.stack(radii).float())

    def features(self, td: TensorDictBase) -> Tensor:
        """See ``features.fingertip_distance``."""
        pos, quat, row = _own(td, "pos", "quat", "row")
        distance, normal = features.fingertip_distance(
            td[keys.KIN], pos, quat, row, self.sdf, self.tip_radius
        )
        return torch.cat([distance, normal.flatten(-2)], -1)


class Contact(Block):
    """Contact wrench and point of each link."""

    needs_object = True

    def features(self, td: TensorDictBase) -> Tensor:
        """See ``features.contact``."""
        return features.contact(td[keys.KIN], td[keys.CONTACT])


class FutureWindow(StateTransform):
    """Coming reference frames, (N, 39 x hands, K), the input of the future encoder.

    Args:
        bank: reference frames.
        horizon: frames K.
        reference_offset: as in ``TrackingContext``.
    """

    def __init__(
        self, bank: ReferenceBank, *, horizon: int, reference_offset: int
    ) -> None:
        super().__init__(
            in_keys=[keys.KIN, keys.OWN, keys.GROUP_MASK, keys.MOTION, keys.FRAME],
            out_keys=[keys.FUTURE],
        )
        self.bank = bank
        self.horizon = horizon
        self.reference_offset = reference_offset
        self.hands = slice(bank.used_hands[0], bank.used_hands[-1] + 1)

    def assemble(self, td: TensorDictBase) -> dict[NestedKey, Tensor]:
        """See ``features.future_window``."""
        motion = td[keys.MOTION].squeeze(-1)
        frame = td[keys.FRAME].squeeze(-1) + self.reference_offset
        vectors, rotations = self.bank.window(motion, frame, self.horizon)
        values = features.future_window(
            td[keys.KIN], vectors, rotations, *_own(td, "pos", "quat", "vel")
        )
        mask = td[keys.GROUP_MASK][..., None, None]
        values = torch.where(mask, values, torch.zeros_like(values))
        values = torch.nan_to_num(values).clamp(-100.0, 100.0)
        return {keys.FUTURE: values[:, self.hands].flatten(1, 2)}


def _own(td: TensorDictBase, *names: str) -> list[Tensor]:
    return [td[keys.OWN, name] for name in names]
