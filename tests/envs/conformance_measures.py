"""How far two records are apart, scenario by scenario; pure numpy.

Each function takes a record of an engine and one of the oracle and returns named
numbers; ``tests/envs/conformance_limits.py`` says how large each may be.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from conformance_oracle import Record, rotation
from conformance_script import AWAY, FALL_VEL, ROW, SEEDS
from synthetic import make_box

GRAVITY = 9.81  # m/s2
SUBSTEP = 1 / 240  # s
FREE = 50  # control steps of free flight
BOX = make_box()
COM = BOX.com + 1e-5  # m; scenes move it a little off, for any object
HELD = slice(60, 120)  # one second of firm grip
LYING = slice(60, 120)  # one second in the open hand
LANDING = slice(0, 20)  # drop into the hand
EARLY, MIDDLE, LATE = slice(0, 10), slice(10, 50), slice(50, None)

Numbers = dict[str, float]


def fall(engine: Record, oracle: Record) -> Numbers:
    """Free fall of the centre of mass against the sum that the integrator computes.

    Velocities first, then positions: ``z_n = z_0 - g dt^2 n (n + 1) / 2``.
    """
    row = ROW["fall"]
    n = 4.0 * np.arange(1, FREE + 1)[:, None]
    start = np.array(AWAY[:3]) + COM
    exact = start + np.array(FALL_VEL[:3]) * n * SUBSTEP
    exact[:, 2:] -= GRAVITY * SUBSTEP**2 * n * (n + 1) / 2
    found = engine.object_pose[:FREE, row, :3] + COM  # it does not turn
    gap = engine.object_pose[:FREE, row] - oracle.object_pose[:FREE, row]
    return {"fall.formula": _most(found - exact), "fall.pose": _most(gap)}


def spin(engine: Record, oracle: Record) -> Numbers:
    """Torque-free spin: angular momentum, and the attitude against MuJoCo C."""
    row = ROW["spin"]
    quat = engine.object_pose[:FREE, row, 3:]
    vel = engine.object_vel[:FREE, row, 3:]
    momentum = np.array([_momentum(q, w) for q, w in zip(quat, vel, strict=True)])
    first = _momentum(quat[0], vel[0])
    lost = np.linalg.norm(momentum - first, axis=-1) / np.linalg.norm(first)
    turn, shift = _pose_gap(engine, oracle, row, slice(FREE))
    return {
        "spin.momentum": float(lost.max()),
        "spin.turn": float(turn.max()),
        "spin.pos": float(shift.max()),
    }


def _momentum(quat: np.ndarray, vel: np.ndarray) -> np.ndarray:
    turn = rotation(quat)
    return turn @ BOX.inertia @ turn.T @ vel


def limits(engine: Record, oracle: Record) -> Numbers:
    """Joints driven into both ends of their range, and resting there."""
    rows = [ROW["upper"], ROW["lower"]]
    gap = engine.joint_pos[:, rows] - oracle.joint_pos[:, rows]
    return {"limits.path": _most(gap), "limits.rest": _most(gap[-20:])}


def small_steps(engine: Record, oracle: Record) -> Numbers:
    """Step responses of all joints within the forces of their servos."""
    return _joint_gap(engine, oracle, "small_steps")


def large_steps(engine: Record, oracle: Record) -> Numbers:
    """Step responses of all joints that saturate the servos."""
    return _joint_gap(engine, oracle, "large_steps")


def fist(engine: Record, oracle: Record) -> Numbers:
    """Fingers close on the thumb and palm, and open."""
    return _joint_gap(engine, oracle, "fist")


def rub(engine: Record, oracle: Record) -> Numbers:
    """Fingertips press on the disc and draw along it."""
    return _joint_gap(engine, oracle, "rub")


def _joint_gap(engine: Record, oracle: Record, name: str) -> Numbers:
    gap = engine.joint_pos[:, ROW[name]] - oracle.joint_pos[:, ROW[name]]
    rms = float(np.sqrt((gap**2).mean(0)).max())
    return {f"{name}.max": _most(gap), f"{name}.rms": rms}


def grip(engine: Record, oracle: Record) -> Numbers:
    """The box lifted between thumb and fingers, and held for a second."""
    return _held(engine, oracle, "grip", HELD)


def cradle(engine: Record, oracle: Record) -> Numbers:
    """The box dropped onto the open hand, and lying there for a second."""
    turn, shift = _pose_gap(engine, oracle, ROW["cradle"], LANDING)
    landing = {"cradle.land_pos": shift.max(), "cradle.land_turn": turn.max()}
    return {**_held(engine, oracle, "cradle", LYING), **landing}


def _held(engine: Record, oracle: Record, name: str, when: slice) -> Numbers:
    row = ROW[name]
    force, wanted = (r.contact[when, row, :, :3] for r in (engine, oracle))
    total = force.sum(1).mean(0) + np.array([0.0, 0.0, BOX.mass * GRAVITY])
    turn, shift = _pose_gap(engine, oracle, row, when)
    drift = [np.ptp(r.object_pose[when, row, :3], 0) for r in (engine, oracle)]
    return {
        f"{name}.weight": float(np.linalg.norm(total) / (BOX.mass * GRAVITY)),
        f"{name}.force": _most(force.mean(0) - wanted.mean(0)),
        f"{name}.pos": float(shift.max()),
        f"{name}.turn": float(turn.max()),
        f"{name}.drift": _most(drift[0] - drift[1]),
    }


def slide(engine: Record, oracle: Record) -> Numbers:
    """The box slides along the disc, tips a little and comes to rest."""
    return _box_gap(engine, oracle, "slide")


def twirl(engine: Record, oracle: Record) -> Numbers:
    """The box spins on the disc about the vertical and comes to rest."""
    return _box_gap(engine, oracle, "twirl")


def hold(engine: Record, oracle: Record) -> Numbers:
    """The box in the air, carried by the hold alone."""
    return _box_gap(engine, oracle, "hold")


def assist(engine: Record, oracle: Record) -> Numbers:
    """The box in the air, carried by the assist alone."""
    return _box_gap(engine, oracle, "assist")


def _box_gap(engine: Record, oracle: Record, name: str) -> Numbers:
    turn, shift = _pose_gap(engine, oracle, ROW[name], slice(None))
    return {f"{name}.pos": float(shift.max()), f"{name}.turn": float(turn.max())}


def random_play(engine: Record, oracle: Record) -> Numbers:
    """Random control in contact: paths at first, statistics when they have parted."""
    rows = [ROW[f"random{seed}"] for seed in SEEDS]
    joints = np.abs(engine.joint_pos[:, rows] - oracle.joint_pos[:, rows]).max(-1)
    shift = np.array([_pose_gap(engine, oracle, r, slice(None))[1] for r in rows]).T
    pushes = [
        np.linalg.norm(r.contact[LATE, rows, :, :3], axis=-1).sum(-1).mean()
        for r in (engine, oracle)
    ]
    low = [r.object_pose[LATE, rows, 2].mean() for r in (engine, oracle)]
    return {
        "random.joints_early": float(joints[EARLY].max()),
        "random.object_early": float(shift[EARLY].max()),
        "random.joints_middle": float(np.median(joints[MIDDLE])),
        "random.object_middle": float(np.median(shift[MIDDLE])),
        "random.joints_late": float(np.median(joints[LATE])),
        "random.push_late": float(abs(pushes[0] / pushes[1] - 1)),
        "random.height_late": float(abs(low[0] - low[1])),
    }


def _pose_gap(
    engine: Record, oracle: Record, row: int, when: slice
) -> tuple[np.ndarray, np.ndarray]:
    """Angle, rad, and distance, m, between the boxes of two records, (T,)."""
    a, b = engine.object_pose[when, row], oracle.object_pose[when, row]
    # The chord of unit quaternions: the cosine would lose half of the digits.
    chord = np.minimum(
        *(np.linalg.norm(a[:, 3:] + s * b[:, 3:], axis=-1) for s in (-1, 1))
    )
    return 4 * np.arcsin(chord / 2), np.linalg.norm(a[:, :3] - b[:, :3], axis=-1)


def _most(gap: np.ndarray) -> float:
    return float(np.abs(gap).max())


Measure = Callable[[Record, Record], Numbers]
_OWN = (fall, spin, small_steps, large_steps, fist, grip, cradle, slide, twirl, rub)
MEASURES: dict[str, tuple[Measure, tuple[str, ...]]] = {
    **{f.__name__: (f, (f.__name__,)) for f in (*_OWN, hold, assist)},
    "limits": (limits, ("upper", "lower")),
    "random": (random_play, tuple(f"random{seed}" for seed in SEEDS)),
}
"""What is measured, and the worlds it needs."""
