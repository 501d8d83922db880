"""The last steps of the attempt worlds, kept on the device of the physics.

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


@dataclass(frozen=True)
class Episode:
    """Everything that was recorded of one finished episode of T steps.

    Attributes:
        env: world.
        env_steps: counter of the run at its last step.
        steps: name -> rows of the steps, (T, ...): qpos, qvel, ctrl, wrench, action.
        qpos0: state that it began from, (nq,).
        qvel0: (nv,).
        motion: motion row.
        frame: frame that the last step was scored on.
        causes: termination -> which hand was blamed for the end, (2,) bool.
    """

    env: int
    env_steps: int
    steps: dict[str, np.ndarray]
    qpos0: np.ndarray
    qvel0: np.ndarray
    motion: int
    frame: int
    causes: dict[str, list[bool]]


class AttemptRing:
    """Records the attempt worlds of an environment.

    Call ``begin`` after resets and ``step`` after each environment step, before the
    reset that follows it.

    Args:
        env: the environment; its first ``num_attempts`` worlds are recorded.
        look_every: steps between two looks at the flags; when None every step where
            that is free, every ``LOOK_EVERY`` where the host would wait.
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

    def begin(self) -> None:
        """Keep the state that the coming step starts from."""
        raw = self.env.physics.raw()
        self._write("qpos0", raw.qpos)
        self._write("qvel0", raw.qvel)

    def step(self, action: Tensor, done: Tensor, env_steps: int) -> list[Episode]:
        """Record the step that the environment has just made.

        Args:
            action: (N, 2, J).
            done: (N, 1) bool.
            env_steps: counter of the run.

        Returns:
            Episodes that are now known to have ended.
        """
        result, raw = self.env.last_step, self.env.physics.raw()
        self._write("qpos", raw.qpos)
        self._write("qvel", raw.qvel)
        self._write("ctrl", raw.ctrl)
        self._write("wrench", raw.wrench)
        self._write("action", action)
        self._write("motion", result.motion)
        self._write("frame", result.frame)
        self._write("done", done)
        for name, blame in result.terminations.items():
            self._write(f"cause/{name}", blame)
        self.written += 1
        self._env_steps.append(env_steps)
        return self.look() if len(self._env_steps) == self.look_every else []

    def look(self) -> list[Episode]:
        """Episodes that ended since the last look, in the order of their ends."""
        counters, self._env_steps = self._env_steps, []
        if self.count == 0 or not counters:
            return []
        first = self.written - len(counters)
        columns = torch.arange(first, self.written) % self.size
        done = self._rings["done"][:, columns.to(self.env.device)].squeeze(-1)
        ends = done.cpu().T.nonzero().tolist()  # by step, then by world
        found = []
        for step, env in ends:
            last = first + step
            found.append(self._take(env, self._began[env], last, counters[step]))
            self._began[env] = last + 1
        return found

    def _write(self, name: str, values: Tensor) -> None:
        values = values[: self.count]
        if name not in self._rings:
            shape = (self.count, self.size, *values.shape[1:])
            self._rings[name] = torch.zeros(
                shape, dtype=values.dtype, device=self.env.device
            )
        self._rings[name][:, self.written % self.size] = values

    def _take(self, env: int, first: int, last: int, env_steps: int) -> Episode:
        columns = torch.arange(first, last + 1) % self.size
        columns = columns.to(self.env.device)

        def rows(name: str) -> np.ndarray:
            return self._rings[name][env, columns].cpu().numpy()

        def final(name: str) -> Tensor:
            return self._rings[name][env, last % self.size]

        names = ("qpos", "qvel", "ctrl", "wrench", "action")
        start = first % self.size
        prefix = "cause/"
        causes = [n for n in self._rings if n.startswith(prefix)]
        return Episode(
            env=env,
            env_steps=env_steps,
            steps={name: rows(name) for name in names},
            qpos0=self._rings["qpos0"][env, start].cpu().numpy().copy(),
            qvel0=self._rings["qvel0"][env, start].cpu().numpy().copy(),
            motion=int(final("motion")),
            frame=int(final("frame")),
            causes={n.removeprefix(prefix): final(n).tolist() for n in causes},
        )
