import copy
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from flashdex.datasets.body_models.human_hand import GRASP, hand_keypoints
from flashdex.datasets.demo import DemoObject, HumanDemo
from flashdex.datasets.tracks import palm_frame
from flashdex.motions.checks.recording import check_demo
from flashdex.motions.findings import concerning, make_strict, status_of
from flashdex.motions.repair.repair import repair

FPS = 30.0
ASIDE = np.array([0, 0.3, 0])
ASIDE_POSE = np.array([0, 0.3, 0, 0, 0, 0, 0])


@pytest.fixture
def demo() -> HumanDemo:
    """Three seconds in closed form: a hand that glides and a box that turns with it."""
    time = np.arange(90) / FPS
    way = np.stack([0.2 * time, 0 * time, 0 * time], axis=-1)
    points = hand_keypoints(GRASP)[None] + way[:, None]
    turn = Rotation.from_rotvec(time[:, None] * [0, 0, 1.0])
    pose = np.concatenate([way, turn.as_quat(scalar_first=True)], axis=1)
    box = DemoObject("box", trimesh.creation.box((0.06, 0.06, 0.06)), pose)
    spare = DemoObject("spare", box.mesh, pose + 2 * ASIDE_POSE)
    palm = palm_frame(points, "right")
    return HumanDemo(
        "clip",
        FPS,
        {"right": points, "left": points + ASIDE},
        {"right": palm, "left": palm + ASIDE_POSE},
        [box, spare],
        hand_object={"right": 1},
    )


def codes(findings):
    return [(f.code, f.level) for f in findings]


def same_tracks(a, b, atol=1e-9):
    for side in b.keypoints:
        np.testing.assert_allclose(a.keypoints[side], b.keypoints[side], atol=atol)
        np.testing.assert_allclose(a.palm[side], b.palm[side], atol=atol)
    for one, two in zip(a.objects, b.objects, strict=True):
        np.testing.assert_allclose(one.pose, two.pose, atol=atol)


def test_sound_motions_pass_unchanged(demo):
    (out,), found = repair(demo)
    assert found == []
    assert out.name == "clip"
    assert "filled" not in out.provenance
    same_tracks(out, demo)


def test_short_gaps_are_closed_and_told(demo):
    whole = copy.deepcopy(demo)
    demo.keypoints["right"][40:43] = np.nan  # 0.1 s; the palm still has values
    demo.palm["left"][60, 4] = np.inf
    demo.objects[0].pose[10:12] = np.nan
    broken = copy.deepcopy(demo)
    (out,), found = repair(demo)
    # the motion is uniform, so that interpolation is exact
    same_tracks(out, whole)
    assert codes(found) == [("E_NAN", "info")]
    assert found[0].frames == (10, 11, 40, 41, 42, 60)
    assert out.provenance["filled"] == {
        "right hand": [[40, 43]],
        "left hand": [[60, 61]],
        "object box": [[10, 12]],
    }
    out.validate()
    same_tracks(demo, broken)  # the input is as it was, NaN included


@pytest.mark.parametrize("frames", [0, 1, 2, 3])
def test_tiny_recordings_do_not_break_it(demo, frames):
    pieces, found = repair(demo.cut(0, frames, name="tiny"))
    assert [p.num_frames for p in pieces] == [frames] * (frames > 0)
    assert status_of(found) == ("kept" if frames else "rejected")


def test_long_gaps_split(demo):
    demo.keypoints["right"][40:44] = np.nan  # one frame more than 0.1 s
    demo.provenance = {"frames": [100, 190]}
    pieces, found = repair(demo)
    assert [p.name for p in pieces] == ["clip_0_40", "clip_44_90"]
    assert [p.provenance["frames"] for p in pieces] == [[100, 140], [144, 190]]
    assert codes(found) == [("E_NAN", "warn")]
    same_tracks(pieces[1], demo.cut(44, 90, name=""))
    for piece in pieces:
        piece.validate()


def test_pieces_below_a_second_are_left_out(demo):
    demo.objects[1].pose[20:25] = np.nan
    pieces, found = repair(demo)
    assert [p.name for p in pieces] == ["clip_25_90"]
    assert "1 cut out of at least 1.0 s, 0.8 s lost" in found[0].text
    demo.objects[1].pose[50:55] = np.nan
    demo.objects[1].pose[75:80] = np.nan
    pieces, found = repair(demo)
    assert pieces == []
    assert codes(found) == [("E_NAN", "reject")]
    assert "0.83 s at most" in found[0].text


