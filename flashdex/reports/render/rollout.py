"""Pictures of a rollout: ``python -m flashdex.reports.render.rollout ROLLOUT... OUT``.

Runs in a process of its own, because MuJoCo chooses its graphics back end (the variable
MUJOCO_GL) when it is imported. ``film.py`` starts it.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import imageio_ffmpeg
import mujoco
import numpy as np
from PIL import Image

from flashdex.errors import FlashdexError
from flashdex.rollouts.rollout import Rollout

MARGIN = 0.08  # m, kept free around every point: hands and objects have a size
MIN_DISTANCE = 0.35  # m
CENTRING_STEPS = 8


def moving_points(rollout: Rollout) -> np.ndarray:
    """World positions that the camera has to show, m, (n, 3).

    Args:
        rollout: stored rollout.
    """
    hands = np.flatnonzero(rollout.hand_active)
    slots = np.flatnonzero(np.asarray(rollout.object_qpos_adr) >= 0)
    tracks = [rollout.fingertips[:, hands], rollout.joints[:, hands]]
    tracks += [rollout.object_pos[:, slots], rollout.ref_object_pos[:, slots]]
    points = np.concatenate([track.reshape(-1, 3) for track in tracks])
    return points[np.isfinite(points).all(1)]


def view_axes(
    azimuth: float, elevation: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions forward, right and up of MuJoCo's free camera in the world, each (3,).

    Args:
        azimuth: deg.
        elevation: deg, negative looks down.
    """
    a, e = math.radians(azimuth), math.radians(elevation)
    level = np.array([math.cos(a), math.sin(a), 0.0])
    forward = math.cos(e) * level + np.array([0.0, 0.0, math.sin(e)])
    right = np.array([math.sin(a), -math.cos(a), 0.0])
    return forward, right, np.cross(right, forward)


def fit_view(
    points: np.ndarray,
    axes: tuple[np.ndarray, np.ndarray, np.ndarray],
    *,
    fovy: float,
    aspect: float,
) -> tuple[np.ndarray, float]:
    """Where to look and from how far, so that the points fill the picture.

    A point (x, y, z) on the axes (right, up, forward) from the point looked at is
    inside if ``|y| + margin <= (d + z) tan(fovy / 2)``, and likewise ``|x|`` with the
    aspect. The smallest such d is taken, then the view is moved until the picture has
    equal room on opposite sides; perspective makes this a fixed-point iteration.

    Args:
        points: world, m, (n, 3).
        axes: forward, right, up, from :func:`view_axes`.
        fovy: vertical opening angle, deg.
        aspect: width over height.

    Returns:
        Point looked at, m, (3,), and distance from it, m.
    """
    forward, right, up = axes
    lookat = (points.min(0) + points.max(0)) / 2
    for _ in range(CENTRING_STEPS):
        distance = _fit_distance(points - lookat, axes, fovy=fovy, aspect=aspect)
        depth = distance + (points - lookat) @ forward
        for axis in (right, up):
            seen = (points - lookat) @ axis / depth
            lookat = lookat + axis * (seen.min() + seen.max()) * distance / 2
    return lookat, _fit_distance(points - lookat, axes, fovy=fovy, aspect=aspect)


def _fit_distance(
    points: np.ndarray,
    axes: tuple[np.ndarray, np.ndarray, np.ndarray],
    *,
    fovy: float,
    aspect: float,
) -> float:
    forward, right, up = axes
    half = math.tan(math.radians(fovy) / 2)
    wide = (np.abs(points @ right) + MARGIN) / (half * aspect) - points @ forward
    high = (np.abs(points @ up) + MARGIN) / half - points @ forward
    return max(MIN_DISTANCE, float(np.max([wide, high])))


WIDTH, HEIGHT = 512, 384  # multiples of 16, as the encoder wants them
FILM_FPS = 30.0
NUM_STILLS, STILL_WIDTH = 4, 320
GHOST = (0.15, 0.45, 0.95, 0.35)  # rgba of the reference object
GHOST_FULL = 0.01  # m, error from which it is fully drawn
AZIMUTHS = (135.0, 45.0, 225.0, 315.0)  # deg, camera directions to choose from
ELEVATION = -27.0  # deg


