"""Full-length rollouts of every motion under a given controller."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.envs.tracking import TrackingEnv
from flashdex.rollouts.build import Attempt
from flashdex.rollouts.recorder import AttemptRing
from flashdex.training.setup import Workbench

Controller = Callable[[TensorDictBase, TrackingEnv], Tensor]
"""State and environment to actions (N, 2, J)."""


def roll_all(
    bench: Workbench,
    controller: Controller,
    *,
    env_steps: int = 0,
    worlds: int = 32,
    target: Callable[[TrackingEnv], Tensor] | None = None,
) -> list[Attempt]:
    """Roll every motion once from frame 0, without assist, noise or terminations.

    Args:
        bench: motions and recipe.
        controller: what acts.
        env_steps: counter stored with the rollouts.
        worlds: motions rolled side by side.
        target: joint position targets (N, 2, J) that replace those of the action, for
            controllers outside the action space.

    Returns:
        One attempt a motion, in library order.
    """
    total = bench.bank.num_motions
    out: list[Attempt] = []
    for first in range(0, total, worlds):
        rows = torch.arange(first, min(first + worlds, total))
        out += _roll(bench, controller, rows, env_steps, target)
    return out


@torch.no_grad()
def _roll(
    bench: Workbench,
    controller: Controller,
    rows: Tensor,
    env_steps: int,
    target: Callable[[TrackingEnv], Tensor] | None,
) -> list[Attempt]:
    env = bench.make_env(num_envs=len(rows), evaluation=True)
    env.forced_motion = rows.to(env.device)
    env.target_override = target
    ring, maker = (
        AttemptRing(env, look_every=1),
        bench.attempt_maker(env.physics.scenes),
    )
    td = env.reset()
    ring.begin()
    found: dict[int, Attempt] = {}
    while len(found) < len(rows):
        action = controller(td, env)
        env.put_action(td, action)
        done = env.step(td)["next", keys.DONE]
        for episode in ring.step(action, done, env_steps):
            if episode.motion not in found:  # short motions begin again
                found[episode.motion] = maker.make(episode)
        td = env.restart(done.squeeze(-1))
        ring.begin()
    return [found[r] for r in rows.tolist()]
