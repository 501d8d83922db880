"""Options of every transform, reward and termination a recipe may name.

The dataclasses here are the one place of these defaults; the code that uses a part
reads its values from an instance and has no second table.

Reward weights are the listed ones: each hand receives half of a weight, except the
failure weight, which the blamed hand pays whole; every term is multiplied by the
control step in seconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from flashdex.errors import UnknownNameError
from flashdex.system.fields import number


@dataclass(frozen=True, kw_only=True)
class NoOptions:
    """A part without options."""


@dataclass(frozen=True, kw_only=True)
class ObjectPointsOptions:
    """Surface points of each hand's object, now and next, in the wrist frame."""

    num_points: int = number(128, low=1, high=128)
    """Points an object, taken from the front of the farthest-point order; fewer is
    faster and coarser."""


@dataclass(frozen=True, kw_only=True)
class FutureWindowOptions:
    """Reference of the coming frames relative to the current simulation."""

    horizon: int = number(10, low=6, high=60)
    """Frames in the window, control steps; the encoder needs at least 6."""


@dataclass(frozen=True, kw_only=True)
class ContactOptions:
    """Contact wrench and contact point of each link, in the wrist frame."""


@dataclass(frozen=True, kw_only=True)
class ObjectPointsRewardOptions:
    """Eq. (6): exp(-e / sigma), e = mean of the worst points after rescaling."""

    weight: float = 1.0
    """Listed weight."""
    sigma: float = number(0.1, above=0)
    """Kernel width, m; smaller pays only close tracking."""
    rho: float = number(0.058, low=0)
    """Radius to which every object is rescaled, m; 0 keeps the true size."""
    top_k: int = number(3, low=1, high=128)
    """How many of the worst points are averaged; 1 is the strictest."""


@dataclass(frozen=True, kw_only=True)
class ObjectPoseRewardOptions:
    """DexMachina's object term exp(-b_p d) exp(-b_r angle), off by default."""

    weight: float = 1.0
    """Listed weight."""
    beta_pos: float = number(10.0, above=0)
    """b_p, 1/m."""
    beta_rot: float = number(1.0, above=0)
    """b_r, 1/rad."""


@dataclass(frozen=True, kw_only=True)
class FingertipDistanceOptions:
    """Eq. (8): mean over tips of exp(-max(0, d - d_ref) / sigma)."""

    weight: float = 0.3
    """Listed weight."""
    sigma: float = number(0.01, above=0)
    """Kernel width, m."""


@dataclass(frozen=True, kw_only=True)
class WristPosOptions:
    """exp(-scale d), d to the human wrist, m."""

    weight: float = 0.15
    """Listed weight."""
    scale: float = number(10.0, above=0)
    """Steepness, 1/m."""


@dataclass(frozen=True, kw_only=True)
class WristRotOptions:
    """exp(-scale angle) to the wanted wrist orientation, rad."""

    weight: float = 0.15
    """Listed weight."""
    scale: float = number(3.0, above=0)
    """Steepness, 1/rad."""


@dataclass(frozen=True, kw_only=True)
class FingertipPosOptions:
    """Mean over tips of exp(-scale d) to the human tips, m."""

    weight: float = 0.3
    """Listed weight."""
    scale: float = number(20.0, above=0)
    """Steepness, 1/m."""


@dataclass(frozen=True, kw_only=True)
class BehaviourCloningOptions:
    """Mean over joints of exp(-scale (target - ref)^2 / (2 range))."""

    weight: float = 0.3
    """Listed weight."""
    scale: float = number(500.0, above=0)
    """Steepness, 1/rad; wrist joints have wide ranges, so there it is nearly flat."""


@dataclass(frozen=True, kw_only=True)
class ActionL2Options:
    """Mean square of the raw action."""

    weight: float = number(-0.01, high=0)
    """Listed weight; larger in size gives smoother and weaker motions."""


