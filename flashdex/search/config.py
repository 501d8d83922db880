"""Configuration of the search."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

from flashdex.system.fields import number

SampleEngine = Literal["cpu", "warp"]
# A GPU steps its worlds side by side: a rung should fill it. Not tuned on one yet.
SAMPLES_FACTOR: dict[SampleEngine, int] = {"cpu": 1, "warp": 64}


@dataclass(frozen=True, kw_only=True)
class Rung:
    """One setting of the ladder: what a pass over a motion may cost."""

    samples: int = number(16, low=2, high=100_000)
    """Sequences of actions tried at once."""
    rounds: int = number(1, low=1, high=1000)
    """Times that they are drawn anew around the best, ever closer."""
    horizon: int = number(24, low=2, high=10_000)
    """Control steps looked ahead."""
    worlds: int = number(1, low=1, high=64)
    """Worlds each sequence is tried in: the nominal one, and perturbed ones."""
    retries: int = number(0, low=0, high=1000)
    """Times that a pass goes back where it has lost an object."""
    spread: float = number(1.0, above=0, high=100)
    """Factor of all noise."""
    tries: int = number(1, low=1, high=10_000)
    """Passes by it, each with noise of its own, before the next rung."""


def _ladder() -> list[Rung]:
    return [
        Rung(samples=16, rounds=1, horizon=24, retries=4),
        Rung(samples=24, rounds=2, horizon=24, retries=8),
        Rung(samples=48, rounds=3, horizon=30, retries=8),
        Rung(samples=64, rounds=4, horizon=36, retries=8, spread=1.5, tries=10),
    ]


def _robust_ladder() -> list[Rung]:
    return [
        Rung(samples=48, rounds=3, horizon=24, retries=6, worlds=4),
        Rung(samples=64, rounds=3, horizon=30, retries=8, worlds=6, tries=10),
    ]


@dataclass(frozen=True, kw_only=True)
class SearchConfig:
    """Search for the actions of one motion after the other, without a policy.

    Lengths are m, rad and control steps. The bounds are the scales of the actions that
    are stored: a run of the search has them as ``env.wrist_pos_scale`` and so on.
    """

    wrist_pos_bound: float = number(0.03, above=0, high=1)
    """Largest wrist position residual, m."""
    wrist_rot_bound: float = number(0.2, above=0, high=3)
    """Largest wrist rotation residual, rad."""
    finger_bound: float = number(0.5, above=0, high=3)
    """Largest finger residual, rad."""
    wrist_pos_noise: float = number(0.008, low=0, high=1)
    """Standard deviation of the wrist's position, m."""
    wrist_rot_noise: float = number(0.05, low=0, high=3)
    """Of its rotation, rad."""
    finger_noise: float = number(0.12, low=0, high=3)
    """Of each finger joint, rad."""
    squeeze_noise: float = number(0.12, low=0, high=3)
    """Of all fingers of a hand closing together, rad."""
    constant_share: float = number(0.7, low=0, high=1)
    """Share of the noise that is the same over the whole horizon."""
    anneal: float = number(0.6, above=0, high=1)
    """Factor of the noise from round to round."""
    elite: int = number(6, low=1, high=10_000)
    """Best samples that the next round is drawn around."""
    enough: float = number(0.25, low=0, high=1000)
    """Mean error, in limits of the criterion, at which a window is not drawn anew."""
    lost: float = number(2.0, above=0, high=1000)
    """Mean error of a stride, in limits, at which the object counts as lost."""
    stride: int = number(8, low=1, high=10_000)
    """Control steps that are decided before looking ahead again."""
    knot: int = number(4, low=1, high=1000)
    """Control steps between knots; actions are linear between them."""
    tip_weight: float = number(0.3, low=0, high=1000)
    """Cost of fingertips that leave the place on the object where they belong."""
    residual_weight: float = number(0.05, low=0, high=1000)
    """Cost of actions, squared."""
    smooth_weight: float = number(0.02, low=0, high=1000)
    """Cost of changes between knots, in standard deviations squared."""
    end_weight: float = number(1.0, low=0, high=1000)
    """Weight added to the last quarter of the horizon."""
    engine: SampleEngine = "cpu"
    """Who tries the samples: cpu = MuJoCo C, warp = MuJoCo Warp on one NVIDIA GPU;
    ``physics=warp`` sets it. What is found is scored and certified in MuJoCo C."""
    samples_factor: int | None = number(None, low=1, high=10_000)
    """Factor of the samples of every rung; null = 1 for cpu, 64 for warp."""
    budget_s: float = number(60.0, above=0, high=1e7)
    """Core-seconds of a motion until a plan passes; one begun is finished."""
    robust_budget_s: float = number(90.0, low=0, high=1e7)
    """Core-seconds from there on, until a plan survives perturbations."""
    workers: int = number(0, low=0, high=1024)
    """Processes, one motion each at a time; 0 = one a core."""
    ladder: list[Rung] = dataclasses.field(default_factory=_ladder)
    """Settings tried in turn, cheapest first, until a plan passes."""
    robust_ladder: list[Rung] = dataclasses.field(default_factory=_robust_ladder)
    """Those tried then, in several worlds, until a plan survives perturbations, too;
    empty = one that passes is enough."""

    @property
    def rungs(self) -> list[Rung]:
        """The rung of each pass: of both ladders in turn, with the samples drawn."""
        factor = self.samples_factor or SAMPLES_FACTOR[self.engine]
        return [
            dataclasses.replace(rung, samples=rung.samples * factor)
            for rung in (*self.ladder, *self.robust_ladder)
            for _ in range(rung.tries)
        ]

    @property
    def num_plain(self) -> int:
        """How many of them are not of the robust ladder."""
        return sum(rung.tries for rung in self.ladder)
