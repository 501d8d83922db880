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
def still_demo() -> HumanDemo:
    """A right hand and a box that both rest for one second at 30 fps."""
    points = np.repeat(hand_keypoints(GRASP)[None] + [0, 0, 0.2], 30, axis=0)
    pose = np.tile([0.1, 0.0, 0.03, 1.0, 0, 0, 0], (30, 1))
    box = DemoObject("box", trimesh.creation.box((0.06, 0.06, 0.06)), pose)
    palm = {"right": palm_frame(points, "right")}
    return HumanDemo("still", 30.0, {"right": points}, palm, [box])
