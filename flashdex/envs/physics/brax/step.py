"""The compiled control step of the brax engine: substeps of N worlds at once.

Only imported where brax is known to be installed.
"""

from __future__ import annotations

import os
import platform
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import torch
from brax import math
from brax.base import Motion, Transform
from brax.mjx import pipeline
from brax.mjx.base import State
from jax import Array
from jax.typing import ArrayLike
from mujoco import mjx
from torch import Tensor

from flashdex.envs.physics.brax.model import BraxModel
from flashdex.envs.physics.brax.wrench import WrenchInputs, object_wrench
from flashdex.errors import FlashdexError
from flashdex.objects.asset import default_cache_dir

MAX_VALUE = 1e10  # MuJoCo's own bound of a usable number


class Worlds(NamedTuple):
    """State of N worlds; every array has a row a world."""

    qpos: Array  # (N, nq)
    qvel: Array  # (N, nv)
    ctrl: Array  # (N, nu)
    # accelerations of the last substep, where the solver starts, (N, nv)
    warmstart: Array
    motion: Array  # motion rows, (N,) int32
    wrench: Array  # on each object in the last substep, world axes, (N, O, 6)
    contact: Array  # net force and point on each link, world, (N, S, L, 6)
    bad: Array  # numbers broke down since the last reset, (N,)
    full: Array  # all places for contacts were taken, since last asked, (N,)


Advance = Callable[[Worlds, WrenchInputs, ArrayLike], Worlds]


def make_advance(model: BraxModel, own_slot: Array) -> Advance:
    """Build the compiled function that advances all worlds by some substeps.

    ``own_slot`` is the object slot of each existing hand by motion, (M, S). The number
    of substeps is not part of what is compiled: none, one and all use one program.
    """
    blank = _blank_state(model)

    def substep(world: Worlds, act: WrenchInputs) -> Worlds:
        # Without this, TPUs multiply in bfloat16 and GPUs in TF32.
        with jax.default_matmul_precision("highest"):
            return _substep(model, own_slot, blank, world, act)

    def advance(worlds: Worlds, act: WrenchInputs, substeps: ArrayLike) -> Worlds:
        shared = act.limits  # by all worlds

        def one(world: Worlds, *own: Array) -> Worlds:
            return substep(world, WrenchInputs(*own, limits=shared))

        return jax.lax.fori_loop(
            0, substeps, lambda _, w: jax.vmap(one)(w, *act[:-1]), worlds
        )

    return jax.jit(advance)


def empty_worlds(model: BraxModel, num_envs: int, slots: int) -> Worlds:
    """Worlds before their first reset: everything zero."""
    system, (hands, _) = model.system, model.link_of_geom.shape
    links = int(model.link_of_geom.max()) + 1

    def zeros(*shape: int, dtype: type = jnp.float32) -> Array:
        return jnp.zeros((num_envs, *shape), dtype)

    return Worlds(
        qpos=zeros(system.nq),
        qvel=zeros(system.nv),
        ctrl=zeros(system.nu),
        warmstart=zeros(system.nv),
        motion=zeros(dtype=jnp.int32),
        wrench=zeros(slots, 6),
        contact=zeros(hands, links, 6),
        bad=zeros(dtype=jnp.bool_),
        full=zeros(dtype=jnp.bool_),
    )


@jax.jit
def place(
    worlds: Worlds, mask: Array, qpos: Array, qvel: Array, ctrl: Array, motion: Array
) -> Worlds:
    """Put the worlds of ``mask`` (N,) into new states; the others stay as they are."""
    zero = jax.tree.map(jnp.zeros_like, worlds)
    new = zero._replace(qpos=qpos, qvel=qvel, ctrl=ctrl, motion=motion)
    return _choose(mask, new._replace(full=worlds.full), worlds)


@jax.jit
def adopt_forward(mask: Array, worlds: Worlds, probe: Worlds) -> Worlds:
    """Take the contacts of a trial substep, which begin at the state itself."""
    seen = worlds._replace(contact=probe.contact, warmstart=probe.warmstart)
    return _choose(mask, seen, worlds)


def _choose(mask: Array, new: Worlds, old: Worlds) -> Worlds:
    def pick(a: Array, b: Array) -> Array:
        return jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    return jax.tree.map(pick, new, old)


def _blank_state(model: BraxModel) -> State:
    """A pipeline state without a forward pass, which would be compiled for minutes."""
    links = model.system.nbody - 1
    zero = jnp.zeros((links, 3))
    pose, speed = Transform(zero, jnp.zeros((links, 4))), Motion(zero, zero)
    data = mjx.make_data(model.system)
    return State(
        q=data.qpos, qd=data.qvel, x=pose, xd=speed, contact=None, **data.__dict__
    )


