"""The GRAB reader: recovery of a known scene, its traps, its messages."""

import pickle

import numpy as np
import pytest
from layouts.grab import write
from layouts.mano_files import write_mano
from layouts.scene import make_scene

from flashdex.datasets.grab import list_grab
from flashdex.datasets.source import SourceOptions
from flashdex.errors import DemoError

FRAMES = 144


@pytest.fixture(scope="module")
def scene():
    return make_scene(120, seconds=FRAMES / 120)


@pytest.fixture(scope="module")
def mano(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mano")
    write_mano(folder)
    return folder


def recordings(path, mano, **options):
    return list_grab(SourceOptions(path=path, mano=mano, **options))


def read(path, mano, **options):
    (recording,) = recordings(path, mano, **options)
    (demo,) = pickle.loads(pickle.dumps(recording.read))()
    demo.validate()
    return demo


@pytest.mark.parametrize("coefficients", [False, True], ids=["fullpose", "hand_pose"])
def test_a_sequence_gives_back_the_scene(scene, mano, tmp_path, coefficients):
    demo = read(write(tmp_path, scene, coefficients=coefficients), mano)
    assert (demo.name, demo.fps, demo.up) == ("s1_mug_drink_1", 120, "z")
    assert (demo.task, demo.split) == ("drink", "test")
    for side, hand in scene.hands.items():
        np.testing.assert_allclose(demo.keypoints[side], hand.keypoints, atol=1e-5)
        np.testing.assert_allclose(demo.palm[side][:, :3], hand.wrist, atol=1e-5)
    (body,), made = demo.objects, scene.objects[0]
    assert body.name == "mug"
    np.testing.assert_allclose(body.pose[:, :3], made.pose[:, :3], atol=1e-6)
    # the stored rotation is the inverse; the box turns by 30 degrees, so it shows
    dots = (body.pose[:, 3:] * made.pose[:, 3:]).sum(-1)
    np.testing.assert_allclose(np.abs(dots), 1, atol=1e-9)
    np.testing.assert_allclose(body.load_mesh().bounds, made.mesh.bounds, atol=1e-6)


def test_the_table_is_the_support(scene, mano, tmp_path):
    demo = read(write(tmp_path, scene), mano)
    assert demo.support_z == pytest.approx(scene.table_z, abs=1e-6)


@pytest.mark.parametrize(
    "changes", [{"table": None}, {"left_out": ("table.ply",)}], ids=["entry", "mesh"]
)
def test_without_a_table_the_height_is_left_open(scene, mano, tmp_path, changes):
    demo = read(write(tmp_path, scene, **changes), mano)
    assert demo.support_z is None
    assert "estimated" in demo.provenance["support"]


def test_names_splits_and_files(scene, mano, tmp_path):
    write(tmp_path, scene, name="s10/apple_eat_1")
    write(tmp_path, scene, name="s2/stamp_lift")
    found = recordings(tmp_path, mano)
    assert [r.name for r in found] == ["s10_apple_eat_1", "s2_stamp_lift"]
    names = {file.name for file in found[1].files}
    assert names == {
        "stamp_lift.npz",
        "stamp.ply",
        "table.ply",
        "s2_lhand.ply",
        "s2_rhand.ply",
        "MANO_LEFT.pkl",
        "MANO_RIGHT.pkl",
    }
    assert [r.read()[0].split for r in found] == ["val", "train"]


def test_untracked_frames_are_nan(scene, mano, tmp_path):
    place = scene.hands["right"].wrist.copy()
    place[4] = np.nan
    (recording,) = recordings(write(tmp_path, scene, hand={"transl": place}), mano)
    (demo,) = recording.read()
    assert np.isnan(demo.keypoints["right"][4]).all()
    assert np.isfinite(demo.keypoints["left"]).all()


def test_models_may_lie_apart(scene, mano, tmp_path):
    root = write(tmp_path, scene)
    (root / "tools/object_meshes/contact_meshes").rename(tmp_path / "apart")
    with pytest.raises(
        DemoError, match=r"^E_FILE: .*mug.ply: mesh not found.*--models"
    ):
        read(root, mano)
    demo = read(root, mano, models=tmp_path / "apart")
    assert demo.support_z == pytest.approx(scene.table_z, abs=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rhand": None}, "^E_KEYS: .*lacks rhand"),
        ({"hand": {"global_orient": None}}, "rhand: lacks global_orient"),
        ({"hand": {"fullpose": np.zeros((FRAMES, 24))}}, r"expected \(T, 45\)"),
        ({"hand": {"transl": np.zeros((9, 3))}}, "^E_LEN: .*transl 9"),
        ({"left_out": ("s1_rhand.ply",)}, "subject's hand"),
        (
            {
                "object": {
                    "params": {
                        "global_orient": np.zeros((9, 3)),
                        "transl": np.zeros((9, 3)),
                    },
                    "object_mesh": "tools/object_meshes/contact_meshes/mug.ply",
                }
            },
            "^E_LEN: .*right hand 144, object 9",
        ),
        (
            {
                "object": {
                    "params": {
                        "global_orient": np.zeros((FRAMES, 3)),
                        "transl": np.zeros((FRAMES, 3)),
                    },
                    "object_mesh": "../../secret.ply",
                }
            },
            "not inside the dataset",
        ),
    ],
)
def test_faults(scene, mano, tmp_path, changes, message):
    with pytest.raises(DemoError, match=message):
        read(write(tmp_path, scene, **changes), mano)


def test_a_hand_of_another_model_is_refused(scene, mano, tmp_path):
    root = write(tmp_path, scene)
    hands = root / "tools/subject_meshes/male"
    scene.objects[0].mesh.export(hands / "s1_rhand.ply")
    with pytest.raises(DemoError, match="a hand of MANO has 778"):
        read(root, mano)


def test_wrong_roots(scene, mano, tmp_path):
    root = write(tmp_path / "GRAB", scene)
    with pytest.raises(DemoError, match=r"E_ROOT.*give .*GRAB"):
        recordings(tmp_path, mano)
    with pytest.raises(DemoError, match=r"E_ROOT.*give .*GRAB"):
        recordings(root / "grab", mano)
    with pytest.raises(DemoError, match="E_MANO"):
        recordings(root, tmp_path)
    (root / "grab/s1/mug_drink_1.npz").unlink()
    with pytest.raises(DemoError, match=r"E_ROOT.*unzip_grab.py"):
        recordings(root, mano)
