"""One log record: counters, conversions, and what the engine could not hold."""

from __future__ import annotations

import logging

from flashdex.algorithms.base import Learner
from flashdex.envs.tracking import TrackingEnv
from flashdex.rollouts.ledger import Ledger
from flashdex.rollouts.scorer import Judging

_LOG = logging.getLogger(__name__)
_ROOM = {
    "contacts": "physics.nconmax",
    "constraints": "physics.njmax",
}


def make_record(
    *,
    env_steps: int,
    lost: int,
    wall_s: float,
    env: TrackingEnv,
    learner: Learner,
    ledger: Ledger,
    judging: Judging,
) -> dict[str, float]:
    """What a log record says besides the running means.

    Args:
        env_steps: counter of the run.
        lost: env steps lost to crashes.
        wall_s: seconds of the run, earlier sessions included.
        env: for the assist and the engine's overflow, which is read and cleared.
        learner: for updates and buffer.
        ledger: for conversions.
        judging: for the attempts in line.
    """
    record: dict[str, float] = {
        "env_steps": env_steps,
        "env_steps_lost": lost,
        "hours": wall_s / 3600,
        "updates": learner.updates,
        **ledger.metrics(wall_s / 3600),
        "convert/pending": judging.pending,
        "buffer/rows": learner.num_rows,
        "buffer/dropped": float(getattr(learner, "num_dropped", 0)),
        "assist/level": env.assist.upper[0] if env.assist is not None else 0.0,
    }
    for kind, worlds in env.physics.take_overflow().items():
        record[f"physics/overflow_{kind}"] = worlds
        _LOG.warning(
            "%d of %d worlds ran out of room for %s: the engine dropped some, so "
            "these worlds were wrong for a while%s",
            worlds,
            env.num_envs,
            kind,
            f". Raise {_ROOM[kind]}" if kind in _ROOM else "",
        )
    return record
