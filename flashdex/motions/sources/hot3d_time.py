"""One uniform time axis for a HOT3D sequence, and what is valid on it.

Aria trajectories hold two stamps a frame, about 0.09 ms apart: one of the colour
camera (stream 214-1), one of the two tracking cameras. The frames are those of 214-1
where a mask file names them, else stamps closer than 10 ms are one. Missing frames
become frames of NaN, so that time stays uniform.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from flashdex.errors import DemoError
from flashdex.motions.sources.hot3d_files import Mask, Track

FPS = 30.0
RATE_TOLERANCE = 0.05
COLOUR_STREAM = "214-1"
MERGE = 10_000_000  # ns; stamps closer than this are one frame
JOIN = 5_000_000  # ns; a row further from a frame than this does not belong to it
SECOND = 1e9
MAX_SECONDS = 4 * 3600  # no session is longer: one wrong stamp would make it years


@dataclass(frozen=True)
class FrameAxis:
    """Uniform frames at 30 fps.

    Args:
        times: stamp of each frame, ns, ascending, (T,); nominal where a frame was not
            recorded.
        recorded: frames that have a stamp of their own, (T,) bool.
        fps: the rate that was measured.
        rule: how doubled stamps were told apart.
    """

    times: np.ndarray
    recorded: np.ndarray
    fps: float
    rule: str

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

        Args:
            mask: None allows all frames, and so does a frame without a row.
            every_stream: all streams must allow a frame, else one is enough.
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
    """The frames of a sequence.

    Args:
        name: of the sequence, for messages.
        tracks: of the objects; their stamps are the frames.
        mask: that says which stamps belong to which camera.

    Raises:
        DemoError: there are fewer than two frames, or the rate is not 30 fps.
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
            f"{name}: W_GAP: its stamps span {seconds:.0f} s, the longest step "
            f"{steps.max() / SECOND:.0f} s. One is wrong; download the file again."
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
