"""Servo gains of a hand: position actuators plus the passive terms of each joint.

A joint follows its target with ``force = clip(kp (target - q) - kv q', +-limit)``; the
passive terms act besides: ``armature q'' + damping q' + frictionloss sign(q')``.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

GainsPreset = Literal["paper", "vendor"]
NUM_WRIST_JOINTS = 6


@dataclass(frozen=True)
class Servo:
    """Gains of one joint: N and m for a slide, N m and rad for a hinge."""

    kp: float
    kv: float
    force_limit: float
    armature: float
    damping: float = 0.0
    frictionloss: float = 0.0


# The released code of the method: kp/kv per wrist group, force +-100, damping 1.0,
# armature 0.1 on every joint.
WRIST_SLIDE = Servo(kp=350.0, kv=15.0, force_limit=100.0, armature=0.1, damping=1.0)
WRIST_HINGE = Servo(kp=60.0, kv=3.0, force_limit=100.0, armature=0.1, damping=1.0)
# An arm carries the hand: stiffer and well damped, so that a wrist target is followed
# within 2 cm at 0.4 m/s instead of overshooting by a third.
ARM_SLIDE = Servo(kp=1000.0, kv=50.0, force_limit=100.0, armature=0.1, damping=1.0)
ARM_HINGE = Servo(kp=60.0, kv=4.0, force_limit=30.0, armature=0.02, damping=0.1)


@dataclass(frozen=True)
class Gains:
    """Gains of all joints of a hand, wrist first; each field is (J,), float64."""

    kp: NDArray[np.float64]  # stiffness, N/m (slides) or N m/rad (hinges)
    kv: NDArray[np.float64]  # servo damping, N s/m or N m s/rad
    force_limit: NDArray[np.float64]  # symmetric bound of the servo force, N or N m
    armature: NDArray[np.float64]  # rotor inertia seen at the joint, kg or kg m2
    damping: NDArray[np.float64]  # passive, N s/m or N m s/rad
    frictionloss: NDArray[np.float64]  # dry friction, N or N m


def make_gains(
    fingers: list[Servo], *, slide: Servo = WRIST_SLIDE, hinge: Servo = WRIST_HINGE
) -> Gains:
    """Gains over all joints: three wrist slides, three wrist hinges, then the fingers.

    Args:
        fingers: one servo a finger joint, in the order of the hand's joints.
        slide: servo of each wrist slide.
        hinge: servo of each wrist hinge.
    """
    servos = [slide] * 3 + [hinge] * 3 + fingers
    # Servo and Gains have the same fields in the same order
    rows = np.array([astuple(servo) for servo in servos], dtype=np.float64)
    return Gains(*np.ascontiguousarray(rows.T))


def critical_kv(kp: float, inertia: float) -> float:
    """Servo damping of ratio one, ``kv = 2 sqrt(kp inertia)``, N m s/rad.

    Args:
        kp: stiffness, N m/rad.
        inertia: armature plus link inertia about the joint, kg m2.
    """
    return 2.0 * float(np.sqrt(kp * inertia))


def servo_lag(gains: Gains) -> NDArray[np.float64]:
    """Time by which each servo trails a target that moves steadily, s, (J,).

    ``kp (target - q) = (kv + damping) q'`` gives ``lag = (kv + damping) / kp``.
    """
    return (gains.kv + gains.damping) / gains.kp
