"""From the recipe's named mapping to the list of transforms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchrl.envs.transforms import Transform

from flashdex import keys
from flashdex.envs.mdp.options import build_options
from flashdex.envs.reference import ReferenceBank
from flashdex.envs.transforms import blocks
from flashdex.envs.transforms.context import ConcatBlocks, TrackingContext
from flashdex.hands.kinematics import HandKinematics
from flashdex.hands.spec import HandSpec


def make_transforms(
    mapping: Mapping[str, Mapping[str, Any] | None],
    bank: ReferenceBank,
    hands: dict[keys.Side, HandSpec],
    *,
    reference_offset: int,
) -> list[Transform]:
    """Build the observation transforms of a recipe in data-flow order.

    Args:
        mapping: ``env.transforms`` of the recipe: name to options, null = left out.
        bank: reference frames and object tables.
        hands: hand specs by side.
        reference_offset: ``env.reference_offset`` of the recipe.

    Returns:
        Context, named blocks, concatenation. Clone them (``Transform.clone``) before
        handing them to a second container; buffers stay shared.
    """
    options = build_options("transforms", mapping)
    kinematics = HandKinematics(hands)
    out: list[Transform] = [
        TrackingContext(bank, kinematics, reference_offset=reference_offset)
    ]
    names = [name for name in options if name != "future_window"]
    out += [_make_block(name, options[name], bank, hands) for name in names]
    if "future_window" in options:
        horizon = options["future_window"].horizon
        window = blocks.FutureWindow(
            bank, horizon=horizon, reference_offset=reference_offset
        )
        out.append(window)
    out.append(ConcatBlocks(names))
    return out


def _make_block(
    name: str, options: Any, bank: ReferenceBank, hands: dict[keys.Side, HandSpec]
) -> Transform:
    match name:
        case "proprioception":
            return blocks.Proprioception(name, bank.used_hands)
        case "reference_delta":
            return blocks.ReferenceDelta(name, bank.used_hands, hands)
        case "object_state":
            return blocks.ObjectState(name, bank.used_hands)
        case "object_points":
            return blocks.ObjectPoints(name, bank, num_points=options.num_points)
        case "surface_distance":
            return blocks.SurfaceDistance(name, bank, hands)
        case "contact":
            return blocks.Contact(name, bank.used_hands)
        case _:
            msg = f"transform '{name}' has options but no implementation"
            raise AssertionError(msg)
