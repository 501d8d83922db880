"""Jumps: steps between neighbouring frames that no hand and no object can make."""

from __future__ import annotations

import numpy as np

from flashdex.datasets.tracks import missing_frames, rotation

JUMP_SPEED, JUMP_TURN, JUMP_STEP = 5.0, 30.0, 0.03  # m/s, rad/s, m
JUMP_RATIO = 6.0  # of the usual step around a frame
USUAL = 7  # steps before and after that tell the usual one
LONGEST = 2  # frames of an outlier that is repaired
JUMP_EVENTS = 5  # more make a motion useless


def jump_steps(pose: np.ndarray, fps: float) -> np.ndarray:
    """Whether a track jumps from frame t to t + 1, (T - 1,) bool.

    A jump is faster than 5 m/s or 30 rad/s, or 6 times the usual step. The pose (T, 7)
    is NaN where not tracked: a step from or to there is none.
    """
    step, turn = _steps(pose, 1)
    return _impossible(step, turn, _usual(step), fps)


def outliers(pose: np.ndarray, fps: float) -> list[tuple[int, int]]:
    """Runs of one or two frames (start, end excluded) off the track: there and back.

    Where the frames before and after a run fit each other, the run is at fault. Longer
    runs, and jumps without a way back, are left alone: nobody knows which side is true.
    """
    step, turn = _steps(pose, 1)
    usual = _usual(step)
    jumps = _impossible(step, turn, usual, fps)
    # bridges[k]: the way from t to t + k + 1, a step at a time
    bridges = {}
    for k in range(1, LONGEST + 1):
        far, twist = (way / (k + 1) for way in _steps(pose, k + 1))
        jumped = _impossible(far, twist, usual[: len(far)], fps)
        bridges[k] = np.isfinite(far) & ~jumped
    found: list[tuple[int, int]] = []
    for start in np.flatnonzero(jumps) + 1:
        if found and found[-1][1] >= start:
            continue  # the frame before is an outlier itself
        for k in range(1, LONGEST + 1):
            end = start + k
            if end < len(pose) and jumps[end - 1] and bridges[k][start - 1]:
                found.append((int(start), int(end)))
                break
    return found


def _steps(pose: np.ndarray, stride: int) -> tuple[np.ndarray, np.ndarray]:
    """Distance (m) and angle (rad) from each frame to the one ``stride`` later."""
    before, after = pose[:-stride], pose[stride:]
    known = ~missing_frames(before, after)
    step, turn = np.full(len(before), np.nan), np.full(len(before), np.nan)
    if known.any():
        before, after = before[known], after[known]
        step[known] = np.linalg.norm(after[:, :3] - before[:, :3], axis=-1)
        way = rotation(after[:, 3:]) * rotation(before[:, 3:]).inv()
        turn[known] = way.magnitude()
    return step, turn


def _usual(step: np.ndarray) -> np.ndarray:
    """Running median of the steps, without those that are unknown."""
    if not len(step):
        return step
    padded = np.pad(step, USUAL, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * USUAL + 1)
    ordered = np.sort(windows, axis=1)  # NaN last
    count = np.isfinite(windows).sum(axis=1)
    row = np.arange(len(step))
    low = ordered[row, np.maximum(count - 1, 0) // 2]
    return (low + ordered[row, count // 2]) / 2


def _impossible(
    step: np.ndarray, turn: np.ndarray, usual: np.ndarray, fps: float
) -> np.ndarray:
    """Comparisons with NaN are False: an unknown step is no jump."""
    bad = (step * fps > JUMP_SPEED) | (turn * fps > JUMP_TURN)
    return bad | ((step > JUMP_RATIO * usual) & (step > JUMP_STEP))
