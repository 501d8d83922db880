import csv

import numpy as np
import pytest
import torch
import trimesh

from flashdex.datasets.demo import DemoObject
from flashdex.datasets.keypoints import read_keypoints
from flashdex.datasets.procedural.reader import procedural
from flashdex.datasets.source import SourceOptions
from flashdex.errors import DemoError, LibraryError, UnknownSourceError
from flashdex.motions.align import align
from flashdex.motions.checks.recording import check_demo
from flashdex.motions.contact.roles import find_roles
from flashdex.motions.findings import status_of
from flashdex.motions.library import MotionLibrary
from flashdex.motions.pipeline.motion import MotionSettings, prepare_motion
from flashdex.motions.pipeline.prepare import Order, run_order
from flashdex.objects.asset import ObjectSettings

QUICK = ObjectSettings(sdf_resolution=40)


def prepare(source, path=None, *, out, workers=1, **settings):
    options = SourceOptions(path=path)
    order = Order(source, options, MotionSettings(**settings))
    return run_order(order, out, workers=workers)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def library(tmp_path_factory, cache):
    out = tmp_path_factory.mktemp("out") / "lib"
    kinds = "pick_box_right,turn_sphere_left"
    return prepare(
        "procedural", kinds, out=out, control_hz=30.0, objects=QUICK, cache_dir=cache
    )


def test_library_holds_what_the_motion_did(library):
    assert library.names == ["pick_box_right", "turn_sphere_left"]
    assert library.motions["hand_active"].tolist() == [[False, True], [True, False]]
    assert library.motions["hand_object"].tolist() == [[-1, 0], [0, -1]]
    demo = procedural(0, kinds=["pick_box_right"])[0]
    rows = slice(0, int(library.motions["length"][0]))
    frames = library.frames[rows]
    every = slice(None, None, 2)  # 60 Hz recorded, 30 Hz prepared
    wanted = demo.keypoints["right"][every]
    np.testing.assert_allclose(frames["keypoints"][:, 1], wanted, atol=1e-6)
    pose = demo.objects[0].pose[every]
    np.testing.assert_allclose(frames["object_pos"][:, 0], pose[:, :3], atol=1e-6)
    np.testing.assert_allclose(frames["object_quat"][:, 0], pose[:, 3:], atol=1e-6)
    assert (frames["tip_dist"][:, 0] == 10.0).all()
    assert frames["tip_dist"][:, 1].min() < 0.005
    assert torch.isfinite(library.frames["joint_vel"]).all()
    assert library.frames["joint_pos"].dtype == torch.float32


def test_velocities_integrate_to_positions(library):
    length = int(library.motions["length"][0])
    # smoothed over two frames of 30 Hz: millimetres late in a reach of 15 cm
    for value, rate in [("object_pos", "object_linvel"), ("joint_pos", "joint_vel")]:
        track = library.frames[value][:length, :, :3].numpy()
        speed = library.frames[rate][:length, :, :3].numpy()
        moved = np.cumsum((speed[1:] + speed[:-1]) / 60, axis=0)
        np.testing.assert_allclose(moved, track[1:] - track[0], atol=0.008)


