"""Hand-made rollouts: poses with known errors, and a scene stepped by MuJoCo C."""

import json

import mujoco
import numpy as np
import pytest
import torch

from flashdex.keys import FINGERS
from flashdex.metrics.rollout import Rollout
from flashdex.metrics.signals import compute_signals

FRAMES, DECIMATION = 90, 4


def turn_z(angle):
    half = torch.as_tensor(angle, dtype=torch.float64) / 2
    zero = torch.zeros_like(half)
    return torch.stack((torch.cos(half), zero, zero, torch.sin(half)), -1)


@pytest.fixture
def poses():
    """Build signals of moving objects whose errors are given, one column a slot."""

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
        return compute_signals(data, **masks)

    return build


SITES = "".join(
    f'<site name="left_pad_{f}" pos=".02 {0.01 * i} 0"/>' for i, f in enumerate(FINGERS)
)
SCENE = f"""
<mujoco>
  <option timestep="0.004166666666666667" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom name="table" type="plane" size="1 1 .1"/>
    <body name="left_base" pos="-.12 0 .03">
      <joint name="left_slide" type="slide" axis="1 0 0" range="-.05 .6" damping="1"/>
      <geom type="box" size=".02 .04 .02" mass=".2"/>{SITES}
      <body name="left_tip" pos=".02 0 0">
        <geom type="sphere" size=".005" mass=".01"/>
      </body>
    </body>
    <body name="box" pos="0 0 .03">
      <freejoint name="box"/>
      <geom type="box" size=".03 .05 .03" mass=".3" friction=".6 .005 .0001"/>
    </body>
  </worldbody>
  <actuator>
    <position joint="left_slide" kp="400" kv="20" forcerange="-40 40"/>
  </actuator>
</mujoco>"""


def step_by_hand(xml, qpos0, ctrl):
    """Reference implementation: plain mj_step, one control row for four substeps."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos0
    rows = {k: [] for k in ("qpos", "qvel", "pos", "quat", "tips", "links")}
    tips = [model.site(f"left_pad_{f}").id for f in FINGERS]
    bodies = [model.body(n).id for n in ("left_base", "left_tip")]
    for row in ctrl:
        data.ctrl[:] = row
        mujoco.mj_step(model, data, nstep=DECIMATION)
        after = mujoco.MjData(model)
        after.qpos[:] = data.qpos
        mujoco.mj_forward(model, after)
        rows["qpos"].append(data.qpos.copy())
        rows["qvel"].append(data.qvel.copy())
        rows["pos"].append(after.body("box").xpos.copy())
        rows["quat"].append(after.body("box").xquat.copy())
        rows["tips"].append(after.site_xpos[tips])
        rows["links"].append(after.xpos[bodies])
    return {k: np.array(v) for k, v in rows.items()}


def make_rollout(xml=SCENE, *, push=0.25, criterion="sr_mt", **changes):
    """A rollout whose reference is what happened: every error is zero."""
    ctrl = np.linspace(0, push, FRAMES)[:, None]
    qpos0 = mujoco.MjModel.from_xml_string(xml).qpos0.copy()
    run = step_by_hand(xml, qpos0, ctrl)
    both = {
        k: np.stack([run[k], np.zeros_like(run[k])], axis=1) for k in ("tips", "links")
    }
    values = {
        "motion": "push",
        "hand": "finger",
        "fps": 60.0,
        "decimation": DECIMATION,
        "grace": 15,
        "qpos0": qpos0,
        "qvel0": np.zeros(run["qvel"].shape[1]),
        "ctrl": ctrl,
        "qpos": run["qpos"],
        "qvel": run["qvel"],
        "object_pos": run["pos"][:, None],
        "object_quat": run["quat"][:, None],
        "ref_object_pos": run["pos"][:, None].copy(),
        "ref_object_quat": run["quat"][:, None].copy(),
        "fingertips": both["tips"],
        "ref_fingertips": both["tips"].copy(),
        "joints": both["links"],
        "ref_joints": both["links"].copy(),
        "hand_active": np.array([True, False]),
        "hand_object": np.array([0, -1]),
        "object_qpos_adr": np.array([1]),
        "object_qvel_adr": np.array([1]),
        "joint_bodies": json.dumps([["left_base", "left_tip"], []]),
        "model_xml": xml,
        "criterion": criterion,
        "errors": "{}",
        "versions": json.dumps({"engine": "mujoco", "mujoco": mujoco.__version__}),
        "seed": 3,
        "env_steps": 1000,
        "actions": np.zeros((FRAMES, 2, 1), dtype=np.float32),
    }
    return Rollout(**{**values, **changes})


@pytest.fixture
def rollout():
    return make_rollout()


@pytest.fixture
def build_rollout():
    return make_rollout


@pytest.fixture
def scene_xml():
    return SCENE


@pytest.fixture
def oracle():
    return step_by_hand
