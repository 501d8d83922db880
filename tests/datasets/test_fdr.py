"""The reader of FlashDexRetarget: a known scene, its traps, its messages."""

import pickle

import numpy as np
import pytest
import torch
from layouts.fdr import matrices, write, write_pack
from layouts.scene import make_scene

from flashdex.datasets.fdr.reader import list_fdr
from flashdex.datasets.source import SourceOptions
from flashdex.errors import DemoError

FRAMES = 108


@pytest.fixture(scope="module")
def scene():
    return make_scene(60, seconds=FRAMES / 60)


def recordings(path, models=None):
    return list_fdr(SourceOptions(path=path, models=models))


def read(path, models=None):
    (recording,) = recordings(path, models)
    (demo,) = pickle.loads(pickle.dumps(recording.read))()
    demo.validate()
    return demo


def same_pose(pose, expected, atol=1e-5):
    np.testing.assert_allclose(pose[:, :3], expected[:, :3], atol=atol)
    dots = np.abs((pose[:, 3:] * expected[:, 3:]).sum(-1))
    np.testing.assert_allclose(dots, 1, atol=atol)


def test_a_clip_gives_back_the_scene(scene, tmp_path):
    demo = read(write(tmp_path, scene))
    assert (demo.name, demo.fps, demo.up) == ("clip_a", 60, "z")
    for side, hand in scene.hands.items():
        np.testing.assert_allclose(demo.keypoints[side], hand.keypoints, atol=1e-5)
        np.testing.assert_allclose(demo.palm[side][:, :3], hand.wrist, atol=1e-5)
        slot = demo.hand_object[side]
        body = scene.objects[0 if side == "right" else 1]
        assert demo.objects[slot].name == body.name
        same_pose(demo.objects[slot].pose, body.pose)
        found = demo.objects[slot].load_mesh()
        np.testing.assert_allclose(found.bounds, body.mesh.bounds, atol=1e-6)
        # the stored wrist frame is MANO's; it agrees with the palm of the joints
        assert demo.provenance["wrist_to_palm_deg"][side] < 15


def test_stored_joint_names_decide_the_order(scene, tmp_path):
    clip = read(write(tmp_path / "a", scene))
    stored = np.load(tmp_path / "a" / "human_demo" / "clip_a.npz")
    names = sorted(
        f"{f}_{s}"
        for f in ("thumb", "index", "middle", "ring", "pinky")
        for s in ("proximal", "intermediate", "distal", "tip")
    )
    shuffled = {
        "mano_right_joint_names": np.array(names[::-1]),
        "mano_right_joints": stored["mano_right_joints"][:, ::-1],
    }
    other = read(write(tmp_path / "b", scene, **shuffled))
    np.testing.assert_array_equal(clip.keypoints["right"], other.keypoints["right"])


def test_a_wrong_wrist_frame_is_told(scene, tmp_path):
    turned = np.tile(np.eye(3), (FRAMES, 1, 1))
    demo = read(write(tmp_path, scene, mano_right_wrist_rot=turned))
    assert demo.provenance["wrist_to_palm_deg"]["right"] > 30


def test_an_object_of_both_hands_appears_once(scene, tmp_path):
    demo = read(write(tmp_path, scene, shared=True))
    assert [body.name for body in demo.objects] == ["box"]
    assert demo.hand_object == {"left": 0, "right": 0}


def test_two_of_the_same_kind_stay_two(scene, tmp_path):
    demo = read(write(tmp_path, scene, obj_left_id=np.array("box")))
    assert [body.name for body in demo.objects] == ["box", "box"]
    assert demo.hand_object == {"left": 0, "right": 1}


def test_scale_enlarges_the_mesh(scene, tmp_path):
    demo = read(write(tmp_path, scene, obj_right_scale=np.float32(1.5)))
    body = demo.objects[demo.hand_object["right"]].load_mesh()
    np.testing.assert_allclose(body.extents, 1.5 * scene.objects[0].mesh.extents)
    assert demo.provenance["obj_right_scale"] == 1.5


def test_one_hand_is_enough(tmp_path):
    demo = read(write(tmp_path, make_scene(60, hands=("right",))))
    assert set(demo.keypoints) == {"right"}


