"""Readers of recordings, by name: each yields human demonstrations."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from flashdex.errors import DemoError, UnknownSourceError
from flashdex.motions.demo import HumanDemo
from flashdex.motions.sources.keypoints import read_keypoints
from flashdex.motions.sources.procedural import KINDS, QUICKSTART, procedural

Reader = Callable[[str | Path | None, int, int | None], Iterable[HumanDemo]]


def _read_keypoints(
    path: str | Path | None, seed: int, limit: int | None
) -> list[HumanDemo]:
    del seed  # files hold no chance
    if path is None:
        raise DemoError(
            "keypoints: no input. Give a folder of .npz files, or one file."
        )
    return read_keypoints(path, limit=limit)


def _make_procedural(
    path: str | Path | None, seed: int, limit: int | None
) -> list[HumanDemo]:
    """``path`` chooses: quickstart (default), all, or kinds separated by commas."""
    chosen = str(path or "quickstart")
    presets = {"quickstart": list(QUICKSTART), "all": list(KINDS)}
    kinds = presets.get(chosen) or [k.strip() for k in chosen.split(",")]
    return procedural(seed, limit, kinds)


SOURCES: dict[str, Reader] = {
    "keypoints": _read_keypoints,
    "procedural": _make_procedural,
}


def read_source(
    source: str, path: str | Path | None, *, seed: int, limit: int | None
) -> list[HumanDemo]:
    """All demonstrations of a source, in a fixed order.

    Args:
        source: name of a reader.
        path: what it reads; see the reader.
        seed: for sources that make motions up.
        limit: at most this many; a made-up source makes exactly this many.

    Raises:
        UnknownSourceError: names the known readers.
    """
    if source not in SOURCES:
        raise UnknownSourceError(source, SOURCES)
    return list(SOURCES[source](path, seed, limit))
