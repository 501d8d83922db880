"""Poses with known errors."""

import pytest
import torch

from flashdex.metrics.errors import compute_tracking_errors


def turn_z(angle):
    half = torch.as_tensor(angle, dtype=torch.float64) / 2
    zero = torch.zeros_like(half)
    return torch.stack((torch.cos(half), zero, zero, torch.sin(half)), -1)


@pytest.fixture
def poses():
    """Build tracking errors of moving objects: those given, one column a slot."""

    def build(
        pos_error, rot_error=None, *, moving=None, tips=None, joints=None, **masks
    ):
        pos_error = torch.as_tensor(pos_error, dtype=torch.float64)
        length, slots = pos_error.shape
        rot_error = torch.zeros_like(pos_error) if rot_error is None else rot_error
        moving = torch.ones(slots) if moving is None else torch.tensor(moving)
        ref = torch.zeros(length, slots, 3, dtype=torch.float64)
        ref[..., 2] = torch.linspace(0, 0.3, length)[:, None] * moving
        pos = ref.clone()
        pos[..., 0] += pos_error
        data = {
            "object_pos": pos,
            "object_quat": turn_z(rot_error),
            "ref_object_pos": ref,
            "ref_object_quat": turn_z(torch.zeros(length, slots)),
        }
        for key, value in (("fingertips", tips), ("joints", joints)):
            if value is not None:
                size = 5 if key == "fingertips" else 4
                shape = (length, 2, size, 3)
                data[f"ref_{key}"] = torch.zeros(shape, dtype=torch.float64)
                data[key] = torch.zeros(shape, dtype=torch.float64)
                data[key][..., 1] = torch.as_tensor(value, dtype=torch.float64)[
                    ..., None
                ]
        masks = {
            "hand_active": (slots == 2, True),
            "hand_object": (0, 1) if slots == 2 else (-1, 0),
        } | masks
        return compute_tracking_errors(data, **masks)

    return build
