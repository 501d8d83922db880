"""Choose the physics engine a recipe names."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from flashdex import keys
from flashdex.envs.physics.base import Physics
from flashdex.envs.physics.cpu import CpuPhysics
from flashdex.envs.scene.scene import Scene
from flashdex.hands.spec import HandSpec
from flashdex.motions.library import MotionLibrary

if TYPE_CHECKING:
    from flashdex.envs.physics.config import PhysicsConfig


def engine_device(physics: PhysicsConfig) -> torch.device:
    """Where the engine's states live: warp and brax use a GPU where they see one.

    Raises:
        FlashdexError: its packages are missing.
    """
    match physics.engine:
        case "warp":
            from flashdex.envs.physics.warp.model import warp_device

            return warp_device()
        case "brax":
            from flashdex.envs.physics.brax.engine import brax_device

            return brax_device()
        case _:
            return torch.device("cpu")


def check_engine(library: MotionLibrary, physics: PhysicsConfig) -> None:
    """Refuse what an engine cannot run, before anything is built.

    Raises:
        FlashdexError: packages are missing, or the collection is not for this engine.
    """
    engine_device(physics)
    if physics.engine == "brax":
        from flashdex.envs.physics.brax.engine import refuse_unlike_objects

        refuse_unlike_objects(library)


def make_physics(
    library: MotionLibrary,
    hands: dict[keys.Side, HandSpec],
    physics: PhysicsConfig,
    num_envs: int,
    scenes: list[Scene] | None = None,
) -> Physics:
    """Build the engine that ``physics.engine`` names.

    ``scenes`` are those of ``build_scenes`` where they are built already: of a large
    collection they are most of the work.

    Raises:
        FlashdexError: its packages are missing, or it cannot run this collection.
    """
    match physics.engine:
        case "cpu":
            return CpuPhysics(library, hands, physics, num_envs, scenes)
        case "warp":
            from flashdex.envs.physics.warp.engine import WarpPhysics

            return WarpPhysics(library, hands, physics, num_envs, scenes)
        case "brax":
            from flashdex.envs.physics.brax.engine import BraxPhysics

            return BraxPhysics(library, hands, physics, num_envs, scenes)
