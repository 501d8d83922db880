"""Load a stored rollout, score it, and replay its controls in MuJoCo C.

    python examples/04_rollout.py RUN [MOTION]

RUN is a run directory, runs/quickstart after `make quickstart`. The rollout holds its
model, first state and controls, so that nothing else is needed.
"""

import sys

import mujoco
import numpy as np

import flashdex
from flashdex.rollouts.certificate import certify

if len(sys.argv) < 2:
    sys.exit(__doc__)
run = flashdex.load_run(sys.argv[1])
print(f"{run.recipe.name}: {len(run.attempts)} attempts, {len(run.converted)} stored")
motion = sys.argv[2] if len(sys.argv) > 2 else next(iter(run.converted))
rollout = run.rollout(motion)
passed = [name for name, verdict in rollout.score().items() if verdict.is_passed]
print(f"{motion}: {rollout.num_frames} frames, passes {len(passed)} criteria")

model = mujoco.MjModel.from_xml_string(rollout.model_xml)
data = mujoco.MjData(model)
data.qpos[:], data.qvel[:] = rollout.qpos0, rollout.qvel0
for ctrl in rollout.ctrl:
    data.ctrl[:] = ctrl
    mujoco.mj_step(model, data, rollout.decimation)
error = np.abs(data.qpos - rollout.qpos[-1]).max()
print(f"open loop, the last state differs by {error:.2g}")
print("certificate:", certify(rollout).verdict)
