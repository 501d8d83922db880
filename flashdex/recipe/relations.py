"""What must hold between values of a recipe that are each allowed on their own."""

from __future__ import annotations

from pathlib import Path

import flashdex.hands
from flashdex.algorithms.config import AlgoConfig
from flashdex.errors import nearest
from flashdex.recipe.schema import Expectation, Recipe


def known_hands() -> list[str]:
    """Return the names of the built-in hands (folders with a left and a right MJCF)."""
    root = Path(flashdex.hands.__path__[0])
    return sorted(path.parent.name for path in root.glob("*/left.xml"))


def find_conflicts(recipe: Recipe) -> list[str]:
    """Return one line for each thing that does not fit together."""
    checks = (_hand, _motions, _rate, _replay, _algo, _env, _expect)
    return [problem for check in checks for problem in check(recipe)]


def _hand(recipe: Recipe) -> list[str]:
    known = known_hands()
    if recipe.hand in known:
        return []
    close = nearest(recipe.hand, known)
    return [f"hand: '{recipe.hand}' is not a hand.{close} Known: {', '.join(known)}."]


def _motions(recipe: Recipe) -> list[str]:
    motions = recipe.motions
    if motions.library is None and motions.source is None:
        return [
            "motions: neither library nor source is given; set motions.library to a "
            "prepared folder or motions.source to procedural"
        ]
    if motions.library is not None:
        return []
    if motions.source not in ("procedural", "myodm") and motions.input is None:
        return [f"motions.input: missing; the source '{motions.source}' reads a folder"]
    return []


def _rate(recipe: Recipe) -> list[str]:
    physics, hz = recipe.physics, recipe.motions.control_hz
    step = physics.decimation * physics.timestep
    if abs(step * hz - 1) < 1e-3:
        return []
    return [
        f"physics.timestep: {physics.decimation} substeps of {physics.timestep:.6g} s "
        f"make {step:.6g} s, but motions.control_hz={hz:g} asks for {1 / hz:.6g} s; "
        f"set physics.timestep={1 / hz / physics.decimation:.8g}"
    ]


def _replay(recipe: Recipe) -> list[str]:
    return replay_conflicts(
        recipe.algo,
        total_env_steps=recipe.total_env_steps,
        num_envs=recipe.env.num_envs,
        where="env.num_envs",
    )


def replay_conflicts(
    algo: AlgoConfig, *, total_env_steps: int, num_envs: int, where: str
) -> list[str]:
    """Return what does not fit between replay buffer, budget and worlds.

    Args:
        algo: sizes of the buffer.
        total_env_steps: budget.
        num_envs: worlds.
        where: key that gives the worlds, for the message.
    """
    if algo.kind == "ppo":
        return []  # no replay
    problems = []
    if algo.min_buffer > algo.buffer_size:
        problems.append(
            f"algo.min_buffer: {algo.min_buffer} rows never fit in algo.buffer_size="
            f"{algo.buffer_size}; learning would not start"
        )
    if algo.min_buffer >= total_env_steps > 1:
        problems.append(
            f"algo.min_buffer: {algo.min_buffer} rows of random actions use up "
            f"total_env_steps={total_env_steps}"
        )
    # The newest n steps of every world have no complete return yet.
    if algo.buffer_size <= num_envs * algo.n_step:
        problems.append(
            f"algo.buffer_size: {algo.buffer_size} must exceed {where} x "
            f"algo.n_step = {num_envs * algo.n_step}"
        )
    return problems


def _algo(recipe: Recipe) -> list[str]:
    algo = recipe.algo
    problems = rate_conflicts(algo)
    if len(algo.future_channels) != 3 or min(algo.future_channels) < 1:
        problems.append(
            f"algo.future_channels: expected three positive numbers, found "
            f"{algo.future_channels}"
        )
    return problems


def rate_conflicts(algo: AlgoConfig) -> list[str]:
    """Return what does not fit between the learning rates."""
    if algo.lr_final > algo.lr:
        return [f"algo.lr_final: {algo.lr_final} is above algo.lr={algo.lr}"]
    return []


def _env(recipe: Recipe) -> list[str]:
    env = recipe.env
    problems = []
    if env.attempt_share > 0 and round(env.attempt_share * env.num_envs) == 0:
        problems.append(
            f"env.attempt_share: {env.attempt_share} of {env.num_envs} worlds is none, "
            f"so nothing could ever be converted; give at least {1 / env.num_envs:.3g}"
        )
    if not any(options is not None for options in env.transforms.values()):
        problems.append("env.transforms: all are off; the policy would see nothing")
    if env.attempt_share >= 1:
        problems.append(
            "env.attempt_share: 1 leaves no world to explore; use less than 1"
        )
    has_object_term = any(
        env.rewards.get(name) is not None for name in ("object_points", "object_pose")
    )
    if env.terminations.get("early_reset") is not None and not has_object_term:
        problems.append(
            "env.terminations.early_reset: it sums the object term, but the rewards "
            "object_points and object_pose are both off; turn one on"
        )
    return problems


def _expect(recipe: Recipe) -> list[str]:
    return expect_conflicts(recipe.expect)


def expect_conflicts(entries: list[Expectation]) -> list[str]:
    """Return the promises that promise nothing."""
    return [
        f"expect[{i}]: give min, max or both"
        for i, entry in enumerate(entries)
        if entry.min is None and entry.max is None
    ]
