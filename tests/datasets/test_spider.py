"""The SPIDER reader: what is stored comes back, what is not is a plausible hand."""

import pickle

import numpy as np
import pytest
from layouts.scene import make_scene
from layouts.spider import TIPS, write
from scipy.spatial.transform import Rotation

from flashdex.datasets.body_models.human_hand import GRASP, OPEN, hand_keypoints
from flashdex.datasets.source import SourceOptions
from flashdex.datasets.spider.hand import fill_hand, pose_hand
from flashdex.datasets.spider.reader import list_spider
from flashdex.datasets.tracks import palm_frame, rotation
from flashdex.errors import DemoError

QUARTER = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


@pytest.fixture(scope="module")
def scene():
    return make_scene(50, seconds=2)


def recordings(path, models=None):
    return list_spider(SourceOptions(path=path, models=models))


def read(path, models=None):
    (recording,) = recordings(path, models)
    (demo,) = pickle.loads(pickle.dumps(recording.read))()
    demo.validate()
    return demo


def angle(first, second):
    """Degrees between the orientations of two pose tracks."""
    turn = rotation(first[:, 3:]).inv() * rotation(second[:, 3:])
    return np.degrees(turn.magnitude())


@pytest.mark.parametrize("turn", [None, QUARTER], ids=["documented", "other_axes"])
def test_what_is_stored_comes_back(scene, tmp_path, turn):
    demo = read(write(tmp_path, scene, turn=turn))
    assert demo.fps == pytest.approx(50)
    assert (demo.name, demo.task) == ("made_up_bimanual_lift_box_0", "lift_box")
    assert demo.hand_object == {"right": 0, "left": 1}
    for side, hand in scene.hands.items():
        points = demo.keypoints[side]
        for place in [0, *TIPS]:
            np.testing.assert_allclose(
                points[:, place], hand.keypoints[:, place], atol=1e-5
            )
        # the palm is recovered, although no knuckle is stored
        assert angle(demo.palm[side], palm_frame(hand.keypoints, side)).max() < 10
        gaps = np.linalg.norm(points - hand.keypoints, axis=-1)
        assert gaps[:, [5, 9, 13, 17]].max() < 0.03
        assert gaps.mean() < 0.03
        note = demo.provenance["made_up"][side]["wrist_frame"]
        assert (
            note == "documented" if turn is None else note.startswith("from the tips")
        )
    assert demo.provenance["keypoints"] == "tips only"
    for body, made in zip(demo.objects, scene.objects, strict=True):
        assert body.name == made.name
        np.testing.assert_allclose(body.pose, made.pose, atol=1e-6)
        np.testing.assert_allclose(body.load_mesh().bounds, made.mesh.bounds, atol=1e-6)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_nominal_hand_is_filled_as_it_was(side):
    """Fingers of the parametric hand bend in one plane: the fill has to find them."""
    share = np.linspace(0, 1, 20)[:, None]
    points = hand_keypoints((1 - share) * OPEN + share * GRASP)
    points = points * [1, 1 if side == "right" else -1, 1]
    filled, notes = pose_hand(points[:, TIPS], side)
    gaps = np.linalg.norm(filled - points, axis=-1)
    assert gaps[:, 5:].max() < 1e-3
    assert gaps[:, :5].max() < 0.02  # the thumb's two bends are not independent here
    assert notes["bone_stretch"] < 1e-3
    assert notes["hand_size"] == 1.0


@pytest.mark.parametrize("side", ["left", "right"])
def test_tips_out_of_reach_and_on_the_knuckle_stay_exact(side):
    flip = [1, 1 if side == "right" else -1, 1]
    tips = hand_keypoints(GRASP[None])[:, TIPS].repeat(3, 0) * flip
    tips[1] *= 1.6
    tips[2, 1] = np.array([0.10, -0.022, 0.01]) * flip
    filled, _ = pose_hand(tips, side)
    assert np.isfinite(filled).all()
    np.testing.assert_allclose(filled[:, TIPS], tips, atol=1e-9)