def test_untracked_frames_are_nan(scene, tmp_path):
    joints = np.load(write(tmp_path / "a", scene) / "human_demo" / "clip_a.npz")
    joints = joints["mano_right_joints"].copy()
    joints[5, 3] = np.nan
    (recording,) = recordings(write(tmp_path / "b", scene, mano_right_joints=joints))
    (demo,) = recording.read()
    assert np.isnan(demo.keypoints["right"][5]).all()
    assert np.isnan(demo.palm["right"][5]).all()
    assert np.isfinite(demo.keypoints["right"][6]).all()


def test_the_table_is_the_lowest_used_disc(scene, tmp_path):
    box = scene.objects[0].pose[0]
    disks = np.array(
        [
            [*box[:2], 0.52, 0.1, 0.01],
            [*box[:2], 0.80, 0.1, 0.01],  # a shelf above it
            [box[0] + 1, box[1], 0.10, 0.2, 0.01],  # nothing stands there
            np.zeros(5),  # padding
        ]
    )
    demo = read(write(tmp_path / "a", scene, support_disks=disks))
    assert demo.support_z == pytest.approx(0.52)
    demo = read(write(tmp_path / "b", scene, support_disks=disks[2:]))
    assert demo.support_z is None
    assert "no object" in demo.provenance["support"]


def context(scene, tail):
    """Tracks of a recording of which the clip is the first part, and one more body."""
    late = matrices(scene.objects[0].pose)
    late = np.concatenate([late[:1].repeat(0, 0), late, late[-1:].repeat(tail, 0)])
    late[FRAMES:, 0, 3] += np.linspace(0.01, 0.2, tail)
    bowl = matrices(scene.objects[1].pose[:1]).repeat(len(late), 0)
    bowl[:, 2, 3] = np.linspace(1, 2, len(late))
    return {
        "desk_context_ids": np.array(["bowl", "box", "gone"]),
        "desk_context_scales": np.ones(3),
        "desk_context_poses": np.stack([bowl, late, bowl]),
    }


@pytest.mark.parametrize("tail", [0, 30])
def test_further_objects_come_from_the_context(scene, tmp_path, tail):
    write(tmp_path, scene, shared=True, **context(scene, tail))
    scene.objects[0].mesh.export(tmp_path / "bowl.stl")
    (tmp_path / "objects" / "bowl").mkdir()
    (tmp_path / "bowl.stl").rename(tmp_path / "objects" / "bowl" / "scan.stl")
    demo = read(tmp_path)
    assert [body.name for body in demo.objects] == ["box", "bowl"]
    expected = np.linspace(1, 2, FRAMES + tail)[:FRAMES]
    np.testing.assert_allclose(demo.objects[1].pose[:, 2], expected, atol=1e-6)
    assert demo.provenance["desk_context"]["no_mesh"] == ["gone"]


def test_context_that_cannot_be_placed_is_left_out(scene, tmp_path):
    still = context(scene, 30)
    still["desk_context_poses"][1, :, :3, 3] = 5.0
    demo = read(write(tmp_path, scene, shared=True, **still))
    assert [body.name for body in demo.objects] == ["box"]
    assert demo.provenance["desk_context"]["left_out"] == ["bowl", "gone"]


def test_a_pack_gives_back_each_clip(scene, tmp_path):
    second = make_scene(60, seconds=1.5)
    found = recordings(write_pack(tmp_path, [scene, second]))
    assert [r.name for r in found] == ["clip_0", "clip_1"]
    assert len({r.key for r in found}) == 2
    names = [file.name for file in found[0].files]
    assert names == ["motion.pt", "visual.obj", "visual.obj"]
    for recording, made in zip(found, [scene, second], strict=True):
        (demo,) = pickle.loads(pickle.dumps(recording.read))()
        demo.validate()
        for side, hand in made.hands.items():
            np.testing.assert_allclose(demo.keypoints[side], hand.keypoints, atol=1e-5)
            body = made.objects[0 if side == "right" else 1]
            slot = demo.hand_object[side]
            same_pose(demo.objects[slot].pose, body.pose)
            assert demo.objects[slot].name == body.name
        assert demo.fps == 60
        assert demo.provenance["fps"]["measured"] == pytest.approx(60, rel=0.01)