def test_report_has_a_row_a_motion(library):
    with open(library.path / "report.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [r["motion"] for r in rows] == library.names
    assert {r["status"] for r in rows} <= {"kept", "flagged"}
    for row in rows:
        assert float(row["tip_error_median_mm"]) < 12
        assert float(row["penetration_max_mm"]) < 4
        assert float(row["object_travel_m"]) > 0.05
    assert library.manifest["quality"]["kept"] >= 1


def test_seed_decides(tmp_path, cache, library):
    again = prepare(
        "procedural",
        "pick_box_right",
        out=tmp_path / "again",
        control_hz=30.0,
        objects=QUICK,
        cache_dir=cache,
    )
    length = len(again.frames)
    for key in ("joint_pos", "keypoints", "object_pos"):
        torch.testing.assert_close(again.frames[key], library.frames[key][:length])


def test_bad_input_is_refused_before_work(tmp_path):
    with pytest.raises(UnknownSourceError, match="Did you mean 'procedural'"):
        prepare("procedual", out=tmp_path / "lib")
    with pytest.raises(DemoError, match="give --input"):
        prepare("keypoints", out=tmp_path / "lib")
    with pytest.raises(DemoError, match=r"no \.npz recordings"):
        prepare("keypoints", tmp_path, out=tmp_path / "lib")
    assert not (tmp_path / "lib").exists()


def write_recording(folder, name, demo, **changes):
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    demo.objects[0].mesh.export(folder / "meshes" / "box.obj")
    arrays = {
        "fps": np.float32(demo.fps),
        "object": "box",
        "obj_pose": demo.objects[0].pose.astype(np.float32),
        "kp_right": demo.keypoints["right"].astype(np.float32),
    }
    arrays |= changes
    np.savez(
        folder / f"{name}.npz", **{k: v for k, v in arrays.items() if v is not None}
    )


def test_keypoints_reader_and_rejected_rows(tmp_path, cache):
    demo = procedural(0, kinds=["pick_box_right"])[0]
    write_recording(tmp_path / "in", "good", demo)
    broken = demo.keypoints["right"].copy()
    broken[40] = np.nan  # closed; a long one leaves nothing of use
    write_recording(tmp_path / "in", "hole", demo, kp_right=broken)
    broken[50:-40] = np.nan
    write_recording(tmp_path / "in", "holes", demo, kp_right=broken)
    (tmp_path / "in" / "segments.json").write_text(
        '[{"clip": "good", "start": 0, "end": 130}]'
    )
    read = read_keypoints(tmp_path / "in")
    assert [d.name for d in read] == ["good_0_130", "hole", "holes"]
    np.testing.assert_allclose(
        read[0].palm["right"], demo.palm["right"][:130], atol=1e-4
    )
    assert read[0].support_z == pytest.approx(0.0, abs=1e-4)
    library = prepare(
        "keypoints",
        tmp_path / "in",
        out=tmp_path / "lib",
        control_hz=20.0,
        objects=QUICK,
        cache_dir=cache,
    )
    assert library.names == ["good_0_130", "hole"]
    with open(library.path / "report.csv", encoding="utf-8") as file:
        rows = {r["motion"]: r for r in csv.DictReader(file)}
    assert rows["holes"]["status"] == "rejected"
    assert "E_NAN: hands and objects are tracked together" in rows["holes"]["reason"]
    assert "E_NAN" in rows["hole"]["reason"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"obj_pose": None}, "lacks obj_pose"),
        ({"kp_right": None}, "lacks kp_left or kp_right"),
        ({"object": np.array(["box"], dtype=object)}, "not a readable .npz"),
    ],
    ids=["object", "hand", "pickle"],
)
def test_unreadable_recordings_are_named(tmp_path, changes, words):
    demo = procedural(0, kinds=["pick_box_right"])[0]
    write_recording(tmp_path, "clip", demo, **changes)
    with pytest.raises(DemoError, match=words):
        read_keypoints(tmp_path)


def test_segment_outside_of_the_recording(tmp_path):
    demo = procedural(0, kinds=["pick_box_right"])[0]
    write_recording(tmp_path, "clip", demo)
    (tmp_path / "segments.json").write_text(
        '[{"clip": "clip", "start": 9, "end": 999}]'
    )
    with pytest.raises(DemoError, match="segment 9-999"):
        read_keypoints(tmp_path)


def shift_object(demo):
    demo.objects[0].pose[:, 1] += 0.25


def shift_far(demo):
    demo.objects[0].pose[:, 1] += 2.0


def shrink_hand(demo):
    demo.keypoints["right"] *= 0.1


def freeze(demo):
    demo.objects[0].pose[:] = demo.objects[0].pose[0]


def teleport(demo):
    demo.objects[0].pose[60:70:2, 0] += 0.4


def shorten(demo):
    vars(demo).update(vars(demo.cut(0, 50, name=demo.name)))


def stretch(demo):
    demo.fps = 5.0


def sink(demo):
    demo.keypoints["right"][60:100, 8] = demo.objects[0].pose[60:100, :3]


def drop(demo):
    demo.objects[0].pose[:, 2] -= 0.08 * np.linspace(0, 1, demo.num_frames)


