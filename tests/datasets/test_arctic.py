"""The ARCTIC reader: recovery of a known scene, its traps, its messages."""

import json
import pickle

import numpy as np
import pytest
from layouts.arctic import expected_vertices, write
from layouts.mano_files import mano_hand, write_mano
from layouts.scene import make_scene

from flashdex.datasets.arctic import list_arctic
from flashdex.datasets.source import SourceOptions
from flashdex.datasets.tracks import rotation
from flashdex.errors import DemoError

FRAMES = 48


@pytest.fixture(scope="module")
def scene():
    return make_scene(30, seconds=FRAMES / 30)


@pytest.fixture(scope="module")
def mano(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mano")
    write_mano(folder)
    return folder


def recordings(path, mano, **options):
    return list_arctic(SourceOptions(path=path, mano=mano, **options))


def read(path, mano, **options):
    (recording,) = recordings(path, mano, **options)
    (demo,) = pickle.loads(pickle.dumps(recording.read))()
    demo.validate()
    return demo


def test_a_sequence_gives_back_the_scene(scene, mano, tmp_path):
    demo = read(write(tmp_path, scene), mano)
    assert (demo.name, demo.fps, demo.up) == ("s01_box_use_01", 30, "z")
    assert demo.task == "box use"
    assert demo.support_z is None
    assert not demo.needs_cutting
    for side, hand in scene.hands.items():
        np.testing.assert_allclose(demo.keypoints[side], hand.keypoints, atol=1e-5)
        np.testing.assert_allclose(demo.palm[side][:, :3], hand.wrist, atol=1e-5)


def test_the_parts_are_two_bodies_that_turn_about_the_hinge(scene, mano, tmp_path):
    demo = read(write(tmp_path, scene), mano)
    assert [body.name for body in demo.objects] == ["box_top", "box_bottom"]
    for body in demo.objects:
        vertices = np.asarray(body.load_mesh().vertices)
        for frame in (0, 17, FRAMES - 1):
            pose = body.pose[frame]
            found = rotation(pose[3:]).apply(vertices) + pose[:3]
            expected = expected_vertices(scene, body.name.split("_")[1], frame)
            np.testing.assert_allclose(found, expected, atol=1e-5)
    joint = demo.provenance["joint"]
    assert demo.objects[joint["child"]].name == "box_top"
    assert joint["axis"] == [0, 0, -1]


def test_all_files_key_the_cache(scene, mano, tmp_path):
    (recording,) = recordings(write(tmp_path, scene), mano)
    names = sorted(file.name for file in recording.files)
    assert names == [
        "MANO_LEFT.pkl",
        "MANO_RIGHT.pkl",
        "bottom.obj",
        "box_use_01.mano.npy",
        "box_use_01.object.npy",
        "top.obj",
    ]


def test_long_sequences_are_to_be_cut(mano, tmp_path):
    assert read(write(tmp_path, make_scene(30, seconds=21)), mano).needs_cutting


def test_splits(scene, mano, tmp_path):
    root = write(tmp_path, scene, split="test")
    assert read(root, mano).split == "test"
    own = tmp_path / "own.json"
    own.write_text(json.dumps({"val": ["s01/box_use_01"]}))
    assert read(root, mano, splits=own).split == "val"
    own.write_text("[1]")
    with pytest.raises(DemoError, match=r"protocol_p1\.json"):
        recordings(root, mano, splits=own)
    with pytest.raises(DemoError, match=r"gone\.json"):
        recordings(root, mano, splits=tmp_path / "gone.json")


def test_untracked_frames_are_nan(scene, mano, tmp_path):
    def lose(stored):
        stored[3, 4] = np.nan
        return stored

    hand = scene.hands["right"]
    turn = hand.axis_angle[:, :3].copy()
    turn[7] = np.nan
    (recording,) = recordings(
        write(tmp_path, scene, hand={"rot": turn}, obj=lose), mano
    )
    (demo,) = recording.read()
    assert np.isnan(demo.keypoints["right"][7]).all()
    assert np.isnan(demo.objects[0].pose[3]).all()
    assert np.isnan(demo.objects[1].pose[3]).all()
    assert np.isfinite(demo.keypoints["left"]).all()
    assert np.isfinite(demo.objects[0].pose[4:]).all()


def test_models_may_lie_apart(scene, mano, tmp_path):
    root = write(tmp_path, scene)
    (root / "meta" / "object_vtemplates").rename(tmp_path / "apart")
    (root / "meta").rmdir()
    assert len(read(root, mano, models=tmp_path / "apart").objects) == 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"hand": {"pose": None}}, "^E_KEYS: .*right hand: lacks pose"),
        ({"hand": {"shape": np.zeros(5)}}, "shape.*expected 10 numbers"),
        ({"hand": {"trans": np.zeros((FRAMES - 1, 3))}}, "^E_LEN: .*frames differ"),
        ({"obj": lambda stored: stored[:, :6]}, r"expected \(T, 7\)"),
        ({"obj": lambda stored: stored[1:]}, "^E_LEN: .*right hand 48, object 47"),
    ],
)
def test_faults(scene, mano, tmp_path, changes, message):
    with pytest.raises(DemoError, match=message):
        read(write(tmp_path, scene, **changes), mano)


def test_missing_parts(scene, mano, tmp_path):
    root = write(tmp_path / "a", scene)
    (root / "meta/object_vtemplates/box/top.obj").unlink()
    with pytest.raises(DemoError, match=r"^E_FILE: .*top.obj: mesh not found"):
        read(root, mano)
    root = write(tmp_path / "b", scene)
    (root / "raw_seqs/s01/box_use_01.object.npy").unlink()
    with pytest.raises(DemoError, match=r"box_use_01\.object\.npy"):
        read(root, mano)
    np.save(root / "raw_seqs/s01/box_use_01.mano.npy", np.array({"left": {}}, object))
    with pytest.raises(DemoError, match=r"lacks (right|rot|pose)"):
        read(root, mano)


def test_wrong_roots(scene, mano, tmp_path):
    root = write(tmp_path / "arctic", scene)
    with pytest.raises(DemoError, match=r"E_ROOT.*give .*arctic"):
        recordings(tmp_path, mano)
    with pytest.raises(DemoError, match="E_MANO"):
        recordings(root, tmp_path)
    (root / "raw_seqs/s01/box_use_01.mano.npy").unlink()
    with pytest.raises(DemoError, match=r"E_ROOT.*raw_seqs.zip"):
        recordings(root, mano)


def test_the_fixture_would_show_a_forgotten_mean(scene):
    """The mean pose moves the tips by more than the tolerance of the test above."""
    assert np.abs(mano_hand("right").hands_mean).max() > 0.05
