"""One physical motion in every layout: all readers must tell the same.

The writers invert each dataset's conventions by formulas of their own (plain loops over
4x4 matrices); the readers are the package's. Rates, units, up axes, quaternion orders,
rest poses, translations, shapes and mesh scales all differ between the files.
"""

import pickle
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import pytest
from layouts import arctic, fdr, grab, hot3d, oakink2, spider, taco
from layouts.mano_files import write_mano
from layouts.scene import make_scene

from flashdex.datasets.arctic import SOURCE as ARCTIC
from flashdex.datasets.demo import UP_ROTATION, DemoObject, HumanDemo
from flashdex.datasets.fdr.reader import SOURCE as FDR
from flashdex.datasets.grab import SOURCE as GRAB
from flashdex.datasets.hot3d.reader import SOURCE as HOT3D
from flashdex.datasets.keypoints import SOURCE as KEYPOINTS
from flashdex.datasets.oakink2.reader import SOURCE as OAKINK2
from flashdex.datasets.source import Source, SourceOptions
from flashdex.datasets.spider.reader import SOURCE as SPIDER
from flashdex.datasets.taco import SOURCE as TACO
from flashdex.datasets.tracks import palm_frame

SECONDS = 2.0
COMMON = 10.0  # Hz, the times that every rate has
WITHIN = 1e-5  # m, and of the elements of rotation matrices
WRIST_AND_TIPS = [0, 4, 8, 12, 16, 20]


@dataclass
class Layout:
    """How one dataset keeps the scene, and how much of it.

    Args:
        source: the reader.
        writer: a module of ``layouts``; None for the package's own format.
        fps: of its files.
        up: of its world.
        options: of the writer.
        num_objects: of the scene that it keeps.
        points: of the 21 keypoints that it keeps.
        parts: whether its objects are parts of the scene's; then "bottom" is rigid.
        frame: axes of its object frame in the scene's, in columns.
        fixed: whether the left hand was fitted with the shape corrected.
    """

    source: Source
    writer: Any
    fps: float
    up: str = "z"
    options: dict = field(default_factory=dict)
    num_objects: int = 2
    points: list[int] = field(default_factory=lambda: list(range(21)))
    parts: bool = False
    frame: np.ndarray = field(default_factory=lambda: np.eye(3))
    fixed: bool = False

    def write(self, root):
        """Write the scene at this layout's rate."""
        moved = scene(self.fps, fixed=self.fixed)
        root.mkdir()
        if self.writer is None:
            write_keypoints(root, moved)
        else:
            self.writer.write(root, moved, **self.options)


@cache
def scene(fps, *, fixed=False):
    return make_scene(fps, seconds=SECONDS, fix_left_shape=fixed)


def write_keypoints(root, moved):
    """The package's own layout."""
    (root / "meshes").mkdir()
    for body in moved.objects:
        body.mesh.export(root / "meshes" / f"{body.name}.obj")
    np.savez(
        root / "clip.npz",
        fps=moved.fps,
        object=[body.name for body in moved.objects],
        obj_pose=np.stack([body.pose for body in moved.objects], axis=1),
        **{f"kp_{side}": hand.keypoints for side, hand in moved.hands.items()},
    )


QUEST, ARIA = {"headset": "Quest3"}, {"headset": "Aria"}
LAYOUTS = {
    "keypoints": Layout(KEYPOINTS, None, 60),
    "taco": Layout(TACO, taco, 30),
    "taco_files": Layout(TACO, taco, 30, options={"frame_files": ("left", "right")}),
    "oakink2": Layout(OAKINK2, oakink2, 120, up="y"),
    "oakink2_late": Layout(OAKINK2, oakink2, 120, up="y", options={"first": 240}),
    "hot3d_quest": Layout(HOT3D, hot3d, 30, up="y", options=QUEST, fixed=True),
    "hot3d_aria": Layout(HOT3D, hot3d, 30, options=ARIA, fixed=True),
    "hot3d_unfixed": Layout(HOT3D, hot3d, 30, up="y", options=QUEST),
    "arctic": Layout(
        ARCTIC, arctic, 30, num_objects=1, parts=True, frame=arctic.SIDEWAYS
    ),
    "grab": Layout(GRAB, grab, 120, num_objects=1),
    "spider": Layout(SPIDER, spider, 50, points=WRIST_AND_TIPS),
    "fdr": Layout(FDR, fdr, 60),
}


