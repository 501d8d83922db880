"""Put engines into states and read them back, a few worlds at a time."""

from __future__ import annotations

import torch


def reset_worlds(physics, ids, motion, state):
    """Reset worlds ``ids`` (n,) to motions (n,) and states of n rows."""
    mask = torch.zeros(physics.num_envs, dtype=torch.bool)
    mask[ids] = True

    def full(rows):
        out = rows.new_zeros(physics.num_envs, *rows.shape[1:])
        out[ids] = rows
        return out.to(physics.device)

    rows = {name: full(value) for name, value in state.items()}
    physics.reset(mask.to(physics.device), full(motion), **rows)


def raw_state(physics, env):
    """Copies of qpos, qvel and ctrl of one world, numpy."""
    raw = physics.raw()
    return tuple(x[env].cpu().numpy().copy() for x in (raw.qpos, raw.qvel, raw.ctrl))
