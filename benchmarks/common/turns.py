"""Engines on a device: the environment's loop and the engine alone take turns.

A turn begins with all worlds reset from the same draw. The environment's loop runs
some control steps; then the engine repeats them from the same start with the same
targets: no observation, no judge, no reset, no wrench. The device is waited for at the
ends of a turn only.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median
from typing import Any

import torch
from torch import Tensor

from benchmarks.common.clock import now
from flashdex import keys
from flashdex.envs.tracking import TrackingEnv

TURN = 32  # control steps, half a second of simulated time
BURN_IN = 2  # turns that are not counted


@dataclass(frozen=True)
class Turn:
    """Seconds that one turn took.

    Attributes:
        env: act with random actions, step, reset what has ended, s.
        physics: the engine's steps alone, s.
    """

    env: float
    physics: float


class TurnTaker:
    """Runs turns on one environment.

    Args:
        env: environment on any engine.
        steps: control steps of a turn.
        seed: of the random actions.
    """

    def __init__(self, env: TrackingEnv, *, steps: int = TURN, seed: int = 0) -> None:
        self.env, self.steps = env, steps
        self.generator = torch.Generator(env.device).manual_seed(seed)

    def run(self) -> Turn:
        """One turn of each."""
        start = self.env.generator.get_state()
        targets, env_seconds = self.loop()
        self.env.generator.set_state(start)  # the same draw: the same states
        return Turn(env_seconds, self.replay(targets))

    @torch.no_grad()
    def loop(self) -> tuple[list[Tensor], float]:
        """The environment's turn: its joint targets, (N, 2, J) each, and its seconds.

        The sum is what a random policy in the training loop would take.
        """
        env = self.env
        shape = (env.num_envs, 2, env.bank.num_joints)
        targets = []
        td = env.reset()
        begin = now(env.device)
        for _ in range(self.steps):
            action = torch.rand(shape, generator=self.generator, device=env.device)
            action = 2 * action - 1
            for i, side in enumerate(keys.SIDES):
                td.set(keys.action(side), action[:, i])
            after = env.step(td).get("next")
            targets.append(after[keys.JOINT_TARGET])
            td = env.reset_worlds(after[keys.DONE].squeeze(-1))
        return targets, now(env.device) - begin

    @torch.no_grad()
    def replay(self, targets: list[Tensor]) -> float:
        """Seconds of the engine alone under the given targets, after a reset.

        Args:
            targets: joint position targets, (N, 2, J) each.
        """
        env = self.env
        env.reset()
        begin = now(env.device)
        for target in targets:
            env.physics.step(target)
        return now(env.device) - begin


def measure(env: TrackingEnv, *, seconds: float, steps: int = TURN) -> dict[str, Any]:
    """Let both take turns for some seconds.

    Args:
        env: environment on any engine.
        seconds: how long to measure, burn-in excluded.
        steps: control steps of a turn.

    Returns:
        ``env_steps_per_s``, ``physics_env_steps_per_s``, ``ratio`` (medians over
        turns), ``warm_up_s`` of the first turns, number of ``segments``.
    """
    taker = TurnTaker(env, steps=steps)
    begin = now(env.device)
    for _ in range(BURN_IN):
        taker.run()
    warm = now(env.device) - begin
    turns: list[Turn] = []
    end = now(env.device) + seconds
    while now(env.device) < end or len(turns) < 3:
        turns.append(taker.run())
    worlds = steps * env.num_envs
    return {
        "env_steps_per_s": round(worlds / median(t.env for t in turns), 1),
        "physics_env_steps_per_s": round(worlds / median(t.physics for t in turns), 1),
        "ratio": round(median(t.physics / t.env for t in turns), 4),
        "segments": len(turns),
        "warm_up_s": round(warm, 2),
    }


def physics_rate(env: TrackingEnv, *, seconds: float, steps: int = TURN) -> float:
    """Env steps a second of the engine alone, under targets of random actions.

    Args:
        env: environment on any engine; its worlds are reset.
        seconds: how long to measure.
        steps: control steps of a turn.
    """
    taker = TurnTaker(env, steps=steps)
    targets, _ = taker.loop()
    taker.replay(targets[:2])  # records what the engine records on the first call
    times = []
    end = now(env.device) + seconds
    while now(env.device) < end or len(times) < 2:
        times.append(taker.replay(targets))
    return steps * env.num_envs / median(times)


def room_used(env: TrackingEnv) -> dict[str, int]:
    """Contacts and constraint rows of the last substep, where the engine keeps them.

    Args:
        env: environment on any engine.

    Returns:
        ``nacon`` of all worlds and ``naconmax``, ``nefc`` of the fullest world and
        ``njmax``; empty for engines without such numbers.
    """
    data = getattr(env.physics, "data", None)
    found: dict[str, int] = {}
    for name, limit in (("nacon", "naconmax"), ("nefc", "njmax")):
        array: Any = getattr(data, name, None)
        if hasattr(array, "numpy"):
            found[name] = int(array.numpy().max())
            found[limit] = int(getattr(data, limit, 0))
    return found
