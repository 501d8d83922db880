"""Stills of a library: ``python -m flashdex.reports.render.stills LIBRARY OUT ROW...``.

The robot reference is drawn with the objects' visual meshes. As with films, drawing
happens in a process of its own: graphics that crash take no report with them.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import mujoco
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from flashdex.geometry.rotation import quat_rotate
from flashdex.hands.attach import add_hand
from flashdex.hands.spec import load_hand
from flashdex.keys import SIDES
from flashdex.motions.contact.fingertips import contact_runs
from flashdex.motions.library import MotionLibrary
from flashdex.reports.render import films
from flashdex.reports.render.scene import ScenePainter, draw_each

WIDTH, HEIGHT = 256, 192  # of one still, pixels
QUALITY = 80  # of the JPEG
SECONDS_A_MOTION = 20  # software drawing on a busy machine
COLOURS = ((0.85, 0.55, 0.25, 1.0), (0.3, 0.6, 0.4, 1.0), (0.45, 0.45, 0.75, 1.0))
DISC = (0.8, 0.8, 0.78, 1.0)


def draw_thumbnails(
    library: MotionLibrary, rows: Sequence[int]
) -> tuple[dict[int, bytes], str]:
    """Strips of stills of some motions, JPEG data by row, at ``still_frames``.

    And why pictures are missing, empty when all are there. Never raises: a library is
    worth reporting without pictures.
    """
    backend = films.find_backend() if rows else None
    if backend is None:
        return {}, films.NO_GRAPHICS if rows else ""
    with tempfile.TemporaryDirectory(prefix="flashdex-stills-") as folder:
        module = "flashdex.reports.render.stills"
        words = ["-m", module, str(library.path.resolve()), folder, *map(str, rows)]
        timeout = 60 + SECONDS_A_MOTION * len(rows)
        fault = films.run_drawer(words, backend, timeout=timeout)
        files = {row: Path(folder) / f"{row}.jpg" for row in rows}
        drawn = {row: f.read_bytes() for row, f in files.items() if f.is_file()}
    if len(drawn) == len(rows):
        return drawn, ""
    missing = f"{len(rows) - len(drawn)} of {len(rows)} motions"
    return drawn, f"no pictures of {missing}: {fault or 'unknown fault'}"


def frames_of(library: MotionLibrary, row: int) -> slice:
    """Rows of the frame axis that belong to a motion."""
    start = int(library.motions["start"][row])
    return slice(start, start + int(library.motions["length"][row]))


def contact_of(library: MotionLibrary, row: int) -> np.ndarray:
    """Human fingers in contact, (T, 2, 5) bool, hands [left, right].

    Where no contacts are stored, they follow from the tip distances.
    """
    span = frames_of(library, row)
    if library.quality is not None:
        return library.quality["contact"][span].bool().numpy()
    gaps = library.frames["tip_dist"][span].numpy()
    hands = [contact_runs(gaps[:, hand], library.fps) for hand in range(len(SIDES))]
    active = library.motions["hand_active"][row].bool().numpy()
    return np.stack(hands, axis=1) & active[:, None]


def still_frames(library: MotionLibrary, row: int) -> dict[str, int]:
    """Frames worth a picture: start, first contact (or a quarter), middle, end."""
    touched = np.flatnonzero(contact_of(library, row).any(axis=(1, 2)))
    length = int(library.motions["length"][row])
    first = {"contact": int(touched[0])} if len(touched) else {"quarter": length // 4}
    return {"start": 0, **first, "middle": length // 2, "end": length - 1}


class StillPainter(ScenePainter):
    """Draws single frames of a motion's reference, each as near as it may be.

    Raises:
        FlashdexError: the hand is unknown.
    """

    def __init__(self, library: MotionLibrary, row: int) -> None:
        hands = load_hand(library.hand)
        self._frames = library.frames[frames_of(library, row)]
        self._hands = library.motions["hand_active"][row].nonzero()[:, 0].tolist()
        rows = library.motions["object_index"][row].tolist()
        self._objects = [int(r) for r in rows if r >= 0]
        self._corners = _corners(library.objects["aabb"][self._objects])
        scene = mujoco.MjSpec()
        for hand in self._hands:
            add_hand(scene, hands[SIDES[hand]])
        for slot, object_row in enumerate(self._objects):
            _add_object(scene, library, object_row, slot)
        _add_discs(scene, library.motions["support_disks"][row].tolist())
        super().__init__(scene, size=(WIDTH, HEIGHT), middle=len(self._frames) // 2)

    def _place(self, frame: int) -> None:
        data, now = self._data, self._frames[frame]
        # the joints of a hand stand together, in the order of its spec
        data.qpos[:] = now["joint_pos"][self._hands].numpy().ravel()
        for slot in range(len(self._objects)):
            data.mocap_pos[slot] = now["object_pos"][slot].numpy()
            data.mocap_quat[slot] = now["object_quat"][slot].numpy()

    def _points(self, frame: int) -> np.ndarray:
        now = self._frames[frame]
        hands = now["keypoints"][self._hands].reshape(-1, 3)
        slots = slice(len(self._objects))
        pos, quat = now["object_pos"][slots, None], now["object_quat"][slots, None]
        objects = quat_rotate(quat, self._corners) + pos
        points = torch.cat([hands, objects.flatten(0, 1)]).double().numpy()
        return points[np.isfinite(points).all(axis=1)]

    def _is_object(self) -> np.ndarray:
        return self.model.body_mocapid >= 0


def _corners(boxes: Tensor) -> Tensor:
    """Corners of boxes, object frame, m, (n, 8, 3)."""
    picks = torch.cartesian_prod(*[torch.arange(2)] * 3)
    return boxes[:, picks, torch.arange(3)]


def _add_object(
    scene: mujoco.MjSpec, library: MotionLibrary, row: int, slot: int
) -> None:
    name = f"object{slot}"
    visual = library.visual(row)
    mesh = scene.add_mesh(name=name)
    mesh.uservert = np.asarray(visual.vertices, dtype=float).ravel()
    mesh.userface = np.asarray(visual.faces, dtype=np.int32).ravel()
    # nothing is simulated, and an open surface has no volume
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    body = scene.worldbody.add_body(name=name, mocap=True)
    geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)
    geom.rgba = COLOURS[slot % len(COLOURS)]
    geom.contype = geom.conaffinity = 0


def _add_discs(scene: mujoco.MjSpec, discs: list[list[float]]) -> None:
    for x, y, top, radius, height in discs:
        if np.isfinite(top):
            scene.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CYLINDER,
                size=[radius, height / 2, 0],
                pos=[x, y, top - height / 2],
                rgba=DISC,
            )


def write_strip(library: MotionLibrary, row: int, path: Path) -> None:
    """Draw the four stills of a motion side by side into a JPEG."""
    painter = StillPainter(library, row)
    try:
        stills = [painter.draw_still(t) for t in still_frames(library, row).values()]
    finally:
        painter.close()
    strip = Image.fromarray(np.concatenate(stills, axis=1))
    strip.save(path, quality=QUALITY, optimize=True)


def main(argv: Sequence[str]) -> int:
    """Draw rows of a library into a folder; report faults on stderr."""
    library, folder = MotionLibrary.load(argv[0]), Path(argv[1])
    return draw_each(
        (library.names[row], partial(write_strip, library, row, folder / f"{row}.jpg"))
        for row in map(int, argv[2:])
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
