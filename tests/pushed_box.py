"""A finger pushes a box: the scene, MuJoCo C stepped plainly, and its rollout."""

import json

import mujoco
import numpy as np

from flashdex.keys import FINGERS
from flashdex.rollouts.rollout import Rollout

FRAMES, DECIMATION = 90, 4
SITES = "".join(
    f'<site name="left_pad_{f}" pos=".02 {0.01 * i} 0"/>' for i, f in enumerate(FINGERS)
)
SCENE = f"""
<mujoco>
  <option timestep="0.004166666666666667" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom name="table" type="plane" size="1 1 .1" rgba=".9 .9 .9 1"/>
    <body name="left_base" pos="-.12 0 .03">
      <joint name="left_slide" type="slide" axis="1 0 0" range="-.05 .6" damping="1"/>
      <geom type="box" size=".02 .04 .02" mass=".2"/>{SITES}
      <body name="left_tip" pos=".02 0 0">
        <geom type="sphere" size=".005" mass=".01"/>
      </body>
    </body>
    <body name="box" pos="0 0 .03">
      <freejoint name="box"/>
      <geom type="box" size=".03 .05 .03" mass=".3" friction=".6 .005 .0001"
        rgba=".9 .2 .1 1"/>
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


def make_rollout(
    xml=SCENE, *, frames=FRAMES, push=0.25, criterion="sr_mt", beside=0.0, **changes
):
    """A rollout whose reference is what happened, but for ``beside`` metres in y."""
    ctrl = np.linspace(0, push, frames)[:, None]
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
        "ref_object_pos": run["pos"][:, None] + np.array([0.0, beside, 0.0]),
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
        "actions": np.zeros((frames, 2, 1), dtype=np.float32),
    }
    return Rollout(**{**values, **changes})
