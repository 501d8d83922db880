"""Environment and bare physics take turns in one process, from equal states.

What else runs on the machine slows both alike. The ratio is what the environment costs:
1 would be nothing but physics. A device is waited for at the ends of a turn only.
"""

from __future__ import annotations

from statistics import median
from typing import Any, NamedTuple

import numpy as np
import torch
from mujoco.batch import Batch
from tensordict import TensorDictBase
from torch.utils.benchmark import timer
from torchrl.envs.utils import step_mdp

from flashdex import keys
from flashdex.envs.physics.cpu import CpuPhysics
from flashdex.envs.tracking import TrackingEnv

STATE = ("qpos", "qvel", "qacc_warmstart")


class Turn(NamedTuple):
    """Seconds of one turn: the environment with its resets, and the physics alone."""

    env: float
    physics: float


class Turns:
    """Any engine: all worlds are reset, then the engine repeats the same targets.

    The environment's loop runs some control steps, half a second of simulated time;
    then the engine repeats them from the same draw: no observation, no judge, no reset,
    no wrench.
    """

    burn_in = 2  # turns that are not counted

    def __init__(self, env: TrackingEnv, *, steps: int = 32, seed: int = 0) -> None:
        self.env, self.steps = env, steps
        self.generator = torch.Generator(env.device).manual_seed(seed)

    def run(self) -> Turn:
        """One turn of each."""
        start = self.env.generator.get_state()
        targets, spent = self.loop()
        self.env.generator.set_state(start)  # the same draw: the same states
        return Turn(spent, self.replay(targets))

    @torch.no_grad()
    def loop(self) -> tuple[list[Any], float]:
        """The environment's turn: what its physics was told each step, and seconds.

        The sum is what a random policy in the training loop would take.
        """
        env, told = self.env, []
        shape = (env.num_envs, 2, env.bank.num_joints)
        td = self.start()
        start = timer()
        for _ in range(self.steps):
            action = torch.rand(shape, generator=self.generator, device=env.device)
            env.put_action(td, 2 * action - 1)
            td = env.step(td)
            told.append(self.told(td.get("next")))
            done = td["next", keys.DONE].squeeze(-1)
            # as the training loop does
            nothing_ends = env.is_host_device and not done.any()
            td = step_mdp(td) if nothing_ends else env.reset_worlds(done)
        self.td = td
        return told, timer() - start

    @torch.no_grad()
    def replay(self, told: list[Any]) -> float:
        """Seconds of the engine alone after a reset, under targets (N, 2, J) each."""
        self.env.reset()
        start = timer()
        for target in told:
            self.env.physics.step(target)
        return timer() - start

    def start(self) -> TensorDictBase:
        """What the environment starts a turn from."""
        return self.env.reset()

    def told(self, after: TensorDictBase) -> Any:
        """What the physics was told in a step, for `replay`."""
        return after[keys.JOINT_TARGET]


class BareTurns(Turns):
    """The cpu engine: a bare ``mujoco.batch`` follows the environment turn by turn.

    Both step the very same models from the same states under the same controls, with
    as many threads.
    """

    burn_in = 4

    def __init__(self, env: TrackingEnv, *, num_threads: int, seed: int = 0) -> None:
        super().__init__(env, steps=10, seed=seed)
        assert isinstance(env.physics, CpuPhysics)
        self.physics = env.physics
        model = self.physics.scene(0).model
        self.bare = Batch(model, nsim=env.num_envs, nthread=num_threads)
        self.ctrl = self.bare.bind("ctrl")
        # Derived fields that are bound are copied out; the environment binds these.
        self.sensordata = self.bare.bind("sensordata")
        self.td = env.reset()

    def run(self) -> Turn:
        """One turn of each, from equal states."""
        envs = range(self.env.num_envs)
        self.bare.set_models([self.physics.scene(e).model for e in envs])
        for name in STATE:
            self.bare.bind(name)[:] = self.physics.batch.bind(name)
        controls, spent = self.loop()
        return Turn(spent, self.replay(controls))

    def start(self) -> TensorDictBase:
        """Where the last turn ended."""
        return self.td

    def told(self, after: TensorDictBase) -> Any:
        """Controls of all worlds, (N, nu)."""
        return np.array(self.physics.batch.bind("ctrl"))

    def replay(self, told: list[Any]) -> float:
        """Seconds of the bare batch under the given controls."""
        start = timer()
        for ctrl in told:
            self.ctrl[:] = ctrl
            self.bare.step(nstep=self.physics.decimation)
        return timer() - start


def measure(turns: Turns, *, seconds: float) -> dict[str, Any]:
    """Let both take turns for some seconds, burn-in excluded; medians over turns.

    Off the cpu engine there is ``warm_up_s`` of the first turns, too.
    """
    begin = timer()
    for _ in range(turns.burn_in):
        turns.run()
    warm = timer() - begin
    found: list[Turn] = []
    end = timer() + seconds
    while timer() < end or len(found) < 3:
        found.append(turns.run())
    steps = turns.steps * turns.env.num_envs
    out: dict[str, Any] = {
        "env_steps_per_s": round(steps / median(t.env for t in found), 1),
        "physics_env_steps_per_s": round(steps / median(t.physics for t in found), 1),
        "ratio": round(median(t.physics / t.env for t in found), 4),
        "segments": len(found),
    }
    return out if isinstance(turns, BareTurns) else {**out, "warm_up_s": round(warm, 2)}


def physics_rate(env: TrackingEnv, *, seconds: float, steps: int = 32) -> float:
    """Env steps a second of the engine alone, under targets of random actions."""
    turns = Turns(env, steps=steps)
    targets, _ = turns.loop()
    turns.replay(targets[:2])  # records what the engine records on the first call
    times = []
    end = timer() + seconds
    while timer() < end or len(times) < 2:
        times.append(turns.replay(targets))
    return steps * env.num_envs / median(times)


def room_used(env: TrackingEnv) -> dict[str, int]:
    """Contacts and constraint rows of the last substep, where the engine keeps them.

    ``nacon`` is of all worlds, ``nefc`` of the fullest one.
    """
    data = getattr(env.physics, "data", None)
    found: dict[str, int] = {}
    for name, limit in (("nacon", "naconmax"), ("nefc", "njmax")):
        array: Any = getattr(data, name, None)
        if hasattr(array, "numpy"):
            found[name] = int(array.numpy().max())
            found[limit] = int(getattr(data, limit, 0))
    return found
