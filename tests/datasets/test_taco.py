"""The reader of TACO, on folders written by ``layouts.taco``."""

import os
import pickle

import numpy as np
import pytest
import torch
from layouts import taco as layout
from layouts.mano_files import write_mano
from layouts.scene import make_scene

from flashdex.datasets.source import SourceOptions
from flashdex.datasets.taco import SOURCE as TACO
from flashdex.datasets.tracks import palm_frame
from flashdex.errors import DemoError
from flashdex.keys import SIDES

HANDS = f"Hand_Poses/{layout.TRIPLET}/{layout.SEQUENCE}"
OBJECTS = f"Object_Poses/{layout.TRIPLET}/{layout.SEQUENCE}"


@pytest.fixture(scope="module")
def scene():
    return make_scene(30.0, seconds=2.0)


@pytest.fixture(scope="module")
def mano(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mano")
    write_mano(folder)
    return folder


@pytest.fixture
def read(mano):
    """Read the only sequence of a root."""

    def run(root, **options):
        recordings = TACO.list(SourceOptions(path=root, mano=mano, **options))
        (recording,) = recordings
        (demo,) = recording.read()
        return demo

    return run


@pytest.fixture
def root(tmp_path, scene):
    return layout.write(tmp_path / "TACO", scene)


def refused(read, root, *words, **options):
    """The reader refuses the root; its message holds all words."""
    with pytest.raises(DemoError) as error:
        read(root, **options)
    for word in words:
        assert word in str(error.value)


def test_recovers_the_motion(read, root, scene):
    demo = read(root)
    demo.validate()
    for side in SIDES:
        error = np.abs(demo.keypoints[side] - scene.hands[side].keypoints)
        assert error.max() < 1e-5
        assert np.array_equal(demo.palm[side][:, :3], demo.keypoints[side][:, 0])
    for body, made in zip(demo.objects, scene.objects, strict=True):
        assert np.abs(layout.matrices(body.pose) - layout.matrices(made.pose)).max() < (
            1e-6
        )
        bounds = body.load_mesh().bounds
        assert np.abs(bounds - made.mesh.bounds).max() < 1e-6  # metres again
    assert demo.fps == 30
    assert demo.up == "z"
    assert demo.support_z is None  # the table is not at z = 0 here
    assert not demo.needs_cutting
    assert demo.name == layout.SEQUENCE
    assert demo.task == "pour in some, bowl, plate"
    assert [body.name for body in demo.objects] == ["bowl_003", "plate_112"]
    assert demo.provenance["notes"] == []
    assert f"{OBJECTS}/tool_003.npy" in demo.provenance["files"]


def test_tensors_from_a_gpu(read, root, scene, monkeypatch):
    hand = scene.hands["right"]
    table = np.concatenate([hand.axis_angle, hand.wrist], axis=1)
    frames = {f"{i:05d}": layout.frame(row) for i, row in enumerate(table)}
    file = root / HANDS / "right_hand.pkl"
    with monkeypatch.context() as patch:
        patch.setattr(torch.serialization, "location_tag", lambda s: "cuda:0")
        layout.dump(file, frames)
    if not torch.cuda.is_available():
        with pytest.raises(RuntimeError, match="CUDA"):
            pickle.loads(file.read_bytes())  # the fixture is what it should be
    assert np.abs(read(root).keypoints["right"] - hand.keypoints).max() < 1e-5


def test_older_layout_and_names_of_frames(read, tmp_path, scene):
    old = layout.write(tmp_path / "old", scene, frame_files=("left",))
    # without leading zeros, "10" sorts before "2" as text
    short = layout.write(tmp_path / "short", scene, key="{}", dtype=np.float32)
    for root in (old, short):
        error = read(root).keypoints["left"] - scene.hands["left"].keypoints
        assert np.abs(error).max() < 1e-5


def test_hand_without_shape(read, tmp_path, scene):
    demo = read(layout.write(tmp_path, scene, shapes=("left",)))
    hand = scene.hands["right"]
    assert np.abs(demo.keypoints["right"][:, 0] - hand.wrist).max() < 1e-6
    assert np.abs(demo.keypoints["right"] - hand.keypoints).max() > 1e-3
    (note,) = demo.provenance["notes"]
    assert note.startswith("W_SHAPE")
    assert "right_hand_shape.pkl" in note


def test_lengths(read, tmp_path, scene):
    frames = len(scene.times)
    lengths = {"right": frames - 2, "target": frames - 1}
    demo = read(layout.write(tmp_path / "a", scene, lengths=lengths))
    demo.validate()
    assert demo.num_frames == frames - 2
    assert demo.provenance["notes"][0].startswith(f"E_LEN: trimmed to {frames - 2}")
    more = layout.write(tmp_path / "b", scene, lengths={"tool": frames - 3})
    refused(read, more, "E_LEN", f"tool {frames - 3}", f"left hand {frames}")


def test_untracked_frames_are_nan(read, tmp_path, scene):
    demo = read(layout.write(tmp_path, scene, nan={"left": [3, 4], "target": [7]}))
    gone = {
        "left": np.isnan(demo.keypoints["left"]).all(axis=(1, 2)),
        "palm": np.isnan(demo.palm["left"]).all(axis=1),
        "right": np.isnan(demo.keypoints["right"]).any(axis=(1, 2)),
        "target": np.isnan(demo.objects[1].pose).all(axis=1),
    }
    found = {name: np.flatnonzero(mask).tolist() for name, mask in gone.items()}
    assert found == {"left": [3, 4], "palm": [3, 4], "right": [], "target": [7]}
    error = demo.keypoints["left"] - scene.hands["left"].keypoints
    assert np.nanmax(np.abs(error)) < 1e-5


def test_splits(read, root, tmp_path):
    splits = tmp_path / "split.txt"
    splits.write_text(f"20230927_032,train\n{layout.SEQUENCE},test_3\n")
    assert read(root, splits=splits).split == "test_3"
    assert read(root).split == ""
    splits.write_text(f"(stir, spoon, bowl) {layout.SEQUENCE}\n")
    refused(read, root, "split.txt", "'sequence,split'", "'(stir,'", splits=splits)
    splits.write_text("20230927_032,train\n")
    refused(read, root, "no sequence in use", splits=splits)
    refused(read, root, "nothing.txt", splits=tmp_path / "nothing.txt")


def test_recordings_can_be_sent_and_are_keyed_by_all_files(root, scene, mano):
    other = "(stir, spoon, bowl)"
    layout.write(root, scene, triplet=other, ids=("112", "003"))
    options = SourceOptions(path=root, mano=mano)
    recordings = TACO.list(options)
    # the same day and number twice: the triplet makes the names unique
    names = [recording.name for recording in recordings]
    assert names == [
        f"{layout.SEQUENCE}_pour_in_some_bowl_plate",
        f"{layout.SEQUENCE}_stir_spoon_bowl",
    ]
    assert recordings[0].key != recordings[1].key
    demo = pickle.loads(pickle.dumps(recordings[1])).read()[0]
    assert demo.objects[0].name == "spoon_112"
    files = {file.name for file in recordings[0].files}
    assert files == {
        "left_hand.pkl",
        "left_hand_shape.pkl",
        "right_hand.pkl",
        "right_hand_shape.pkl",
        "tool_003.npy",
        "target_112.npy",
        "003_cm.obj",
        "112_cm.obj",
        "MANO_LEFT.pkl",
        "MANO_RIGHT.pkl",
    }


@pytest.mark.parametrize(
    "models",
    ["object_models_released", "Object_Models/object_models_released", "elsewhere"],
)
def test_places_of_the_meshes(read, tmp_path, scene, models):
    layout.write(tmp_path, scene, models=models)
    extra = tmp_path / models if models == "elsewhere" else None
    assert len(read(tmp_path, models=extra).objects) == 2


def test_wrong_root(read, root, tmp_path):
    refused(read, tmp_path, "E_ROOT", "Hand_Poses", "above the root", str(root))
    refused(read, root / "Hand_Poses", "E_ROOT", "inside the root", str(root))
    refused(read, tmp_path / "nothing", "E_ROOT", "no such path")
    packed = tmp_path / "packed"
    packed.mkdir()
    (packed / "Hand_Poses.zip").write_bytes(b"PK")
    refused(read, packed, "E_ROOT", "Unpack Hand_Poses.zip")
    refused(read, packed / "Hand_Poses.zip", "E_ROOT", "Unpack the archive")
    for mesh in (root / "Object_Models").iterdir():
        mesh.unlink()
    refused(read, root, "E_ROOT", "_cm.obj", "--models")


@pytest.mark.parametrize(
    "file", [f"{HANDS}/left_hand.pkl", f"{OBJECTS}/target_112.npy"]
)
def test_pointers_are_told_when_listing(root, mano, file):
    (root / file).write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0")
    with pytest.raises(DemoError, match="Git-LFS pointer"):
        TACO.list(SourceOptions(path=root, mano=mano))


def test_other_folders_are_told(read, root, caplog):
    (root / "Hand_Poses" / "__MACOSX" / "x").mkdir(parents=True)
    assert read(root).name == layout.SEQUENCE
    assert "__MACOSX" in caplog.text


def test_mano_is_missed_when_listing(root, tmp_path):
    with pytest.raises(DemoError, match="MANO"):
        TACO.list(SourceOptions(path=root, mano=tmp_path / "nothing"))


@pytest.mark.parametrize(
    ("gone", "words"),
    [
        (f"{HANDS}/right_hand.pkl", ["no right hand"]),
        (f"{OBJECTS}/tool_003.npy", ["0 files tool_<id>.npy"]),
        ("Object_Models/112_cm.obj", ["target_112.npy", "no mesh 112_cm.obj"]),
    ],
)
def test_missing_file(read, root, gone, words):
    (root / gone).unlink()
    refused(read, root, "E_FILE", *words)


def test_sequence_without_objects_is_listed(root, scene, mano):
    layout.write(root, scene, sequence="20231105_019")
    for file in (root / OBJECTS).iterdir():
        file.unlink()
    (root / OBJECTS).rmdir()
    recordings = TACO.list(SourceOptions(path=root, mano=mano))
    assert [r.name for r in recordings] == [layout.SEQUENCE, "20231105_019"]
    with pytest.raises(DemoError, match="E_FILE"):
        recordings[0].read()


class Attack:
    """A pickle that would make a folder."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("file", ["left_hand.pkl", "right_hand_shape.pkl"])
def test_pickles_run_nothing(read, root, tmp_path, file):
    layout.dump(root / HANDS / file, {"00001": Attack(tmp_path / "made")})
    refused(read, root, "E_PICKLE", "mkdir", file)
    assert not (tmp_path / "made").exists()


def test_poses_are_never_unpickled(read, root, tmp_path):
    file = root / OBJECTS / "tool_003.npy"
    np.save(file, np.array([Attack(tmp_path / "made")], dtype=object))
    refused(read, root, "tool_003.npy", "pickled arrays are not read")
    layout.dump(file, Attack(tmp_path / "made"))
    refused(read, root, "tool_003.npy", "pickled arrays are not read")
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("left_hand.pkl", [1.0], ["expected a dict of frames"]),
        ("left_hand.pkl", {}, ["expected a dict of frames"]),
        ("left_hand.pkl", {"1": {"hand_pose": np.zeros(48)}}, ["hand_trans", "'1'"]),
        (
            "left_hand.pkl",
            {"1": {"hand_pose": np.zeros(45), "hand_trans": np.zeros(3)}},
            ["hand_pose", "(45,)", "expected 48 numbers"],
        ),
        (
            "left_hand.pkl",
            {"1": {"hand_pose": "no", "hand_trans": np.zeros(3)}},
            ["a str", "expected 48 numbers"],
        ),
        ("left_hand_shape.pkl", {"betas": np.zeros(10)}, ["hand_shape"]),
        ("left_hand_shape.pkl", {"hand_shape": np.zeros(16)}, ["(16,)", "10 numbers"]),
    ],
)
def test_wrong_keys(read, root, file, content, words):
    layout.dump(root / HANDS / file, content)
    refused(read, root, "E_KEYS", file, *words)


@pytest.mark.parametrize(
    "content",
    [np.zeros((60, 3, 4)), np.array(["text"] * 60), np.zeros((0, 7))],
)
def test_wrong_shape_of_poses(read, root, content):
    np.save(root / OBJECTS / "tool_003.npy", content)
    refused(read, root, "E_KEYS", "tool_003.npy", "(T, 4, 4)")


def test_rotations(read, root, scene):
    file = root / OBJECTS / "tool_003.npy"
    track = np.load(file)
    bent = track.copy()
    bent[5, 0, :3] *= 1.01
    np.save(file, bent)
    demo = read(root)
    assert demo.provenance["notes"][0].startswith("E_ROT")
    assert np.abs(np.linalg.norm(demo.objects[0].pose[:, 3:], axis=1) - 1).max() < 1e-9
    back = layout.matrices(demo.objects[0].pose[5:6])[0]
    assert np.abs(back - track[5]).max() < 0.01
    bent[5] = track[5] * [[1, 1, -1, 1]]
    np.save(file, bent)
    refused(read, root, "E_ROT", "frame 5", "determinant")
    np.save(file, track.swapaxes(1, 2))
    refused(read, root, "E_ROT", "last row")


@pytest.mark.parametrize("clip", ["20231104_010", "20231104_017"])
def test_real_wrists_and_palms(read, demos, tmp_path, clip):
    """Real parameters on the made-up hand: what does not depend on its shape agrees."""
    real = np.load(demos / "taco" / f"{clip}.npz")
    made = make_scene(30.0, seconds=len(real["hand_pose"]) / 30)
    hand = made.hands["left"]
    hand.axis_angle, hand.wrist = real["hand_pose"], real["hand_trans"]
    points = read(layout.write(tmp_path, made)).keypoints["left"]
    # The recording's own wrist comes from posed vertices: 0.9 mm off on average.
    # "J0 + t" would be 90 mm off.
    gap = np.linalg.norm(points[:, 0] - real["kp_left"][:, 0], axis=1)
    assert gap.max() < 1.3e-3
    # 11 degrees on average: the made-up palm is not quite of MANO's shape
    palm = palm_frame(points, "left")
    dots = np.abs((palm[:, 3:] * real["palm_left"][:, 3:]).sum(axis=1))
    assert np.rad2deg(2 * np.arccos(dots.clip(max=1))).max() < 14
    mine, theirs = (k[:, 4::4] - k[:, :1] for k in (points, real["kp_left"]))
    lengths = np.linalg.norm(mine, axis=-1) * np.linalg.norm(theirs, axis=-1)
    angle = np.rad2deg(np.arccos((mine * theirs).sum(axis=-1) / lengths))
    # 7 to 14 degrees on average: fingers bend the way that was recorded
    assert angle.max() < 23
    assert angle.mean(axis=0).max() < 15
