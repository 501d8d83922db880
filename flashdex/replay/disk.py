"""Replay rows on disk: segments that are appended, never rewritten.

Every row a run ever stored has a number; a ring of capacity C holds the newest C. Each
checkpoint writes the rows that are new since the one before as segment files, and a
small manifest that lists the segments its ring consists of. So a checkpoint costs the
rows of one interval, whatever the size of the buffer, and the disk holds the buffer
plus the rows of the intervals between the kept checkpoints.
"""

from __future__ import annotations

import json
import logging
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import TensorDict
from torchrl.data import ReplayBuffer

from flashdex.replay.buffer import RowBuffer
from flashdex.replay.codec import row_bytes
from flashdex.system.files import open_atomic, write_atomic

_LOG = logging.getLogger(__name__)
FOLDER, REPLAY = "checkpoints", "replay"  # of the run, and in it
PART_BYTES = 1 << 28  # of one segment; bounds the memory a checkpoint takes
_WRAP = 1 << 32  # torchrl counts written rows in 32 bits


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


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))


class ReplayLog:
    """Stores and restores a one-dimensional ring buffer beside the checkpoints.

    Rows of another ``meaning`` (motions, rewards, ...) are not loaded. When not
    ``enabled`` it stores nothing, but still loads and deletes.
    """

    def __init__(
        self, run_dir: Path, buffer: ReplayBuffer, *, meaning: str, enabled: bool = True
    ) -> None:
        self.folder = run_dir / FOLDER / REPLAY
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
        self.folder.mkdir(parents=True, exist_ok=True)
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
        write_atomic(self.folder / f"{stem}.json", json.dumps(manifest))
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
            with open_atomic(self.folder / segment.file) as file:
                torch.save(rows.to_dict(), file)
            out.append(segment)
        return out

    def load(self, stem: str) -> bool:
        """Fill the empty buffer as it was at a checkpoint; a warning says why not.

        Equal capacity puts every row where it was, so that sampling goes on bit-equal;
        a smaller or larger ring takes the newest rows.
        """
        path = self.folder / f"{stem}.json"
        if not path.is_file():
            return False
        try:
            manifest = _read(path)
            if manifest["meaning"] != self.meaning:
                _LOG.warning("an override changed what replay rows mean: none is kept")
                return False
            self._fill(manifest)
        except Exception as error:
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

    def _fill(self, manifest: dict[str, Any]) -> None:
        segments = [Segment(**s) for s in manifest["segments"]]
        written = manifest["written"]
        same = manifest["capacity"] == self.capacity
        oldest = written - min(manifest["rows"], self.capacity)
        first = (manifest["written"] - manifest["rows"]) if same else 0
        # Row numbers and ring positions differ by a constant, as the ring began at 0.
        writer, storage = self.buffer.writer, cast(Any, self.buffer.storage)
        writer.load_state_dict({"_cursor": first % self.capacity if same else 0})
        for segment in segments:
            content = torch.load(self.folder / segment.file, weights_only=True)
            rows = TensorDict(content, batch_size=[segment.rows])
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
        """Delete what no remaining checkpoint needs."""
        needed = {f"{stem}.json" for stem in stems}
        for stem in stems:
            path = self.folder / f"{stem}.json"
            if path.is_file():
                manifest = _read(path)
                needed |= {s["file"] for s in manifest["segments"]}
        for path in self.folder.glob("*"):
            if path.name not in needed:
                path.unlink()
        # after a failed save its segments are gone, and have to be written again
        self._segments = [s for s in self._segments if s.file in needed]
