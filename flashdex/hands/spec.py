"""What the rest of flashdex knows about a robot hand of one side."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import mujoco
import numpy as np
from numpy.typing import NDArray

from flashdex.errors import FlashdexError, UnknownHandError
from flashdex.hands import known_hands
from flashdex.hands.gains import NUM_WRIST_JOINTS, Gains, GainsPreset
from flashdex.keys import FINGERS, SIDES, Side
from flashdex.system.mjcf import check_mjcf

# Six joints move the base: three slides, then hinges about z, x and -y. (name, axis)
WRIST_JOINTS: tuple[tuple[str, tuple[float, float, float]], ...] = (
    ("wrist_x", (1.0, 0.0, 0.0)),
    ("wrist_y", (0.0, 1.0, 0.0)),
    ("wrist_z", (0.0, 0.0, 1.0)),
    ("wrist_rz", (0.0, 0.0, 1.0)),
    ("wrist_rx", (1.0, 0.0, 0.0)),
    ("wrist_ry", (0.0, -1.0, 0.0)),
)
WRIST_RANGE = (5.0, 5.0, 5.0, 6.2, 6.2, 6.2)

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class HandError(FlashdexError):
    """A hand that cannot be used as it was asked for."""


@dataclass(frozen=True)
class HandSpec:
    """A hand of one side: J joints (wrist first), L links (base first), five fingers.

    Names are those of the scene: they carry the prefix ``left_`` or ``right_``.
    Metres, radians, quaternions wxyz. The fixed transform of a link is its pose in its
    parent at joint angle zero; joint axes pass through the link's origin.

    Example:
        >>> hand = load_hand("xhand")["left"]
        >>> hand.num_joints, hand.num_links, hand.joint_names[6]
        (18, 13, 'left_hand_thumb_bend_joint')
    """

    name: str  # embodiment, as in ``load_hand``
    side: Side
    mjcf: str  # model without wrist joints and actuators; names without side
    joint_names: tuple[str, ...]  # six wrist joints, then the fingers' (J)
    joint_range: Floats  # lower and upper limit, m or rad, (J, 2)
    joint_axis: Floats  # unit axis in the frame of the joint's link, (J, 3)
    joint_link: Ints  # link moved by each joint, -1 for wrist joints, (J,)
    velocity_limit: Floats  # motor speed, rad/s; infinite for the wrist, (J,)
    link_names: tuple[str, ...]  # parents before children (L)
    link_parent: Ints  # index of the parent, -1 for the base, (L,)
    link_pos: Floats  # origin in the parent's frame, m, (L, 3)
    link_quat: Floats  # orientation in the parent's frame, (L, 4)
    tip_link: Ints  # distal link of each finger, (5,)
    tip_pos: Floats  # tracking point on the pad, in the distal link's frame, m, (5, 3)
    # centre and radius of the distal end sphere, m, (5, 3) and (5,): the distance of a
    # tip to an object is SDF(center) - radius
    tip_center: Floats
    tip_radius: Floats
    vendor_tip_pos: Floats  # the vendor's fingertip, on the finger's axis, m, (5, 3)
    # (link, human keypoint 0..20) of every mapped link; of the proximal and of the
    # distal ones, thumb to pinky
    keypoint_links: tuple[tuple[int, int], ...]
    level1_links: tuple[tuple[int, int], ...]
    distal_links: tuple[tuple[int, int], ...]
    wrist_from_palm: Floats  # R_palm_base of R_world_base = R_world_palm R_palm_base
    gains: Mapping[GainsPreset, Gains]  # servo presets by name

    @property
    def prefix(self) -> str:
        """Prefix of every element of this hand in a scene."""
        return f"{self.side}_"

    @property
    def num_joints(self) -> int:
        """J, the six joints of the wrist included."""
        return len(self.joint_names)

    @property
    def num_links(self) -> int:
        """Links, the base included, the virtual links of the wrist not."""
        return len(self.link_names)

    @property
    def wrist_axes(self) -> Floats:
        """Axes of the wrist joints, each in the frame of its own link, (6, 3)."""
        return self.joint_axis[:NUM_WRIST_JOINTS]


def load_hand(name: str) -> dict[Side, HandSpec]:
    """Load both sides of a built-in hand.

    Raises:
        UnknownHandError: the name is not built in.

    Example:
        >>> sorted(load_hand("xhand"))
        ['left', 'right']
    """
    if name not in known_hands():
        raise UnknownHandError(name, known_hands())
    facts = importlib.import_module(f"flashdex.hands.{name}")
    return {side: _make_spec(name, side, facts) for side in SIDES}


def _make_spec(name: str, side: Side, facts: ModuleType) -> HandSpec:
    file = Path(str(facts.__file__)).with_name(f"{side}.xml")
    mjcf = file.read_text(encoding="utf-8")
    check_mjcf(mjcf, where=str(file))
    model = mujoco.MjSpec.from_string(mjcf).compile()
    _refuse_unsupported(model, where=str(file))
    links = [model.body(i).name for i in range(1, model.nbody)]
    pairs = {n: (links.index(n), facts.LINK_KEYPOINTS[n]) for n in facts.LINK_KEYPOINTS}
    wrist_range = np.outer(WRIST_RANGE, (-1.0, 1.0))
    joints = [n for n, _ in WRIST_JOINTS]
    joints += [model.joint(i).name for i in range(model.njnt)]
    unlimited = np.full(NUM_WRIST_JOINTS, np.inf)
    no_link = np.full(NUM_WRIST_JOINTS, -1)
    return HandSpec(
        name=name,
        side=side,
        mjcf=mjcf,
        joint_names=tuple(f"{side}_{n}" for n in joints),
        joint_range=np.concatenate([wrist_range, model.jnt_range]),
        joint_axis=np.concatenate([[a for _, a in WRIST_JOINTS], model.jnt_axis]),
        joint_link=np.r_[no_link, model.jnt_bodyid - 1].astype(np.int64),
        velocity_limit=np.r_[unlimited, facts.FINGER_VELOCITY_LIMIT],
        link_names=tuple(f"{side}_{n}" for n in links),
        # the base hangs on the world, body 0; its parent here is -1, the wrist
        link_parent=model.body_parentid[1:].astype(np.int64) - 1,
        link_pos=model.body_pos[1:].copy(),
        link_quat=model.body_quat[1:].copy(),
        **_read_tips(model),
        keypoint_links=tuple(pairs.values()),
        level1_links=tuple(pairs[n] for n in facts.LEVEL1_LINKS),
        distal_links=tuple(pairs[n] for n in facts.DISTAL_LINKS),
        wrist_from_palm=np.array(facts.WRIST_FROM_PALM[side]),
        gains=facts.GAINS,
    )


def _read_tips(model: mujoco.MjModel) -> dict[str, NDArray]:
    centers = [model.site(f"center_{f}") for f in FINGERS]
    return {
        "tip_link": np.array([int(s.bodyid[0]) - 1 for s in centers]),
        "tip_pos": np.array([model.site(f"pad_{f}").pos for f in FINGERS]),
        "tip_center": np.array([s.pos for s in centers]),
        "tip_radius": np.array([s.size[0] for s in centers]),
        "vendor_tip_pos": np.array([model.site(f"tip_{f}").pos for f in FINGERS]),
    }


def _refuse_unsupported(model: mujoco.MjModel, *, where: str) -> None:
    # the kinematics know one hinge through the origin of each link, and no more
    hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
    shared = len(np.unique(model.jnt_bodyid)) < model.njnt
    if shared or np.any(model.jnt_type != hinge) or np.any(model.jnt_pos != 0):
        raise HandError(
            f"{where}: a finger joint is not a single hinge through its link's origin. "
            "Allowed: at most one hinge a link, pos 0 0 0. Split the link or move its "
            "frame onto the joint."
        )
    moved = np.any(model.body_pos[1] != 0) or np.any(model.body_quat[1, 1:] != 0)
    if moved or np.any(model.jnt_bodyid == 1) or np.sum(model.body_parentid == 0) != 2:
        raise HandError(
            f"{where}: the first body is not a bare base. Allowed: one body in the "
            "world, at its origin, without joint; the wrist joints are added to it."
        )