def dress_model(rollout: Rollout) -> mujoco.MjModel:
    """Compile the model of a rollout with light, a pale sky and a large picture.

    Args:
        rollout: stored rollout; its own model stays as it is.
    """
    spec = mujoco.MjSpec.from_string(rollout.model_xml)
    dress_scene(spec, width=WIDTH, height=HEIGHT)
    return spec.compile()


def dress_scene(spec: mujoco.MjSpec, *, width: int, height: int) -> None:
    """Add the light and the pale sky of all pictures to a scene.

    Args:
        spec: scene under construction.
        width: of the largest picture, pixels.
        height: likewise.
    """
    spec.add_texture(
        name="film_sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.97, 0.98, 1.0],
        rgb2=[0.80, 0.84, 0.89],
        width=32,
        height=32 * 6,
    )
    spec.worldbody.add_light(
        pos=[0.6, -0.8, 3.0],
        dir=[-0.2, 0.27, -1.0],
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=[0.6] * 3,
        castshadow=True,
    )
    view = spec.visual
    view.headlight.ambient = [0.45] * 3
    view.headlight.diffuse = [0.4] * 3
    view.quality.shadowsize = 2048  # software rendering pays for every pixel
    view.global_.offwidth, view.global_.offheight = width, height
    # The picture spans objects of centimetres, whatever far-away bodies the scene has.
    spec.stat.extent = 1.0
    view.map.znear, view.map.zfar = 0.02, 30.0


def frame_camera(
    model: mujoco.MjModel, rollout: Rollout, *, azimuth: float
) -> mujoco.MjvCamera:
    """Place a camera that sees everything the hands and objects do.

    Args:
        model: from :func:`dress_model`.
        rollout: gives the points that must be in sight.
        azimuth: direction of sight, deg.
    """
    lookat, distance = fit_view(
        moving_points(rollout),
        view_axes(azimuth, ELEVATION),
        fovy=float(model.vis.global_.fovy),
        aspect=WIDTH / HEIGHT,
    )
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat[:], camera.distance = lookat, distance
    camera.azimuth, camera.elevation = azimuth, ELEVATION
    return camera


def add_ghost(
    scene: mujoco.MjvScene, model: mujoco.MjModel, ghost: mujoco.MjData
) -> None:
    """Draw the object geoms once more, translucent, where the reference has them.

    Args:
        scene: holds the simulated state.
        model: compiled model.
        ghost: state whose objects are at their reference.
    """
    owners = {int(b) for b in model.jnt_bodyid[model.jnt_type == 0]}
    for drawn in list(scene.geoms[: scene.ngeom]):
        if drawn.objtype != mujoco.mjtObj.mjOBJ_GEOM or scene.ngeom >= scene.maxgeom:
            continue
        if int(model.geom_bodyid[drawn.objid]) not in owners:
            continue
        pos, mat = ghost.geom_xpos[drawn.objid], ghost.geom_xmat[drawn.objid]
        colour = np.array(GHOST, dtype=np.float32)
        # two coinciding surfaces flicker, so the ghost fades in with the error
        turn = np.linalg.norm(np.ravel(drawn.mat) - mat) * 0.05
        error = np.linalg.norm(np.ravel(drawn.pos) - pos) + turn
        colour[3] *= min(1.0, error / GHOST_FULL)
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(
            geom,
            drawn.type,
            np.array(drawn.size),
            pos,
            mat,
            colour,
        )
        geom.dataid, geom.objtype = drawn.dataid, mujoco.mjtObj.mjOBJ_UNKNOWN
        geom.category = drawn.category
        scene.ngeom += 1


