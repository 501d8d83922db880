"""Replay rows on disk: segments that are appended, never rewritten.

Every row a run ever stored has a number; a ring of capacity C holds the newest C. Each
checkpoint writes the rows that are new since the one before as segment files, and a
small manifest that lists the segments its ring consists of. So a checkpoint costs the
rows of one interval, whatever the size of the buffer, and the disk holds the buffer
plus the rows of the intervals between the kept checkpoints.
"""

from __future__ import annotations

import logging
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import TensorDict
from torchrl.data import ReplayBuffer

from flashdex.errors import RunError, is_of_machine
from flashdex.replay.buffer import RowBuffer
from flashdex.replay.codec import row_bytes
from flashdex.system.files import own_files, own_folder, remove_own
from flashdex.system.jsonl import read_object, write_object
from flashdex.system.run_files import CHECKPOINTS, FOLDERS, REPLAY
from flashdex.system.tensors import first_non_finite, read_tensors, write_tensors

_LOG = logging.getLogger(__name__)
PART_BYTES = 1 << 28  # of one segment; bounds the memory a checkpoint takes
_WRAP = 1 << 32  # torchrl counts written rows in 32 bits
_SEGMENT = re.compile(r"\d{12}-\d{1,6}\.pt")


@dataclass(frozen=True)
class Segment:
    """One file of rows: its name, the number of its first row, how many rows."""

    file: str
    first: int
    rows: int

    @property
    def end(self) -> int:
        """Number after its last row."""
        return self.first + self.rows

    @classmethod
    def parse(cls, entry: Any) -> Segment:
        """Read an entry of a manifest.

        Raises:
            ValueError: it is none.
        """
        is_whole = isinstance(entry, dict) and set(entry) == {"file", "first", "rows"}
        if not is_whole or not all(_is_count(entry[k]) for k in ("first", "rows")):
            raise ValueError(f"{entry!r:.80} is no entry of a segment")
        name = entry["file"]
        if not isinstance(name, str) or not _SEGMENT.fullmatch(name):
            raise ValueError(f"{name!r:.80} is no name of a segment")
        return cls(**entry)


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 1 << 62


def _read(run_dir: Path, stem: str) -> tuple[dict[str, Any], list[Segment]]:
    """Manifest of a checkpoint and its segments, empty where it has none.

    Raises:
        RunError: it is damaged, or a link.
        ValueError: it says what no manifest says.
    """
    manifest = read_object(run_dir, REPLAY, f"{stem}.json")
    if not manifest:
        return {}, []
    for key in ("capacity", "written", "rows"):
        if not _is_count(manifest.get(key)):
            raise ValueError(f"its manifest has {manifest.get(key)!r:.40} as '{key}'")
    segments = manifest.get("segments")
    if not isinstance(segments, list):
        raise ValueError("its manifest names no segments")
    return manifest, [Segment.parse(entry) for entry in segments]


def _read_rows(run_dir: Path, segment: Segment) -> TensorDict:
    """Rows of a file.

    Raises:
        RunError, ValueError: it is a link, damaged, or holds what is not finite.
    """
    try:
        content = read_tensors(run_dir, REPLAY, segment.file)
    except ValueError as error:
        raise ValueError(f"{segment.file}: {error}") from error
    if isinstance(content, dict) and content.get("sealed") is True:
        content = content.get("rows")  # bare in earlier versions
    if not isinstance(content, dict):
        raise ValueError(f"{segment.file}: it holds no rows")
    if bad := first_non_finite(content):
        raise ValueError(f"{segment.file}: its '{bad}' is not finite")
    return TensorDict(content, batch_size=[segment.rows])


def check_rows(run_dir: Path, stem: str) -> int:
    """Read the replay rows of a checkpoint, file by file; returns how many there are.

    Raises:
        RunError, ValueError: the manifest or a file is missing or damaged.
    """
    _, segments = _read(run_dir, stem)
    return sum(len(_read_rows(run_dir, segment)) for segment in segments)


