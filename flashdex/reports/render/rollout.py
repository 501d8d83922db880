"""Film of a rollout: ``python -m flashdex.reports.render.rollout ROLLOUT... OUT``."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import imageio_ffmpeg
import mujoco
import numpy as np
from PIL import Image

from flashdex.reports.render.films import Film
from flashdex.reports.render.scene import ScenePainter, View, draw_each, update_poses
from flashdex.rollouts.rollout import Rollout
from flashdex.system.files import open_atomic
from flashdex.system.mjcf import check_mjcf

WIDTH, HEIGHT = 512, 384  # multiples of 16, as the encoder wants them
FILM_FPS = 30.0
NUM_STILLS, STILL_WIDTH = 4, 320
GHOST = (0.15, 0.45, 0.95, 0.35)  # rgba of the reference object
GHOST_FULL = 0.01  # m, error from which it is fully drawn


class Painter(ScenePainter):
    """Draws control steps of a stored rollout, the reference object as a ghost."""

    def __init__(self, rollout: Rollout) -> None:
        self.rollout = rollout
        self._moving = _moving_points(rollout)
        self._cameras: dict[View, mujoco.MjvCamera] = {}
        check_mjcf(rollout.model_xml, where=rollout.motion)
        spec = mujoco.MjSpec.from_string(rollout.model_xml)
        super().__init__(spec, size=(WIDTH, HEIGHT), middle=rollout.num_frames // 2)
        self._ghost = mujoco.MjData(self.model)

    def _points(self, frame: int) -> np.ndarray:
        return self._moving

    def _camera(self, view: View, frame: int) -> mujoco.MjvCamera:
        """One for the whole film: it sees all that ever moves, and stands still."""
        if view not in self._cameras:
            self._cameras[view] = super()._camera(view, frame)
        return self._cameras[view]

    def _is_object(self) -> np.ndarray:
        owners = self.model.jnt_bodyid[self.model.jnt_type == 0]
        return np.isin(np.arange(self.model.nbody), owners)

    def _place(self, frame: int) -> None:
        self._data.qpos[:] = self.rollout.qpos[frame]

    def _add(self, scene: mujoco.MjvScene, frame: int) -> None:
        """Draw the objects once more, translucent, where the reference has them."""
        rollout, ghost = self.rollout, self._ghost
        ghost.qpos[:] = self._data.qpos
        for slot, adr in enumerate(rollout.object_qpos_adr):
            if adr >= 0:
                ghost.qpos[adr : adr + 3] = rollout.ref_object_pos[frame, slot]
                ghost.qpos[adr + 3 : adr + 7] = rollout.ref_object_quat[frame, slot]
        update_poses(self.model, ghost)
        is_object = self._is_object()[self.model.geom_bodyid]
        for drawn in list(scene.geoms[: scene.ngeom]):
            is_geom = drawn.objtype == mujoco.mjtObj.mjOBJ_GEOM
            if is_geom and is_object[drawn.objid] and scene.ngeom < scene.maxgeom:
                pos, mat = ghost.geom_xpos[drawn.objid], ghost.geom_xmat[drawn.objid]
                _add_ghost(scene, drawn, pos, mat)


def _moving_points(rollout: Rollout) -> np.ndarray:
    """World positions that the camera has to show, m, (n, 3)."""
    hands = np.flatnonzero(rollout.hand_active)
    slots = np.flatnonzero(np.asarray(rollout.object_qpos_adr) >= 0)
    tracks = [rollout.fingertips[:, hands], rollout.joints[:, hands]]
    tracks += [rollout.object_pos[:, slots], rollout.ref_object_pos[:, slots]]
    points = np.concatenate([track.reshape(-1, 3) for track in tracks])
    return points[np.isfinite(points).all(1)]


def _add_ghost(
    scene: mujoco.MjvScene, drawn: mujoco.MjvGeom, pos: np.ndarray, mat: np.ndarray
) -> None:
    colour = np.array(GHOST, dtype=np.float32)
    # two coinciding surfaces flicker, so the ghost fades in with the error
    turn = np.linalg.norm(np.ravel(drawn.mat) - mat) * 0.05
    error = np.linalg.norm(np.ravel(drawn.pos) - pos) + turn
    colour[3] *= min(1.0, error / GHOST_FULL)
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, drawn.type, np.array(drawn.size), pos, mat, colour)
    geom.dataid, geom.objtype = drawn.dataid, mujoco.mjtObj.mjOBJ_UNKNOWN
    geom.category = drawn.category
    scene.ngeom += 1


def write_film(rollout: Rollout, film: Film) -> None:
    """Write the film in real time, its first picture and a strip of stills."""
    film.video.parent.mkdir(parents=True, exist_ok=True)
    half = film.video.with_name(f".{film.video.stem}.{os.getpid()}.tmp.mp4")
    stride = max(1, round(rollout.fps / FILM_FPS))
    last = rollout.num_frames - 1
    painter = Painter(rollout)
    try:
        half.unlink(missing_ok=True)  # the encoder would follow a link that waits here
        spread = np.linspace(0, last, NUM_STILLS).round().astype(int).tolist()
        stills = [Image.fromarray(painter.draw_still(t)) for t in spread]
        frames = (painter.draw(t) for t in range(0, rollout.num_frames, stride))
        _write_mp4(frames, half, fps=rollout.fps / stride)
        os.replace(half, film.video)  # takes the place of a link, follows none
    finally:
        half.unlink(missing_ok=True)
        painter.close()
    pictures = {film.poster: stills[0], film.stills: _side_by_side(stills)}
    for path, picture in pictures.items():
        with open_atomic(path) as file:
            picture.save(file, "png", optimize=True)


def _side_by_side(pictures: Sequence[Image.Image]) -> Image.Image:
    """Join pictures to one row, small and with few colours, for a light page."""
    height = round(STILL_WIDTH * pictures[0].height / pictures[0].width)
    row = Image.new("RGB", (STILL_WIDTH * len(pictures), height))
    for index, picture in enumerate(pictures):
        row.paste(picture.resize((STILL_WIDTH, height)), (index * STILL_WIDTH, 0))
    return row.quantize(128)


def _write_mp4(frames: Iterator[np.ndarray], path: Path, *, fps: float) -> None:
    writer = imageio_ffmpeg.write_frames(
        str(path),
        (WIDTH, HEIGHT),
        fps=fps,  # type: ignore[arg-type]  a fraction is fine for ffmpeg
        codec="libx264",
        quality=None,  # type: ignore[arg-type]  crf below decides
        output_params=["-crf", "27", "-preset", "fast", "-movflags", "+faststart"],
    )
    writer.send(None)
    for frame in frames:
        writer.send(np.ascontiguousarray(frame))
    writer.close()


def main(argv: Sequence[str]) -> int:
    """Draw every rollout file into the folder named last; report faults on stderr."""
    *files, folder = argv
    return draw_each((file, partial(_draw, Path(file), Path(folder))) for file in files)


def _draw(file: Path, folder: Path) -> None:
    write_film(Rollout.load(file), Film.at(folder / file.stem))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