def test_ends_without_track_are_cut_off(demo):
    demo.palm["left"][:2] = np.nan  # too short a gap to matter, but there is no before
    demo.objects[0].pose[-20:] = np.nan
    (out,), found = repair(demo)
    assert out.name == "clip"
    assert out.provenance["frames"] == [2, 70]
    assert codes(found) == [("E_NAN", "info")]


def test_tracks_that_are_never_there_are_dropped(demo):
    demo.keypoints["left"][:] = np.nan
    demo.objects[0].pose[:] = np.nan
    (out,), found = repair(demo)
    assert list(out.keypoints) == ["right"]
    assert [b.name for b in out.objects] == ["spare"]
    assert out.hand_object == {"right": 0}
    assert codes(found) == [("E_NAN", "info")]
    assert "left hand, object 'box' left out" in found[0].text
    demo.keypoints["right"][:] = np.nan
    pieces, found = repair(demo)
    assert pieces == []
    assert "no hand is tracked" in found[-1].text
    assert status_of(found) == "rejected"


def test_hardly_tracked_hand_does_not_cost_the_motion(demo):
    demo.keypoints["left"][15:] = np.nan
    (out,), found = repair(demo)
    assert list(out.keypoints) == ["right"]
    assert out.num_frames == 90
    assert codes(found) == [("E_NAN", "warn")]


def test_sessions_keep_their_gaps(demo):
    demo.needs_cutting = True
    demo.keypoints["left"][15:] = np.nan
    demo.objects[0].pose[20:40] = np.nan
    demo.objects[0].pose[60] = np.nan
    (out,), found = repair(demo)
    assert out.num_frames == 90
    assert np.isnan(out.keypoints["left"][15:]).all()
    assert np.flatnonzero(np.isnan(out.objects[0].pose[:, 0])).tolist() == list(
        range(20, 40)
    )
    assert codes(found) == [("E_NAN", "info")]


@pytest.mark.parametrize("length", [1, 2])
def test_there_and_back_is_interpolated(demo, length):
    whole = copy.deepcopy(demo)
    demo.objects[0].pose[50 : 50 + length, :3] += [0, 0.4, 0]
    demo.palm["right"][20 : 20 + length, :3] += [0, 0, 0.5]
    demo.keypoints["right"][20 : 20 + length] += [0, 0, 0.5]
    (out,), found = repair(demo)
    same_tracks(out, whole)
    assert codes(found) == [("W_JUMP", "warn"), ("E_NAN", "info")]
    assert found[0].frames == (20, 50)


def test_a_turn_there_and_back_is_interpolated(demo):
    whole = copy.deepcopy(demo)
    demo.objects[0].pose[50, 3:] = Rotation.from_rotvec([2.5, 0, 0]).as_quat(
        scalar_first=True
    )
    (out,), _ = repair(demo)
    same_tracks(out, whole)


def test_longer_jumps_are_reported_only(demo):
    demo.objects[0].pose[50:53, 1] += 0.4
    demo.objects[1].pose[30:, 1] += 0.4
    (out,), found = repair(demo)
    assert found == []
    same_tracks(out, demo)
    (finding,) = check_demo(out)
    assert (finding.code, finding.level) == ("W_JUMP", "warn")
    assert "3 jumps" in finding.text


def test_too_many_jumps_reject(demo):
    demo.objects[0].pose[20:70:8, 1] += 0.4  # seven
    _, found = repair(demo)
    assert codes(found)[0] == ("W_JUMP", "reject")
    demo.needs_cutting = True
    _, found = repair(demo)
    assert codes(found)[0] == ("W_JUMP", "warn")


def test_signs_and_norms(demo):
    whole = copy.deepcopy(demo)
    demo.objects[0].pose[30:45, 3:] *= -1
    demo.objects[1].pose[12, 3:] *= 1.05
    (out,), found = repair(demo)
    same_tracks(out, whole)
    assert codes(found) == [("E_ROT", "warn"), ("I_SIGN", "info")]
    assert "norm off by 0.05 in 1 frames, first in frame 12" in found[0].text
    assert found[1].text == "2 quaternion flips undone"
    demo.objects[1].pose[12, 3:] *= 2
    pieces, found = repair(demo)
    assert pieces == []
    assert codes(found) == [("E_ROT", "reject")]


