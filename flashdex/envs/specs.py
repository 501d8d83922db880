"""Specs of the tracking environment: what it emits, takes and pays."""

from __future__ import annotations

import torch
from torch import Size
from torchrl.data import Binary, Bounded, Composite, Unbounded

from flashdex import keys
from flashdex.envs.contact import CODE_WIDTH


def state_spec(num_envs: int, joints: int, slots: int, links: int) -> Composite:
    """Compact state of N worlds, as ``flashdex.keys`` lists it.

    Args:
        num_envs: worlds N.
        joints: joints of a hand, wrist included.
        slots: object slots of a world.
        links: links of a hand.
    """
    n = num_envs
    whole = torch.int64
    leaves = {
        keys.JOINT_POS: Unbounded(Size((n, 2, joints))),
        keys.JOINT_VEL: Unbounded(Size((n, 2, joints))),
        keys.JOINT_TARGET: Unbounded(Size((n, 2, joints))),
        keys.OBJECT_POSE: Unbounded(Size((n, slots, 7))),
        keys.OBJECT_VEL: Unbounded(Size((n, slots, 6))),
        keys.CONTACT: Unbounded(Size((n, 2, links, CODE_WIDTH)), dtype=torch.int8),
        keys.MOTION: Unbounded(Size((n, 1)), dtype=whole),
        keys.FRAME: Unbounded(Size((n, 1)), dtype=whole),
        keys.ATTEMPT: Binary(1, Size((n, 1)), dtype=torch.bool),
    }
    return Composite(leaves, shape=(n,))


def action_spec(num_envs: int, joints: int) -> Composite:
    """Actions of both hands in [-1, 1], (N, J) each."""
    n = num_envs
    sides = {
        s: Composite({keys.ACTION: Bounded(-1.0, 1.0, Size((n, joints)))}, shape=(n,))
        for s in keys.SIDES
    }
    return Composite(sides, shape=(n,))


def reward_spec(num_envs: int) -> Composite:
    """Rewards of both hands, (N, 1) each."""
    n = num_envs
    sides = {
        s: Composite({keys.REWARD: Unbounded(Size((n, 1)))}, shape=(n,))
        for s in keys.SIDES
    }
    return Composite(sides, shape=(n,))


def done_spec(num_envs: int) -> Composite:
    """Flags at the root, (N, 1) each."""
    n = num_envs
    names = (keys.DONE, keys.TERMINATED, keys.TRUNCATED)
    flags = {name: Binary(1, Size((n, 1)), dtype=torch.bool) for name in names}
    return Composite(flags, shape=(n,))
