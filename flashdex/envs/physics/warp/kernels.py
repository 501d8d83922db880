# type: ignore
# Kernels are written in the dialect of Python that warp compiles.
"""Warp kernels of the engine: the wrench on objects, and the mark of bad worlds.

Only imported where warp is known to be installed.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

GRAVITY = wp.constant(9.81)  # m/s2
vec7 = wp.types.vector(length=7, dtype=float)
_LIMIT = wp.constant(1e10)  # MuJoCo's own bound of a usable number
_TINY = wp.constant(1.0842022e-19)  # square root of the smallest normal float32


@wp.func
def _rotate(w: float, u: wp.vec3, v: wp.vec3) -> wp.vec3:
    t = 2.0 * wp.cross(u, v)
    return v + w * t + wp.cross(u, t)


@wp.func
def _turn(rw: float, ru: wp.vec3, w: float, u: wp.vec3) -> wp.vec3:
    """Shortest rotation vector from (w, u) to (rw, ru), world axes."""
    dw = rw * w + wp.dot(ru, u)
    du = w * ru - rw * u - wp.cross(ru, u)
    if dw < 0.0:
        dw = -dw
        du = -du
    sine = wp.length(du)
    if sine < _TINY:
        return 2.0 * du
    return (2.0 * wp.atan2(sine, dw) / sine) * du


@wp.func
def _clamp(v: wp.vec3, limit: float) -> wp.vec3:
    return wp.vec3(
        wp.clamp(v[0], -limit, limit),
        wp.clamp(v[1], -limit, limit),
        wp.clamp(v[2], -limit, limit),
    )


@wp.func
def _three(rows: wp.array2d[float], world: int, at: int) -> wp.vec3:
    return wp.vec3(rows[world, at], rows[world, at + 1], rows[world, at + 2])


@wp.func
def _torque(inertia: wp.mat33, w: float, u: wp.vec3, accel: wp.vec3) -> wp.vec3:
    """Torque in world axes for an angular acceleration in world axes."""
    return _rotate(w, u, inertia * _rotate(w, -u, accel))


@wp.kernel
def apply_wrench(
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    qpos_adr: wp.array[int],
    dof_adr: wp.array[int],
    body: wp.array[int],
    ref_pose: wp.array2d[vec7],
    ref_vel: wp.array2d[wp.spatial_vector],
    mass: wp.array2d[float],
    inertia: wp.array2d[wp.mat33],
    present: wp.array2d[bool],
    hold: wp.array[float],
    kp: wp.array[float],
    kv: wp.array[float],
    params: wp.array[float],
    xfrc: wp.array2d[wp.spatial_vector],
    wrench: wp.array2d[wp.spatial_vector],
) -> None:
    """``ObjectWrench.__call__`` of one object slot, into ``xfrc_applied``."""
    world, slot = wp.tid()
    total = wp.spatial_vector()
    if present[world, slot]:
        p, v, ref = qpos_adr[slot], dof_adr[slot], ref_pose[world, slot]
        w, u = qpos[world, p + 3], _three(qpos, world, p + 4)
        stiff, ratio = params[0], params[1]
        # MuJoCo keeps the spin of a free joint in body axes.
        spin = _rotate(w, u, _three(qvel, world, v + 3))
        lag = wp.spatial_top(ref_vel[world, slot]) - _three(qvel, world, v)
        spin_lag = wp.spatial_bottom(ref_vel[world, slot]) - spin
        offset = wp.vec3(ref[0], ref[1], ref[2]) - _three(qpos, world, p)
        turn = _turn(ref[3], wp.vec3(ref[4], ref[5], ref[6]), w, u)
        own, share = inertia[world, slot], hold[world]

        accel = stiff * stiff * offset + 2.0 * stiff * lag
        accel = accel + wp.vec3(0.0, 0.0, GRAVITY)
        angular = stiff * stiff * turn + 2.0 * stiff * spin_lag
        force = share * mass[world, slot] * accel
        torque = share * _torque(own, w, u, angular)

        pull = kp[world] * offset + kv[world] * lag
        angular = ratio * kp[world] * turn + wp.sqrt(ratio) * kv[world] * spin_lag
        force = force + _clamp(pull, params[2])
        torque = torque + _clamp(_torque(own, w, u, angular), params[3])
        total = wp.spatial_vector(force, torque)
    xfrc[world, body[slot]] = total
    wrench[world, slot] = total


@wp.func
def _unusable(x: float) -> bool:
    return not wp.isfinite(x) or wp.abs(x) > _LIMIT


@wp.kernel
def mark_bad(
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    qacc: wp.array2d[float],
    bad: wp.array[bool],
) -> None:
    """Mark worlds with a number that is not finite or beyond MuJoCo's bound."""
    world = wp.tid()
    found = bool(False)  # noqa: UP018 - warp: a variable, not a constant
    for i in range(qpos.shape[1]):
        found = found or _unusable(qpos[world, i])
    for i in range(qvel.shape[1]):
        found = found or _unusable(qvel[world, i]) or _unusable(qacc[world, i])
    if found:
        bad[world] = True
