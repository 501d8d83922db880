"""The files of a HOT3D sequence as arrays: poses (.csv), hands (.jsonl), masks."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.datasets.files import read_text, told
from flashdex.errors import DemoError, is_of_machine
from flashdex.keys import SIDES, Side
from flashdex.system.jsonl import parse_json

POSE_HEADER = "object_uid,timestamp[ns],t_wo_x[m],t_wo_y[m],t_wo_z[m]"
POSE_COLUMNS = (*POSE_HEADER.split(","), "q_wo_w", "q_wo_x", "q_wo_y", "q_wo_z")
MASK_COLUMNS = ("timestamp[ns]", "stream_id", "mask")
HAND_IDS: dict[str, Side] = {"0": "left", "1": "right"}
MAX_STAMP = 1 << 62  # ns
WRIST = 7  # first columns of a hand's row: position, quaternion wxyz


@dataclass(frozen=True)
class Track:
    """Rows of one body."""

    times: np.ndarray  # ns, ascending, (N,) int64
    values: np.ndarray  # a row a time, (N, D)


@dataclass(frozen=True)
class Mask:
    """Rows of a mask file: one per time and camera stream."""

    times: np.ndarray  # ns, (N,) int64
    streams: np.ndarray  # such as ``214-1``, (N,)
    values: np.ndarray  # whether the frame may be used, (N,) bool


def read_poses(file: Path) -> dict[str, Track]:
    """Poses of ``dynamic_objects.csv`` or ``headset_trajectory.csv``.

    By uid, in the order of the file: position (m), quaternion wxyz, (N, 7).
    """
    rows: dict[str, list[tuple[int, list[float]]]] = {}
    for line, (uid, time, *pose) in _table(file, POSE_COLUMNS):
        with _cells(file, line):
            row = (_stamp(time), [float(cell) for cell in pose])
        rows.setdefault(uid, []).append(row)
    return {uid: _track(found, 7) for uid, found in rows.items()}


def read_mask(file: Path) -> Mask | None:
    """A mask file, or None where the release has none."""
    if not file.is_file():
        return None
    times, streams, values = [], [], []
    for line, (time, stream, value) in _table(file, MASK_COLUMNS):
        with _cells(file, line):
            times.append(_stamp(time))
            values.append({"true": True, "false": False}[value.strip().lower()])
        streams.append(stream)
    order = np.argsort(np.array(times, dtype=np.int64), kind="stable")
    return Mask(
        np.array(times, dtype=np.int64)[order],
        np.array(streams, dtype=str)[order],
        np.array(values, dtype=bool)[order],
    )


def read_hands(file: Path, widths: dict[str, int]) -> dict[Side, Track]:
    """Hand poses of a ``.jsonl`` trajectory; a line may lack either hand.

    ``widths`` names the fields wanted beside ``wrist_xform``, and their lengths. Per
    hand that occurs: wrist position (m), quaternion wxyz, then the fields.
    """
    rows: dict[Side, list[tuple[int, list[float]]]] = {side: [] for side in SIDES}
    for number, line in enumerate(text_of(file).splitlines(), start=1):
        if not line.strip():
            continue
        with _cells(file, number):
            record = parse_json(line.encode("utf-8"))
            time = _stamp(record["timestamp_ns"])
            for key, hand in record["hand_poses"].items():
                if hand is not None:
                    rows[HAND_IDS[key]].append((time, _hand_row(hand, widths)))
    width = WRIST + sum(widths.values())
    return {side: _track(found, width) for side, found in rows.items() if found}


def _stamp(value: Any) -> int:
    """A time, ns, that 64 bits hold."""
    time = int(value)
    if abs(time) > MAX_STAMP:
        raise ValueError(f"a time stamp of {len(str(abs(time)))} digits")
    return time


def _hand_row(hand: dict[str, Any], widths: dict[str, int]) -> list[float]:
    wrist = hand["wrist_xform"]
    parts = [(wrist["t_xyz"], 3), (wrist["q_wxyz"], 4)]
    parts += [(hand[name], width) for name, width in widths.items()]
    for values, width in parts:
        if len(values) != width:
            raise ValueError(f"{len(values)} values where {width} are expected")
    if not any(wrist["q_wxyz"]):
        raise ValueError("q_wxyz is zero")
    return [float(value) for values, _ in parts for value in values]


def _cells(file: Path, line: int) -> AbstractContextManager[None]:
    return told(f"{file}, line {line}", "not a row of this file (download it again)")


def text_of(file: Path) -> str:
    """The text of a file; where it is missing, the message lists what is there."""
    try:
        return read_text(file)
    except FileNotFoundError as error:
        found = ", ".join(sorted(p.name for p in file.parent.glob("*"))) or "nothing"
        raise DemoError(
            f"{file}: not found. The folder holds {found}. Download "
            f"'ground_truth' and 'hand_data' of the sequence.",
            code="E_FILE",
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        if is_of_machine(error):
            raise
        raise DemoError(f"{file}: not readable as text: {error}") from error


def _table(file: Path, columns: tuple[str, ...]) -> Iterator[tuple[int, list[str]]]:
    """Line numbers and the cells of ``columns`` in this order."""
    rows = _rows(file)  # one at a time: a row of cells takes forty times its text
    header = [name.strip() for name in next(rows, [])]
    missing = [name for name in columns if name not in header]
    if missing:
        raise DemoError(
            f"{file}: lacks the columns {', '.join(missing)}. Its first line is "
            f"'{','.join(header)[:200]}'."
        )
    places = [header.index(name) for name in columns]
    for line, row in enumerate(rows, start=2):
        if row:
            with _cells(file, line):
                if len(row) < len(header):
                    raise ValueError(f"{len(row)} cells, {len(header)} expected")
            yield line, [row[place] for place in places]


def _rows(file: Path) -> Iterator[list[str]]:
    try:
        yield from csv.reader(text_of(file).splitlines())
    except csv.Error as error:
        raise DemoError(
            f"{file}: not a table of comma-separated cells: {error}."
        ) from error


def _track(rows: list[tuple[int, list[float]]], width: int) -> Track:
    rows = sorted(rows, key=lambda row: row[0])
    values = np.array([row for _, row in rows], dtype=np.float64).reshape(-1, width)
    return Track(np.array([time for time, _ in rows], dtype=np.int64), values)


FPS = 30.0
RATE_TOLERANCE = 0.05
COLOUR_STREAM = "214-1"
MERGE = 10_000_000  # ns; stamps closer than this are one frame
JOIN = 5_000_000  # ns; a row further from a frame than this does not belong to it
SECOND = 1e9
MAX_SECONDS = 4 * 3600  # no session is longer: one wrong stamp would make it years


@dataclass(frozen=True)
class FrameAxis:
    """Uniform frames at 30 fps."""

    times: np.ndarray  # stamps, ns, ascending, (T,); nominal where not recorded
    recorded: np.ndarray  # frames that have a stamp of their own, (T,) bool
    fps: float  # the rate that was measured
    rule: str  # how doubled stamps were told apart

    def frame_of(self, times: np.ndarray) -> np.ndarray:
        """The frame within 5 ms of each time (ns, (N,)), -1 without one."""
        right = np.searchsorted(self.times, times).clip(1, max(len(self.times) - 1, 1))
        right = np.minimum(right, len(self.times) - 1)
        left = np.maximum(right - 1, 0)
        before = np.abs(self.times[left] - times)
        after = np.abs(self.times[right] - times)
        nearest = np.where(before <= after, left, right)
        return np.where(np.minimum(before, after) <= JOIN, nearest, -1)

    def sample(self, track: Track) -> np.ndarray:
        """The row nearest to each frame, (T, D); NaN where none is within 5 ms."""
        frames = self.frame_of(track.times)
        out = np.full((len(self.times), track.values.shape[1]), np.nan)
        gap = np.abs(track.times - self.times[frames])
        # Farther rows are written first: the nearest one of a frame stays.
        order = np.argsort(-gap, kind="stable")
        order = order[frames[order] >= 0]
        out[frames[order]] = track.values[order]
        return out

    def allowed(self, mask: Mask | None, *, every_stream: bool) -> np.ndarray:
        """Frames that a mask does not forbid, (T,) bool.

        No mask allows all frames, and no row its frame. With ``every_stream`` all
        streams must allow a frame, else one is enough.
        """
        if mask is None:
            return np.ones(len(self.times), dtype=bool)
        frames = self.frame_of(mask.times)
        counts = np.zeros((2, len(self.times)), dtype=int)
        inside = frames >= 0
        np.add.at(counts, (mask.values[inside].astype(int), frames[inside]), 1)
        refused, agreed = counts
        return refused == 0 if every_stream else (agreed > 0) | (refused == 0)


def frame_axis(name: str, tracks: Iterable[Track], mask: Mask | None) -> FrameAxis:
    """The frames of a sequence: the stamps of its objects' tracks.

    The mask says which stamps belong to which camera. A ``DemoError`` where there are
    fewer than two frames, or the rate is not 30 fps.
    """
    times = [track.times for track in tracks]
    stamps = np.unique(np.concatenate(times)) if times else np.zeros(0, dtype=np.int64)
    kept, rule = _single_stamps(stamps, mask)
    if len(kept) < 2:
        raise DemoError(
            f"{name}: {len(kept)} frames in dynamic_objects.csv; a motion needs more."
        )
    steps = np.diff(kept)
    if (seconds := (kept[-1] - kept[0]) / SECOND) > MAX_SECONDS:
        raise DemoError(
            f"{name}: its stamps span {seconds:.0f} s, the longest step "
            f"{steps.max() / SECOND:.0f} s. One is wrong; download the file again.",
            code="W_GAP",
        )
    fps = float(SECOND / np.median(steps))
    if abs(fps / FPS - 1) > RATE_TOLERANCE:
        raise DemoError(
            f"{name}: {fps:.2f} frames a second by its stamps, expected {FPS:.0f}. "
            f"Stamps are nanoseconds; Aria doubles them, which masks/"
            f"mask_object_pose_available.csv resolves."
        )
    # Rounded step by step: the clock of a headset drifts by frames within minutes.
    index = np.concatenate([[0], np.cumsum(np.rint(steps * fps / SECOND).clip(1))])
    index = index.astype(int)
    grid = np.interp(np.arange(index[-1] + 1), index, (kept - kept[0]).astype(float))
    times_ns = kept[0] + np.rint(grid).astype(np.int64)
    recorded = np.zeros(len(times_ns), dtype=bool)
    recorded[index] = True
    return FrameAxis(times_ns, recorded, fps, rule)


def _single_stamps(stamps: np.ndarray, mask: Mask | None) -> tuple[np.ndarray, str]:
    """One stamp a frame, and the rule that chose it."""
    if mask is not None:
        colour = mask.times[mask.streams == COLOUR_STREAM]
        kept = stamps[np.isin(stamps, colour)]
        if len(kept) > 0:
            return kept, f"stamps of stream {COLOUR_STREAM}"
    kept = []
    for stamp in stamps.tolist():
        if not kept or stamp - kept[-1] >= MERGE:
            kept.append(stamp)
    merged = len(kept) < len(stamps)
    rule = "stamps closer than 10 ms are one" if merged else "one stamp a frame"
    return np.array(kept, dtype=np.int64), rule
