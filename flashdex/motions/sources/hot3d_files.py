"""The files of a HOT3D sequence as arrays: poses (.csv), hands (.jsonl), masks."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.errors import DemoError
from flashdex.keys import SIDES, Side
from flashdex.motions.sources.roots import refuse_pointer

POSE_HEADER = "object_uid,timestamp[ns],t_wo_x[m],t_wo_y[m],t_wo_z[m]"
POSE_COLUMNS = (*POSE_HEADER.split(","), "q_wo_w", "q_wo_x", "q_wo_y", "q_wo_z")
MASK_COLUMNS = ("timestamp[ns]", "stream_id", "mask")
HAND_IDS: dict[str, Side] = {"0": "left", "1": "right"}
MAX_STAMP = 1 << 62  # ns
# what JSON of another layout, or nested too deep, raises
BROKEN_JSON = (
    *(ValueError, KeyError, TypeError, AttributeError),
    *(OverflowError, RecursionError),
)
WRIST = 7  # first columns of a hand's row: position, quaternion wxyz


@dataclass(frozen=True)
class Track:
    """Rows of one body.

    Args:
        times: ns, ascending, (N,) int64.
        values: a row a time, (N, D).
    """

    times: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class Mask:
    """Rows of a mask file: one per time and camera stream.

    Args:
        times: ns, (N,) int64.
        streams: such as ``214-1``, (N,).
        values: whether the frame may be used, (N,) bool.
    """

    times: np.ndarray
    streams: np.ndarray
    values: np.ndarray


def read_poses(file: Path) -> dict[str, Track]:
    """Poses of ``dynamic_objects.csv`` or ``headset_trajectory.csv``.

    Returns:
        By uid, in the order of the file: position (m), quaternion wxyz, (N, 7).

    Raises:
        DemoError: the file is missing, has other columns, or a cell is no number.
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

    Args:
        file: one JSON a line.
        widths: the fields wanted beside ``wrist_xform``, and their lengths.

    Returns:
        Per hand that occurs: wrist position (m), quaternion wxyz, then the fields.

    Raises:
        DemoError: the file is missing, or names the first line that is wrong.
    """
    rows: dict[Side, list[tuple[int, list[float]]]] = {side: [] for side in SIDES}
    for number, line in enumerate(read_lines(file), start=1):
        if not line.strip():
            continue
        with _cells(file, number):
            record = json.loads(line)
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


@contextmanager
def _cells(file: Path, line: int) -> Iterator[None]:
    """Turns what a malformed row raises into one message with its line."""
    try:
        yield
    except BROKEN_JSON as error:
        raise DemoError(
            f"{file}, line {line}: not a row of this file: {error!r}. Download the "
            f"file again."
        ) from error


def read_lines(file: Path) -> list[str]:
    """Lines of a text file.

    Raises:
        DemoError: it is missing (the message lists what is there), or no text.
    """
    try:
        refuse_pointer(file)
        return file.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError as error:
        found = ", ".join(sorted(p.name for p in file.parent.glob("*"))) or "nothing"
        raise DemoError(
            f"{file}: not found (E_FILE). The folder holds {found}. Download "
            f"'ground_truth' and 'hand_data' of the sequence."
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise DemoError(f"{file}: not readable as text: {error}") from error


def _table(file: Path, columns: tuple[str, ...]) -> Iterator[tuple[int, list[str]]]:
    """Line numbers and the cells of ``columns`` in this order."""
    try:
        rows = list(csv.reader(read_lines(file)))
    except csv.Error as error:
        raise DemoError(
            f"{file}: not a table of comma-separated cells: {error}."
        ) from error
    header = [name.strip() for name in rows[0]] if rows else []
    missing = [name for name in columns if name not in header]
    if missing:
        raise DemoError(
            f"{file}: lacks the columns {', '.join(missing)}. Its first line is "
            f"'{','.join(header)}'."
        )
    places = [header.index(name) for name in columns]
    for line, row in enumerate(rows[1:], start=2):
        if row:
            with _cells(file, line):
                if len(row) < len(header):
                    raise ValueError(f"{len(row)} cells, {len(header)} expected")
            yield line, [row[place] for place in places]


def _track(rows: list[tuple[int, list[float]]], width: int) -> Track:
    rows = sorted(rows, key=lambda row: row[0])
    times = np.array([time for time, _ in rows], dtype=np.int64)
    return Track(
        times, np.array([v for _, v in rows], dtype=np.float64).reshape(-1, width)
    )
