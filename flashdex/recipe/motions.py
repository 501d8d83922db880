"""Schema of the environment half of a recipe: motions, physics, env, assist.

These dataclasses are the one place of defaults. Metres, radians, seconds, kilograms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from flashdex.datasets import source_names
from flashdex.system.fields import SEED_MAX, number

if TYPE_CHECKING:  # the readers that there are; a checker of types cannot know them
    SourceName = str
else:
    SourceName = Literal[tuple(source_names())]


@dataclass(frozen=True, kw_only=True)
class MotionsConfig:
    """Which motions are trained on: a prepared library, or a source to prepare."""

    library: str | None = None
    """Folder of a prepared library; when given, nothing is prepared."""
    source: SourceName | None = None
    """Reader of the recordings, which are prepared when no library is given."""
    input: str | None = None
    """Folder or file the reader reads; procedural and myodm need none."""
    mano: str | None = None
    """Folder with MANO_LEFT and MANO_RIGHT, for sources that need the hand model."""
    models: str | None = None
    """Folder of the object models, where it lies apart from the recordings."""
    speed: float = number(1.0, low=0.01, high=100)
    """Playback speed of the recordings; 0.5 makes a motion last twice as long."""
    select: Annotated[list[str], Field(min_length=1)] | None = None
    """Names or globs of the motions to keep; null keeps all."""
    count: int | None = number(None, low=1, high=10**6)
    """The first so many motions that are kept or, procedural, made; null = all."""
    seed: int = number(0, low=0, high=SEED_MAX)
    """Seed of procedural motions and of preparation."""
    control_hz: float = number(60.0, low=1, high=10_000)
    """Control rate at which a source is prepared, 1/s; a library keeps its own, which
    must be one over physics.timestep x physics.decimation."""