@pytest.fixture(scope="module")
def mano(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mano")
    write_mano(folder)
    return folder


@pytest.fixture(scope="module", params=list(LAYOUTS))
def told(request, tmp_path_factory, mano) -> tuple[Layout, HumanDemo]:
    """A layout, and what its reader makes of the scene in it."""
    layout = LAYOUTS[request.param]
    root = tmp_path_factory.mktemp(request.param) / "root"
    layout.write(root)
    (recording,) = layout.source.list(SourceOptions(path=root, mano=mano))
    # as a worker gets it
    (demo,) = pickle.loads(pickle.dumps(recording.read))()
    return layout, demo


def turn_up(demo) -> np.ndarray:
    """Matrix that turns the demo's up axis into z."""
    angle = UP_ROTATION[demo.up]
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])


def at_common_times(track, fps):
    """Frames at multiples of 0.1 s; every rate of a layout has them."""
    step = fps / COMMON
    assert step == pytest.approx(round(step), abs=1e-6)
    assert len(track) == pytest.approx(SECONDS * fps, abs=1)
    return track[:: round(step)]


def matrices(quats):
    """Rotation matrices of quaternions wxyz by the quadratic form."""
    w, v = quats[:, 0, None, None], quats[:, 1:]
    cross = np.stack([np.cross(v, axis) for axis in np.eye(3)], axis=-1)
    outer = v[:, :, None] * v[:, None, :]
    square = np.sum(v * v, axis=1)[:, None, None]
    return (w * w - square) * np.eye(3) + 2 * outer + 2 * w * cross


def body_of(layout, demo, wanted) -> DemoObject:
    """The object of a demo that is the scene's: that of its size."""
    if layout.parts:
        (body,) = [b for b in demo.objects if "bottom" in b.name]
        return body
    sizes = np.array([body.load_mesh().extents for body in demo.objects])
    nearest = np.abs(sizes - wanted.mesh.extents).max(axis=1).argmin()
    body = demo.objects[int(nearest)]
    assert np.abs(body.load_mesh().bounds - wanted.mesh.bounds).max() < WITHIN
    return body


def test_all_layouts_tell_the_same_keypoints(told):
    layout, demo = told
    assert demo.up == layout.up
    assert set(demo.keypoints) == {"left", "right"}
    for side, hand in scene(30, fixed=layout.fixed).hands.items():
        found = at_common_times(demo.keypoints[side], demo.fps) @ turn_up(demo).T
        wanted = at_common_times(hand.keypoints, 30)
        gap = np.abs(found - wanted)[:, layout.points]
        assert gap.max() < WITHIN, side


def test_all_layouts_tell_the_same_palms(told):
    layout, demo = told
    if len(layout.points) < 21:
        pytest.skip("it keeps no knuckles, so its palm is an estimate")
    for side, hand in scene(30, fixed=layout.fixed).hands.items():
        found = at_common_times(demo.palm[side], demo.fps)
        wanted = at_common_times(palm_frame(hand.keypoints, side), 30)
        turned = turn_up(demo) @ matrices(found[:, 3:])
        assert np.abs(found[:, :3] @ turn_up(demo).T - wanted[:, :3]).max() < WITHIN
        # 0.2 um on a palm of 4 cm is a turn of 5e-6; floats of 32 bits do that
        assert np.abs(turned - matrices(wanted[:, 3:])).max() < 5 * WITHIN


def test_all_layouts_tell_the_same_object_poses(told):
    layout, demo = told
    for wanted in scene(30).objects[: layout.num_objects]:
        pose = at_common_times(body_of(layout, demo, wanted).pose, demo.fps)
        truth = at_common_times(wanted.pose, 30)
        place = pose[:, :3] @ turn_up(demo).T
        turned = turn_up(demo) @ matrices(pose[:, 3:])
        assert np.abs(place - truth[:, :3]).max() < WITHIN
        assert np.abs(turned - matrices(truth[:, 3:]) @ layout.frame).max() < WITHIN


def test_the_scene_tells_conventions_apart():
    """Where a mistake in a convention would not show, the test above says nothing."""
    moved = scene(30)
    for side, hand in moved.hands.items():
        # translation of the rest wrist, rotation about it, mean pose, shape
        assert np.linalg.norm(hand.j0) > 0.08
        assert np.ptp(hand.axis_angle[:, :3], axis=0).max() > 0.2
        assert np.abs(hand.betas).min() > 0.1
        fixed = scene(30, fixed=True).hands[side].keypoints
        apart = np.abs(fixed - hand.keypoints).max()
        assert (apart > 2e-3) == (side == "left")
        # frames differ from each other, so a shift by one frame shows
        steps = np.linalg.norm(np.diff(hand.keypoints, axis=0), axis=-1).max(axis=1)
        assert np.median(steps) > 100 * WITHIN
    for body in moved.objects:
        turn = matrices(body.pose[:, 3:])
        # a transposed rotation or an order xyzw shows
        assert np.abs(turn - turn.swapaxes(1, 2)).max() > 0.1
