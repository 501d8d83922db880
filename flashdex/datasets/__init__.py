"""Readers of recordings, by name: each lists recordings that workers read.

A reader is a module of this folder, or the module ``reader`` of a folder in it, with a
line ``SOURCE = Source(...)``; module or folder are called like the source. It is found
by that line and imported when it is asked for. ``register`` makes a reader known that
lives elsewhere.
"""

from __future__ import annotations

import importlib
import re
from pathlib import Path

from flashdex.datasets.source import Recording, Source, SourceOptions
from flashdex.errors import DemoError, UnknownSourceError

MANO_HINT = (
    "MANO is the hand model of mano.is.tue.mpg.de (registration): give the folder with "
    "MANO_LEFT.pkl and MANO_RIGHT.pkl."
)
REGISTERED: dict[str, Source] = {}
DEFINED = re.compile(r"^SOURCE = Source\(", re.MULTILINE)


def register(source: Source) -> Source:
    """Make a reader known under its name, in this process."""
    REGISTERED[source.name] = source
    return source


def source_names() -> list[str]:
    """All sources, in alphabetical order; no reader is imported."""
    return sorted({*_modules(), *REGISTERED})


def get_source(name: str) -> Source:
    """The reader of that name; an ``UnknownSourceError`` names the known ones."""
    modules = _modules()
    if name in REGISTERED:
        return REGISTERED[name]
    if name not in modules:
        raise UnknownSourceError(name, source_names())
    return importlib.import_module(modules[name]).SOURCE


def _modules() -> dict[str, str]:
    found = {}
    for folder in map(Path, __path__):
        for file in (*folder.glob("*.py"), *folder.glob("*/reader.py")):
            if DEFINED.search(file.read_text(encoding="utf-8")):
                parts = file.relative_to(folder).with_suffix("").parts
                found[parts[0]] = ".".join([__name__, *parts])
    return found


def list_recordings(source: str, options: SourceOptions) -> list[Recording]:
    """All recordings of a source, in a fixed order; none of them is read yet.

    Raises:
        UnknownSourceError: names the known readers.
        DemoError: an option is missing, or the root is not such a dataset.
    """
    reader = get_source(source)
    missing = [name for name in reader.needs if getattr(options, name) is None]
    if missing:
        words = ["--input" if m == "path" else f"--{m}" for m in missing]
        hint = f" {MANO_HINT}" if "mano" in missing else ""
        raise DemoError(
            f"{source}: give {' and '.join(words)}. It reads {reader.about}.{hint}"
        )
    path = options.path
    if path is not None and not reader.made_up and not path.exists():
        raise DemoError(f"{source}: no such file or folder: {path}")
    if options.limit is not None and options.limit < 1:
        raise DemoError(f"{source}: --limit is {options.limit}; at least 1 is needed.")
    try:
        recordings = reader.list(options)
    except OSError as error:  # a name too long, a folder that may not be entered
        raise DemoError(f"{source}: cannot be read: {error}.") from error
    if not recordings:
        raise DemoError(f"{source}: no recordings in {path}.")
    return recordings if options.limit is None else recordings[: options.limit]


def format_sources() -> str:
    """One line a source: its name and what it reads."""
    names = source_names()
    width = max(map(len, names))
    lines = [f"  {name:<{width}}  {get_source(name).about}" for name in names]
    return "\n".join(["recordings (flashdex prepare --source NAME):", *lines])
