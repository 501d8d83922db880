"""Plain MuJoCo C, one world after the other, and what any engine did: records."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from conformance_script import NUM_WORLDS, RIGHT, ROW, STEPS, Script

from flashdex import keys
from flashdex.envs.physics.base import Physics
from flashdex.envs.scene.scene import Scene
from flashdex.envs.scene.wrench import ObjectWrench

DECIMATION = 4
Step = Callable[[mujoco.MjModel, mujoco.MjData], None]


@dataclass(frozen=True)
class Record:
    """States after every control step of N worlds, float64; rows not run are NaN.

    Attributes:
        joint_pos: of the right hand, (T, N, J).
        joint_vel: (T, N, J).
        object_pose: (T, N, 7).
        object_vel: world axes, (T, N, 6).
        contact: force of the box on each link and its point, (T, N, L, 6).
    """

    joint_pos: np.ndarray
    joint_vel: np.ndarray
    object_pose: np.ndarray
    object_vel: np.ndarray
    contact: np.ndarray

    @classmethod
    def empty(cls, steps: int, joints: int, links: int) -> Record:
        """Nothing run yet."""
        widths = [(joints,), (joints,), (7,), (6,), (links, 6)]
        return cls(*(np.full((steps, NUM_WORLDS, *w), np.nan) for w in widths))

    def until(self, steps: int) -> Record:
        """The first control steps."""
        return Record(*(field[:steps] for field in vars(self).values()))

    def put(self, step: int, row: int | slice, values: Iterable[np.ndarray]) -> None:
        """Write one control step of some worlds, in the order of the attributes."""
        fields = vars(self).values()
        for field, value in zip(fields, values, strict=True):
            field[step, row] = value


class Oracle:
    """MuJoCo C on the scene's text; addresses by name, nothing from ``StateMap``.

    Args:
        scene: of the only motion.
        edit: changes the compiled model, to play a broken engine.
        step: advances one substep.
    """

    def __init__(
        self,
        scene: Scene,
        edit: Callable[[mujoco.MjModel], None] | None = None,
        step: Step = mujoco.mj_step,
    ) -> None:
        self.step = step
        self.model = model = mujoco.MjModel.from_xml_string(scene.xml)
        if edit is not None:
            edit(model)
        self.hand = scene.hands["right"]
        joints = [model.joint(n) for n in self.hand.joint_names]
        self.qpos = [j.qposadr[0] for j in joints]
        self.dof = [j.dofadr[0] for j in joints]
        self.ctrl = [model.actuator(n).id for n in self.hand.joint_names]
        self.sensors = [f"contact_{n}" for n in self.hand.link_names]

    def start(self, state: dict[str, torch.Tensor], row: int) -> mujoco.MjData:
        """Data of one world in a state, after ``mj_forward``."""
        data = mujoco.MjData(self.model)
        joints = (state[k][row, RIGHT].double().numpy() for k in _JOINTS)
        data.qpos[self.qpos], data.qvel[self.dof] = joints
        data.ctrl[self.ctrl] = state["joint_pos"][row, RIGHT].double().numpy()
        box = data.joint("object0")
        box.qpos[:] = state["object_pose"][row, 0].double().numpy()
        vel = state["object_vel"][row, 0].double().numpy()
        box.qvel[:3], box.qvel[3:] = vel[:3], rotation(box.qpos[3:]).T @ vel[3:]
        mujoco.mj_forward(self.model, data)
        return data

    def read(self, data: mujoco.MjData) -> tuple[np.ndarray, ...]:
        """Values of a ``Record``."""
        sensed = np.array([data.sensor(n).data for n in self.sensors])
        joints = data.qpos[self.qpos], data.qvel[self.dof]
        return *joints, *_box(data), sensed

    def run(
        self, script: Script, names: Iterable[str] = tuple(ROW), steps: int = STEPS
    ) -> Record:
        """Run the script in the worlds of some scenarios."""
        out = Record.empty(steps, len(self.qpos), len(self.sensors))
        for row in sorted({ROW[name] for name in names}):
            data = self.start(script.state, row)
            for step in range(steps):
                target = script.target[step, row, RIGHT].double().numpy()
                data.ctrl[self.ctrl] = target
                self._substeps(data, script.wrench(step, slice(row, row + 1)))
                out.put(step, row, self.read(data))
        return out

    def _substeps(self, data: mujoco.MjData, wrench: ObjectWrench) -> None:
        slots, pulled = wrench.mass.shape[1], bool(wrench.present.any())
        for _ in range(DECIMATION):
            if pulled:
                box = (torch.tensor(x).float() for x in _box(data))
                pose, vel = (x.expand(1, slots, -1) for x in box)
                force = wrench(pose, vel)[0, 0].double().numpy()
                data.body("object0").xfrc_applied[:] = force
            self.step(self.model, data)


def step_like_mjx(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Forces and accelerations of MuJoCo C, integrated as MJX 3.17 does.

    MuJoCo 4 leaves the damping of servos at their force limit out of the implicit part
    and takes the gyroscopic forces of free bodies in; MJX does neither. With this step
    its two causes of difference, integration and contact, can be told apart.
    """
    mujoco.mj_forward(model, data)
    mass, moment = np.zeros((model.nv, model.nv)), np.zeros((model.nu, model.nv))
    mujoco.mj_fullM(model, data, mass)
    sparse = (data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    mujoco.mju_sparse2dense(moment, data.actuator_moment, *sparse)
    damping = np.diag(model.dof_damping)
    damping -= moment.T * model.actuator_biasprm[:, 2] @ moment
    force = data.qfrc_smooth + data.qfrc_constraint
    step = model.opt.timestep
    data.qacc_warmstart[:] = data.qacc
    data.qvel += step * np.linalg.solve(mass + step * damping, force)
    mujoco.mj_integratePos(model, data.qpos, data.qvel, step)


def _box(data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """Pose and velocity of the box, world axes."""
    box = data.joint("object0")
    spin = rotation(box.qpos[3:]) @ box.qvel[3:]
    return box.qpos.copy(), np.concatenate([box.qvel[:3], spin])


_JOINTS = ("joint_pos", "joint_vel")


def rotation(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix of a quaternion wxyz, (3, 3)."""
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(quat, np.float64))
    return out.reshape(3, 3)


def read_engine(physics: Physics) -> tuple[np.ndarray, ...]:
    """Values of a ``Record`` of all worlds of an engine."""
    state = physics.state()
    rows = [state[keys.JOINT_POS][:, RIGHT], state[keys.JOINT_VEL][:, RIGHT]]
    rows += [state[keys.OBJECT_POSE][:, 0], state[keys.OBJECT_VEL][:, 0]]
    rows.append(state[keys.CONTACT][:, RIGHT])
    return tuple(np.asarray(x.double().cpu()) for x in rows)


def run_engine(physics: Physics, script: Script, steps: int = STEPS) -> Record:
    """Run the script on an engine, all worlds at once."""
    n, device = physics.num_envs, physics.device
    state = {name: value.to(device) for name, value in script.state.items()}
    motion = torch.zeros(n, dtype=torch.long, device=device)
    physics.reset(torch.ones_like(motion).bool(), motion, **state)
    first = read_engine(physics)
    out = Record.empty(steps, first[0].shape[-1], first[-1].shape[-2])
    for step in range(steps):
        wrench = on_device(script.wrench(step), device)
        physics.step(script.target[step].to(device), wrench)
        out.put(step, slice(None), read_engine(physics))
    return out


def on_device(wrench: ObjectWrench, device: torch.device) -> ObjectWrench:
    """The same wrench with its tensors on a device."""
    moved = {k: v.to(device) for k, v in vars(wrench).items() if torch.is_tensor(v)}
    return type(wrench)(**{**vars(wrench), **moved})
