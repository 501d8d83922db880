"""Meshes that are missing or far away, and rest under noise: what is made of them."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from flashdex.datasets import list_recordings
from flashdex.datasets.demo import DemoObject
from flashdex.datasets.procedural.reader import procedural
from flashdex.datasets.source import SourceOptions
from flashdex.datasets.support import lowest_points, speeds, still_runs
from flashdex.motions.checks.aligned import check_up
from flashdex.motions.checks.recording import check_demo
from flashdex.motions.pipeline.motion import MotionSettings, prepare_demo
from flashdex.motions.repair.objects import settle_objects
from flashdex.motions.repair.repair import repair

BOX = trimesh.creation.box((0.06, 0.06, 0.06))


@pytest.fixture
def demo(still_demo):
    """A hand, a box that a hand carries round, and a spare one that moves with it."""
    turn = Rotation.from_rotvec(np.linspace(0, 1.5, 30)[:, None] * [0.3, 1, 0.2])
    place = np.linspace(0, 0.2, 30)[:, None] * [1, 0.5, 1]
    pose = np.concatenate([place, turn.as_quat(scalar_first=True)], axis=1)
    return replace(
        still_demo, objects=[DemoObject("box", BOX, pose), DemoObject("b", BOX, pose)]
    )


@pytest.mark.parametrize("fault", ["missing", "no_mesh", "empty"])
def test_bystander_without_a_mesh_is_left_out(demo, tmp_path, fault):
    file = tmp_path / ("lamp.zip" if fault == "no_mesh" else "lamp.ply")
    if fault != "missing":
        file.write_bytes(b"")
    lamp = DemoObject("lamp", file, np.tile(demo.objects[0].pose[:1], (30, 1)))
    made = replace(demo, objects=[lamp, *demo.objects], hand_object={"right": 2})
    out, found = settle_objects(made)
    assert [b.name for b in out.objects] == ["box", "b"]
    assert out.hand_object == {"right": 1}
    assert [(f.code, f.level) for f in found] == [("E_MESH", "warn")]
    moved = replace(lamp, pose=demo.objects[0].pose)
    for change in (
        {"hand_object": {"right": 0}},  # the recording says that it is used
        {"objects": [moved, demo.objects[1]], "hand_object": {}},
        {"objects": [lamp], "hand_object": {}},  # there is nothing else
    ):
        same, found = settle_objects(replace(made, **change))
        assert same.objects[0].name == "lamp"
        assert found == []


@pytest.mark.parametrize("away", [0.0, 0.05, 0.3, 1.0, 5.0])
def test_far_mesh_comes_to_its_frame_and_stays_where_it_is(demo, away):
    shift = np.array([0.6, -0.8, 0.0]) * away
    moved = BOX.copy()
    moved.apply_translation(shift)
    body = demo.objects[0]
    pose = body.pose.copy()
    pose[:, :3] -= Rotation.from_quat(pose[:, 3:], scalar_first=True).apply(shift)
    pose[3] = np.nan
    made = replace(demo, objects=[DemoObject("box", moved, pose), demo.objects[1]])
    out, found = settle_objects(made)
    far = away > 0.1
    assert [f.code for f in found] == ["W_ORIGIN"] * far
    assert ("mesh_shift" in out.provenance) == far
    json.dumps(out.provenance)
    one = out.objects[0]
    centre = BOX.bounds.mean(axis=0) if far else shift
    np.testing.assert_allclose(one.load_mesh().bounds.mean(axis=0), centre, atol=1e-9)
    seen = np.arange(30) != 3
    assert np.isnan(one.pose[3]).all()
    low = lowest_points(one.pose[seen], one.load_mesh().vertices)
    want = lowest_points(body.pose[seen], BOX.vertices)
    np.testing.assert_allclose(low, want, atol=1e-9)
    # what is measured at the origin is measured where the object is
    codes = [f.code for f in repair(out)[1]]
    assert "W_JUMP" not in codes
    if far:
        np.testing.assert_allclose(one.pose[seen], body.pose[seen], atol=1e-9)


def noisy(fps, millimetres, degrees, *, seconds=2.0):
    rng = np.random.default_rng(0)
    count = int(seconds * fps)
    turns = rng.normal(0, np.deg2rad(degrees), (count, 3))
    quats = Rotation.from_rotvec(turns).as_quat(scalar_first=True)
    return np.column_stack([rng.normal(0, 1e-3 * millimetres, (count, 3)), quats])


@pytest.mark.parametrize("fps", [15, 30, 60, 120, 240, 1000])
@pytest.mark.parametrize("noise", [(0, 0), (0.1, 0.05), (1, 0.5), (2, 1.0)])
def test_rest_with_noise_is_rest_at_any_rate(fps, noise):
    runs = still_runs(noisy(fps, *noise), fps)
    assert sum(b - a for a, b in runs) > 0.8 * 2 * fps


@pytest.mark.parametrize("fps", [30, 60, 240])
@pytest.mark.parametrize("noise", [(0, 0), (1, 0.5)])
@pytest.mark.parametrize("speed", [0.06, 0.5])
def test_motion_with_noise_is_motion_at_any_rate(fps, noise, speed):
    pose = noisy(fps, *noise)
    pose[:, 0] += speed * np.arange(len(pose)) / fps
    assert still_runs(pose, fps) == []
    found, _ = speeds(pose, fps)
    np.testing.assert_allclose(np.median(found), speed, atol=0.02)


def test_rest_ends_where_it_ended_without_noise():
    fps = 60
    pose = noisy(fps, 0, 0, seconds=4)
    pose[120:, 0] = 0.4 * np.arange(120) / fps
    ((start, end),) = still_runs(pose, fps)
    assert start == 0
    assert 114 <= end <= 120
    ((_, noised),) = still_runs(
        pose + noisy(fps, 1, 0, seconds=4) * [1, 1, 1, 0, 0, 0, 0], fps
    )
    assert 100 <= noised <= 122


SETTINGS = MotionSettings(attempts=1)
ORDER = [0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20]


def reason(demo):
    """Why a motion is rejected."""
    ((item),) = prepare_demo(demo, SETTINGS)
    assert item.row["status"] == "rejected"
    return item.row["reason"]


def test_causes_are_named(tmp_path):
    (good,) = procedural(0, kinds=["pick_box_right"])
    points = good.keypoints["right"]
    mano = np.empty_like(points)
    mano[:, ORDER] = points
    told = reason(replace(good, keypoints={"right": mano}, palm={}))
    assert "MANO's order" in told
    xyzw = good.palm["right"].copy()
    xyzw[:, 3:] = np.roll(xyzw[:, 3:], -1, axis=1)
    assert "xyzw" in reason(replace(good, palm={"right": xyzw}))


@pytest.mark.parametrize("times", [1, 2, 3, 6])
def test_frames_that_stand_several_times_are_told(times):
    (good,) = procedural(0, kinds=["pick_box_right"])
    held = np.arange(good.num_frames) // times * times
    body = good.objects[0]
    made = replace(
        good,
        keypoints={"right": good.keypoints["right"][held]},
        palm={"right": good.palm["right"][held]},
        objects=[replace(body, pose=body.pose[held])],
    )
    told = [f.text for f in check_demo(made) if f.code == "W_HELD"]
    assert len(told) == (times > 1)
    assert all(f"every frame stands {times} times" in text for text in told)


def test_names_stored_as_bytes_are_names(write_keypoints):
    (good,) = procedural(0, kinds=["pick_box_right"])
    name = good.objects[0].name
    for stored in (np.bytes_(name), np.array([name.encode()])):
        folder = write_keypoints(good, object=stored)
        (recording,) = list_recordings("keypoints", SourceOptions(path=folder))
        assert recording.read()[0].objects[0].name == name
        assert any(file.name == f"{name}.obj" for file in recording.files)


@pytest.mark.parametrize(
    ("sunk", "rise", "told"),
    [
        pytest.param(0.018, 0.13, True, id="another_table_beyond_doubt"),
        pytest.param(0.018, 0.03, False, id="nothing_rises_from_it"),
        pytest.param(0.008, 0.13, False, id="own_table_holds"),
    ],
)
def test_world_that_is_y_up_is_told(sunk, rise, told):
    pose = np.tile([0, 0, 0.3, 1, 0, 0, 0.0], (90, 1))
    way = np.sin(np.linspace(0, np.pi, 60))
    pose[:60, 1] += rise * way
    pose[:60, 2] -= sunk * way
    found = check_up([pose], [BOX.vertices], 30.0)
    assert [f.code for f in found] == ["W_UP"] * told
    assert all("is up +y?" in f.text for f in found)
