"""Prepared recordings on the disk: what is done is not done again.

A file a recording, named by the hash of everything its result depends on: content of
its files, settings, and the code that prepares. An interrupted preparation goes on
where it was, and one new recording costs one recording.
"""

from __future__ import annotations

import hashlib
import json
import logging
import time
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

import flashdex
from flashdex.datasets.source import Recording
from flashdex.motions.library_writer import MotionRecord
from flashdex.motions.pipeline.motion import MotionSettings, Prepared
from flashdex.objects.asset import DAMAGED, read_object
from flashdex.system.archives import read_npz
from flashdex.system.files import hash_file, open_atomic

logger = logging.getLogger(__name__)

# parts of the package that decide the result: their code, and models of the hands
CODE = ("motions", "hands", "geometry", "keys.py")
CODE_SUFFIXES = (".py", ".xml")
LIBRARIES = ("numpy", "scipy", "torch", "mujoco", "trimesh", "coacd")
DAY = 86_400.0  # s; nobody writes one file for so long


def content_hash(recording: Recording) -> str:
    """SHA-256 of what a recording is made of: its files' content and its key."""
    digest = hashlib.sha256(recording.key.encode())
    for file in recording.files:
        if not file.is_file():  # a pipe would be waited for, a device has no end
            raise OSError(f"{file} is not a file")
        digest.update(hash_file(file).encode())
    return digest.hexdigest()


def cache_file(recording: Recording, settings: MotionSettings) -> Path:
    """Where the result of a recording with these settings is kept.

    Raises:
        OSError: a file of the recording cannot be read.
    """
    content = content_hash(recording)
    facts = [recording.name, content, settings.facts(), _code_hash()]
    text = json.dumps(facts, sort_keys=True, default=str)
    name = f"{hashlib.sha256(text.encode()).hexdigest()}.npz"
    return settings.cache_root / "motions" / name


@cache
def _code_hash() -> str:
    """Of the code and the libraries that prepare: a changed line is another result."""
    root = Path(flashdex.__file__).parent
    digest = hashlib.sha256()
    for part in (root / name for name in CODE):
        for file in sorted(part.rglob("*")) if part.is_dir() else [part]:
            if file.suffix in CODE_SUFFIXES:
                digest.update(file.read_bytes())
    digest.update(" ".join(version(name) for name in LIBRARIES).encode())
    return digest.hexdigest()


def remove_torn(root: Path) -> None:
    """Delete what writers that were killed, a day ago or earlier, left in a cache."""
    with suppress(OSError):  # a cache that cannot be written is left as it is
        for file in root.glob("*/.*.npz.*.tmp"):
            if time.time() - file.lstat().st_mtime > DAY:
                file.unlink()


def write_prepared(file: Path, prepared: list[Prepared]) -> None:
    """Keep all motions of a recording, rejected ones too; a failure is only logged."""
    arrays: dict[str, np.ndarray] = {}
    entries: list[dict[str, Any]] = []
    for i, item in enumerate(prepared):
        entries.append({"row": item.row, "record": None})
        if item.record is None:
            continue
        fields = dict(vars(item.record))
        for kind in ("frames", "quality"):
            table = fields.pop(kind)
            arrays |= {f"{i}/{kind}/{key}": value for key, value in table.items()}
        arrays[f"{i}/support_disks"] = fields.pop("support_disks")
        fields["objects"] = [[a.name, a.sha256] for a in fields["objects"]]
        entries[-1]["record"] = fields
    try:
        arrays["entries"] = np.array(json.dumps(entries, default=str))
        with open_atomic(file) as stream:
            np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
    except OSError as error:
        logger.warning("%s: motion not cached (%s)", file, error)


def read_prepared(file: Path, root: Path) -> list[Prepared] | None:
    """What ``write_prepared`` kept; None when it, or an object of it, is not there.

    The objects are in the cache ``root``.
    """
    if not file.is_file():
        return None
    try:
        stored = read_npz(file)
        entries = json.loads(str(stored["entries"]))
        records = [_read_record(stored, i, e, root) for i, e in enumerate(entries)]
        pairs = zip(records, entries, strict=True)
        return [Prepared(record, _row_of(entry)) for record, entry in pairs]
    except DAMAGED as error:
        logger.warning("%s: unreadable (%s); preparing the motion again", file, error)
        return None


def _row_of(entry: dict[str, Any]) -> dict[str, Any]:
    row = entry["row"]
    if not all(isinstance(row[key], str) for key in ("motion", "status", "reason")):
        raise ValueError("a row without motion, status or reason")
    return row


def _read_record(
    stored: dict[str, np.ndarray], row: int, entry: dict[str, Any], root: Path
) -> MotionRecord | None:
    fields = entry["record"]
    if fields is None:
        return None
    objects = []
    for name, sha256 in fields["objects"]:
        asset = read_object(sha256, name=name, cache_dir=root)
        if asset is None:
            raise KeyError(f"object {name}")
        objects.append(asset)
    fields["objects"] = objects
    fields["frames"], fields["quality"] = {}, {}
    for key in stored:
        words = key.split("/")
        if words[0] == str(row) and len(words) == 3:
            fields[words[1]][words[2]] = stored[key]
    for pair in ("hand_active", "hand_object"):
        fields[pair] = tuple(fields[pair])
    return MotionRecord(**fields, support_disks=stored[f"{row}/support_disks"])