class ReplayLog:
    """Stores and restores a one-dimensional ring buffer beside the checkpoints.

    Rows of another ``meaning`` (motions, rewards, ...) are not loaded. When not
    ``enabled`` it stores nothing, but still loads and deletes.
    """

    def __init__(
        self, run_dir: Path, buffer: ReplayBuffer, *, meaning: str, enabled: bool = True
    ) -> None:
        self.run_dir, self.folder = run_dir, run_dir / REPLAY
        self.buffer, self.meaning, self.enabled = buffer, meaning, enabled
        self._segments: list[Segment] = []
        self._written = 0  # rows ever stored, earlier sessions included
        self._counted = 0  # of them by the buffer's own counter

    @property
    def capacity(self) -> int:
        """Rows of the full ring."""
        return int(self.buffer.storage.max_size)

    def save(self, stem: str) -> None:
        """Write what is new, then the manifest ``<stem>.json``."""
        if not self.enabled:
            return
        own_folder(self.run_dir, CHECKPOINTS)
        own_folder(self.run_dir, REPLAY)
        if isinstance(self.buffer, RowBuffer):
            self.buffer.flush()  # rows on their way count as stored
        self._count()
        oldest = self._written - len(self.buffer)
        kept = [s for s in self._segments if s.end > oldest]
        start = max(kept[-1].end if kept else 0, oldest)
        segments = [*kept, *self._append(stem, start)]
        manifest = {
            "meaning": self.meaning,
            "capacity": self.capacity,
            "written": self._written,
            "rows": len(self.buffer),
            "segments": [asdict(s) for s in segments],
        }
        write_object(manifest, self.run_dir, REPLAY, f"{stem}.json")
        self._segments = segments

    def _count(self) -> None:
        now = self.buffer.write_count
        self._written += (now - self._counted) % _WRAP
        self._counted = now

    def _append(self, stem: str, start: int) -> list[Segment]:
        """Write rows ``start`` and later, in parts."""
        if start == self._written:
            return []
        cursor = self.buffer.writer.state_dict()["_cursor"]
        storage: Any = self.buffer.storage
        size = max(1, PART_BYTES // max(row_bytes(storage[:1]), 1))
        out = []
        for first in range(start, self._written, size):
            end = min(first + size, self._written)
            number = torch.arange(first, end, device=storage.device)
            rows = storage[(cursor - self._written + number) % self.capacity].cpu()
            segment = Segment(f"{stem}-{len(out)}.pt", first, end - first)
            content = {"sealed": True, "rows": rows.to_dict()}
            write_tensors(content, self.run_dir, REPLAY, segment.file)
            out.append(segment)
        return out

    def load(self, stem: str) -> bool:
        """Fill the empty buffer as it was at a checkpoint; a warning says why not.

        Equal capacity puts every row where it was, so that sampling goes on bit-equal;
        a smaller or larger ring takes the newest rows.
        """
        try:
            manifest, segments = _read(self.run_dir, stem)
            if not manifest:
                if self.enabled:
                    _LOG.warning("checkpoint %s has no replay rows", stem)
                return False
            if manifest.get("meaning") != self.meaning:
                _LOG.warning("an override changed what replay rows mean: none is kept")
                return False
            self._fill(manifest, segments)
        except Exception as error:
            if is_of_machine(error):
                raise
            _LOG.warning(
                "replay rows of checkpoint %s cannot be read (%s): the policy fills "
                "the buffer again",
                stem,
                error,
            )
            self.buffer.empty()
            self._count()
            self._segments, self._written = [], 0
            return False
        return True

    def _fill(self, manifest: dict[str, Any], segments: list[Segment]) -> None:
        written = manifest["written"]
        same = manifest["capacity"] == self.capacity
        oldest = written - min(manifest["rows"], self.capacity)
        first = (manifest["written"] - manifest["rows"]) if same else 0
        # Row numbers and ring positions differ by a constant, as the ring began at 0.
        writer, storage = self.buffer.writer, cast(Any, self.buffer.storage)
        writer.load_state_dict({"_cursor": first % self.capacity if same else 0})
        for segment in segments:
            rows = _read_rows(self.run_dir, segment)
            rows = rows[max(0, oldest - segment.first) :]
            if len(rows):
                self.buffer.extend(rows.to(storage.device))
        if len(self.buffer) != written - oldest:
            msg = f"{len(self.buffer)} rows instead of {written - oldest}"
            raise ValueError(msg)
        self._counted = self.buffer.write_count
        # A ring of another size numbers its rows anew, so its segments are new, too.
        self._segments = segments if same else []
        self._written = written if same else len(self.buffer)

    def prune(self, stems: set[str]) -> None:
        """Delete what no remaining checkpoint needs; files of its own only.

        While a manifest cannot be read nobody knows what it needs: nothing goes.
        """
        needed = {f"{stem}.json" for stem in stems}
        for stem in stems:
            try:
                needed |= {s.file for s in _read(self.run_dir, stem)[1]}
            except (RunError, ValueError) as error:
                _LOG.warning("%s: no replay rows are deleted: %s", self.folder, error)
                return
        for path in own_files(self.run_dir, REPLAY, "[0-9]*"):
            if path.name not in needed and FOLDERS[REPLAY].fullmatch(path.name):
                remove_own(self.run_dir, REPLAY, path.name)
        # after a failed save its segments are gone, and have to be written again
        self._segments = [s for s in self._segments if s.file in needed]
