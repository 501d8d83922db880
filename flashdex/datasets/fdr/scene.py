"""What else a clip of FlashDexRetarget tells: its table, and objects no hand holds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.datasets.demo import DemoObject
from flashdex.datasets.fields import numbers, poses_from_matrices, words
from flashdex.datasets.roots import scaled_mesh
from flashdex.errors import DemoError

# tracks of one object agree when they are closer than this, m
SAME_PLACE = 1e-3


def support_height(
    clip: dict[str, Any], poses: list[np.ndarray]
) -> tuple[float | None, str]:
    """Height of the table from ``support_disks`` (K, 5): x, y, z_top, radius, height.

    The table is the lowest disc over which an object's origin starts or ends. Discs
    of radius 0 are padding. With no such disc the height is left to be estimated.

    Args:
        clip: arrays of the clip.
        poses: of the objects, (T, 7).

    Returns:
        Height, m, or None, and how it was decided.
    """
    if "support_disks" not in clip:
        return None, "no support_disks in the file: estimated from objects at rest"
    disks = numbers(clip["support_disks"], what="support_disks")
    if disks.size % 5:
        raise DemoError(f"support_disks has shape {disks.shape}; expected (K, 5).")
    disks = disks.reshape(-1, 5)
    tops = []
    for x, y, top, radius, _ in disks[np.isfinite(disks).all(-1) & (disks[:, 3] > 0)]:
        ends = np.concatenate([pose[[0, -1], :2] for pose in poses])
        if (np.hypot(*(ends - [x, y]).T) <= radius).any():
            tops.append(float(top))
    if not tops:
        return None, "no object starts or ends over a disc: estimated from rest"
    return min(tops), "lowest of support_disks over which an object starts or ends"


def context_objects(
    clip: dict[str, Any],
    held: list[DemoObject],
    seek: Callable[[str], Path | None],
    file: Path,
) -> tuple[list[DemoObject], dict[str, Any]]:
    """Objects of ``desk_context_*`` that no hand holds and whose mesh is found.

    Their tracks cover the whole recording that the clip was cut from; the clip's place
    in it is where its own object has the same track. Where this is not certain, the
    objects are left out.

    Args:
        clip: arrays of the clip.
        held: the objects of the hands.
        seek: mesh file by object id, or None.
        file: for messages.

    Returns:
        The objects, and what is to be told about them.
    """
    if "desk_context_ids" not in clip or "desk_context_poses" not in clip:
        return [], {}
    names = words(clip["desk_context_ids"])
    tracks = numbers(clip["desk_context_poses"], what=f"{file}: desk_context_poses")
    if len(tracks) != len(names):
        raise DemoError(
            f"{file}: desk_context_poses has {len(tracks)} tracks for {len(names)} ids."
        )
    scales = clip.get("desk_context_scales", np.ones(len(names)))
    scales = numbers(scales, what=f"{file}: desk_context_scales").ravel()
    if len(scales) != len(names):
        raise DemoError(f"{file}: {len(scales)} scales for {len(names)} context ids.")
    start = _place(dict(zip(names, tracks, strict=True)), held)
    others = [i for i, name in enumerate(names) if name not in {b.name for b in held}]
    if start is None:
        left_out = [names[i] for i in others]
        return [], {"desk_context": {"left_out": left_out, "why": "clip not located"}}
    bodies, left_out = [], []
    for i in others:
        mesh = seek(names[i])
        if mesh is None:
            left_out.append(names[i])
            continue
        part = tracks[i][start : start + len(held[0].pose)]
        pose, _ = poses_from_matrices(part, what=f"{file}: desk context {names[i]}")
        bodies.append(DemoObject(names[i], scaled_mesh(mesh, float(scales[i])), pose))
    told = {"first_frame": start, "no_mesh": left_out}
    return bodies, {"desk_context": told}


def _place(tracks: dict[str, np.ndarray], held: list[DemoObject]) -> int | None:
    """First frame of the clip in the recording; None where it is not certain."""
    frames = len(held[0].pose)
    lengths = {len(track) for track in tracks.values()}
    if lengths == {frames}:
        return 0
    known = [(tracks[b.name], b.pose) for b in held if b.name in tracks]
    if not known or min(lengths) < frames:
        return None
    places = []
    for start in range(min(lengths) - frames + 1):
        gaps = [t[start : start + frames, :3, 3] - p[:, :3] for t, p in known]
        if all(np.abs(gap).max() < SAME_PLACE for gap in gaps):
            places.append(start)
    return places[0] if len(places) == 1 else None
