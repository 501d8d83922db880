"""What the engines are asked to do in the conformance suite.

One hand and one box (``reduced_library``); all worlds run side by side for the same
control steps, so that an engine is compiled and run once. World axes, SI units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from reduced import FRAMES
from torch import Tensor

from flashdex import keys
from flashdex.envs.reference import ReferenceBank
from flashdex.envs.scene.wrench import ObjectWrench
from flashdex.hands.spec import HandSpec
from flashdex.motions.library import MotionLibrary

STEPS = 200  # control steps
RIGHT = keys.SIDES.index("right")
SEEDS = (0, 1, 2, 3)
# Where the hand is far from the box, one world serves a scenario of each.
SHARED = (
    *(("upper", "fall"), ("lower", "hold"), ("small_steps", "spin")),
    *(("large_steps", "assist"), ("fist", "slide"), ("rub", "twirl")),
)
SINGLE = ("grip", "cradle", *(f"random{seed}" for seed in SEEDS), "twin")
NUM_WORLDS = len(SHARED) + len(SINGLE)
ROW = {name: row for row, names in enumerate(SHARED) for name in names}
ROW |= {name: row for row, name in enumerate(SINGLE, len(SHARED))}
REST = (0.0, 0.0, 0.02, 1.0, 0.0, 0.0, 0.0)  # the box on the disc
AWAY = (0.0, 3.0, 2.0, 1.0, 0.0, 0.0, 0.0)  # beside the disc, in the air
FALL_VEL = (0.5, 0.2, 0.0, 0.0, 0.0, 0.0)
SPIN_VEL = (0.0, 0.0, 2.0, 4.0, -3.0, 5.0)
CLOSE = (0.2, 0.2, 0.3, 0.0, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3)  # rad, grip
PALM_UP = (0.0, 1.5, 0.0)  # wrist hinges


@dataclass(frozen=True)
class Script:
    """Start states and commands of N worlds over T control steps, float32.

    Attributes:
        state: arguments of ``Physics.reset``: joint_pos and joint_vel (N, 2, J),
            object_pose (N, O, 7), object_vel (N, O, 6).
        target: joint position targets, (T, N, 2, J).
        ref_pose: where the wrench pulls the object, (T, N, O, 7).
        ref_vel: (T, N, O, 6).
        hold: share of the hold, (N,).
        assist: stiffness and damping of the assist, (N, 2).
        mass: (N, O).
        inertia: (N, O, 3, 3).
    """

    state: dict[str, Tensor]
    target: Tensor
    ref_pose: Tensor
    ref_vel: Tensor
    hold: Tensor
    assist: Tensor
    mass: Tensor
    inertia: Tensor

    def wrench(self, step: int, rows: slice = slice(None)) -> ObjectWrench:
        """What pulls the objects of worlds ``rows`` in one control step."""
        pulled = (self.hold > 0) | (self.assist[:, 0] > 0)
        present = pulled[:, None] & (self.mass > 0)
        return ObjectWrench(
            ref_pose=self.ref_pose[step, rows],
            ref_vel=self.ref_vel[step, rows],
            mass=self.mass[rows],
            inertia=self.inertia[rows],
            present=present[rows],
            hold=self.hold[rows],
            kp=self.assist[rows, 0],
            kv=self.assist[rows, 1],
            hold_stiffness=20.0,
            torque_ratio=96.0,
            force_limit=50.0,
            torque_limit=50.0,
        )


def make_script(
    library: MotionLibrary,
    bank: ReferenceBank,
    hands: dict[keys.Side, HandSpec],
    seed: int = 0,
) -> Script:
    """Write the scenarios of ``ROW``; other seeds shift and turn all but the fall."""
    plan = _Plan(hands["right"], bank)
    for write in (_objects, _joints, _hands, _pulls):
        write(plan)
    _vary(plan, seed)
    _randoms(plan, seed)
    n, slots = NUM_WORLDS, library.motions["object_index"].shape[1]
    pose = torch.zeros(n, slots, 7)
    pose[..., 3] = 1.0
    pose[:, 0] = torch.as_tensor(plan.pose)
    ref_pose = pose.expand(STEPS, n, slots, 7).clone()
    ref_pose[:, :, 0] = torch.as_tensor(plan.ref_pose)
    ref_vel = torch.zeros(STEPS, n, slots, 6)
    ref_vel[:, :, 0, :3] = torch.as_tensor(plan.ref_vel)
    mass, inertia = torch.zeros(n, slots), torch.zeros(n, slots, 3, 3)
    mass[:, 0] = library.objects["mass"][0].float()
    inertia[:, 0] = library.objects["inertia"][0].float()
    object_vel = torch.zeros(n, slots, 6)
    object_vel[:, 0] = torch.as_tensor(plan.vel)
    state = {
        "joint_pos": _right(plan.joints),
        "joint_vel": _right(plan.joint_vel),
        "object_pose": pose,
        "object_vel": object_vel,
    }
    hold, assist = torch.as_tensor(plan.hold), torch.as_tensor(plan.assist)
    target = _right(plan.target)
    return Script(state, target, ref_pose, ref_vel, hold, assist, mass, inertia)


def _right(values: np.ndarray) -> Tensor:
    out = torch.zeros(*values.shape[:-1], 2, values.shape[-1])
    out[..., RIGHT, :] = torch.as_tensor(values)
    return out


class _Plan:
    """Arrays that the scenarios fill; the hand waits open beside the resting box."""

    def __init__(self, hand: HandSpec, bank: ReferenceBank) -> None:
        n, joints = NUM_WORLDS, hand.num_joints
        self.hand, self.bank = hand, bank
        self.lower, self.upper = np.asarray(hand.joint_range).T
        middle = 0.5 * (self.lower + self.upper)
        middle[:3] = 1.2, 0.0, 1.0
        self.joints = np.tile(middle, (n, 1)).astype(np.float32)
        self.joint_vel = np.zeros((n, joints), np.float32)
        self.pose = np.tile(REST, (n, 1)).astype(np.float32)
        self.vel = np.zeros((n, 6), np.float32)
        self.target = np.tile(self.joints, (STEPS, 1, 1))
        self.ref_pose = np.tile(self.pose, (STEPS, 1, 1))
        self.ref_vel = np.zeros((STEPS, n, 3), np.float32)
        self.hold = np.zeros(n, np.float32)
        self.assist = np.zeros((n, 2), np.float32)

    def reference(self, frame: int) -> dict[str, np.ndarray]:
        """Joints and object of the motion at one frame."""
        ref = self.bank.at(torch.zeros(1).long(), torch.tensor([frame]))
        pose = torch.cat([ref["object_pos"], ref["object_quat"]], -1)
        return {
            "joints": np.asarray(ref["joint_pos"][0, RIGHT]),
            "joint_vel": np.asarray(ref["joint_vel"][0, RIGHT]),
            "pose": np.asarray(pose[0, 0]),
        }


def _objects(plan: _Plan) -> None:
    for name, vel in (("fall", FALL_VEL), ("spin", SPIN_VEL)):
        plan.pose[ROW[name]], plan.vel[ROW[name]] = AWAY, vel
    plan.vel[ROW["slide"], 0] = 0.3
    plan.vel[ROW["twirl"], 5] = 40.0  # rad/s about the vertical


def _joints(plan: _Plan) -> None:
    still = np.r_[4:6]  # one hinge at its end: the hand stays clear of the disc
    thumb = np.r_[6:9]  # at its upper limits it is inside the palm
    rows = (
        ("upper", plan.upper, 1, np.r_[still, thumb]),
        ("lower", plan.lower, -1, still),
    )
    for name, limit, sign, idle in rows:
        row, start = ROW[name], limit - 0.1 * sign
        plan.joints[row], plan.target[:, row] = start, limit + 0.4 * sign
        plan.joint_vel[row] = 3.0 * sign
        start = np.where(np.arange(len(start)) < 6, 0.0, plan.lower)[idle]
        plan.joints[row, idle] = plan.target[:, row, idle] = start
        plan.joint_vel[row, idle] = 0.0
    wave = np.where(np.arange(STEPS) // 40 % 2 == 0, 1.0, -1.0)[:, None]
    sizes = {"small_steps": (0.04, 0.2, 0.15), "large_steps": (0.3, 1.2, 0.6)}
    for name, (slide, hinge, finger) in sizes.items():
        row = ROW[name]
        step = np.repeat([slide, hinge, finger], [3, 3, len(plan.lower) - 6])
        step[9] = 0.07  # rad; the index spreads away from the middle finger
        plan.joints[row, 6:] = plan.lower[6:] + 0.02 + step[6:]
        plan.target[:, row] = plan.joints[row] + wave * step
    fist = ROW["fist"]  # fingers close on the thumb and open
    plan.target[:, fist, 6:] += 0.6 * wave


def _hands(plan: _Plan) -> None:
    time = np.arange(STEPS)
    ref, grip = plan.reference(0), ROW["grip"]
    plan.joints[grip], plan.pose[grip] = ref["joints"], ref["pose"]
    plan.target[:, grip] = ref["joints"]
    closing = np.clip(time / 20, 0, 1)[:, None] * np.array(CLOSE)
    plan.target[:, grip, 6:] += closing
    plan.target[:, grip, 2] += 0.1 * np.clip((time - 20) / 30, 0, 1)

    cradle = ROW["cradle"]  # the box drops onto palm and fingers
    plan.joints[cradle, :3] = 0.0, 0.0, 0.5
    plan.joints[cradle, 3:6] = PALM_UP
    plan.joints[cradle, 6:] = ref["joints"][6:]
    plan.target[:, cradle] = plan.joints[cradle]
    plan.pose[cradle, :3] = 0.0, 0.1, 0.56

    rub = ROW["rub"]  # fingertips press on the disc and draw along it
    plan.joints[rub], plan.target[:, rub] = ref["joints"], ref["joints"]
    plan.joints[rub, 1] -= 0.3
    plan.target[:, rub, 1] -= 0.3
    plan.target[:, rub, 2] -= 0.02 * np.clip(time / 20, 0, 1)
    plan.target[:, rub, 0] += 0.2 * np.clip((time - 30) / 100, 0, 1)


def _pulls(plan: _Plan) -> None:
    seconds = np.arange(STEPS) / 60
    for name in ("hold", "assist"):
        row = ROW[name]
        plan.pose[row, :3] = 0.02, -0.01, 0.5
        plan.pose[row, 3:] = np.cos(0.2), 0.0, np.sin(0.2), 0.0
        plan.vel[row] = 0.1, 0.0, 0.0, 0.0, 1.0, -2.0
        plan.ref_pose[:, row, :3] = 0.0, 0.0, 0.5
        plan.ref_pose[:, row, 0] += 0.1 * np.sin(2 * seconds)
        plan.ref_pose[:, row, 3:] = 1.0, 0.0, 0.0, 0.0
        plan.ref_vel[:, row, 0] = 0.2 * np.cos(2 * seconds)
    plan.hold[ROW["hold"]] = 1.0
    plan.assist[ROW["assist"]] = 80.0, 5.0


def _vary(plan: _Plan, seed: int) -> None:
    if seed == 0:
        return
    draw = np.random.default_rng(seed)
    pushed = [ROW[n] for n in ("grip", "cradle", "slide", "twirl", "hold", "assist")]
    plan.pose[pushed, :2] += draw.normal(scale=1e-3, size=(len(pushed), 2))
    plan.vel[1:] *= draw.uniform(0.8, 1.2, size=(NUM_WORLDS - 1, 1))
    plan.joint_vel *= draw.uniform(0.8, 1.2, size=(NUM_WORLDS, 1))
    plan.joints[ROW["rub"], 2] += draw.normal(scale=1e-3)
    for name in ("small_steps", "large_steps", "fist"):
        plan.target[:, ROW[name]] += draw.normal(scale=0.02, size=len(plan.lower))


def _randoms(plan: _Plan, first_seed: int) -> None:
    scale = np.repeat([0.01, 0.1, 0.3], [3, 3, len(plan.lower) - 6])
    for seed in SEEDS:
        row, draw = ROW[f"random{seed}"], np.random.default_rng([first_seed, seed])
        ref = plan.reference(seed * (FRAMES // 2 - 2) // len(SEEDS))
        plan.joints[row], plan.joint_vel[row] = ref["joints"], ref["joint_vel"]
        plan.pose[row] = ref["pose"]
        noise = draw.normal(size=(STEPS // 5, len(scale))).repeat(5, 0)
        plan.target[:, row] = ref["joints"] + scale * noise
    first, twin = ROW["random0"], ROW["twin"]
    for values in (plan.joints, plan.joint_vel, plan.pose):
        values[twin] = values[first]
    plan.target[:, twin] = plan.target[:, first]
