import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch
import trimesh

from flashdex.errors import LibraryError
from flashdex.motions import library_writer
from flashdex.motions.library import MotionLibrary
from flashdex.motions.library_format import FRAME_KEYS
from flashdex.motions.library_writer import LibraryWriter, MotionRecord
from flashdex.motions.velocities import derive_velocities
from flashdex.objects.asset import ObjectSettings, make_object

SHAPES = {
    "joint_pos": (2, 18),
    "joint_vel": (2, 18),
    "wrist_pos": (2, 3),
    "wrist_quat": (2, 4),
    "wrist_linvel": (2, 3),
    "wrist_angvel": (2, 3),
    "keypoints": (2, 21, 3),
    "keypoint_linvel": (2, 21, 3),
    "tip_dist": (2, 5),
    "object_pos": (2, 3),
    "object_quat": (2, 4),
    "object_linvel": (2, 3),
    "object_angvel": (2, 3),
}
LENGTHS = (7, 31, 12)


@pytest.fixture(scope="module")
def assets(tmp_path_factory):
    settings = ObjectSettings(sdf_resolution=12)
    cache = tmp_path_factory.mktemp("cache")
    sizes = [(0.04, 0.05, 0.06), (0.03, 0.03, 0.03)]
    return [
        make_object(
            trimesh.creation.box(s), settings=settings, cache_dir=cache, name="box"
        )
        for s in sizes
    ]


def draw(rng, key, shape):
    values = rng.normal(size=shape)
    if key.endswith("_quat"):
        return values / np.linalg.norm(values, axis=-1, keepdims=True)
    # decimetres: a recording moves no faster than a few metres a second
    return np.abs(values) if key == "tip_dist" else 0.1 * values


def make_record(name, frames, objects, seed):
    rng = np.random.default_rng(seed)
    drawn = {k: draw(rng, k, (frames, *s)) for k, s in SHAPES.items()}
    return MotionRecord(
        name=name,
        frames=drawn | derive_velocities(drawn, 60.0),
        hand_active=(False, True),
        hand_object=(-1, 0),
        objects=objects,
        support_disks=np.full((4, 5), np.nan),
        info={"source": "test", "licence": "none"},
    )


@pytest.fixture
def records(assets):
    slots = [assets[:1], assets, assets[1:]]
    return [make_record(f"m{i}", LENGTHS[i], slots[i], i) for i in range(3)]


def write(records, path):
    writer = LibraryWriter(path, hand="xhand", fps=60.0)
    for record in records:
        writer.add(record)
    return writer.write(report="motion\n")


def test_round_trip(records, assets, tmp_path):
    library = MotionLibrary.load(write(records, tmp_path / "lib"))
    assert library.names == ["m0", "m1", "m2"]
    assert (library.fps, library.hand, library.num_motions) == (60.0, "xhand", 3)
    assert set(SHAPES) == set(FRAME_KEYS)
    for key in FRAME_KEYS:
        wanted = np.concatenate([r.frames[key] for r in records]).astype(np.float32)
        np.testing.assert_array_equal(library.frames[key].numpy(), wanted)
    assert library.motions["object_index"].tolist() == [[0, -1], [0, 1], [1, -1]]
    assert library.motions["hand_active"].dtype == torch.bool
    for row, asset in enumerate(assets):
        for saved, part in zip(library.parts(row), asset.parts, strict=True):
            np.testing.assert_allclose(saved, part, atol=1e-7)
        np.testing.assert_array_equal(library.objects["points"][row], asset.points)
        assert library.visual(row).volume == pytest.approx(
            np.prod(asset.aabb[1] - asset.aabb[0]), rel=1e-4
        )


def test_index_clamps_like_brute_force(records, tmp_path):
    library = MotionLibrary.load(write(records, tmp_path / "lib"))
    motion = torch.arange(3)[:, None].expand(3, 80)
    frame = torch.arange(-20, 60).expand(3, 80)
    got = library.index(motion, frame)
    for m in range(3):
        rows = range(sum(LENGTHS[:m]), sum(LENGTHS[: m + 1]))
        for f in range(-20, 60):
            assert got[m, f + 20] == rows[min(max(f, 0), LENGTHS[m] - 1)]
    gathered = library.at(motion, frame)["tip_dist"]
    torch.testing.assert_close(gathered[1, 25], library.frames["tip_dist"][7 + 5])


