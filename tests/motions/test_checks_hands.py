"""Checks that tell a wrong side, a wrong clock and a wrong unit from sound motions."""

from dataclasses import replace

import numpy as np
import pytest

from flashdex.datasets.demo import DemoObject
from flashdex.datasets.fields import number, numbers, word
from flashdex.datasets.keypoints import read_keypoints
from flashdex.datasets.procedural.reader import procedural
from flashdex.datasets.tracks import palm_frame
from flashdex.errors import DemoError
from flashdex.motions.align import align
from flashdex.motions.checks.aligned import check_company
from flashdex.motions.checks.recording import check_demo, check_sides
from flashdex.motions.contact.roles import find_roles
from flashdex.motions.repair.repair import repair


@pytest.fixture
def demo():
    return procedural(0, kinds=["pick_box_right"])[0]


def codes(findings):
    return [(f.code, f.level) for f in findings]


@pytest.mark.parametrize("palm", ["of the points", "of the other hand"])
def test_hand_under_the_name_of_the_other_is_rejected(demo, palm):
    assert check_sides(demo) == []
    points = demo.keypoints["right"]
    own = palm_frame(points, "left" if palm == "of the points" else "right")
    other = replace(demo, keypoints={"left": points}, palm={"left": own})
    (found,) = check_sides(other)
    assert (found.code, found.level) == ("E_SIDE", "reject")
    assert "left and right swapped" in found.text


@pytest.mark.parametrize("tips", [(4, 8, 12, 16, 20), (8, 12, 16, 20, 4)])
def test_order_of_mano_is_named_whatever_that_of_its_tips(demo, tips):
    joints = [5, 6, 7, 9, 10, 11, 17, 18, 19, 13, 14, 15, 1, 2, 3]
    points = demo.keypoints["right"][:, [0, *joints, *tips]]
    palm = {"right": demo.palm["right"]}
    (found,) = check_sides(replace(demo, keypoints={"right": points}, palm=palm))
    assert (found.code, found.level) == ("E_SIDE", "reject")
    assert "MANO's order" in found.text


def test_mirrored_world_is_rejected(demo):
    points = demo.keypoints["right"] * [1, -1, 1]
    mirrored = replace(
        demo, keypoints={"right": points}, palm={"right": palm_frame(points, "right")}
    )
    assert codes(check_sides(mirrored)) == [("E_SIDE", "reject")]


@pytest.mark.parametrize(("late", "wanted"), [(0, []), (2, []), (25, ["W_ALONE"])])
def test_hands_that_come_late_are_flagged(demo, late, wanted):
    first = demo.objects[0]
    early = np.concatenate([first.pose[late:], np.repeat(first.pose[-1:], late, 0)])
    demo.objects[0] = DemoObject(first.name, first.mesh, early)
    found = check_company(find_roles(align(demo, control_hz=30.0)))
    assert [f.code for f in found] == wanted


@pytest.mark.parametrize(
    ("edit", "wanted"),
    [
        (lambda p: p, []),
        (lambda p: p + np.array([500.0, 0, 0]), []),
        (lambda p: p + np.array([5000.0, 0, 0]), ["reject"]),
        (lambda p: 12 * p, ["warn"]),
        (lambda p: 1000 * p, ["reject"]),
    ],
    ids=["sound", "far", "too_far", "long", "millimetres"],
)
def test_tracks_that_leave_the_table_are_told(demo, edit, wanted):
    pose = demo.objects[0].pose
    reach = np.linalg.norm(pose[:, :3] - np.median(pose[:, :3], axis=0), axis=1).max()
    assert 1.5 < 12 * reach < 3
    pose[:, :3] = edit(pose[:, :3])
    found = [f for f in check_demo(demo) if f.code == "E_UNIT" and "object" in f.text]
    assert [f.level for f in found] == wanted


def test_numbers_that_are_no_positions_are_missing_frames(demo):
    demo.objects[0].pose[60:63, 1] = 1e30
    demo.keypoints["right"][80, 4] = 1e308
    (whole,), found = repair(demo)
    assert ("E_NAN", "info") in codes(found)
    assert np.abs(whole.objects[0].pose).max() < 2
    assert np.abs(whole.keypoints["right"]).max() < 2


def test_recorded_hands_have_the_right_side_and_company(demos):
    for file in sorted((demos / "taco").glob("*.npz")):
        (demo,) = read_keypoints(file)
        assert check_sides(demo) == []
        assert check_company(find_roles(align(demo, control_hz=30.0))) == []


def test_entries_of_another_kind_are_named():
    assert number(np.array([[30]]), what="x") == 30.0
    assert word(np.array("box"), what="x") == "box"
    np.testing.assert_array_equal(numbers([[1, 2]], what="x"), [[1.0, 2.0]])
    for value in ("thirty", 1j, None, [[1], [2, 3]], {"a": 1}, b"1", [2**70]):
        with pytest.raises(DemoError, match=r"^E_KEYS: fps: not numbers") as caught:
            numbers(value, what="fps")
        assert caught.value.code == "E_KEYS"
    with pytest.raises(DemoError, match="expected one number"):
        number([1, 2], what="fps")
    with pytest.raises(DemoError, match="expected one text"):
        word(["a", "b"], what="name")
