"""Readers of recordings, by name: each lists recordings that workers read."""

from __future__ import annotations

from flashdex.datasets.arctic import ARCTIC
from flashdex.datasets.fdr.reader import FDR
from flashdex.datasets.grab import GRAB
from flashdex.datasets.hot3d.reader import HOT3D
from flashdex.datasets.keypoints import KEYPOINTS
from flashdex.datasets.myodm import MYODM
from flashdex.datasets.oakink2.reader import OAKINK2
from flashdex.datasets.procedural.reader import PROCEDURAL
from flashdex.datasets.source import Recording, Source, SourceOptions
from flashdex.datasets.spider.reader import SPIDER
from flashdex.datasets.taco.reader import TACO
from flashdex.errors import DemoError, UnknownSourceError

MANO_HINT = (
    "MANO is the hand model of mano.is.tue.mpg.de (registration): give the folder with "
    "MANO_LEFT.pkl and MANO_RIGHT.pkl."
)
SOURCES: dict[str, Source] = {
    "procedural": PROCEDURAL,
    "keypoints": KEYPOINTS,
    "myodm": MYODM,
    "taco": TACO,
    "oakink2": OAKINK2,
    "hot3d": HOT3D,
    "arctic": ARCTIC,
    "grab": GRAB,
    "spider": SPIDER,
    "fdr": FDR,
}


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
        words = ["--input" if m == "path" else f"--{m}" for m in missing]
        hint = f" {MANO_HINT}" if "mano" in missing else ""
        raise DemoError(
            f"{source}: give {' and '.join(words)}. It reads {reader.about}.{hint}"
        )
    made_up = source == "procedural"  # its input is a word
    if options.path is not None and not made_up and not options.path.exists():
        raise DemoError(f"{source}: no such file or folder: {options.path}")
    if options.limit is not None and options.limit < 1:
        raise DemoError(f"{source}: --limit is {options.limit}; at least 1 is needed.")
    try:
        recordings = reader.list(options)
    except OSError as error:  # a name too long, a folder that may not be entered
        raise DemoError(f"{source}: cannot be read: {error}.") from error
    if not recordings:
        raise DemoError(f"{source}: no recordings in {options.path}.")
    return recordings if options.limit is None else recordings[: options.limit]


def format_sources() -> str:
    """One line a source: its name and what it reads."""
    width = max(map(len, SOURCES))
    lines = [f"  {name:<{width}}  {s.about}" for name, s in SOURCES.items()]
    return "\n".join(["recordings (flashdex prepare --source NAME):", *lines])