def test_untracked_frames_are_nan():
    points = hand_keypoints(GRASP[None]).repeat(4, 0)
    wrist = np.tile([0.0, 0, 0, 1, 0, 0, 0], (4, 1))
    wrist[1, 0] = np.nan
    filled = fill_hand(wrist, points[:, TIPS], "right").keypoints
    assert np.isnan(filled[1]).all()
    assert np.isfinite(filled[[0, 2, 3]]).all()


def test_a_side_that_takes_no_part_is_left_out(scene, tmp_path):
    demo = read(write(tmp_path, scene, embodiment="right"))
    assert set(demo.keypoints) == {"right"}
    assert [body.name for body in demo.objects] == ["box"]
    assert demo.hand_object == {"right": 0}


def test_a_shared_object_stands_on_the_right_only(scene, tmp_path):
    demo = read(write(tmp_path / "a", scene, info={"left_object_mesh_dir": None}))
    assert len(demo.keypoints) == 2
    assert [body.name for body in demo.objects] == ["box"]
    assert demo.hand_object == {}  # contact decides
    box = "processed/made_up/assets/objects/box"
    again = {
        "info": {"left_object_mesh_dir": box},
        "qpos_obj_left": scene.objects[0].pose,
    }
    demo = read(write(tmp_path / "b", scene, **again))
    assert [body.name for body in demo.objects] == ["box"]


def test_joints_of_do_as_i_do_are_used(scene, tmp_path):
    points = scene.hands["right"].keypoints
    joints = {"qpos_pip_right": points[:, [2, 6, 10, 14, 18]]}
    joints["qpos_dip_right"] = points[:, [3, 7, 11, 15, 19]]
    demo = read(write(tmp_path, scene, embodiment="right", **joints))
    known = [0, 2, 3, 4, 6, 7, 8, 10, 11, 12, 14, 15, 16, 18, 19, 20]
    np.testing.assert_allclose(
        demo.keypoints["right"][:, known], points[:, known], atol=1e-6
    )
    assert demo.provenance["keypoints"] == "tips, PIP and DIP only"


def test_the_rate_comes_from_ref_dt(scene, tmp_path):
    demo = read(write(tmp_path / "a", scene, info={"ref_dt": 0.08}, info_beside=True))
    assert demo.fps == pytest.approx(12.5)
    demo = read(write(tmp_path / "b", scene, info={"ref_dt": "left out"}))
    assert demo.fps == pytest.approx(50)
    assert demo.provenance["fps"] == "SPIDER's reference rate"


def test_roots_and_names(scene, tmp_path):
    write(tmp_path, scene)
    write(tmp_path, scene, task="pour")
    names = ["made_up_bimanual_lift_box_0", "made_up_bimanual_pour_0"]
    assert [r.name for r in recordings(tmp_path)] == names
    assert [r.name for r in recordings(tmp_path / "processed" / "made_up")] == names
    file = next(tmp_path.rglob("pour/0/*.npz"))
    assert [r.name for r in recordings(file)] == names[1:]
    files = {f.name for f in recordings(file)[0].files}
    assert files == {"trajectory_keypoints.npz", "task_info.json", "visual.obj"}


def test_absolute_and_apart_meshes(scene, tmp_path):
    gone = {
        f"{s}_object_mesh_dir": f"/gone/assets/objects/{n}"
        for s, n in (("right", "box"), ("left", "block"))
    }
    write(tmp_path, scene, info=gone)
    assert [b.name for b in read(tmp_path).objects] == ["box", "block"]  # by its name
    folder = tmp_path / "processed" / "made_up" / "assets"
    folder.rename(tmp_path / "moved")
    with pytest.raises(DemoError, match=r"no mesh of object 'box'.*--models"):
        read(tmp_path)
    demo = read(tmp_path, models=tmp_path / "moved" / "objects")
    assert [b.name for b in demo.objects] == ["box", "block"]