@dataclass(frozen=True, kw_only=True)
class FailureOptions:
    """Paid once by the blamed hands in the step that terminates by failure."""

    weight: float = number(-100.0, high=0)
    """Whole weight (not halved); times 1/60 s it is -1.67."""


@dataclass(frozen=True, kw_only=True)
class ObjectDroppedOptions:
    """Object below its reference height; charges the hand of that object."""

    distance: float = number(0.1, above=0)
    """Allowed drop, m."""


@dataclass(frozen=True, kw_only=True)
class EarlyResetOptions:
    """Running sum of the object term below a line; charges hands below it."""

    threshold: float = number(0.6, low=0, high=1)
    """Demanded mean of the object term; 0.6 is a point error of 5.1 cm."""
    window: int = number(5, low=1)
    """Steps between raises of the line; also the grace, control steps."""


@dataclass(frozen=True, kw_only=True)
class FingertipOffOptions:
    """A fingertip far from its human tip; charges that hand."""

    distance: float = number(0.2, above=0)
    """Allowed distance, m."""
    grace: int = number(15, low=0)
    """Steps after a reset that are not judged, control steps."""


@dataclass(frozen=True, kw_only=True)
class SanityOptions:
    """Speeds no healthy simulation reaches, or NaN; charges both hands."""

    max_link_speed: float = number(100.0, above=0)
    """Hand links, m/s."""
    max_joint_speed: float = number(200.0, above=0)
    """Hand joints, m/s and rad/s."""
    max_object_speed: float = number(100.0, above=0)
    """Objects, m/s."""
    max_object_spin: float = number(200.0, above=0)
    """Objects, rad/s."""


TRANSFORMS: dict[str, type] = {
    "proprioception": NoOptions,
    "reference_delta": NoOptions,
    "object_state": NoOptions,
    "object_points": ObjectPointsOptions,
    "surface_distance": NoOptions,
    "contact": ContactOptions,
    "future_window": FutureWindowOptions,
}
REWARDS: dict[str, type] = {
    "object_points": ObjectPointsRewardOptions,
    "object_pose": ObjectPoseRewardOptions,
    "fingertip_distance": FingertipDistanceOptions,
    "wrist_pos": WristPosOptions,
    "wrist_rot": WristRotOptions,
    "fingertip_pos": FingertipPosOptions,
    "behaviour_cloning": BehaviourCloningOptions,
    "action_l2": ActionL2Options,
    "failure": FailureOptions,
}
TERMINATIONS: dict[str, type] = {
    "object_dropped": ObjectDroppedOptions,
    "early_reset": EarlyResetOptions,
    "fingertip_off": FingertipOffOptions,
    "sanity": SanityOptions,
}
OFF_BY_DEFAULT = frozenset({"object_pose"})

Kind = Literal["transforms", "rewards", "terminations"]
REGISTRY: dict[Kind, dict[str, type]] = {
    "transforms": TRANSFORMS,
    "rewards": REWARDS,
    "terminations": TERMINATIONS,
}


def default_mapping(kind: Kind) -> dict[str, dict[str, Any] | None]:
    """Return every registered name of a kind with no option set (None = off)."""
    return {name: None if name in OFF_BY_DEFAULT else {} for name in REGISTRY[kind]}


def build_options(
    kind: Kind, mapping: Mapping[str, Mapping[str, Any] | None]
) -> dict[str, Any]:
    """Turn a recipe's named mapping into option objects, in order, nulls left out.

    Args:
        kind: which registry the names belong to.
        mapping: name to options (missing ones take their default), or None = off.

    Returns:
        Name to an instance of the option dataclass of that name.

    Example:
        >>> build_options("transforms", {"future_window": {"horizon": 6}})
        {'future_window': FutureWindowOptions(horizon=6)}
    """
    known = REGISTRY[kind]
    for name in mapping:
        if name not in known:
            raise UnknownNameError(name, known, where=f"env.{kind}")
    return {
        name: known[name](**options)
        for name, options in mapping.items()
        if options is not None
    }
