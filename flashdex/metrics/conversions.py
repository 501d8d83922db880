"""Bookkeeping of attempts: which motions were ever converted, and which still are."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from flashdex.metrics.aggregate import Rate
from flashdex.metrics.verdict import CertificateVerdict, State

WORST_TO_BEST: tuple[CertificateVerdict, ...] = (
    "not_measured",
    "failed",
    "certified",
    "robust",
)


@dataclass(frozen=True)
class FirstConversion:
    """When a motion passed for the first time.

    Args:
        env_steps: env steps of the run.
        gpu_hours: wall time times devices since process start, evaluation included.
        attempt: number of the attempt of this motion, from 1.
    """

    env_steps: int
    gpu_hours: float
    attempt: int


@dataclass
class ConversionBook:
    """Counts conversions of one run by the run's criterion.

    Args:
        num_accepted: motions of the collection.
        num_offered: motions before checks rejected some.

    Example:
        >>> book = ConversionBook(num_accepted=2, num_offered=4)
        >>> book.record("lift", "passed", env_steps=10, gpu_hours=0.5)
        True
        >>> book.record("lift", "failed", env_steps=20, gpu_hours=1.0)
        False
        >>> book.metrics()["convert/cumulative"], book.metrics()["convert/last"]
        (1, 0.0)
    """

    num_accepted: int
    num_offered: int
    first: dict[str, FirstConversion] = field(default_factory=dict)
    last: dict[str, State] = field(default_factory=dict)
    attempts: dict[str, int] = field(default_factory=dict)
    certificates: dict[str, CertificateVerdict] = field(default_factory=dict)
    gpu_hours: float = 0.0

    def record(
        self, motion: str, state: State, *, env_steps: int, gpu_hours: float
    ) -> bool:
        """Note one attempt: a full rollout from frame 0, no assist, deterministic.

        Args:
            motion: motion id.
            state: verdict of the run's criterion.
            env_steps: env steps so far.
            gpu_hours: wall time times devices so far.

        Returns:
            True if this is the motion's first conversion.
        """
        self.gpu_hours = max(self.gpu_hours, gpu_hours)
        self.attempts[motion] = self.attempts.get(motion, 0) + 1
        self.last[motion] = state
        if state != "passed" or motion in self.first:
            return False
        self.first[motion] = FirstConversion(
            env_steps, gpu_hours, self.attempts[motion]
        )
        return True

    def record_certificate(self, motion: str, verdict: CertificateVerdict) -> None:
        """Note the certificate of a stored rollout; the best one of a motion stays.

        Args:
            motion: motion id.
            verdict: of the certificate.
        """
        old = self.certificates.get(motion, "not_measured")
        if WORST_TO_BEST.index(verdict) >= WORST_TO_BEST.index(old):
            self.certificates[motion] = verdict

    @property
    def last_rate(self) -> Rate:
        """Outcome of each motion's latest attempt."""
        return Rate.of(self.last.values())

    def metrics(self) -> dict[str, float | int | None]:
        """The ``convert/`` group; rates are None where nothing was measured."""
        total = len(self.first)
        verdicts = list(self.certificates.values())
        robust = verdicts.count("robust")
        return {
            "convert/cumulative": total,
            "convert/rate": _share(total, self.num_accepted),
            "convert/rate_all": _share(total, self.num_offered),
            "convert/last": self.last_rate.value,
            "convert/per_gpu_hour": _share(total, self.gpu_hours),
            "convert/certified": robust + verdicts.count("certified"),
            "convert/robust": robust,
            "convert/uncertified": total
            - sum(
                self.certificates.get(m, "not_measured") != "not_measured"
                for m in self.first
            ),
        }

    def state_dict(self) -> dict[str, Any]:
        """Plain data for a checkpoint."""
        return asdict(self)

    @classmethod
    def from_state_dict(cls, state: dict[str, Any]) -> ConversionBook:
        """Rebuild from :meth:`state_dict`.

        Args:
            state: plain data.
        """
        first = {m: FirstConversion(**f) for m, f in state["first"].items()}
        return cls(**{**state, "first": first})


def _share(count: int, total: float) -> float | None:
    return count / total if total else None
