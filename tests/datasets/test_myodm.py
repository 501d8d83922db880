"""MyoDM: fetched from a package file, read by the hand's kinematics."""

import hashlib
import subprocess

import numpy as np
import pytest
from layouts.myodm import BONE, FRAMES, PALM, write_wheel

from flashdex.datasets import fetch as fetching
from flashdex.datasets.fetch import UnknownDatasetError, fetch, myodm_dir
from flashdex.datasets.myodm import list_myodm, myohand_keypoints, read_clip
from flashdex.datasets.source import SourceOptions
from flashdex.errors import DemoError


@pytest.fixture
def wheel(tmp_path, monkeypatch):
    file = write_wheel(tmp_path / "myosuite.whl")
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    monkeypatch.setattr(fetching, "WHEEL_SHA256", digest)
    return file


@pytest.fixture
def folder(wheel, tmp_path):
    return fetch("myodm", tmp_path / "data", wheel=wheel)


def test_only_what_is_needed_is_taken_out(folder):
    found = {str(f.relative_to(folder)) for f in folder.rglob("*") if f.is_file()}
    assert found == {
        "clips/cup_lift.npz",
        "clips/knife_lift.npz",
        "meshes/cup.stl",
        "meshes/knife.stl",
        "myohand_body.xml",
        "source.json",
        "LICENSE",
        "LICENSE.hand",
        "LICENSE.objects",
    }


def test_complete_folder_is_not_fetched_again(folder, monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("pip was called")

    monkeypatch.setattr(subprocess, "run", refuse)
    assert fetch("myodm", folder) == folder


@pytest.mark.parametrize(
    "damage",
    [
        pytest.param(lambda file: file.unlink(), id="missing"),
        pytest.param(lambda file: file.write_bytes(b""), id="empty"),
        pytest.param(
            lambda file: file.write_bytes(file.read_bytes()[:-1] + b"?"), id="changed"
        ),
    ],
)
def test_interrupted_or_changed_folder_is_refused_and_kept(folder, wheel, damage):
    damage(folder / "meshes/cup.stl")
    with pytest.raises(DemoError, match="empty folder"):
        fetch("myodm", folder, wheel=wheel)
    assert (folder / "clips/cup_lift.npz").is_file()


def test_other_package_file_is_refused(wheel, tmp_path, monkeypatch):
    monkeypatch.setattr(fetching, "WHEEL_SHA256", "0" * 64)
    with pytest.raises(DemoError, match="sha256"):
        fetch("myodm", tmp_path / "other", wheel=wheel)
    assert not (tmp_path / "other").exists()
    assert not list(tmp_path.glob(".fetch-*"))


def test_failed_download_names_a_way_out(tmp_path, monkeypatch):
    def fail(command, **kwargs):
        return subprocess.CompletedProcess(command, 1, "", "ERROR: no network\n")

    monkeypatch.setattr(subprocess, "run", fail)
    with pytest.raises(DemoError, match=r"no network.*--wheel"):
        fetch("myodm", tmp_path / "data")


def test_unknown_dataset_is_refused(tmp_path):
    with pytest.raises(UnknownDatasetError, match="myodm"):
        fetch("myodn", tmp_path)


def test_keypoints_in_the_zero_pose_are_sums_of_offsets(folder):
    points = myohand_keypoints(folder / "myohand_body.xml", np.zeros((1, 29)))[0]
    arm = np.array([0.1 - 0.175, -0.55 + 0.1, 0.32])  # 1.4 m down and up again
    turn = np.diag([-1.0, -1.0, 1.0])  # the arm is turned by 3.14, not quite pi
    wrist = np.array([0.0, PALM[0], 0.0])
    knuckle = wrist + np.array([PALM[2] * 0.5, 0.09, 0.0])
    tip = knuckle + np.array([0, 2 * BONE + 0.02, 0])
    for place, local in ((0, wrist), (9, knuckle), (12, tip)):
        np.testing.assert_allclose(points[place], arm + turn @ local, atol=1e-3)


def test_finger_joint_turns_its_own_finger_only(folder):
    bent = np.zeros((2, 29))
    bent[1, 13] = np.pi / 2  # mcp2_flexion, after 6 root, 3 wrist and 4 thumb joints
    straight, curled = myohand_keypoints(folder / "myohand_body.xml", bent)
    moved = np.linalg.norm(curled - straight, axis=-1) > 1e-9
    assert np.flatnonzero(moved).tolist() == [6, 7, 8]
    reach = 2 * BONE + 0.02
    np.testing.assert_allclose(
        np.linalg.norm(curled[8] - straight[8]), np.sqrt(2) * reach, atol=1e-6
    )


def test_heights_are_absolute_where_the_first_pose_has_six_entries(folder):
    lifted = read_clip(folder / "clips/cup_lift.npz")[0]
    absolute = read_clip(folder / "clips/knife_lift.npz")[0]
    np.testing.assert_allclose(lifted.objects[0].pose[:, 2], 0.075)
    np.testing.assert_allclose(absolute.objects[0].pose[:, 2], 0.04)
    rise = lifted.keypoints["right"][-1] - lifted.keypoints["right"][0]
    np.testing.assert_allclose(rise, np.tile([0, 0, 0.1], (21, 1)), atol=1e-9)
    assert lifted.num_frames == FRAMES
    assert lifted.task == "lift"
    assert lifted.provenance["sha256"] == fetching.WHEEL_SHA256


def test_missing_folder_says_how_to_fetch(tmp_path):
    with pytest.raises(DemoError, match="flashdex fetch myodm"):
        list_myodm(SourceOptions(path=tmp_path))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"robot": np.zeros((FRAMES, 28))}, "robot"),
        ({"object": np.zeros((FRAMES - 1, 7))}, "object"),
        ({"time": np.arange(FRAMES) * 0.01}, "time"),
        ({"object": np.full((FRAMES, 7), "x")}, "float"),
    ],
)
def test_broken_clip_is_refused_with_its_name(folder, change, told):
    file = folder / "clips/cup_lift.npz"
    data = dict(np.load(file)) | change
    np.savez(file, **data)
    with pytest.raises(DemoError, match=rf"cup_lift\.npz.*{told}"):
        read_clip(file)


def test_hand_tree_with_entities_is_refused(folder):
    tree = folder / "myohand_body.xml"
    tree.write_text("<!DOCTYPE x [<!ENTITY a 'aa'>]>" + tree.read_text())
    with pytest.raises(DemoError, match="DOCTYPE"):
        read_clip(folder / "clips/cup_lift.npz")


def test_recorded_clips_agree_with_the_reference(demos):
    if not (myodm_dir() / "source.json").is_file():
        pytest.skip("MyoDM is not fetched; run: flashdex fetch myodm")
    wanted = sorted((demos / "myodm").glob("*.npz"))
    assert len(wanted) == 12
    for file in wanted:
        demo = read_clip(myodm_dir() / "clips" / file.name)[0]
        with np.load(file, allow_pickle=False) as data:
            points, pose = data["kp_right"], data["obj_pose"]
        np.testing.assert_allclose(demo.keypoints["right"], points, atol=1e-6)
        found = demo.objects[0].pose
        np.testing.assert_allclose(found[:, :3], pose[:, :3], atol=1e-6)
        same = np.abs((found[:, 3:] * pose[:, 3:]).sum(-1))
        np.testing.assert_allclose(same, 1.0, atol=1e-6)
