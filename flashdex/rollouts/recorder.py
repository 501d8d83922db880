"""Finished episodes of the attempt worlds, recorded on the device of the physics.

Reading a flag from a GPU makes the host wait for it. So every step is written to a ring
that is longer than any episode, and the host looks at the flags once in a while: an
episode that has ended in the meantime still lies in the ring.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from flashdex.envs.tracking import TrackingEnv

LOOK_EVERY = 16  # steps; each look waits for the device once
STEPS = ("qpos", "qvel", "ctrl", "wrench", "action")
CAUSE = "cause/"


@dataclass(frozen=True)
class Episode:
    """One finished episode of T steps of a world, as recorded."""

    env: int  # world
    env_steps: int  # counter of the run at the last step
    steps: dict[str, np.ndarray]  # qpos, qvel, ctrl, wrench, action AFTER it, (T, ...)
    qpos0: np.ndarray  # state that it began from, (nq,)
    qvel0: np.ndarray  # (nv,)
    motion: int  # row of the motion
    frame: int  # reference frame that the last step was scored on
    causes: dict[str, list[bool]]  # termination -> hands blamed for the end, (2,)


class EpisodeRecorder:
    """Records the first ``num_attempts`` worlds of an environment.

    Call ``record_start`` after resets and ``record_step`` after each environment step,
    before the reset that follows it. The flags are looked at every ``look_every``
    steps: every one where that is free, ``LOOK_EVERY`` where the host would wait.
    """

    def __init__(self, env: TrackingEnv, *, look_every: int | None = None) -> None:
        self.env, self.count = env, env.num_attempts
        if look_every is None:
            look_every = 1 if env.is_host_device else LOOK_EVERY
        self.look_every = look_every
        self.size = env.max_episode_steps + look_every
        self.written = 0  # vector steps recorded
        self._env_steps: list[int] = []  # of the steps since the last look
        self._began = [0] * self.count  # first step of the open episode of each world
        self._rings: dict[str, Tensor] = {}

    def record_start(self) -> None:
        """Keep the state that the coming step starts from."""
        raw = self.env.physics.raw()
        self._write(qpos0=raw.qpos, qvel0=raw.qvel)

    def record_step(
        self, action: Tensor, done: Tensor, env_steps: int
    ) -> list[Episode]:
        """Record the step that the environment has just made, and what has ended.

        ``action`` is (N, 2, J), ``done`` (N, 1) bool, ``env_steps`` the run's counter.
        """
        result, raw = self.env.last_step, self.env.physics.raw()
        causes = {CAUSE + name: blame for name, blame in result.terminations.items()}
        self._write(
            qpos=raw.qpos,
            qvel=raw.qvel,
            ctrl=raw.ctrl,
            wrench=raw.wrench,
            action=action,
            motion=result.motion,
            frame=result.frame,
            done=done,
            **causes,
        )
        self.written += 1
        self._env_steps.append(env_steps)
        return self.finished() if len(self._env_steps) == self.look_every else []

    def finished(self) -> list[Episode]:
        """Episodes that ended since the last look, in the order of their ends."""
        counters, self._env_steps = self._env_steps, []
        if self.count == 0 or not counters:
            return []
        first = self.written - len(counters)
        done = self._rings["done"][:, self._columns(first, self.written)].squeeze(-1)
        found = []
        for step, env in done.cpu().T.nonzero().tolist():  # by step, then by world
            last = first + step
            found.append(self._take(env, self._began[env], last, counters[step]))
            self._began[env] = last + 1
        return found

    def _columns(self, first: int, stop: int) -> Tensor:
        return (torch.arange(first, stop) % self.size).to(self.env.device)

    def _write(self, **rows: Tensor) -> None:
        for name, values in rows.items():
            if name not in self._rings:
                shape = (self.count, self.size, *values.shape[1:])
                ring = torch.zeros(shape, dtype=values.dtype, device=self.env.device)
                self._rings[name] = ring
            self._rings[name][:, self.written % self.size] = values[: self.count]

    def _take(self, env: int, first: int, last: int, env_steps: int) -> Episode:
        columns = self._columns(first, last + 1)

        def at(name: str, step: int) -> Tensor:
            return self._rings[name][env, step % self.size]

        causes = [name for name in self._rings if name.startswith(CAUSE)]
        return Episode(
            env=env,
            env_steps=env_steps,
            steps={n: self._rings[n][env, columns].cpu().numpy() for n in STEPS},
            qpos0=at("qpos0", first).cpu().numpy().copy(),
            qvel0=at("qvel0", first).cpu().numpy().copy(),
            motion=int(at("motion", last)),
            frame=int(at("frame", last)),
            causes={n.removeprefix(CAUSE): at(n, last).tolist() for n in causes},
        )
