"""Files that are damaged or made to harm: refused, and never written outside."""

import json
import shutil
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

import flashdex
from flashdex.cli.main import main
from flashdex.datasets import list_recordings
from flashdex.datasets.fetch import fetch
from flashdex.datasets.hot3d.files import Track, frame_axis
from flashdex.datasets.procedural.reader import procedural
from flashdex.datasets.source import Recording, SourceOptions
from flashdex.datasets.spider.reader import known_files, read_objects
from flashdex.datasets.tracks import palm_frame
from flashdex.errors import DemoError, LibraryError, MeshError
from flashdex.motions.library_writer import LibraryWriter, _unique_names
from flashdex.motions.pipeline import cache as motion_cache
from flashdex.motions.pipeline.motion import MotionSettings
from flashdex.motions.pipeline.workers import Job, run_job
from flashdex.objects import mesh_files
from flashdex.objects.asset import ObjectSettings, make_object
from flashdex.objects.meshes import load_mesh

BOX = trimesh.creation.box((0.05, 0.05, 0.05))


@pytest.mark.parametrize(
    "name", ["../../out", "/tmp/out", "..", "", "a/b", "a\0b", "\udcff", "x" * 300]
)
def test_object_names_are_plain_folders(tmp_path, name):
    asset = make_object(
        BOX, settings=ObjectSettings(sdf_resolution=12), cache_dir=tmp_path, name="a"
    )
    object.__setattr__(asset, "name", name)
    for folder in _unique_names([asset, asset]):
        path = tmp_path / "meshes" / folder
        path.mkdir(parents=True)
        assert path.resolve().parent == (tmp_path / "meshes").resolve()


def test_numbered_names_do_not_meet_names_with_a_number(tmp_path):
    asset = make_object(
        BOX, settings=ObjectSettings(sdf_resolution=12), cache_dir=tmp_path, name="a"
    )
    other = make_object(
        BOX, settings=ObjectSettings(sdf_resolution=12), cache_dir=tmp_path, name="a_2"
    )
    assert _unique_names([other, asset, asset]) == ["a_2", "a", "a_3"]


def test_changed_hand_model_or_keys_are_another_result(tmp_path, monkeypatch):
    root = tmp_path / "flashdex"
    shutil.copytree(Path(flashdex.__file__).parent, root)
    monkeypatch.setattr(flashdex, "__file__", str(root / "__init__.py"))
    hashes = [motion_cache._code_hash.__wrapped__()]
    for part in ("hands/xhand/left.xml", "keys.py", "motions/align.py"):
        with (root / part).open("a") as file:
            file.write("\n")
        hashes.append(motion_cache._code_hash.__wrapped__())
    assert len(set(hashes)) == 4


def break_entry(file, name):
    """Spoils the compressed bytes of one entry."""
    with zipfile.ZipFile(file) as archive:
        start = archive.getinfo(name).header_offset + 30 + len(name) + 20
    data = bytearray(file.read_bytes())
    data[start : start + 10] = bytes(b ^ 0xFF for b in data[start : start + 10])
    file.write_bytes(data)


@pytest.mark.parametrize(
    ("source", "entry"), [("keypoints", "object"), ("fdr", "obj_left_id")]
)
def test_damaged_archive_is_listed_and_refused_when_read(tmp_path, source, entry):
    file = tmp_path / "clip.npz"
    np.savez_compressed(file, **{entry: "box"})
    break_entry(file, f"{entry}.npy")
    (listed,) = list_recordings(source, SourceOptions(path=tmp_path))
    with pytest.raises(DemoError, match=r"clip\.npz: not a readable"):
        listed.read()


def test_array_that_announces_terabytes_is_refused(tmp_path):
    file = tmp_path / "clip.npz"
    head = {"descr": "<f8", "fortran_order": False, "shape": (10**13,)}
    with zipfile.ZipFile(file, "w") as archive, archive.open("object.npy", "w") as out:
        np.lib.format.write_array_header_1_0(out, head)
    (listed,) = list_recordings("keypoints", SourceOptions(path=tmp_path))
    with pytest.raises(DemoError, match="are not sizes"):
        listed.read()


@pytest.mark.parametrize("name", ["x" * 5000, "../box"])
def test_impossible_object_name_does_not_end_the_listing(tmp_path, name):
    np.savez(tmp_path / "clip.npz", object=name)
    assert list_recordings("keypoints", SourceOptions(path=tmp_path))


def test_archives_are_no_meshes(tmp_path):
    file = tmp_path / "mesh.zip"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("mesh.obj", BOX.export(file_type="obj"))
    with pytest.raises(MeshError, match=r"mesh\.zip: not readable as a mesh"):
        load_mesh(file)


