"""How much memory the warp engine takes, from a model and without a GPU."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

from flashdex.envs.physics.warp.model import (
    Room,
    WorldRows,
    model_fields,
    require_warp,
    room_of,
)
from flashdex.envs.scene.scene import build_scenes
from flashdex.envs.scene.union import build_union
from flashdex.hands.spec import HandSpec
from flashdex.keys import Side
from flashdex.motions.library import MotionLibrary

if TYPE_CHECKING:
    from flashdex.envs.physics.config import PhysicsConfig

# Below two worlds some arrays have a row more than worlds.
_FEW, _MORE = 2, 10
_MAKERS = ("empty", "zeros", "ones", "full", "empty_like", "zeros_like", "clone")


@dataclasses.dataclass(frozen=True)
class WarpMemory:
    """Bytes of the warp engine."""

    fixed: int  # model and data that do not grow with the worlds
    model: int  # each world's own rows of the model
    data: int  # each world's state, contacts and constraints
    step: int  # what a step allocates for each world while it runs
    room: Room  # contacts and constraint rows that this is for

    @property
    def per_world(self) -> int:
        """Bytes that each further world takes."""
        return self.model + self.data + self.step


def measure_warp(
    library: MotionLibrary, hands: dict[Side, HandSpec], physics: PhysicsConfig
) -> WarpMemory:
    """Make the engine's arrays for 2 and for 10 worlds on the CPU and compare.

    Raises:
        MissingExtraError: warp or mujoco_warp is not installed.
    """
    scenes = build_scenes(library, hands, physics)
    union = build_union(library, hands, physics, scenes, model_fields())
    room = room_of(union.model, physics)
    found = {}
    for count in (_FEW, _MORE):
        rows = WorldRows(union, count, room, "cpu")
        sizes = (_bytes(rows.model), _bytes(rows.data), _step_bytes(rows))
        found[count] = sizes
    spread = _MORE - _FEW
    model, data, step = (
        (more - few) // spread
        for few, more in zip(found[_FEW], found[_MORE], strict=True)
    )
    fixed = sum(found[_FEW]) - _FEW * (model + data + step)
    return WarpMemory(fixed, model, data, step, room)


def _bytes(owner: Any) -> int:
    """Bytes of all arrays of a dataclass, nested ones included."""
    wp = require_warp()[0]
    total = 0
    for field in dataclasses.fields(owner):
        value = getattr(owner, field.name, None)
        if isinstance(value, wp.array):
            total += getattr(value, "capacity", 0)
        elif dataclasses.is_dataclass(value):
            total += _bytes(value)
    return total


def _step_bytes(rows: WorldRows) -> int:
    """Bytes a step asks for besides model and data: solver and collision buffers."""
    wp, mjw = require_warp()
    made: list[int] = []
    with wp.ScopedDevice("cpu"), _dry(wp, made):
        mjw.step(rows.model, rows.data)
    return sum(made)


@contextmanager
def _dry(wp: Any, made: list[int]) -> Iterator[None]:
    """Let warp code allocate and compute nothing: no kernel is compiled or launched."""

    def counted(make: Any) -> Any:
        def call(*args: Any, **options: Any) -> Any:
            array = make(*args, **options)
            made.append(array.capacity)
            return array

        return call

    def skip(*_: Any, **__: Any) -> None:
        """Launch nothing."""

    def once(_: Any, while_body: Any, **options: Any) -> None:
        while_body(**options)  # nothing would ever end the loop

    stand_ins = {"launch": skip, "launch_tiled": skip, "capture_while": once}
    stand_ins |= {name: counted(getattr(wp, name)) for name in _MAKERS}
    with ExitStack() as patched:
        for name, stand_in in stand_ins.items():
            patched.enter_context(patch.object(wp, name, stand_in))
        yield
