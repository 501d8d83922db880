"""Camera and light of all pictures: fitted to what moves, seen where objects show most.

Drawing runs in a process of its own, because MuJoCo chooses its graphics back end (the
variable MUJOCO_GL) when it is imported; ``films.py`` starts it.
"""

from __future__ import annotations

import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence

import mujoco
import numpy as np

from flashdex.errors import FlashdexError

MARGIN = 0.08  # m, kept free around every point: hands and objects have a size
MIN_DISTANCE = 0.35  # m
CENTRING_STEPS = 8
# Azimuth and elevation, deg, of the camera: sides to choose from. A still may also look
# along the table or from above, where a palm hides the object from everywhere else.
View = tuple[float, float]
SIDES: tuple[View, ...] = tuple((a, -27.0) for a in (135.0, 45.0, 225.0, 315.0))
MORE_SIDES: tuple[View, ...] = (
    *((a, -27.0) for a in (90.0, 0.0, 180.0, 270.0)),
    *((a, -8.0) for a in (135.0, 45.0, 225.0, 315.0)),
    *((a, -65.0) for a in (135.0, 315.0)),
)
BETTER = 1.3  # times as much of the objects is seen: worth another side than before
Axes = tuple[np.ndarray, np.ndarray, np.ndarray]


def view_axes(azimuth: float, elevation: float) -> Axes:
    """Directions forward, right and up of MuJoCo's free camera in the world, each (3,).

    Angles are in degrees; a negative elevation looks down.
    """
    a, e = math.radians(azimuth), math.radians(elevation)
    level = np.array([math.cos(a), math.sin(a), 0.0])
    forward = math.cos(e) * level + np.array([0.0, 0.0, math.sin(e)])
    right = np.array([math.sin(a), -math.cos(a), 0.0])
    return forward, right, np.cross(right, forward)


def fit_view(
    points: np.ndarray, axes: Axes, *, fovy: float, aspect: float
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
    half = math.tan(math.radians(fovy) / 2)

    def fit(rel: np.ndarray) -> float:
        wide = (np.abs(rel @ right) + MARGIN) / (half * aspect) - rel @ forward
        high = (np.abs(rel @ up) + MARGIN) / half - rel @ forward
        return max(MIN_DISTANCE, float(np.max([wide, high])))

    lookat = (points.min(0) + points.max(0)) / 2
    for _ in range(CENTRING_STEPS):
        distance = fit(points - lookat)
        depth = distance + (points - lookat) @ forward
        for axis in (right, up):
            seen = (points - lookat) @ axis / depth
            lookat = lookat + axis * (seen.min() + seen.max()) * distance / 2
    return lookat, fit(points - lookat)


def dress_scene(spec: mujoco.MjSpec, *, width: int, height: int) -> mujoco.MjSpec:
    """Add light and a pale sky to a scene, for pictures of that many pixels."""
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
    return spec


class ScenePainter(ABC):
    """Draws single frames of something that moves, ``size`` = (width, height) pixels.

    Light and sky are added to the scene. The objects of the frame ``middle`` decide
    from which side to look, or those of each frame for itself, in stills.
    """

    def __init__(
        self, spec: mujoco.MjSpec, *, size: tuple[int, int], middle: int
    ) -> None:
        width, height = size
        self._aspect = width / height
        self.model = dress_scene(spec, width=width, height=height).compile()
        self._data = mujoco.MjData(self.model)
        self._renderer = mujoco.Renderer(self.model, height, width)
        self._view = self._choose_view(middle, SIDES)

    @abstractmethod
    def _place(self, frame: int) -> None:
        """Write the state of a frame into ``_data``."""

    @abstractmethod
    def _points(self, frame: int) -> np.ndarray:
        """World positions that must be in sight, m, (n, 3)."""

    @abstractmethod
    def _is_object(self) -> np.ndarray:
        """Which bodies are manipulated objects, (nbody,) bool."""

    def _add(self, scene: mujoco.MjvScene, frame: int) -> None:  # noqa: B027
        """Draw more than the model has."""

    def close(self) -> None:
        """Free the graphics context."""
        self._renderer.close()

    def draw(self, frame: int) -> np.ndarray:
        """Picture of one frame, (height, width, 3) uint8."""
        return self._draw(frame, self._view)

    def draw_still(self, frame: int) -> np.ndarray:
        """The same from the side that shows most of the objects in this frame."""
        return self._draw(frame, self._choose_view(frame, (*SIDES, *MORE_SIDES)))

    def _draw(self, frame: int, view: View) -> np.ndarray:
        self._place(frame)
        update_poses(self.model, self._data)
        self._renderer.update_scene(self._data, self._camera(view, frame))
        self._add(self._renderer.scene, frame)
        return self._renderer.render()

    def _camera(self, view: View, frame: int) -> mujoco.MjvCamera:
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.azimuth, camera.elevation = view
        camera.lookat[:], camera.distance = fit_view(
            self._points(frame),
            view_axes(*view),
            fovy=float(self.model.vis.global_.fovy),
            aspect=self._aspect,
        )
        return camera

    def _choose_view(self, frame: int, views: Sequence[View]) -> View:
        """Look from where the most of the objects is seen; the earlier of equals."""
        self._place(frame)
        update_poses(self.model, self._data)
        geoms = np.flatnonzero(self._is_object()[self.model.geom_bodyid])
        self._renderer.enable_segmentation_rendering()
        seen = {}
        for view in views:
            self._renderer.update_scene(self._data, self._camera(view, frame))
            seen[view] = int(np.isin(self._renderer.render()[..., 0], geoms).sum())
        self._renderer.disable_segmentation_rendering()
        best = max(seen, key=seen.__getitem__)
        usual = getattr(self, "_view", best)
        return usual if seen[usual] * BETTER >= seen[best] else best


def update_poses(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Poses of everything that is drawn, from ``qpos``."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)


def draw_each(jobs: Iterable[tuple[str, Callable[[], object]]]) -> int:
    """Draw what has a name; name faults on stderr. Returns the exit code."""
    faults = 0
    for name, draw in jobs:
        try:
            draw()
        except (FlashdexError, OSError, ValueError) as error:
            faults += 1
            sys.stderr.write(f"{name}: {' '.join(str(error).split())}\n")
    return int(faults > 0)
