"""What acts, stores and learns: FlashSAC, PPO, and what a user registers."""

from __future__ import annotations

from flashdex.algorithms.base import ALGORITHMS, Learner
from flashdex.errors import FlashdexError, nearest


def known_algorithms() -> dict[str, type[Learner]]:
    """All registered algorithms by ``algo.kind``."""
    # they register themselves; imported late, as they load torchrl
    from flashdex.algorithms import flashsac, ppo

    del flashsac, ppo
    return ALGORITHMS


def find_algorithm(kind: str) -> type[Learner]:
    """The algorithm of an ``algo.kind``.

    Raises:
        FlashdexError: no such algorithm is registered.
    """
    known = known_algorithms()
    if kind not in known:
        raise FlashdexError(
            f"algo.kind: {kind!r} is not allowed.{nearest(kind, known)} Allowed: "
            f"{', '.join(known)}."
        )
    return known[kind]
