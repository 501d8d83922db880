"""Every motion once from frame 0: rollouts under a controller, and their scores."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.algorithms.base import Learner
from flashdex.envs.tracking import TrackingEnv
from flashdex.metrics.aggregate import mean_object_errors, mope_more
from flashdex.metrics.criteria import worst_movement
from flashdex.rollouts.build import RolloutBuilder
from flashdex.rollouts.recorder import EpisodeRecorder
from flashdex.rollouts.rollout import Rollout
from flashdex.training.build import RunBuilder

Controller = Callable[[TensorDictBase, TrackingEnv], Tensor]
"""State and environment to actions (N, 2, J)."""
SHOWN = ("sr_mt_obj", "sr_mt_obj_x0.5", "sr_mt_obj_moved", "sr_mt")
SHOWN += ("sr_spider_raw", "sr_spider_centred")


def roll_all(
    builder: RunBuilder,
    controller: Controller,
    *,
    env_steps: int = 0,
    worlds: int = 32,
    target: Callable[[TrackingEnv], Tensor] | None = None,
    rows: Sequence[int] | None = None,
) -> Iterator[Rollout]:
    """Roll motions once from frame 0, without assist, noise or terminations.

    One rollout a motion, all of them in library order when ``rows`` is None; ``worlds``
    of them roll side by side. ``target`` gives joint position targets (N, 2, J) in the
    place of those of the action, for controllers outside the action space.
    """
    wanted = range(builder.bank.num_motions) if rows is None else rows
    if not wanted:
        return
    worlds = min(worlds, len(wanted))
    # one for all chunks: what it is made of grows with the whole collection
    env = builder.make_env(num_envs=worlds, evaluation=True)
    env.target_override = target
    rollouts = builder.rollout_builder(env.physics.scenes)
    for first in range(0, len(wanted), worlds):
        chunk = list(wanted[first : first + worlds])
        yield from _roll(env, rollouts, controller, chunk, env_steps)


@torch.no_grad()
def _roll(
    env: TrackingEnv,
    rollouts: RolloutBuilder,
    controller: Controller,
    rows: list[int],
    env_steps: int,
) -> list[Rollout]:
    spare = env.num_envs - len(rows)  # worlds of a last chunk that is not full
    env.forced_motion = torch.tensor(rows + rows[-1:] * spare, device=env.device)
    recorder = EpisodeRecorder(env, look_every=1)
    td = env.reset()
    recorder.record_start()
    found: dict[int, Rollout] = {}
    while len(found) < len(rows):
        action = controller(td, env)
        env.put_action(td, action)
        done = env.step(td)["next", keys.DONE]
        for episode in recorder.record_step(action, done, env_steps):
            if episode.motion not in found:  # short motions begin again
                found[episode.motion] = rollouts.build(episode)
        td = env.reset_worlds(done.squeeze(-1))
        recorder.record_start()
    return [found[r] for r in rows]


def evaluate_motions(
    builder: RunBuilder, learner: Learner, *, env_steps: int
) -> dict[str, Any]:
    """Roll every motion from frame 0, deterministic, no assist, no terminations.

    Returns:
        ``totals``, rates and mean errors of the collection, and ``motions``, for each
        its name, the state of each verdict, its errors by the criterion of the run, its
        mean object errors, which the totals are means of, and its ratios of movement.
    """

    def act(td: TensorDictBase, env: TrackingEnv) -> Tensor:
        return learner.act(td.to(learner.device), explore=False)

    criterion = builder.recipe.train.criterion
    names = list(dict.fromkeys([criterion, *SHOWN]))
    rows, errors = [], []
    for rollout in roll_all(builder, act, env_steps=env_steps):
        verdicts = rollout.score()
        tracked = rollout.tracking_errors()
        mean, ratios = mean_object_errors(tracked), worst_movement(tracked)
        values = verdicts[criterion].values.items()
        row = {
            "motion": rollout.motion,
            **{name: verdicts[name].state for name in names},
            "errors": {k: round(v, 5) for k, v in values},
            # what the totals are means of
            "mope": None if mean is None else mean.pos * 1e3,
            "more": None if mean is None else mean.rot,
            **{f"{key}_ratio": ratio for key, ratio in ratios.items()},
        }
        rows.append(row)
        errors.append((mean, verdicts["sr_spider_centred"]))
    totals: dict[str, Any] = {"env_steps": env_steps, **mope_more(errors)}
    for name in names:
        states = [row[name] for row in rows]
        totals[name] = {
            s: states.count(s) for s in ("passed", "failed", "not_measured")
        }
    return {"totals": totals, "motions": rows}