MARKS = [0.0, -1.0, 999.0, np.nan]


@pytest.mark.parametrize("mark", MARKS)
@pytest.mark.parametrize("palm", ["marked", "identity", "none"])
def test_marks_of_untracked_hands_are_gaps(demo, mark, palm):
    whole = copy.deepcopy(demo)
    points = demo.keypoints["right"].copy()
    points[30:33] = mark
    palms = demo.palm["right"].copy()
    palms[30:33] = mark if palm == "marked" else [0, 0, 0, 1, 0, 0, 0]
    given = {} if palm == "none" else {"right": palms}
    made = replace(demo, keypoints={"right": points}, palm=given)
    assert np.isnan(made.keypoints["right"][30:33]).all()
    (out,), found = repair(made)
    assert codes(found) == [("E_NAN", "info")]
    assert "3 frames interpolated, first frame 30" in found[0].text
    same = replace(whole, keypoints={"right": whole.keypoints["right"]})
    np.testing.assert_allclose(
        out.keypoints["right"], same.keypoints["right"], atol=1e-6
    )


@pytest.mark.parametrize("mark", MARKS)
def test_marks_of_untracked_objects_are_gaps(demo, mark):
    pose = demo.objects[1].pose.copy()
    pose[30:33] = mark
    body = DemoObject("spare", demo.objects[1].mesh, pose)
    (out,), found = repair(replace(demo, objects=[demo.objects[0], body]))
    assert codes(found) == [("E_NAN", "info")]
    np.testing.assert_allclose(out.objects[1].pose, demo.objects[1].pose, atol=1e-4)


@pytest.mark.parametrize("mark", MARKS)
def test_hand_of_marks_only_is_left_out(demo, mark):
    left = np.full((90, 21, 3), mark)
    (out,), _ = repair(replace(demo, keypoints=demo.keypoints | {"left": left}))
    assert list(out.keypoints) == ["right"]


def test_zero_quaternion_is_a_gap(demo):
    demo.objects[1].pose[12, 3:] = 0.0
    _, found = repair(demo)
    assert codes(found) == [("E_NAN", "info")]


@pytest.mark.parametrize("mark", MARKS)
def test_points_that_are_missing_alone_are_named(demo, mark):
    points = demo.keypoints["right"].copy()
    points[15:65, 20] = mark
    pieces, found = repair(replace(demo, keypoints=demo.keypoints | {"right": points}))
    assert pieces == []
    assert "right hand: keypoint 20 (pinky tip) missing in 50 frames" in found[0].text


def test_flickering_hand_is_missing(demo):
    for start in range(3, 88, 4):
        demo.keypoints["right"][start] = np.nan
        demo.keypoints["left"][start] = np.nan
    (out,), _ = repair(demo)
    found = check_demo(out)
    # the right hand uses an object; nobody says what the left one does
    assert codes(found) == [("W_MISSHAND", "reject"), ("W_MISSHAND", "warn")]
    assert "24 % of the right hand" in found[0].text
    steady = out.cut(0, 3, name="piece")
    assert "W_MISSHAND" not in [f.code for f in check_demo(steady)]


def test_findings_of_a_piece(demo):
    demo.objects[0].pose[10, 1] += 0.4
    demo.keypoints["right"][40:50] = np.nan
    pieces, found = repair(demo)
    assert codes(concerning(found, pieces[0])) == [
        ("W_JUMP", "warn"),
        ("E_NAN", "info"),
        ("E_NAN", "warn"),
    ]
    assert codes(concerning(found, pieces[1])) == [("E_NAN", "warn")]
    assert status_of(make_strict(concerning(found, pieces[1]))) == "rejected"
    assert status_of(make_strict(found[1:2])) == "kept"


def test_recordings_are_left_alone(demos):
    from flashdex.datasets.keypoints import read_file

    for file in sorted((demos / "myodm").glob("*.npz")):
        recording = read_file(file)
        (out,), found = repair(recording)
        assert found == [], file.stem
        same_tracks(out, recording, atol=1e-5)


def test_whisking_jumps(demos):
    from flashdex.datasets.keypoints import read_file

    (out,), _ = repair(read_file(demos / "do_as_i_do" / "whisking.npz"))
    assert "W_JUMP" in [f.code for f in check_demo(out)]