def test_scene_that_repeats_a_mesh_too_often_is_refused(tmp_path, monkeypatch):
    file = tmp_path / "scene.glb"
    data = bytearray(trimesh.Scene(BOX).export(file_type="glb"))
    (length,) = struct.unpack_from("<I", data, 12)
    scene = json.loads(data[20 : 20 + length])
    place = next(i for i, node in enumerate(scene["nodes"]) if "mesh" in node)
    count = len(scene["nodes"])
    scene["nodes"] += [scene["nodes"][place]] * 9
    scene["scenes"][0]["nodes"] += range(count, count + 9)
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    size = struct.pack("<II", 20 + len(text) + len(rest), len(text))
    file.write_bytes(b"glTF\2\0\0\0" + size + b"JSON" + text + rest)
    assert len(load_mesh(file).faces) == 120
    monkeypatch.setattr(mesh_files, "MAX_FACES", 119)
    with pytest.raises(MeshError, match="120 triangles; at most 119"):
        load_mesh(file)


def test_one_wrong_stamp_does_not_fill_the_memory():
    stamps = np.concatenate([[0], 17 * 10**17 + np.arange(60) * 33_333_333])
    track = Track(stamps, np.zeros((61, 7)))
    with pytest.raises(DemoError, match="the longest step 1700000000 s"):
        frame_axis("P0001", [track], None)


def spider(folder, info):
    """A folder with one mesh and an info."""
    mesh = folder / "box" / "visual.obj"
    mesh.parent.mkdir()
    BOX.export(mesh)
    (folder / "task_info.json").write_text(json.dumps(info))
    return folder / "trajectory_keypoints.npz", mesh


def test_mesh_that_one_side_lacks_hides_no_files_of_the_other(tmp_path):
    info = {"left_object_mesh_dir": "none", "right_object_mesh_dir": "box"}
    file, mesh = spider(tmp_path, info)
    assert known_files(file, None) == (tmp_path / "task_info.json", mesh)


def test_object_on_both_sides_counts_once_where_it_is_not_tracked(tmp_path):
    info = {"left_object_mesh_dir": "box", "right_object_mesh_dir": "box"}
    file, _ = spider(tmp_path, info)
    pose = np.tile([0.1, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (5, 1))
    pose[2] = 0.0
    data = {"qpos_obj_left": pose, "qpos_obj_right": pose.copy()}
    assert len(read_objects(data, file, info, None)) == 1


def test_deep_info_does_not_end_the_listing(tmp_path):
    np.savez(tmp_path / "trajectory_keypoints.npz", a=1)
    (tmp_path / "task_info.json").write_text("[" * 200_000)
    (listed,) = list_recordings("spider", SourceOptions(path=tmp_path))
    with pytest.raises(DemoError, match="not readable JSON"):
        listed.read()


def test_names_do_not_steer_the_terminal(tmp_path, capsys):
    np.savez(tmp_path / "a\x1b[2Jb.npz", object="box")
    words = ["prepare", "--dry-run", "--source", "keypoints", "--input", str(tmp_path)]
    assert main(words) == 0
    assert "a?[2Jb  1 files" in capsys.readouterr().out


def test_fetch_into_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(DemoError, match="empty folder"):
        fetch("myodm", tmp_path / "file")


def make_box():
    return procedural(0, kinds=["pick_box_right"])


@pytest.fixture
def job(tmp_path):
    small = ObjectSettings(sdf_resolution=24)
    cache = tmp_path / "cache"
    settings = MotionSettings(
        control_hz=15.0, objects=small, attempts=1, cache_dir=cache
    )
    return Job(Recording(name="box", read=make_box), settings)


def test_objects_that_cannot_be_cached_do_not_cost_the_motion(job):
    root = job.settings.cache_dir
    root.mkdir()
    (root / "objects").write_text("no folder")
    (kept,) = run_job(job).load(root)
    assert kept.record is not None


def test_cache_that_is_cleaned_meanwhile_is_told(job):
    outcome = run_job(job)
    shutil.rmtree(job.settings.cache_dir / "objects")
    with pytest.raises(LibraryError, match="Start again"):
        outcome.load(job.settings.cache_dir)


def test_hand_of_zeros_is_a_hand_that_was_not_tracked():
    points = make_box()[0].keypoints["right"].copy()
    points[3] = 0.0
    palm = palm_frame(points, "right")
    assert np.flatnonzero(np.isnan(palm).any(axis=1)).tolist() == [3]
    np.testing.assert_array_equal(palm[4:], palm_frame(points[4:], "right"))


def test_report_takes_names_that_are_no_characters(job, tmp_path):
    (kept,) = run_job(job).load(job.settings.cache_dir)
    writer = LibraryWriter(tmp_path / "library", hand="xhand", fps=15.0)
    writer.add(kept.record)
    path = writer.write(report="motion\na\udcff\n")
    assert (path / "report.csv").read_text() == "motion\na\\udcff\n"
