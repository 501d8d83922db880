"""The HOT3D reader: a known scene is recovered; its traps; real samples."""

import json
import pickle

import numpy as np
import pytest
from layouts.hot3d import FIRST_UID, write
from layouts.mano_files import write_mano
from layouts.scene import make_scene
from layouts.umetrack import UMETRACK_SHIFT, umetrack_keypoints
from scipy.spatial.transform import Rotation
from trimesh.proximity import closest_point

from flashdex.datasets.hot3d.files import Mask, Track, frame_axis
from flashdex.datasets.hot3d.hands import load_umetrack
from flashdex.datasets.hot3d.reader import list_hot3d
from flashdex.datasets.source import SourceOptions
from flashdex.objects.meshes import load_mesh

NAME = "P0003_c701bd11"
TO_Z_UP = Rotation.from_euler("x", 90, degrees=True)
FRAMES = 48


@pytest.fixture(scope="module")
def scene():
    """The scene as the left model was fitted with its shape fixed."""
    return make_scene(30, seconds=1.6, fix_left_shape=True)


@pytest.fixture(scope="module")
def mano(tmp_path_factory):
    """A folder of made-up MANO models."""
    folder = tmp_path_factory.mktemp("mano")
    write_mano(folder)
    return folder


def read(root, *, mano=None, models=None):
    (recording,) = list_hot3d(SourceOptions(path=root, mano=mano, models=models))
    (demo,) = pickle.loads(pickle.dumps(recording.read))()
    return demo


def upright(demo, points):
    return (
        points
        if demo.up == "z"
        else TO_Z_UP.apply(points.reshape(-1, 3)).reshape(points.shape)
    )


def same(demo, points, expected, *, frames=slice(None)):
    got = upright(demo, points)[frames]
    np.testing.assert_allclose(got, expected[frames], atol=1e-5)


@pytest.mark.parametrize("headset", ["Aria", "Quest3"])
def test_recovers_the_scene(tmp_path, scene, mano, headset):
    write(tmp_path, scene, headset=headset)
    demo = read(tmp_path, mano=mano)
    demo.validate()
    assert demo.up == {"Aria": "z", "Quest3": "y"}[headset]
    assert (demo.fps, demo.num_frames, demo.needs_cutting) == (30.0, FRAMES, True)
    for side, hand in scene.hands.items():
        same(demo, demo.keypoints[side], hand.keypoints)
        same(demo, demo.palm[side][:, :3], hand.wrist)
    assert [body.name for body in demo.objects] == ["box", "block"]
    for body, true in zip(demo.objects, scene.objects, strict=True):
        vertices = body.load_mesh().vertices
        np.testing.assert_allclose(vertices, true.mesh.vertices, atol=1e-6)
        for frame in (0, 20, 47):
            placed = _placed(body.pose[frame], vertices)
            same(demo, placed, _placed(true.pose[frame], true.mesh.vertices))
    assert demo.provenance["keypoints"] == "mano"
    assert demo.provenance["left_shape"]["fixed"] is True
    json.dumps(demo.provenance)


def _placed(pose, points):
    return Rotation.from_quat(pose[3:], scalar_first=True).apply(points) + pose[:3]


@pytest.mark.parametrize("headset", ["Aria", "Quest3"])
def test_umetrack_without_mano(tmp_path, scene, headset):
    write(tmp_path, scene, headset=headset, omit=("mano_hand_pose_trajectory.jsonl",))
    demo = read(tmp_path)
    assert demo.provenance["keypoints"] == "umetrack"
    for side in scene.hands:
        expected = umetrack_keypoints(scene, side)
        same(demo, demo.keypoints[side], expected)
        wrist = scene.hands[side].wrist + UMETRACK_SHIFT
        same(demo, demo.keypoints[side][:, 0], wrist)


def test_left_shape_is_decided_by_the_wrist(tmp_path, mano):
    """Hands fitted with the raw left model are read with it."""
    raw = make_scene(30, seconds=1.6, fix_left_shape=False)
    write(tmp_path, raw)
    demo = read(tmp_path, mano=mano)
    choice = demo.provenance["left_shape"]
    assert choice["fixed"] is False
    assert choice["gap_raw_mm"] < 1.5 < 5 < choice["gap_fixed_mm"]
    same(demo, demo.keypoints["left"], raw.hands["left"].keypoints)


