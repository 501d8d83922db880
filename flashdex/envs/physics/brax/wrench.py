"""The wrench on objects in JAX: the maths of ``envs.scene.wrench`` for one world.

Only imported where brax is known to be installed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from brax import math
from jax import Array
from torch import Tensor

from flashdex.envs.scene.wrench import LIMITS, ObjectWrench

GRAVITY = 9.81  # m/s2


class WrenchInputs(NamedTuple):
    """``ObjectWrench`` as arrays; here of one world, batched in front elsewhere.

    ``limits`` holds its four numbers: stiffness of the hold, rad/s; torque ratio, no
    unit; force limit, N; torque limit, N m, (4,).
    """

    ref_pose: Array
    ref_vel: Array
    mass: Array
    inertia: Array
    present: Array
    hold: Array
    kp: Array
    kv: Array
    limits: Array


def wrench_inputs(
    wrench: ObjectWrench, to_jax: Callable[[Tensor], Array]
) -> WrenchInputs:
    """The arrays of all worlds, (N, ...), but ``limits``, which they share."""
    limits = [getattr(wrench, name) for name in LIMITS]
    arrays = [getattr(wrench, name) for name in WrenchInputs._fields[:-1]]
    return WrenchInputs(*map(to_jax, arrays), limits=jnp.array(limits, jnp.float32))


def object_wrench(act: WrenchInputs, pose: Array, vel: Array) -> Array:
    """Force and torque on each object of one world, world axes, (O, 6).

    Poses (O, 7) and velocities (O, 6), linear before angular, are in the world.
    """
    turn = jax.vmap(_turn)(act.ref_pose[:, 3:], pose[:, 3:])
    offset = jnp.concatenate([act.ref_pose[:, :3] - pose[:, :3], turn], -1)
    speed = act.ref_vel - vel
    total = _hold(act, pose, offset, speed) + _assist(act, pose, offset, speed)
    return jnp.where(act.present[:, None], total, 0.0)


def _hold(act: WrenchInputs, pose: Array, offset: Array, speed: Array) -> Array:
    stiffness = act.limits[0]
    accel = stiffness**2 * offset + 2 * stiffness * speed
    force = act.mass[:, None] * accel[:, :3].at[:, 2].add(GRAVITY)
    torque = jax.vmap(_torque)(pose[:, 3:], act.inertia, accel[:, 3:])
    return act.hold * jnp.concatenate([force, torque], -1)


def _assist(act: WrenchInputs, pose: Array, offset: Array, speed: Array) -> Array:
    _, ratio, force_limit, torque_limit = act.limits
    force = act.kp * offset[:, :3] + act.kv * speed[:, :3]
    accel = ratio * act.kp * offset[:, 3:] + jnp.sqrt(ratio) * act.kv * speed[:, 3:]
    torque = jax.vmap(_torque)(pose[:, 3:], act.inertia, accel)
    force = jnp.clip(force, -force_limit, force_limit)
    return jnp.concatenate([force, jnp.clip(torque, -torque_limit, torque_limit)], -1)


def _torque(quat: Array, inertia: Array, accel: Array) -> Array:
    """Torque of an angular acceleration, both in world axes, (3,)."""
    return math.rotate(inertia @ math.inv_rotate(accel, quat), quat)


def _turn(ref: Array, quat: Array) -> Array:
    """Shortest rotation vector from ``quat`` to ``ref``, world axes, (3,)."""
    q = math.quat_mul(ref, math.quat_inv(quat))
    q = jnp.where(q[0] < 0, -q, q)
    sine = jnp.linalg.norm(q[1:])
    # Below the square root of the smallest number angle / sine is 2 exactly.
    tiny = sine < jnp.finfo(q.dtype).tiny ** 0.5
    safe = jnp.where(tiny, 1.0, sine)
    return q[1:] * jnp.where(tiny, 2.0, 2 * jnp.arctan2(safe, q[0]) / safe)