def test_tips_that_fit_no_hand_are_refused(scene, tmp_path):
    with pytest.raises(DemoError, match=r"tips of the left hand are 0\.\d+ m"):
        read(write(tmp_path, scene, shift=np.array([0.0, 0.5, 0.0])))


def test_gigahands_stores_no_wrist_but_mano_translation(scene, tmp_path):
    """The writer turns the rest wrist with the hand, as MANO does about its origin."""
    root = write(tmp_path, scene, info={"dataset_name": "gigahand"})
    file = next(root.rglob("trajectory_keypoints.npz"))
    arrays = dict(np.load(file))
    for side, hand in scene.hands.items():
        turned = np.einsum("tij,j->ti", hand.rotations[:, 0], hand.j0)
        arrays[f"qpos_wrist_{side}"][:, :3] -= turned
    np.savez(file, **arrays)
    demo = read(root)
    for side, hand in scene.hands.items():
        gap = np.linalg.norm(demo.keypoints[side][:, 0] - hand.wrist, axis=-1)
        assert gap.max() < 0.02  # 0.1 without the correction
        tips = demo.keypoints[side][:, TIPS]
        np.testing.assert_allclose(tips, hand.keypoints[:, TIPS], atol=1e-5)
        assert "translation" in demo.provenance["made_up"][side]["wrist"]


def test_the_first_hot3d_set_is_refused(scene, tmp_path):
    with pytest.raises(DemoError, match="'hot3d' holds no wrist"):
        read(write(tmp_path / "a", scene, info={"dataset_name": "hot3d"}))
    read(write(tmp_path / "b", scene, info={"dataset_name": "hot3d_v2"}))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"qpos_finger_right": np.zeros((100, 5, 3))}, r"expected \(T, 5, 7\)"),
        ({"qpos_obj_right": np.zeros((100, 6))}, r"qpos_obj_right \(100, 6\)"),
        ({"qpos_obj_right": np.full((100, 7), 2.0)}, "quaternions of norm 4"),
        ({"qpos_finger_right": None, "qpos_finger_left": None}, "no hand"),
        ({"info": {"ref_dt": -1.0}}, "ref_dt is -1.0"),
        (
            {"info": {f"{s}_object_mesh_dir": None for s in ("left", "right")}},
            "no object.*right_object_mesh_dir",
        ),
    ],
)
def test_faults(scene, tmp_path, changes, message):
    with pytest.raises(DemoError, match=message):
        read(write(tmp_path, scene, **changes))


def test_wrong_roots(scene, tmp_path):
    (tmp_path / "trajectory_mjwp.npz").write_bytes(b"")
    with pytest.raises(DemoError, match=r"E_ROOT.*trajectory_mjwp.npz.*processed/"):
        recordings(tmp_path)
    root = write(tmp_path / "a", scene)
    next(root.rglob("task_info.json")).write_text("{")
    with pytest.raises(DemoError, match="not readable JSON"):
        read(root)


@pytest.mark.assets
def test_the_documented_frame_fits_recorded_hands(demos):
    """On every recorded hand the tips speak for the documented axes, not another's."""
    tried = 0
    for file in sorted(demos.glob("*/*.npz")):
        data = np.load(file)
        for side in ("left", "right"):
            if f"kp_{side}" not in data:
                continue
            points = data[f"kp_{side}"].astype(float)
            ahead = points[:, 9] - points[:, 0]
            across = points[:, 5] - points[:, 13]
            out = np.cross(across if side == "right" else -across, ahead)
            axes = [out, np.cross(ahead, out), ahead]
            axes = np.stack([a / np.linalg.norm(a, axis=1)[:, None] for a in axes], -1)
            quats = Rotation.from_matrix(axes).as_quat(scalar_first=True)
            wrist = np.concatenate([points[:, 0], quats], axis=1)
            hand = fill_hand(wrist, points[:, TIPS], side)
            assert hand.notes["wrist_frame"] == "documented"
            own = palm_frame(points, side)
            assert angle(own, palm_frame(hand.keypoints, side)).mean() < 3
            tried += 1
    assert tried == 24
