"""What a source lists: recordings that are read later, each in a worker process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # names of sources are asked for where nothing is read
    from flashdex.datasets.demo import HumanDemo


@dataclass(frozen=True, kw_only=True)
class SourceOptions:
    """What a user tells a source; every source uses what applies to it.

    Attributes:
        path: folder or file of the dataset.
        mano: folder with ``MANO_LEFT``/``MANO_RIGHT`` (.pkl or .npz).
        models: folder of the object models, where it lies apart from the dataset.
        splits: file that names the split of each recording, where it lies apart.
        seed: for sources that make motions up.
        limit: at most this many recordings; a made-up source makes exactly this many.
    """

    path: Path | None = None
    mano: Path | None = None
    models: Path | None = None
    splits: Path | None = None
    seed: int = 0
    limit: int | None = None

    def folder(self, name: str) -> Path:
        """An option that the source needs (``Source.needs``), as it was given."""
        value = getattr(self, name)
        assert value is not None, name
        return value


@dataclass(frozen=True, kw_only=True)
class Recording:
    """One recording of a dataset, listed but not read.

    Listing is cheap and refuses a wrong root at once; ``read`` is called in a worker
    and may refuse the recording with a ``DemoError``.

    Attributes:
        name: unique in the source; a file name.
        read: reads the recording as one or more motions; picklable (a
            ``functools.partial`` of a module's function).
        files: all files the result depends on: their content keys the cache.
        key: whatever else it depends on, as text.
    """

    name: str
    read: Callable[[], list[HumanDemo]]
    files: tuple[Path, ...] = ()
    key: str = ""


@dataclass(frozen=True, kw_only=True)
class Source:
    """A reader of one dataset layout.

    Attributes:
        name: how recipes and the command line call it.
        list: names the recordings of a root, in a fixed order.
        about: one line: what it reads.
        licence: one line: terms of the recordings, shown before they are used.
        needs: which options must be given (``path``, ``mano``, ...).
        made_up: its path is a word, not a place on the disk.
    """

    name: str
    list: Callable[[SourceOptions], list[Recording]]
    about: str
    licence: str = ""
    needs: tuple[str, ...] = ("path",)
    made_up: bool = False