def _substep(
    model: BraxModel, own_slot: Array, blank: State, world: Worlds, act: WrenchInputs
) -> Worlds:
    wrench = object_wrench(act, *_objects(model, world, len(act.mass)))
    used = len(model.object_body)
    applied = jnp.zeros_like(blank.xfrc_applied)
    applied = applied.at[model.object_body].set(wrench[:used])
    state = blank.replace(
        qpos=world.qpos,
        qvel=world.qvel,
        qacc_warmstart=world.warmstart,
        xfrc_applied=applied,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # brax reads ``data.ncon``
        state = pipeline.step(system_of(model, world.motion), state, world.ctrl)
    numbers = jnp.concatenate([state.qpos, state.qvel, state.qacc])
    return world._replace(
        qpos=state.qpos,
        qvel=state.qvel,
        warmstart=state.qacc_warmstart,
        wrench=wrench,
        contact=_contact(model, own_slot[world.motion], state),
        # A number that is not finite fails the comparison.
        bad=world.bad | ~jnp.all(jnp.abs(numbers) <= MAX_VALUE),
        full=world.full | is_full(model, state),
    )


def system_of(model: BraxModel, motion: ArrayLike) -> mjx.Model:
    """The system with the supports of one motion."""
    system, ids = model.system, model.support_geoms
    return system.replace(
        geom_pos=system.geom_pos.at[ids].set(model.support_pos[motion]),
        geom_size=system.geom_size.at[ids].set(model.support_size[motion]),
    )


def _objects(model: BraxModel, world: Worlds, slots: int) -> tuple[Array, Array]:
    """Object poses (O, 7) and velocities (O, 6), world; zero where no slot exists."""
    pose, vel = jnp.zeros((slots, 7)).at[:, 3].set(1.0), jnp.zeros((slots, 6))
    columns = model.object_qpos[:, None] + jnp.arange(7)
    found = world.qpos[columns]
    speed = world.qvel[model.object_dof[:, None] + jnp.arange(6)]
    # MuJoCo keeps the spin of a free joint in body axes.
    spin = jax.vmap(math.rotate)(speed[:, 3:], found[:, 3:])
    speed = jnp.concatenate([speed[:, :3], spin], -1)
    used = len(model.object_qpos)
    return pose.at[:used].set(found), vel.at[:used].set(speed)


def _contact(model: BraxModel, own_slot: Array, state: State) -> Array:
    """Net force of its own object on each link and its point, world, (S, L, 6).

    The point is the mean of the contact points, weighted by the size of their forces.
    """
    contact, rows = state._impl.contact, state._impl.contact.efc_address
    local = state._impl.efc_force[rows[:, None] + jnp.arange(3)]
    force = jnp.einsum("cij,ci->cj", contact.frame, local)  # on the second geom
    size = jnp.linalg.norm(force, axis=-1, keepdims=True)
    links = jnp.asarray(model.link_of_geom)[:, contact.geom]  # (S, C, 2)
    slots = jnp.asarray(model.slot_of_geom)[contact.geom]  # (C, 2)
    num_links = int(model.link_of_geom.max()) + 1

    def of_hand(link: Array, own: Array) -> Array:
        first = (link[:, 0] >= 0) & (slots[:, 1] == own)
        second = (link[:, 1] >= 0) & (slots[:, 0] == own)
        row = jnp.where(first, link[:, 0], jnp.where(second, link[:, 1], num_links))
        signed = jnp.where(first[:, None], -force, force)
        parts = jnp.concatenate([signed, size * contact.pos, size], -1)
        total = jax.ops.segment_sum(parts, row, num_links + 1)[:num_links]
        weight = total[:, 6:]
        point = total[:, 3:6] / jnp.where(weight > 0, weight, 1.0)
        return jnp.concatenate([total[:, :3], point], -1)

    return jax.vmap(of_hand)(links, own_slot)


def is_full(model: BraxModel, state: mjx.Data) -> Array:
    """Whether all places of a contact dimension are taken, so that some may lack."""
    contact = state._impl.contact
    touching = contact.dist < contact.includemargin
    full = jnp.zeros((), bool)
    for dim in set(contact.dim.tolist()):
        chosen = contact.dim == dim
        if chosen.sum() == model.places:  # otherwise there is room for all
            full |= touching[chosen].all()
    return full


_NARROW = {torch.float64: torch.float32, torch.int64: torch.int32}


def set_up() -> torch.device:
    """Choose the device, share it with torch, keep compiled programs; torch's name.

    JAX would take three quarters of a GPU at its start; it does not here, unless
    ``XLA_PYTHON_CLIENT_PREALLOCATE`` says so. On a TPU torch stays on the host.
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    if jax.config.values["jax_compilation_cache_dir"] is None:
        with suppress(
            FlashdexError, RuntimeError
        ):  # without a home they are compiled anew
            home = os.environ.get("XDG_CACHE_HOME")
            root = Path(home) / "flashdex" if home else default_cache_dir()
            # Programs are for the processor that compiled them; homes can be shared.
            folder = root / "jax" / platform.node()
            jax.config.update("jax_compilation_cache_dir", str(folder))
    device = _target()
    jax.config.update("jax_default_device", device)
    if device.platform == "gpu":
        return torch.device("cuda", device.local_hardware_id)
    return torch.device("cpu")


def to_jax(x: Tensor) -> Array:
    """A private copy of a tensor as a JAX array, 32 bit."""
    own = x.detach().to(_NARROW.get(x.dtype, x.dtype), copy=True).contiguous()
    return jax.device_put(jax.dlpack.from_dlpack(own), _target())


def to_torch(x: Array) -> Tensor:
    """A view of a JAX array: read it, never write it, and clone what leaves."""
    if next(iter(x.devices())).platform not in ("cpu", "gpu"):
        x = jax.device_put(x, jax.devices("cpu")[0])
    return torch.from_dlpack(x)


def _target() -> Any:
    first = jax.devices()[0]
    alone = first.platform == "gpu" and not torch.cuda.is_available()
    return jax.devices("cpu")[0] if alone else first