def test_the_velocities_of_a_pack_overrule_its_rate(scene, tmp_path):
    (demo,) = recordings(write_pack(tmp_path, [scene], fps=30.0))[0].read()
    assert demo.fps == pytest.approx(30, rel=0.01)
    assert "velocities" in demo.provenance["fps"]["from"]


def test_a_pack_without_velocities_has_the_documented_rate(scene, tmp_path):
    left_out = {f"mano_{s}_wrist_vel": None for s in ("left", "right")}
    (demo,) = recordings(write_pack(tmp_path, [scene], **left_out))[0].read()
    assert demo.fps == 60
    assert "not in the file" in demo.provenance["fps"]["from"]


def test_clips_go_before_the_pack_and_retargeted_after(scene, tmp_path):
    write(tmp_path, scene, folder="retargeted", name="late")
    assert [r.name for r in recordings(tmp_path)] == ["late"]
    write_pack(tmp_path, [scene])
    write(tmp_path, scene, name="early")
    (tmp_path / "human_demo" / "early.tmp.npz").write_bytes(b"unfinished")
    assert [r.name for r in recordings(tmp_path)] == ["early"]
    assert [r.name for r in recordings(tmp_path / "human_demo")] == ["early"]


def test_models_may_lie_apart(scene, tmp_path):
    write(tmp_path, scene)
    (tmp_path / "objects").rename(tmp_path / "elsewhere")
    demo = read(tmp_path, models=tmp_path / "elsewhere")
    assert demo.objects[0].load_mesh().volume > 0
    with pytest.raises(DemoError, match=r"no mesh of object 'block'.*--models"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fps": None}, "lacks fps"),
        ({"mano_right_joints": np.zeros((FRAMES, 21, 3))}, r"expected \(T, 20, 3\)"),
        ({"mano_right_wrist_pos": None}, r"expected \(T, 20, 3\) and \(T, 3\)"),
        ({"obj_right_pose": np.zeros((FRAMES, 7))}, r"expected \(T, 4, 4\)"),
        ({"obj_right_id": np.array("../secret")}, "it is a path"),
        ({"obj_right_pose": None, "obj_left_id": None}, "no object"),
        ({"mano_right_joint_names": np.array(["a"] * 20)}, "mano_right_joint_names"),
        (
            {"mano_right_joints": None, "mano_left_joints": None},
            "no hand.*Is this a clip of FlashDexRetarget",
        ),
        (
            {
                "desk_context_ids": np.array(["a"]),
                "desk_context_poses": np.zeros((2, 1)),
            },
            "desk_context_poses has 2 tracks for 1 ids",
        ),
    ],
)
def test_faults_of_a_clip(scene, tmp_path, changes, message):
    with pytest.raises(DemoError, match=message):
        read(write(tmp_path, scene, **changes))


def test_faults_of_a_pack(scene, tmp_path):
    path = write_pack(
        tmp_path / "a", [scene], motion_object_slot_left=torch.tensor([7])
    )
    with pytest.raises(DemoError, match=r"slot_left\[0\] = 7.*has 2 entries"):
        recordings(path)[0].read()
    path = write_pack(tmp_path / "b", [scene], length_starts=torch.tensor([9]))
    with pytest.raises(DemoError, match="rows 9 to 117"):
        recordings(path)[0].read()
    path = write_pack(tmp_path / "c", [scene], motion_num_frames=None)
    with pytest.raises(DemoError, match="lacks motion_num_frames"):
        recordings(path)


def test_several_meshes_are_not_guessed(scene, tmp_path):
    write(tmp_path, scene)
    folder = tmp_path / "objects" / "block"
    for name in ("one.obj", "two.obj"):
        (folder / name).write_bytes((folder / "visual.obj").read_bytes())
    (folder / "visual.obj").unlink()
    with pytest.raises(DemoError, match="2 meshes"):
        read(tmp_path)


def test_wrong_roots(scene, tmp_path):
    (tmp_path / "README.md").write_text("")
    with pytest.raises(DemoError, match=r"E_ROOT.*human_demo/\*.npz.*README.md"):
        recordings(tmp_path)
    pointer = tmp_path / "human_demo"
    pointer.mkdir()
    (pointer / "clip.npz").write_text("version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(DemoError, match="Git-LFS"):
        recordings(tmp_path)
