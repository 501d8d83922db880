"""What fails for want of memory or by a disk is no fault of the data: tried again."""

import errno
import json
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh

from flashdex.datasets import list_recordings
from flashdex.datasets.procedural.reader import procedural
from flashdex.datasets.source import SourceOptions
from flashdex.errors import DemoError, MeshError, is_of_machine
from flashdex.motions.pipeline.motion import MotionSettings
from flashdex.motions.pipeline.workers import Job, run_job
from flashdex.objects import decompose
from flashdex.objects.asset import ObjectSettings, make_object
from flashdex.objects.meshes import load_mesh

FAILURES = {
    "memory": MemoryError(),
    "disk": OSError(errno.EIO, "Input/output error"),
    "no_space": OSError(errno.ENOSPC, "No space left on device"),
    "too_many_files": OSError(errno.EMFILE, "Too many open files"),
    "stale_network_disk": OSError(errno.ESTALE, "Stale file handle"),
    "torch": RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"),
    "simulator": ValueError("Error: engine error: Could not allocate memory"),
    "threads": RuntimeError("can't start new thread"),
    "not_allowed_yet": PermissionError(errno.EACCES, "Permission denied"),
}
machine = pytest.mark.parametrize("failure", FAILURES.values(), ids=FAILURES)


@pytest.fixture
def fail_once(monkeypatch):
    """The first time that a file of this ending is opened, it fails."""
    real = Path.open

    def arm(suffix, failure):
        left = [failure]

        def flaky(path, *args, **kwargs):
            if path.suffix == suffix and left:
                raise left.pop()
            return real(path, *args, **kwargs)

        monkeypatch.setattr(Path, "open", flaky)
        return left

    return arm


@machine
@pytest.mark.parametrize("suffix", [".npz", ".obj"])
def test_failed_reading_is_not_kept(
    tmp_path, write_keypoints, fail_once, failure, suffix
):
    demo = procedural(0, kinds=["pick_box_right"])[0].cut(0, 40, name="clip")
    folder = write_keypoints(demo)
    # a piece needs the table of the whole recording, and so the mesh
    spans = [{"clip": "clip", "start": 0, "end": 30}]
    (folder / "segments.json").write_text(json.dumps(spans))
    settings = MotionSettings(attempts=1, cache_dir=tmp_path / "cache")
    (listed,) = list_recordings("keypoints", SourceOptions(path=folder))
    job = Job(listed, settings)
    run_job(Job(replace(listed, name="other"), settings))  # hashes are known
    left = fail_once(suffix, failure)
    reasons = [run_job(job).rows[0]["reason"].split(":")[0] for _ in range(2)]
    assert not left
    assert reasons == ["E_MACHINE", "R_SHORT"]


@machine
def test_a_mesh_is_not_called_broken_when_the_machine_is(tmp_path, fail_once, failure):
    demo = procedural(0, kinds=["pick_box_right"])[0]
    file = tmp_path / "box.obj"
    demo.objects[0].load_mesh().export(file)
    fail_once(".obj", failure)
    with pytest.raises(type(failure)):
        load_mesh(file)
    assert len(load_mesh(file).faces)


@machine
def test_an_object_is_not_made_of_one_hull_when_the_machine_fails(
    tmp_path, monkeypatch, failure
):
    def fails(*_, **__):
        raise failure

    monkeypatch.setattr(decompose, "run_limited", fails)
    torus = trimesh.creation.torus(0.04, 0.01, major_sections=12, minor_sections=8)
    with pytest.raises(type(failure)):
        make_object(
            torus, settings=ObjectSettings(sdf_resolution=8), cache_dir=tmp_path
        )
    assert not list(tmp_path.glob("objects/*.npz"))


def test_what_nobody_foresaw_is_not_kept(tmp_path, write_keypoints, monkeypatch):
    demo = procedural(0, kinds=["pick_box_right"])[0].cut(0, 40, name="clip")
    (listed,) = list_recordings("keypoints", SourceOptions(path=write_keypoints(demo)))
    left = [RuntimeError("can't start new thread")]

    def fail(*_):
        raise left.pop() if left else DemoError("seen again", code="AGAIN")

    monkeypatch.setattr("flashdex.motions.pipeline.motion.repair", fail)
    monkeypatch.setattr("flashdex.motions.pipeline.motion.settle_objects", fail)
    job = Job(listed, MotionSettings(attempts=1, cache_dir=tmp_path / "cache"))
    reasons = [run_job(job).rows[0]["reason"].split(":")[0] for _ in range(2)]
    assert reasons == ["E_MACHINE", "AGAIN"]


@pytest.mark.parametrize(
    "error",
    [
        FileNotFoundError(errno.ENOENT, "none"),
        IsADirectoryError(errno.EISDIR, "folder"),
        OSError(errno.ENAMETOOLONG, "long"),
        OSError("said by a library"),
        ValueError("content"),
        DemoError("refused"),
        MeshError("refused"),
        RuntimeError("shapes differ"),
    ],
    ids=repr,
)
def test_faults_of_the_data_are_kept(error):
    assert not is_of_machine(error)