def test_equal_objects_are_stored_once(records, tmp_path):
    path = write(records, tmp_path / "lib")
    (meshes,) = path.glob("data-*/meshes")
    assert sorted(p.name for p in meshes.iterdir()) == ["box", "box_2"]


def test_failure_leaves_nothing_and_keeps_the_old(records, tmp_path, monkeypatch):
    path = write(records[:1], tmp_path / "lib")

    def disk_full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(library_writer, "write_meshes", disk_full)
    with pytest.raises(LibraryError, match=r"No space left.*[Cc]heck free"):
        write(records, path)
    assert [p.name for p in tmp_path.iterdir()] == ["lib"]
    assert MotionLibrary.load(path).names == ["m0"]


def test_unwritable_folder_is_a_library_error(records, tmp_path):
    if os.geteuid() == 0:
        blocked = tmp_path / "file"
        blocked.write_text("in the way")
    else:
        blocked = tmp_path / "locked"
        blocked.mkdir(mode=0o500)
    with pytest.raises(LibraryError, match="could not write"):
        write(records, blocked / "lib")


def test_replaces_only_libraries(records, tmp_path):
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "thesis.txt").write_text("precious")
    with pytest.raises(LibraryError, match="is not a motion library"):
        write(records, tmp_path / "lib")
    assert (tmp_path / "lib" / "thesis.txt").read_text() == "precious"
    shutil.rmtree(tmp_path / "lib")
    write(records, tmp_path / "lib")
    assert MotionLibrary.load(write(records[:2], tmp_path / "lib")).num_motions == 2
    assert [p.name for p in tmp_path.iterdir()] == ["lib"]


KILLED = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
import test_library as t
from flashdex.motions import library_writer
from flashdex.motions.velocities import derive_velocities
from flashdex.objects.asset import ObjectSettings, make_object
import trimesh
coarse = ObjectSettings(sdf_resolution=12)
mesh = trimesh.creation.box((0.04, 0.05, 0.06))
box = make_object(mesh, name="box", settings=coarse, cache_dir=Path(sys.argv[3]))
def stall(*_):
    Path(sys.argv[3], "reached").touch()
    time.sleep(60)
library_writer.hash_rows = stall
t.write([t.make_record("m0", 7, [box], 0)], Path(sys.argv[1]) / "lib")
"""


def test_kill_in_the_middle_leaves_no_library(tmp_path):
    folder, cache = tmp_path / "out", tmp_path / "cache"
    cache.mkdir()
    arguments = [str(folder), os.path.dirname(__file__), str(cache)]
    root = os.path.dirname(os.path.dirname(os.path.dirname(__file__)))
    env = {**os.environ, "PYTHONPATH": root}
    child = subprocess.Popen([sys.executable, "-c", KILLED, *arguments], env=env)
    deadline = time.time() + 120
    while not (cache / "reached").exists() and time.time() < deadline:
        assert child.poll() is None
        time.sleep(0.05)
    child.send_signal(signal.SIGKILL)
    child.wait()
    with pytest.raises(LibraryError, match=r"not a motion library: no manifest\.json"):
        MotionLibrary.load(folder / "lib")
    # the next writer removes what the killed one left
    box = make_object(trimesh.creation.box((0.04, 0.05, 0.06)), cache_dir=cache)
    path = write([make_record("m0", 7, [box], 0)], folder / "lib")
    assert MotionLibrary.load(path).names == ["m0"]
    assert len([p for p in path.iterdir() if "data-" in p.name]) == 1


def test_nothing_and_twice_are_refused(records, tmp_path):
    with pytest.raises(LibraryError, match="nothing to write"):
        write([], tmp_path / "lib")
    with pytest.raises(LibraryError, match="two motions are called 'm0'"):
        write([records[0], records[0]], tmp_path / "lib")
    del records[1].frames["tip_dist"]
    with pytest.raises(LibraryError, match="tip_dist"):
        write(records, tmp_path / "lib")
    assert not (tmp_path / "lib").exists()
