"""Readers of recordings, by name: each lists recordings that workers read.

A reader is a module of this folder, or the module ``reader`` of a folder in it, with a
line ``SOURCE = Source(...)``; module or folder are called like the source. It is found
by that line and imported when it is asked for. ``register`` makes a reader known that
lives elsewhere.
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import logging
import re
from pathlib import Path
from typing import Any

from flashdex.datasets.source import Recording, Source, SourceOptions, is_named
from flashdex.errors import DemoError, UnknownSourceError

MANO_HINT = (
    "MANO is the hand model of mano.is.tue.mpg.de (registration): give the folder with "
    "MANO_LEFT.pkl and MANO_RIGHT.pkl."
)
_LOG = logging.getLogger(__name__)
REGISTERED: dict[str, Source] = {}
DEFINED = re.compile(r"^SOURCE = Source\(", re.MULTILINE)


def register(source: Source) -> Source:
    """Make a reader known under its name, in this process."""
    REGISTERED[source.name] = source
    return source


def source_names() -> list[str]:
    """All sources, in alphabetical order; no reader is imported."""
    return sorted({*_files(), *REGISTERED})


def describe_sources() -> dict[str, str]:
    """What each source reads, by its name; no reader is imported."""
    return {name: _declared(name).about for name in source_names()}


def _declared(name: str) -> Source:
    """What a reader says of itself, without importing it: it lists nothing."""
    if name in REGISTERED:
        return REGISTERED[name]
    told: dict[str, Any] = {"name": name, "about": ""}
    for line in ast.parse(_files()[name][0].read_text(encoding="utf-8")).body:
        call = line.value if isinstance(line, ast.Assign) else None
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "Source":
            for word in call.keywords:
                with contextlib.suppress(ValueError):  # a function is no constant
                    told[str(word.arg)] = ast.literal_eval(word.value)
    return Source(**told, list=lambda _: [])


def get_source(name: str) -> Source:
    """The reader of that name; an ``UnknownSourceError`` names the known ones."""
    files = _files()
    if name in REGISTERED:
        return REGISTERED[name]
    if name not in files:
        raise UnknownSourceError(name, source_names())
    return importlib.import_module(files[name][1]).SOURCE


def _files() -> dict[str, tuple[Path, str]]:
    """File and module of each reader, by name."""
    found = {}
    for folder in map(Path, __path__):
        for file in (*folder.glob("*.py"), *folder.glob("*/reader.py")):
            if DEFINED.search(file.read_text(encoding="utf-8")):
                parts = file.relative_to(folder).with_suffix("").parts
                found[parts[0]] = file, ".".join([__name__, *parts])
    return found


def check_options(source: str, options: SourceOptions) -> None:
    """Refuse options that a source cannot do with; no reader is imported.

    Raises:
        UnknownSourceError: names the known readers.
        DemoError: an option is missing, or names a place that is not there.
    """
    if source not in source_names():
        raise UnknownSourceError(source, source_names())
    reader = _declared(source)
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


def list_recordings(source: str, options: SourceOptions) -> list[Recording]:
    """All recordings of a source, in a fixed order; none of them is read yet.

    Raises:
        UnknownSourceError: names the known readers.
        DemoError: an option is missing, or the root is not such a dataset.
    """
    check_options(source, options)
    try:
        recordings = get_source(source).list(options)
    except OSError as error:  # a name too long, a folder that may not be entered
        raise DemoError(f"{source}: cannot be read: {error}.") from error
    if not recordings:
        raise DemoError(f"{source}: no recordings in {options.path}.")
    return _select(recordings, options)


def _select(recordings: list[Recording], options: SourceOptions) -> list[Recording]:
    """Recordings that are asked for, in the order in which they are.

    A motion is called like its recording, or like it and a piece of it: where a pattern
    tells neither, all are needed to find it.
    """
    if options.select is None:
        return recordings if options.limit is None else recordings[: options.limit]
    chosen: dict[str, Recording] = {}
    for pattern in options.select:
        found = {r.name: r for r in recordings if is_named(r.name, pattern)}
        found = found or {r.name: r for r in recordings if pattern.startswith(r.name)}
        if not found:
            text = "'%s' names no recording; all %d are prepared to find such motions"
            _LOG.warning(text, pattern, len(recordings))
            return recordings
        chosen |= {name: r for name, r in found.items() if name not in chosen}
    return list(chosen.values())[: options.limit]