class Painter:
    """Draws single frames of a rollout.

    Args:
        rollout: stored rollout.
    """

    def __init__(self, rollout: Rollout) -> None:
        self.rollout = rollout
        self.model = dress_model(rollout)
        self._data = mujoco.MjData(self.model)
        self._ghost = mujoco.MjData(self.model)
        self._renderer = mujoco.Renderer(self.model, HEIGHT, WIDTH)
        self._camera = self._choose_camera()

    def close(self) -> None:
        """Free the graphics context."""
        self._renderer.close()

    def draw(self, frame: int) -> np.ndarray:
        """Picture of one control step, (HEIGHT, WIDTH, 3) uint8.

        Args:
            frame: row of the rollout.
        """
        self._place(frame)
        self._renderer.update_scene(self._data, self._camera)
        add_ghost(self._renderer.scene, self.model, self._ghost)
        return self._renderer.render()

    def _place(self, frame: int) -> None:
        qpos = self.rollout.qpos[frame]
        self._data.qpos[:] = self._ghost.qpos[:] = qpos
        for slot, adr in enumerate(self.rollout.object_qpos_adr):
            if adr >= 0:
                place = self._ghost.qpos[adr : adr + 7]
                place[:3] = self.rollout.ref_object_pos[frame, slot]
                place[3:] = self.rollout.ref_object_quat[frame, slot]
        for data in (self._data, self._ghost):
            mujoco.mj_kinematics(self.model, data)
            mujoco.mj_comPos(self.model, data)
            mujoco.mj_camlight(self.model, data)

    def _choose_camera(self) -> mujoco.MjvCamera:
        """Look from where the most of the objects is seen half way through."""
        self._place(self.rollout.num_frames // 2)
        self._renderer.enable_segmentation_rendering()
        cameras = [frame_camera(self.model, self.rollout, azimuth=a) for a in AZIMUTHS]
        seen = [self._count_object_pixels(camera) for camera in cameras]
        self._renderer.disable_segmentation_rendering()
        return cameras[int(np.argmax(seen))]

    def _count_object_pixels(self, camera: mujoco.MjvCamera) -> int:
        self._renderer.update_scene(self._data, camera)
        ids = self._renderer.render()[..., 0]
        owners = self.model.jnt_bodyid[self.model.jnt_type == 0]
        geoms = np.flatnonzero(np.isin(self.model.geom_bodyid, owners))
        return int(np.isin(ids, geoms).sum())


def write_film(rollout: Rollout, out: Path) -> list[Path]:
    """Write ``<name>.mp4``, its first picture and a strip of stills, in real time.

    Args:
        rollout: stored rollout.
        out: target without suffix.

    Returns:
        The film, ``<name>.png`` with the stills side by side, ``<name>_poster.png``.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    stride = max(1, round(rollout.fps / FILM_FPS))
    film, strip, poster = (
        out.with_name(out.name + ending) for ending in (".mp4", ".png", "_poster.png")
    )
    painter = Painter(rollout)
    try:
        stills = [Image.fromarray(painter.draw(t)) for t in still_frames(rollout)]
        frames = (painter.draw(t) for t in range(0, rollout.num_frames, stride))
        _write_mp4(frames, film, fps=rollout.fps / stride)
    finally:
        painter.close()
    stills[0].save(poster, optimize=True)
    side_by_side(stills).save(strip, optimize=True)
    return [film, strip, poster]


def still_frames(rollout: Rollout) -> list[int]:
    """Rows of the stills, evenly spread from first to last.

    Args:
        rollout: stored rollout.
    """
    return (
        np.linspace(0, rollout.num_frames - 1, NUM_STILLS).round().astype(int).tolist()
    )


def side_by_side(pictures: Sequence[Image.Image]) -> Image.Image:
    """Join pictures to one row, small and with few colours, for a light page.

    Args:
        pictures: of one size.
    """
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
    """Draw every rollout into the folder named last; report faults on stderr.

    Args:
        argv: rollout files, then the folder.
    """
    *files, folder = argv
    faults = 0
    for file in files:
        try:
            write_film(Rollout.load(file), Path(folder) / Path(file).stem)
        except (FlashdexError, OSError, ValueError) as error:
            faults += 1
            sys.stderr.write(f"{file}: {error}\n")
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
