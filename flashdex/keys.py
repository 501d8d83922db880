"""Every TensorDict key of flashdex, in one place.

Sizes used throughout: N worlds, H = 2 hands ordered [left, right], J joints of a
hand (six wrist joints first), L links of a hand, O object slots, K future frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

Side = Literal["left", "right"]
SIDES: tuple[Side, Side] = ("left", "right")
FINGERS = ("thumb", "index", "middle", "ring", "pinky")
TIP_KEYPOINTS = (4, 8, 12, 16, 20)

# -- compact state: what the environment emits and what replay stores ---------
JOINT_POS = "joint_pos"  # (N, H, J) m and rad
JOINT_VEL = "joint_vel"  # (N, H, J) m/s and rad/s
JOINT_TARGET = "joint_target"  # (N, H, J) position targets of the last control step
OBJECT_POSE = "object_pose"  # (N, O, 7) position and wxyz quaternion, world
OBJECT_VEL = "object_vel"  # (N, O, 6) linear and angular velocity, world
CONTACT = "contact"  # (N, H, L, 7) int8 codes, see envs.contact
MOTION = "motion"  # (N, 1) int64 row of the motion library
FRAME = "frame"  # (N, 1) int64 frame that the coming step is scored against
STATE = (
    JOINT_POS,
    JOINT_VEL,
    JOINT_TARGET,
    OBJECT_POSE,
    OBJECT_VEL,
    CONTACT,
    MOTION,
    FRAME,
)
ATTEMPT = "attempt"  # (N, 1) bool, world that starts at frame 0 without assist

# -- what the transforms assemble ---------------------------------------------
KIN = "kin"  # forward kinematics of both hands
REF = "ref"  # reference frame shown to the policy
OWN = "own"  # each hand's own object: pos, quat, vel, row, present
BLOCKS = "blocks"  # one observation block per named transform
OBSERVATION = "observation"  # (N, D) the blocks side by side
FUTURE = "future"  # (N, 2 * 39, K) future window
GROUP_MASK = "group_mask"  # (N, G) bool, group takes part in the motion

# -- actions, rewards, flags --------------------------------------------------
ACTION = "action"
REWARD = "reward"
REWARD_TERMS = "reward_terms"  # by hand: raw value of each reward, (N, 1) by name
FAILED = "failed"
STEPS = "steps"  # (N, 1) window length of an n-step row
DONE, TERMINATED, TRUNCATED = "done", "terminated", "truncated"


def action(side: Side) -> tuple[str, str]:
    """Key of the action of one hand, (N, J) in [-1, 1]."""
    return (side, ACTION)


def reward(side: Side) -> tuple[str, str]:
    """Key of the reward of one hand, (N, 1)."""
    return (side, REWARD)


def reward_term(side: Side, name: str) -> tuple[str, str, str]:
    """Key of the raw value of one reward for one hand, (N, 1)."""
    return (side, REWARD_TERMS, name)


def failed(side: Side) -> tuple[str, str]:
    """Key of the flag that blames one hand for the end of the episode, (N, 1)."""
    return (side, FAILED)


def sides_of(by_side: Mapping[Side, object]) -> list[Side]:
    """Hands that a mapping has, left first."""
    return [side for side in SIDES if side in by_side]
