"""Full-length rollouts of every motion under a given controller."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import step_mdp

from flashdex import keys
from flashdex.envs.tracking import TrackingEnv
from flashdex.training.attempts import Attempt, AttemptRecorder
from flashdex.training.setup import Workbench

Controller = Callable[[TensorDictBase, TrackingEnv], Tensor]
"""State and environment to actions (N, 2, J)."""


def roll_all(
    bench: Workbench,
    controller: Controller,
    *,
    criterion: str,
    env_steps: int = 0,
    worlds: int = 32,
    target: Callable[[TrackingEnv], Tensor] | None = None,
) -> list[Attempt]:
    """Roll every motion once from frame 0, without assist, noise or terminations.

    Args:
        bench: motions and recipe.
        controller: what acts.
        criterion: stored with the rollouts.
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
        out += _roll(bench, controller, rows, criterion, env_steps, target)
    return out


@torch.no_grad()
def _roll(
    bench: Workbench,
    controller: Controller,
    rows: Tensor,
    criterion: str,
    env_steps: int,
    target: Callable[[TrackingEnv], Tensor] | None,
) -> list[Attempt]:
    env = bench.make_env(num_envs=len(rows), evaluation=True)
    env.forced_motion = rows.to(env.device)
    env.target_override = target
    recorder = AttemptRecorder(
        env,
        criterion=criterion,
        seed=bench.recipe.seed,
        engine=bench.recipe.physics.engine,
        look_every=1,
    )
    td = env.reset()
    recorder.begin()
    found: dict[int, Attempt] = {}
    for _ in range(int(bench.bank.length.cpu()[rows].max()) + 1):
        action = controller(td, env)
        for i, side in enumerate(keys.SIDES):
            td.set(keys.action(side), action[:, i])
        td = env.step(td)
        for attempt in recorder.step(action, td["next"], env_steps):
            found.setdefault(attempt.motion, attempt)
        if len(found) == len(rows):
            break
        td = step_mdp(td)
    return [found[r] for r in rows.tolist()]