def test_left_shape_is_fixed_where_nothing_can_be_compared(tmp_path, scene, mano):
    write(tmp_path, scene, omit=("umetrack_hand_pose_trajectory.jsonl",))
    demo = read(tmp_path, mano=mano)
    assert "default" in demo.provenance["left_shape"]["why"]
    same(demo, demo.keypoints["left"], scene.hands["left"].keypoints)


def test_doubled_stamps_without_masks(tmp_path, scene):
    write(tmp_path, scene, headset="Aria", masks=())
    demo = read(tmp_path)
    assert demo.num_frames == FRAMES
    assert demo.provenance["stamps"] == "stamps closer than 10 ms are one"
    same(demo, demo.objects[0].pose[:, :3], scene.objects[0].pose[:, :3])


def test_doubled_stamps_by_the_colour_stream(scene):
    """The mask decides, also where the colour camera has the second stamp."""
    first = np.arange(10, dtype=np.int64) * 33_333_333
    stamps = np.sort(np.concatenate([first, first + 90_000]))
    streams = np.array(["1201-1", "214-1"] * 10)
    mask = Mask(stamps, streams, np.ones(20, dtype=bool))
    rows = Track(stamps, np.arange(20.0)[:, None])
    axis = frame_axis("x", [rows], mask)
    np.testing.assert_array_equal(axis.sample(rows)[:, 0], np.arange(1, 20, 2))


def test_missing_frames_are_nan_on_a_uniform_axis(tmp_path, scene, mano):
    holes, no_left, no_hands = (30, 31), (10, 11, 12), (20,)
    write(
        tmp_path, scene, headset="Aria", holes=holes, no_left=no_left, no_hands=no_hands
    )
    demo = read(tmp_path, mano=mano)
    assert demo.num_frames == FRAMES
    assert demo.provenance["unrecorded_frames"] == 2
    lost = {
        "right": {*holes, *no_hands},
        "left": {*holes, *no_hands, *no_left},
    }
    for side, points in demo.keypoints.items():
        assert set(_nan_frames(points)) == lost[side]
        assert set(_nan_frames(demo.palm[side])) == lost[side]
        kept = sorted(set(range(FRAMES)) - lost[side])
        same(demo, points, scene.hands[side].keypoints, frames=kept)
    assert _nan_frames(demo.objects[0].pose) == list(holes)


def _nan_frames(track):
    bad = ~np.isfinite(track.reshape(len(track), -1)).all(axis=1)
    return np.flatnonzero(bad).tolist()


def test_masks(tmp_path, scene):
    """Quality: all streams must agree. "Available" is false where one hand misses."""
    both, one = ("1201-1", "1201-2"), ("1201-2",)
    forbidden = {
        "hand_pose_available": {5: both, 6: one},
        "object_pose_available": {15: both, 16: one},
        "object_pose_quality": {25: one},
        "qa_pass": {35: one},
    }
    write(tmp_path, scene, masks=tuple(forbidden), forbidden=forbidden)
    demo = read(tmp_path)
    assert _nan_frames(demo.keypoints["right"]) == [35]
    assert _nan_frames(demo.objects[0].pose) == [25, 35]
    assert demo.provenance["absent_masks"] == []
    assert demo.provenance["masked_frames"] == dict.fromkeys(forbidden, 1)


def test_both_metadata_layouts(tmp_path, scene):
    write(tmp_path, scene, metadata="flag")
    (tmp_path / "object_library" / "instance.json").unlink()
    demo = read(tmp_path)
    assert [body.name for body in demo.objects] == ["box", "block"]
    assert demo.provenance["version"] == "v2"


def test_an_object_without_model_is_told(tmp_path, scene):
    write(tmp_path, scene, coffee_pot=True)
    demo = read(tmp_path)
    assert [body.name for body in demo.objects] == ["box", "block"]
    assert demo.provenance["missing_meshes"] == ["coffee_pot"]
    assert demo.provenance["most_moved"]["object"] == "coffee_pot"
    assert "'coffee_pot' moves most" in demo.provenance["notes"][0]


