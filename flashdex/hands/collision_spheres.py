"""A robot hand as spheres on its links: what keeps its reference out of objects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import mujoco
import numpy as np
import torch
from torch import Tensor

from flashdex.hands.spec import HandSpec
from flashdex.keys import Side, sides_of


@dataclass
class HandSpheres:
    """Spheres that fill the collision geoms of both hands; [left, right]."""

    link: Tensor  # of each sphere, (S,)
    pos: Tensor  # centres in the link's frame, m, (2, S, 3)
    radius: Tensor  # m, (S,)
    distal: Tensor  # finger (0 to 4) of spheres on a distal link, else -1, (S,)


def make_spheres(specs: Mapping[Side, HandSpec]) -> HandSpheres:
    """Spheres of one hand or both; capsules and boxes are filled, others refused."""
    sides = sides_of(specs)
    models = [mujoco.MjSpec.from_string(specs[s].mjcf).compile() for s in sides]
    # both sides get as many spheres, though their sizes differ by fractions of a mm
    hands = [
        _spheres_of(specs[side], model, models[0].geom_size)
        for side, model in zip(sides, models, strict=True)
    ]
    links, _, radii = hands[0]
    tips = {int(link): f for f, link in enumerate(specs[sides[0]].tip_link)}
    return HandSpheres(
        link=torch.tensor(links),
        pos=torch.tensor(np.stack([h[1] for h in hands])),
        radius=torch.tensor(radii, dtype=torch.float64),
        distal=torch.tensor([tips.get(link, -1) for link in links]),
    )


def _spheres_of(
    spec: HandSpec, model: mujoco.MjModel, like: np.ndarray
) -> tuple[list[int], np.ndarray, list[float]]:
    names = [n.removeprefix(spec.prefix) for n in spec.link_names]
    links, centres, radii = [], [], []
    for i in np.flatnonzero((model.geom_contype != 0) | (model.geom_conaffinity != 0)):
        geom = model.geom(i)
        local, radius = _fill(int(geom.type[0]), geom.size, like[i])
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, geom.quat)
        link = names.index(model.body(int(geom.bodyid[0])).name)
        links += [link] * len(local)
        centres.append(local @ matrix.reshape(3, 3).T + geom.pos)
        radii += [radius] * len(local)
    return links, np.concatenate(centres), radii


def _fill(kind: int, size: np.ndarray, like: np.ndarray) -> tuple[np.ndarray, float]:
    """Centres (K, 3) and radius of spheres in a geom, as many as ``like`` needs."""
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.zeros((1, 3)), float(size[0])
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        radius, half = float(size[0]), float(size[1])
        count = 1 + int(np.ceil(2 * like[1] / (0.8 * like[0])))
        line = np.linspace(-half, half, count)
        return np.stack([0 * line, 0 * line, line], axis=1), radius
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        radius = float(size.min())
        axes = [
            np.linspace(radius - s, s - radius, 1 + int(np.ceil(extra)))
            if extra > 0.1
            else np.zeros(1)
            for s, extra in zip(size, like / like.min() - 1, strict=True)
        ]
        return np.array(list(product(*axes))), radius
    raise ValueError(f"geom type {kind}: only spheres, capsules and boxes are filled")


# share of its range at which a relaxed finger joint rests
RELAXED = 0.3
MIDDLE_KNUCKLE = 9


class HandModel:
    """What the retargeting needs to know of the hands, [left, right]; float64.

    Attributes:
        low: lower joint limits, (2, J); ``high`` likewise.
        relaxed: posture that fingers return to, (2, J).
        tip_link: distal link of each finger, (5,).
        tip_pos: pad points in the link's frame, m, (2, 5, 3).
        tip_center: end spheres, (2, 5, 3); ``tip_radius`` (2, 5).
        knuckle: middle knuckle in the base frame, m, (2, 3).
        wrist_from_palm: quaternion R_palm_base, (2, 4).
        spheres: fill of the collision geoms.
    """

    def __init__(self, specs: Mapping[Side, HandSpec]) -> None:
        hands = [specs[side] for side in sides_of(specs)]

        def stack(field: str) -> Tensor:
            return torch.tensor(np.stack([getattr(h, field) for h in hands]))

        self.low, self.high = stack("joint_range").unbind(-1)
        self.relaxed = self.low + RELAXED * (self.high - self.low)
        self.tip_link = torch.as_tensor(hands[0].tip_link)
        self.tip_pos, self.tip_center = stack("tip_pos"), stack("tip_center")
        self.tip_radius = stack("tip_radius")
        self.wrist_from_palm = stack("wrist_from_palm")
        self.knuckle = torch.tensor(np.stack([_knuckle(h) for h in hands]))
        self.spheres = make_spheres(specs)


def _knuckle(spec: HandSpec) -> np.ndarray:
    """Origin of the link that stands for the middle MCP, base frame, m, (3,)."""
    links = [link for link, point in spec.keypoint_links if point == MIDDLE_KNUCKLE]
    return spec.link_pos[links[0]]
