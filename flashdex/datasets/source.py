"""What a source lists: recordings that are read later, each in a worker process."""

from __future__ import annotations

import fnmatch
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # names of sources are asked for where nothing is read
    from flashdex.datasets.demo import HumanDemo


@dataclass(frozen=True, kw_only=True)
class SourceOptions:
    """What a user tells a source; every source uses what applies to it."""

    path: Path | None = None  # folder or file of the dataset
    mano: Path | None = None  # with ``MANO_LEFT``/``MANO_RIGHT`` (.pkl or .npz)
    models: Path | None = None  # folder of the object models, where it lies apart
    splits: Path | None = None  # file of the split of each recording, if apart
    seed: int = 0  # for sources that make motions up
    # names or globs of motions; recordings that can have none of them are left out
    select: tuple[str, ...] | None = None
    limit: int | None = None  # of recordings; a made-up source makes exactly so many

    def folder(self, name: str) -> Path:
        """An option that the source needs (``Source.needs``), as it was given."""
        value = getattr(self, name)
        assert value is not None, name
        return value


def is_named(name: str, pattern: str) -> bool:
    """Whether a name is meant: literally, or by a glob that it matches."""
    return name == pattern or fnmatch.fnmatchcase(name, pattern)


@dataclass(frozen=True, kw_only=True)
class Recording:
    """One recording of a dataset, listed but not read.

    Listing is cheap and refuses a wrong root at once; ``read`` is called in a worker
    and may refuse the recording with a ``DemoError``.
    """

    name: str  # unique in the source; a file name
    # one or more motions; picklable (a ``functools.partial`` of a module's function)
    read: Callable[[], list[HumanDemo]]
    files: tuple[Path, ...] = ()  # that it depends on: their content keys the cache
    key: str = ""  # whatever else it depends on, as text


@dataclass(frozen=True, kw_only=True)
class Source:
    """A reader of one dataset layout."""

    name: str  # how recipes and the command line call it
    list: Callable[[SourceOptions], list[Recording]]  # of a root, in a fixed order
    about: str  # one line: what it reads
    licence: str = ""  # one line: terms of the recordings, shown before they are used
    needs: tuple[str, ...] = ("path",)  # options that must be given
    made_up: bool = False  # its path is a word, not a place on the disk
