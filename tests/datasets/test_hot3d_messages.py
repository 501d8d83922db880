"""The HOT3D reader: what it says of wrong roots, missing files and bad content."""

import json

import pytest
from layouts.hot3d import write
from layouts.mano_files import write_mano
from layouts.scene import make_scene

from flashdex.datasets.hot3d.reader import list_hot3d
from flashdex.datasets.source import SourceOptions
from flashdex.errors import DemoError

NAME = "P0003_c701bd11"
FRAMES = 48


@pytest.fixture(scope="module")
def scene():
    return make_scene(30, seconds=1.6)


@pytest.fixture(scope="module")
def mano(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mano")
    write_mano(folder)
    return folder


def _read(root, **options):
    for recording in list_hot3d(SourceOptions(path=root, **options)):
        recording.read()


def _refused(match, root, **options):
    with pytest.raises(DemoError, match=match):
        _read(root, **options)


def test_wrong_roots(tmp_path, scene):
    folder = write(tmp_path / "a" / "b", scene)
    _refused("no such folder", tmp_path / "nothing")
    _refused("part of a sequence", folder / "masks")
    _refused(r"lie deeper: give .*a/b", tmp_path)
    (tmp_path / "zipped").mkdir()
    (tmp_path / "zipped" / "P0003_c701bd11_ground_truth.zip").touch()
    _refused("Unpack the .zip", tmp_path / "zipped")


def test_no_library(tmp_path, scene):
    write(tmp_path, scene, models=False)
    _refused("no object models.*--models", tmp_path)


def test_git_lfs_pointer(tmp_path, scene):
    folder = write(tmp_path, scene)
    pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n"
    (folder / "dynamic_objects.csv").write_text(pointer)
    _refused("pointer", tmp_path)


def test_no_mano_models(tmp_path, scene):
    write(tmp_path, scene)
    _refused("E_MANO", tmp_path, mano=tmp_path)


def test_test_participants_are_skipped(tmp_path, scene):
    files = ("dynamic_objects.csv", "mano_hand_pose_trajectory.jsonl")
    name = "P0004_0a1b2c3d"
    write(tmp_path, scene, name=name, participant="P0004", truth=False, omit=files)
    _refused("no ground truth.*P0004 belongs to the test set", tmp_path)


@pytest.mark.parametrize("layout", ["status", "flag"])
def test_no_ground_truth(tmp_path, scene, layout):
    write(tmp_path, scene, truth=False, metadata=layout)
    _refused("no ground truth for object poses and umetrack", tmp_path)


@pytest.mark.parametrize(
    "file",
    [
        "metadata.json",
        "mano_hand_pose_trajectory.jsonl",
    ],
)
def test_missing_files(tmp_path, scene, mano, file):
    write(tmp_path, scene, omit=(file,))
    _refused(f"{file}: not found.*hand_data", tmp_path, mano=mano)


@pytest.mark.parametrize(
    "file",
    ["umetrack_hand_user_profile.json", "umetrack_hand_pose_trajectory.jsonl"],
)
def test_missing_umetrack_files(tmp_path, scene, file):
    write(tmp_path, scene, omit=(file,))
    _refused(f"{file}: not found", tmp_path)


def test_wrong_columns_and_cells(tmp_path, scene):
    folder = write(tmp_path, scene)
    file = folder / "dynamic_objects.csv"
    text = file.read_text()
    file.write_text(text.replace("q_wo_w", "qw"))
    _refused("lacks the columns q_wo_w", tmp_path)
    lines = text.splitlines()
    file.write_text("\n".join([*lines[:4], lines[4].replace(".", "x"), *lines[5:]]))
    _refused("csv, line 5: not a row", tmp_path)


def test_wrong_hand_lines(tmp_path, scene, mano):
    folder = write(tmp_path, scene)
    file = folder / "mano_hand_pose_trajectory.jsonl"
    lines = file.read_text().splitlines()
    record = json.loads(lines[2])
    record["hand_poses"]["0"]["pose"] = [0.0] * 45
    file.write_text("\n".join([*lines[:2], json.dumps(record), *lines[3:]]))
    _refused("jsonl, line 3: .*45 values where 15", tmp_path, mano=mano)
    file.write_text("\n".join([*lines[:2], lines[2][:40], *lines[3:]]))
    _refused("jsonl, line 3", tmp_path, mano=mano)


def test_wrong_profiles(tmp_path, scene):
    folder = write(tmp_path, scene)
    file = folder / "umetrack_hand_user_profile.json"
    model = json.loads(file.read_text())["hand_model"]
    short = model | {"landmark_rest_positions": model["landmark_rest_positions"][:20]}
    file.write_text(json.dumps({"hand_model": short}))
    _refused(r"landmark_rest_positions has shape \(20, 3\)", tmp_path)
    late = model | {"joint_parent": [float(j) for j in range(22)]}
    file.write_text(json.dumps({"hand_model": late}))
    _refused("joint_parent must name earlier joints", tmp_path)
    lost = model | {"joint_frame_index": [255.0] * 22}
    file.write_text(json.dumps({"hand_model": lost}))
    _refused("no joint moves bones", tmp_path)
    file.write_text("{}")
    _refused("not a hand profile", tmp_path)


@pytest.mark.parametrize("wrong", ["Aria", "Vision"])
def test_wrong_headset(tmp_path, scene, wrong):
    folder = write(tmp_path, scene)
    file = folder / "metadata.json"
    file.write_text(file.read_text().replace("Quest3", wrong))
    told = {"Aria": "Aria means z up, but", "Vision": "headset 'Vision'; allowed"}
    _refused(told[wrong], tmp_path)


def test_wrong_rate(tmp_path):
    write(tmp_path, make_scene(60, seconds=1.6), masks=())
    folder = tmp_path / NAME
    for file in folder.glob("*.*"):
        text = file.read_text()
        for frame in range(96, -1, -1):
            old = 43_124_400_000_000 + round(frame * 1e9 / 30)
            text = text.replace(str(old), str(43_124_400_000_000 + frame * 16_666_667))
        file.write_text(text)
    _refused("60.00 frames a second", tmp_path)


def test_no_object_or_hand_is_left(tmp_path, scene):
    write(tmp_path, scene, coffee_pot=True)
    library = tmp_path / "object_library"
    for file in library.glob("*.glb"):
        file.rename(library / f"9{file.name}")
    _refused("none of its objects.*box, block, coffee_pot", tmp_path)


def test_no_hand_is_left(tmp_path, scene):
    write(
        tmp_path,
        scene,
        no_hands=range(1, FRAMES),
        masks=("qa_pass",),
        forbidden={"qa_pass": {0: ("1201-1", "1201-2")}},
    )
    _refused("no hand is tracked", tmp_path)