@pytest.mark.parametrize(
    ("change", "code", "status"),
    [
        (shift_object, "R_CONTACT", "rejected"),
        (shift_far, "E_UNIT", "rejected"),
        (shrink_hand, "E_UNIT", "rejected"),
        (freeze, "W_STATIC", None),
        (teleport, "W_JUMP", "rejected"),
        (shorten, "R_SHORT", "rejected"),
        (stretch, "R_LONG", "rejected"),
        (sink, "W_PEN", "rejected"),
        (drop, "R_BELOW", "rejected"),
    ],
    ids=lambda v: getattr(v, "__name__", None),
)
def test_codes(change, code, status, cache):
    demo = procedural(0, kinds=["pick_box_right"])[0]
    change(demo)
    settings = MotionSettings(control_hz=20.0, objects=QUICK, cache_dir=cache)
    row = prepare_motion(demo, settings).row
    assert code in row["reason"]
    assert row["status"] == status or status is None


def test_few_jumps_are_flagged_only():
    demo = procedural(0, kinds=["pick_box_right"])[0]
    demo.objects[0].pose[60, 0] += 0.4
    findings = check_demo(demo)
    assert [(f.code, f.level) for f in findings] == [("W_JUMP", "warn")]
    assert status_of(findings) == "flagged"


def test_hopeless_mesh_rejects_its_motion_only(cache):
    demo = procedural(0, kinds=["pick_box_right"])[0]
    flat = trimesh.Trimesh(demo.objects[0].mesh.vertices * [1, 1, 0], [[0, 1, 2]] * 4)
    demo.objects[0] = DemoObject("flat", flat, demo.objects[0].pose)
    row = prepare_motion(demo, MotionSettings(objects=QUICK, cache_dir=cache)).row
    assert row["status"] == "rejected"
    assert row["reason"].startswith("E_MESH")


def test_nothing_kept_is_an_error(tmp_path, cache):
    demo = procedural(0, kinds=["pick_box_right"])[0]
    write_recording(tmp_path / "in", "short", demo.cut(0, 45, name="short"))
    with pytest.raises(LibraryError, match=r"none of 1 motions was kept(.|\n)*R_SHORT"):
        prepare("keypoints", tmp_path / "in", out=tmp_path / "lib", cache_dir=cache)
    assert not (tmp_path / "lib").exists()


@pytest.mark.slow
def test_workers_give_the_same_library(tmp_path, cache, library):
    parallel = prepare(
        "procedural",
        "pick_box_right,turn_sphere_left",
        out=tmp_path / "lib",
        control_hz=30.0,
        workers=2,
        objects=QUICK,
        cache_dir=cache,
    )
    assert parallel.names == library.names
    torch.testing.assert_close(
        parallel.frames["joint_pos"], library.frames["joint_pos"]
    )


def test_recorded_tip_distances_are_met(demos):
    file = demos / "myodm" / "cubesmall_lift.npz"
    aligned = find_roles(align(read_keypoints(file)[0], control_hz=50.0))
    stored = np.load(file)["tipdist_right"]
    np.testing.assert_allclose(aligned.tip_dist[:, 1], stored, atol=2e-4)
    assert aligned.support_z == pytest.approx(0.0, abs=0.002)


def test_recorded_palms_are_met(demos):
    from flashdex.datasets.tracks import palm_frame

    with np.load(demos / "manipnet" / "mug1.npz") as data:
        for side in ("left", "right"):
            palm = palm_frame(data[f"kp_{side}"].astype(float), side)
            same = np.abs(np.sum(palm[:, 3:] * data[f"palm_{side}"][:, 3:], axis=1))
            assert same.min() > 1 - 1e-6


@pytest.mark.slow
def test_real_recordings_become_references(demos, tmp_path, cache):
    library = prepare(
        "keypoints",
        demos / "myodm" / "spheresmall_lift.npz",
        out=tmp_path / "lib",
        objects=QUICK,
        cache_dir=cache,
    )
    assert isinstance(library, MotionLibrary)
    with open(library.path / "report.csv", encoding="utf-8") as file:
        row = next(csv.DictReader(file))
    assert float(row["tip_error_median_mm"]) < 15
    assert float(row["penetration_p95_mm"]) < 4
