"""Motions and shared data for the tests of ``flashdex.motions``."""

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

from flashdex.datasets.body_models.human_hand import GRASP, hand_keypoints
from flashdex.datasets.demo import DemoObject, HumanDemo
from flashdex.datasets.tracks import palm_frame

REPOSITORY = Path(__file__).parents[1]


@pytest.fixture
def demos() -> Path:
    """Folder of real recordings; the test is skipped where there is none."""
    shared = Path(os.environ.get("FLASHDEX_SHARED", REPOSITORY.parent / "shared"))
    if not (shared / "demos" / "index.json").is_file():
        pytest.skip(f"no recordings in {shared / 'demos'}; set FLASHDEX_SHARED")
    return shared / "demos"


@pytest.fixture
def write_keypoints(tmp_path):
    """Write motions as a folder that the reader ``keypoints`` reads; return it.

    Fields of the file replace those of the motion (None: not written).
    """

    def write(*demos, folder=tmp_path / "recordings", **fields):
        (folder / "meshes").mkdir(parents=True, exist_ok=True)
        for demo in demos:
            for body in demo.objects:
                body.load_mesh().export(folder / "meshes" / f"{body.name}.obj")
            data = {
                "fps": demo.fps,
                "object": np.array([b.name for b in demo.objects]),
                "obj_pose": np.stack([b.pose for b in demo.objects], axis=1),
                **{f"kp_{side}": points for side, points in demo.keypoints.items()},
                **{f"palm_{side}": pose for side, pose in demo.palm.items()},
            }
            data = {k: v for k, v in (data | fields).items() if v is not None}
            np.savez(folder / f"{demo.name}.npz", **data)
        return folder

    return write


@pytest.fixture
def still_demo() -> HumanDemo:
    """A right hand and a box that both rest for one second at 30 fps."""
    points = np.repeat(hand_keypoints(GRASP)[None] + [0, 0, 0.2], 30, axis=0)
    pose = np.tile([0.1, 0.0, 0.03, 1.0, 0, 0, 0], (30, 1))
    box = DemoObject("box", trimesh.creation.box((0.06, 0.06, 0.06)), pose)
    palm = {"right": palm_frame(points, "right")}
    return HumanDemo("still", 30.0, {"right": points}, palm, [box])
