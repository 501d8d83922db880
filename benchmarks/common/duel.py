"""The cpu engine: environment and bare ``mujoco.batch`` take turns.

Both step the very same models from the same states under the same controls, by turns
in one process, so that what else runs on the machine slows both alike. The ratio is
what the environment costs: 1 would be nothing but physics.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np
import torch
from mujoco.batch import Batch
from tensordict import TensorDictBase

from flashdex import keys
from flashdex.envs.physics.cpu import CpuPhysics
from flashdex.envs.tracking import TrackingEnv

SEGMENT = 10  # control steps by which the two take turns, from equal states
BURN_IN = 4  # segments that are not counted
STATE = ("qpos", "qvel", "qacc_warmstart")


@dataclass(frozen=True)
class Segment:
    """Seconds that one segment took.

    Attributes:
        env: environment steps with their resets, s.
        physics: the same controls on bare physics, s.
    """

    env: float
    physics: float


class Duel:
    """The environment and a bare batch that follows it segment by segment.

    Args:
        env: environment on the cpu engine.
        num_threads: threads of the bare batch; as the environment's.
        seed: of the random actions.
    """

    def __init__(self, env: TrackingEnv, *, num_threads: int, seed: int = 0) -> None:
        assert isinstance(env.physics, CpuPhysics)
        self.env, self.physics = env, env.physics
        model = self.physics.scene(0).model
        self.bare = Batch(model, nsim=env.num_envs, nthread=num_threads)
        self.ctrl = self.bare.bind("ctrl")
        # Derived fields that are bound are copied out; the environment binds these.
        self.sensordata = self.bare.bind("sensordata")
        self.generator = torch.Generator().manual_seed(seed)
        self.td = env.reset()

    def run(self) -> Segment:
        """One segment of each, from equal states."""
        self._follow()
        actions = self._draw()
        controls, spent = [], 0.0
        for action in actions:
            start = time.perf_counter()
            self.td = self._env_step(action)
            spent += time.perf_counter() - start
            controls.append(np.array(self.physics.batch.bind("ctrl")))
        start = time.perf_counter()
        for ctrl in controls:
            self.ctrl[:] = ctrl
            self.bare.step(nstep=self.physics.decimation)
        return Segment(spent, time.perf_counter() - start)

    def _follow(self) -> None:
        envs = range(self.env.num_envs)
        self.bare.set_models([self.physics.scene(e).model for e in envs])
        for name in STATE:
            self.bare.bind(name)[:] = self.physics.batch.bind(name)

    def _draw(self) -> torch.Tensor:
        shape = (SEGMENT, 2, self.env.num_envs, self.env.bank.num_joints)
        return 2 * torch.rand(shape, generator=self.generator) - 1

    def _env_step(self, action: torch.Tensor) -> TensorDictBase:
        for side, value in zip(keys.SIDES, action, strict=True):
            self.td.set(keys.action(side), value)
        return self.env.step_and_maybe_reset(self.td)[1]


def measure(env: TrackingEnv, *, num_threads: int, seconds: float) -> dict[str, Any]:
    """Let both take turns for some seconds.

    Args:
        env: environment on the cpu engine.
        num_threads: threads of the engine, 0 for all cores.
        seconds: how long to measure, burn-in excluded.

    Returns:
        env_steps_per_s, physics_env_steps_per_s, ratio (medians over segments) and
        the number of segments.
    """
    duel = Duel(env, num_threads=num_threads)
    for _ in range(BURN_IN):
        duel.run()
    segments: list[Segment] = []
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(segments) < 3:
        segments.append(duel.run())
    steps = SEGMENT * env.num_envs
    return {
        "env_steps_per_s": round(steps / median(s.env for s in segments), 1),
        "physics_env_steps_per_s": round(
            steps / median(s.physics for s in segments), 1
        ),
        "ratio": round(median(s.physics / s.env for s in segments), 4),
        "segments": len(segments),
    }
