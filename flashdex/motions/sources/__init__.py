"""Readers of recordings, by name: each lists recordings that workers read."""

from __future__ import annotations

from flashdex.errors import DemoError, UnknownSourceError
from flashdex.motions.recording import Recording, Source, SourceOptions
from flashdex.motions.sources.keypoints import KEYPOINTS
from flashdex.motions.sources.procedural import PROCEDURAL

SOURCES: dict[str, Source] = {"keypoints": KEYPOINTS, "procedural": PROCEDURAL}


def list_recordings(source: str, options: SourceOptions) -> list[Recording]:
    """All recordings of a source, in a fixed order; none of them is read yet.

    Args:
        source: name of a reader.
        options: where the dataset lies, and what else the reader needs.

    Raises:
        UnknownSourceError: names the known readers.
        DemoError: an option is missing, or the root is not such a dataset.
    """
    if source not in SOURCES:
        raise UnknownSourceError(source, SOURCES)
    reader = SOURCES[source]
    missing = [name for name in reader.needs if getattr(options, name) is None]
    if missing:
        told = ", ".join("--input" if m == "path" else f"--{m}" for m in missing)
        raise DemoError(f"{source}: {told} is missing. It reads {reader.about}")
    recordings = reader.list(options)
    if not recordings:
        raise DemoError(f"{source}: no recordings in {options.path}.")
    return recordings if options.limit is None else recordings[: options.limit]
