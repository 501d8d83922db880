"""Choose the physics engine a recipe names."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from flashdex import keys
from flashdex.envs.physics.base import Physics
from flashdex.envs.physics.cpu import CpuPhysics
from flashdex.hands.spec import HandSpec
from flashdex.motions.library import MotionLibrary

if TYPE_CHECKING:
    from flashdex.recipe import PhysicsConfig

_CPU = torch.device("cpu")


def engine_device(physics: PhysicsConfig) -> torch.device:
    """Where the engine's states live: the GPU for warp and brax, where there is one.

    Args:
        physics: engine settings of the recipe.
    """
    on_gpu = physics.engine != "cpu" and torch.cuda.is_available()
    return torch.device("cuda", torch.cuda.current_device()) if on_gpu else _CPU


def make_physics(
    library: MotionLibrary,
    hands: dict[keys.Side, HandSpec],
    physics: PhysicsConfig,
    num_envs: int,
) -> Physics:
    """Build the engine that ``physics.engine`` names.

    Args:
        library: the prepared collection.
        hands: hand specs by side.
        physics: engine settings of the recipe.
        num_envs: worlds N.

    Raises:
        FlashdexError: its packages are missing, or it cannot run this collection.
    """
    match physics.engine:
        case "cpu":
            return CpuPhysics(library, hands, physics, num_envs)
        case "warp":
            from flashdex.envs.physics.warp import WarpPhysics

            return WarpPhysics(library, hands, physics, num_envs)
        case "brax":
            from flashdex.envs.physics.brax import BraxPhysics

            return BraxPhysics(library, hands, physics, num_envs)