@pytest.mark.parametrize("group", ["train", "hot3d_dataset/test"])
def test_roots(tmp_path, scene, group):
    """A folder of sequences, one sequence, groups; the library is found beside."""
    folder = write(tmp_path / group, scene)
    (tmp_path / group / "object_library").rename(tmp_path / "assets")
    for root in (tmp_path, folder.parent, folder):
        assert read(root, models=tmp_path / "assets").name == NAME
    demo = read(tmp_path)
    assert demo.split == folder.parent.name
    assert demo.provenance["files"] == [f"{group}/{NAME}"]


def test_files_and_key_name_what_the_result_depends_on(tmp_path, scene, mano):
    write(tmp_path, scene)
    (before,) = list_hot3d(SourceOptions(path=tmp_path, mano=mano))
    names = {file.name for file in before.files}
    assert {"dynamic_objects.csv", "mask_hand_pose_available.csv"} < names
    assert {f"{FIRST_UID}.glb", "instance.json", "MANO_LEFT.pkl"} < names
    (tmp_path / "object_library" / "1.glb").write_bytes(b"later")
    (after,) = list_hot3d(SourceOptions(path=tmp_path, mano=mano))
    assert after.key != before.key


# -- real samples -------------------------------------------------------------


@pytest.fixture
def samples(demos):
    root = demos / "hot3d_sample"
    recordings = list_hot3d(SourceOptions(path=root))
    return {r.name[:5]: r.read()[0] for r in recordings}, root


def test_real_samples(samples):
    demos, _ = samples
    aria, quest = demos["P0003"], demos["P0002"]
    assert (aria.num_frames, aria.up) == (34, "z")
    assert (quest.num_frames, quest.up) == (15, "y")
    for demo, length in ((aria, 0.0963), (quest, 0.1047)):
        for points in demo.keypoints.values():
            bones = np.linalg.norm(points[:, 9] - points[:, 0], axis=1)
            np.testing.assert_allclose(bones, length, atol=5e-5)
    missing = ["coffee_pot", "mug_white", "puzzle_toy"]
    assert aria.provenance["missing_meshes"] == missing
    assert "'coffee_pot' moves most" in aria.provenance["notes"][0]
    assert aria.provenance["absent_masks"] == ["object_pose_quality", "qa_pass"]
    assert quest.provenance["most_moved"] == {"object": "mouse", "m": 0.0344}


def test_real_fingers_touch_the_mouse(samples):
    """Distance of the tips to the surface, thumb to pinky, known from elsewhere."""
    quest = samples[0]["P0002"]
    mouse = next(body for body in quest.objects if body.name == "mouse")
    turn = Rotation.from_quat(mouse.pose[:, 3:], scalar_first=True).inv()
    medians = []
    for tip in (4, 8, 12, 16, 20):
        points = turn.apply(quest.keypoints["right"][:, tip] - mouse.pose[:, :3])
        medians.append(np.median(closest_point(mouse.load_mesh(), points)[1]) * 1e3)
    np.testing.assert_allclose(medians, [8.9, 7.5, 9.7, 10.5, 10.3], atol=0.06)


def test_real_translation_is_not_the_wrist(samples):
    """UmeTrack wrist minus MANO translation is constant in the world while it turns."""
    demos, root = samples
    folders = {"P0003": "Aria/P0003_c701bd11", "P0002": "Quest3/P0002_273c2819"}
    for name, folder in folders.items():
        file = root / folder / "mano_hand_pose_trajectory.jsonl"
        lines = [json.loads(line)["hand_poses"] for line in file.open()]
        lines = lines[::2] if name == "P0003" else lines
        for key, side, sign in (("0", "left", -1), ("1", "right", 1)):
            places = [line[key]["wrist_xform"]["t_xyz"] for line in lines]
            offset = demos[name].keypoints[side][:, 0] - places
            assert offset.std(axis=0).max() < 1e-3
            assert 0.07 < sign * offset.mean(axis=0)[0] < 0.12


def test_real_meshes_carry_the_transform_of_their_node(samples):
    for file in (samples[1] / "object_library").glob("*.glb"):
        extent = load_mesh(file).extents.max()
        assert 0.05 < extent < 0.5


def test_real_profile_has_plausible_bones(samples):
    profile = "Aria/P0003_c701bd11/umetrack_hand_user_profile.json"
    hand = load_umetrack(samples[1] / profile)
    thumb = np.linalg.norm(np.diff(hand.points[[0, 1, 2, 3, 4]], axis=0), axis=1)
    assert ((thumb > 0.015) & (thumb < 0.06)).all()
