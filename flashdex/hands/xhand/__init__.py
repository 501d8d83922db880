"""XHand (XHAND1, RobotEra): 12 finger joints, five fingers of two phalanges.

``left.xml`` and ``right.xml`` hold links, joints, primitives and sites; this module
holds what a model file has no place for. Names carry no side.
"""

from __future__ import annotations

from flashdex.hands.gains import (
    ARM_HINGE,
    ARM_SLIDE,
    Gains,
    GainsPreset,
    Servo,
    critical_kv,
    make_gains,
)

# body -> human keypoint it stands for (21-keypoint order, wrist = 0). Phalanges are two
# a finger, so no link stands for the DIP keypoints 7, 11, 15, 19.
LINK_KEYPOINTS: dict[str, int] = {
    "hand_thumb_bend_link": 1,
    "hand_thumb_rota_link1": 2,
    "hand_thumb_rota_link2": 3,
    "hand_index_bend_link": 5,
    "hand_index_rota_link1": 5,
    "hand_index_rota_link2": 6,
    "hand_mid_link1": 9,
    "hand_mid_link2": 10,
    "hand_ring_link1": 13,
    "hand_ring_link2": 14,
    "hand_pinky_link1": 17,
    "hand_pinky_link2": 18,
}

# thumb to pinky; joint_error compares these two levels with LINK_KEYPOINTS
_FINGERS = ("thumb_rota", "index_rota", "mid", "ring", "pinky")
LEVEL1_LINKS: tuple[str, ...] = tuple(f"hand_{f}_link1" for f in _FINGERS)
DISTAL_LINKS: tuple[str, ...] = tuple(f"hand_{f}_link2" for f in _FINGERS)

# Rotation of the base link in the geometric palm frame (x to the middle MCP, z out of
# the palm): R_world_base = R_world_palm R_palm_base. wxyz.
WRIST_FROM_PALM: dict[str, tuple[float, float, float, float]] = {
    "left": (0.5, -0.5, -0.5, 0.5),
    "right": (0.5, 0.5, -0.5, -0.5),
}

# Vendor limits of the two motor classes: N m, rad/s.
_EFFORT = {"large": 1.1, "small": 0.4}
_VELOCITY = {"large": 8.63, "small": 14.38}

# joint -> motor class, link inertia about the joint at q0 with the palm held, kg m2
_MOTORS: dict[str, tuple[str, float]] = {
    "hand_thumb_bend_joint": ("large", 1.0e-3),
    "hand_thumb_rota_joint1": ("large", 4.0e-4),
    "hand_thumb_rota_joint2": ("small", 2.7e-5),
    "hand_index_bend_joint": ("small", 3.9e-4),
    "hand_index_joint1": ("large", 2.2e-4),
    "hand_index_joint2": ("small", 1.3e-5),
    "hand_mid_joint1": ("large", 2.2e-4),
    "hand_mid_joint2": ("small", 1.3e-5),
    "hand_ring_joint1": ("large", 2.2e-4),
    "hand_ring_joint2": ("small", 1.3e-5),
    "hand_pinky_joint1": ("large", 2.2e-4),
    "hand_pinky_joint2": ("small", 1.3e-5),
}

# largest joint speed of the motors, rad/s, in joint order
FINGER_VELOCITY_LIMIT: list[float] = [_VELOCITY[m] for m, _ in _MOTORS.values()]


def _make_vendor_servo(motor: str, inertia: float) -> Servo:
    # kp reaches the effort limit at 0.35 rad; armature puts both motors near 42 rad/s
    large = motor == "large"
    kp, armature, friction = (3.0, 0.0017, 0.04) if large else (1.1, 0.0006, 0.01)
    return Servo(
        kp=kp,
        kv=critical_kv(kp, armature + inertia),
        force_limit=_EFFORT[motor],
        armature=armature,
        frictionloss=friction,
    )


_PAPER = Servo(kp=20.0, kv=1.5, force_limit=100.0, armature=0.1, damping=1.0)

# paper: gains and force bounds of the method's released code; vendor: what the real
# motors can follow. The paper's gains under the motors' effort limits would take 2 to
# 5 s for a finger stroke (damping 1.0 eats a 0.4 N m motor at 0.4 rad/s).
GAINS: dict[GainsPreset, Gains] = {
    "paper": make_gains([_PAPER for _ in _MOTORS]),
    "vendor": make_gains(
        [_make_vendor_servo(*m) for m in _MOTORS.values()],
        slide=ARM_SLIDE,
        hinge=ARM_HINGE,
    ),
}
