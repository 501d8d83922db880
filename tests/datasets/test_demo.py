from pathlib import Path

import numpy as np
import pytest

from flashdex.datasets.demo import HumanDemo
from flashdex.errors import DemoError


def test_sound_demo_is_accepted_and_stays_as_it_is(still_demo):
    before = still_demo.keypoints["right"].copy(), still_demo.objects[0].pose.copy()
    still_demo.validate()
    np.testing.assert_array_equal(still_demo.keypoints["right"], before[0])
    np.testing.assert_array_equal(still_demo.objects[0].pose, before[1])


def break_nan(demo):
    demo.keypoints["right"][7, 3, 0] = np.nan


def break_infinity(demo):
    demo.objects[0].pose[4, 2] = np.inf


def break_quat(demo):
    demo.palm["right"][9, 3:] *= 1.05


def break_object_quat(demo):
    demo.objects[0].pose[2, 3:] = 0.0


def break_shape(demo):
    demo.keypoints["right"] = demo.keypoints["right"][:, :20]


def break_length(demo):
    demo.palm["right"] = demo.palm["right"][:-1]


def break_mesh(demo):
    demo.objects[0].mesh = Path("nowhere/box.obj")


def break_hand(demo):
    demo.keypoints = {}


def break_side(demo):
    demo.keypoints["both"] = demo.keypoints["right"]


def break_palm(demo):
    demo.palm = {}


def break_objects(demo):
    demo.objects = []


def break_fps(demo):
    demo.fps = 0.0


def break_slot(demo):
    demo.hand_object = {"right": 1}


def break_frames(demo):
    cut = demo.cut(0, 9, name="still")
    cut.fps = 10.0
    vars(demo).update(vars(cut))


def break_seconds(demo):
    vars(demo).update(vars(demo.cut(0, 14, name="still")))


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (break_nan, "right hand holds NaN or infinity in 1 frames, first in frame 7"),
        (break_infinity, "object 'box' holds NaN or infinity in 1 frames.* frame 4"),
        (break_quat, "palm of the right hand: quaternion of frame 9 has norm 1.050"),
        (break_object_quat, "object 'box': quaternion of frame 2 has norm 0.000"),
        (break_shape, r"shape \(30, 20, 3\), expected \(30, 21, 3\)"),
        (break_length, r"shape \(29, 7\), expected \(30, 7\)"),
        (break_mesh, "mesh of object 'box' not found: nowhere"),
        (break_hand, "no hand"),
        (break_side, "hand 'both'; allowed: left, right"),
        (break_palm, "right hand has no palm pose"),
        (break_objects, "no object"),
        (break_fps, "fps is 0.0"),
        (break_slot, "there are 1 objects"),
        (break_frames, "too short: 9 frames"),
        (break_seconds, "too short: 14 frames, 0.47 s"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_faults_are_named(still_demo: HumanDemo, fault, words):
    fault(still_demo)
    with pytest.raises(DemoError, match=words) as caught:
        still_demo.validate()
    assert str(caught.value).startswith("still: ")


def test_cut_keeps_the_rest(still_demo):
    piece = still_demo.cut(5, 25, name="piece")
    piece.validate()
    assert piece.num_frames == 20
    assert piece.name == "piece"
    np.testing.assert_array_equal(
        piece.objects[0].pose, still_demo.objects[0].pose[5:25]
    )
