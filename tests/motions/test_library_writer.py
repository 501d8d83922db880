"""Where a library is written to, and what is left when the disk refuses."""

import errno
import os
import shutil

import numpy as np
import pytest
from mutations import KINDS, snapshot
from synthetic import make_box
from test_library import make_record, write

from flashdex.errors import LibraryError
from flashdex.motions.library import MotionLibrary
from flashdex.motions.library_writer import LibraryWriter, check_target
from flashdex.motions.pipeline.prepare import Order, run_order
from flashdex.reports.library.report import write_library_report


@pytest.fixture
def record(library):
    """A motion that differs from those of the synthetic library."""
    return make_record("new", 9, [make_box()], 0)


def names_of(path):
    return MotionLibrary.load(path).names


@pytest.fixture
def place(copy, tmp_path, monkeypatch, request):
    """A folder that ``--out`` may name, with an old library or without."""
    match request.param:
        case "new":
            return tmp_path / "new" / "deep"
        case "old":
            return copy
        case "link":
            (tmp_path / "link").symlink_to(copy)
            return tmp_path / "link"
        case "empty":
            (tmp_path / "empty").mkdir()
            return tmp_path / "empty"
        case "here":
            monkeypatch.chdir(copy)
            return "."
        case "relative":
            monkeypatch.chdir(tmp_path)
            return "lib"
        case "left-by-a-kill":
            for name in ("manifest.json", "report.csv"):
                (copy / name).unlink()
            return copy
        case "damaged":
            (copy / "manifest.json").write_text("{")
            return copy
        case "schema-1":
            shutil.rmtree(copy)
            (copy / "frames").mkdir(parents=True)
            (copy / "manifest.json").write_text('{"schema": 1, "motions": []}')
            return copy


PLACES = ["new", "old", "link", "empty", "here", "relative", "left-by-a-kill"]
PLACES += ["damaged", "schema-1"]


@pytest.mark.parametrize("place", PLACES, indirect=True)
def test_the_folder_that_out_names_is_renewed(place, record, tmp_path):
    before = os.path.realpath(place)
    # a mount point is a folder that cannot be another one
    inode = os.stat(place).st_ino if os.path.exists(place) else None
    write([record], place)
    assert names_of(place) == ["new"]
    assert os.path.realpath(place) == before
    assert inode in (None, os.stat(place).st_ino)
    held = [name for name in os.listdir(place) if not name.startswith(".")]
    assert len(held) == 3
    assert sorted(held)[1:] == ["manifest.json", "report.csv"]


def test_a_mount_point_is_renewed(copy, record, monkeypatch):
    real = os.replace, os.rename

    def refuse(make):
        def rename(source, target, **words):
            if os.path.samefile(source, copy):
                raise OSError(errno.EBUSY, "Device or resource busy")
            make(source, target, **words)

        return rename

    monkeypatch.setattr("os.replace", refuse(real[0]))
    monkeypatch.setattr("os.rename", refuse(real[1]))
    write([record], copy)
    assert names_of(copy) == ["new"]


def test_the_same_again_leaves_what_others_read(tmp_path, record):
    first = MotionLibrary.load(write([record], tmp_path / "lib"))
    again = MotionLibrary.load(write([record], tmp_path / "lib"))
    assert first.manifest["data"] == again.manifest["data"]
    assert len(first.parts(0)) == 1
    assert len(os.listdir(tmp_path / "lib")) == 4


def test_the_same_again_mends_what_is_damaged(tmp_path, record):
    path = write([record], tmp_path / "lib")
    (mesh,) = path.glob("data-*/meshes/box/visual.obj")
    mesh.write_text("")
    assert names_of(write([record], path)) == ["new"]


def thesis(path):
    path.mkdir()
    (path / "thesis.txt").write_text("precious")


def extension(path):
    thesis(path)
    (path / "manifest.json").write_text('{"manifest_version": 3}')


REFUSED = {
    "other-files": thesis,
    "other-manifest": extension,
    "file": lambda path: path.write_text("precious"),
    "link-to-nothing": lambda path: path.symlink_to("nowhere"),
    "link-to-a-file": lambda path: path.symlink_to(__file__),
    "fifo": os.mkfifo,
}


@pytest.mark.parametrize("name", [".DS_Store", "lost+found"])
def test_what_a_disk_puts_into_an_empty_folder_is_let_pass(tmp_path, record, name):
    (tmp_path / "out" / name).mkdir(parents=True)
    check_target(tmp_path / "out")
    assert names_of(write([record], tmp_path / "out")) == ["new"]
    assert (tmp_path / "out" / name).is_dir()


def test_a_name_too_long_is_refused_before_the_work(tmp_path):
    with pytest.raises(LibraryError, match="cannot be a path"):
        check_target(tmp_path / ("a" * 300))


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_library_is_refused_before_the_work(tmp_path, monkeypatch, case):
    def work(*_, **__):
        raise AssertionError("worked first")

    monkeypatch.setattr("flashdex.motions.pipeline.prepare.run_jobs", work)
    REFUSED[case](tmp_path / "out")
    before = snapshot(tmp_path)
    with pytest.raises(LibraryError, match="out"):
        run_order(Order("procedural"), tmp_path / "out")
    with pytest.raises(LibraryError, match="out"):
        LibraryWriter(tmp_path / "out", hand="xhand", fps=60.0)
    assert snapshot(tmp_path) == before


def test_a_pipe_among_its_data_is_not_waited_for(copy, record):
    pipe = copy / "data-0123456789abcdef"
    os.mkfifo(pipe)
    assert MotionLibrary.load(write([record], copy)).num_motions == 1
    assert pipe.is_fifo()


@pytest.mark.parametrize("kind", ["folder", "link", "dangling", "fifo"])
@pytest.mark.parametrize("name", ["report.csv", "report.html"])
def test_what_is_no_report_is_refused_and_stays(copy, record, name, kind):
    (copy / name).write_text("mine")
    KINDS[kind](copy / name, np.random.default_rng(0))
    before = snapshot(copy)
    with pytest.raises(LibraryError, match=rf"{name}: is a .*, not a file of its own"):
        write([record], copy)
    if name == "report.html":
        with pytest.raises(LibraryError, match="not a file of its own"):
            write_library_report(MotionLibrary.load(copy), thumbnails=False)
    assert snapshot(copy) == before


def test_a_path_over_a_folder_that_is_not_there_yet_is_checked(tmp_path, record):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/report.csv").write_text("mine")
    with pytest.raises(LibraryError, match="not a motion library"):
        write([record], tmp_path / "new/../mine")
    assert os.listdir(tmp_path / "mine") == ["report.csv"]


@pytest.mark.parametrize("name", ["a\0b", "a" * 300], ids=["nul", "long"])
def test_what_cannot_be_a_path_is_refused(tmp_path, record, name):
    with pytest.raises(LibraryError):
        write([record], tmp_path / name)


def test_what_a_killed_writer_left_is_removed(copy, record):
    for name in ("manifest.json", "report.html"):
        (copy / f".{name}.123.tmp").write_text("torn")
    write([record], copy)
    assert not list(copy.glob(".*.tmp"))


def test_only_data_of_libraries_is_removed(copy, record, tmp_path):
    for name in ("frames", "notes", "data-mine", "data-" + "0" * 15):
        thesis(copy / name)
    thesis(tmp_path / "aside")
    (copy / ("data-" + "1" * 16)).symlink_to(tmp_path / "aside")
    write([record], copy)
    for name in ("frames", "notes", "data-mine", "data-" + "0" * 15):
        assert (copy / name / "thesis.txt").read_text() == "precious"
    assert (tmp_path / "aside" / "thesis.txt").read_text() == "precious"


def test_what_cannot_be_opened_again_is_not_written(copy, record):
    record.frames["wrist_quat"][3] = 0.0
    before = snapshot(copy)
    with pytest.raises(LibraryError, match=r"(?s)not written.*wrist_quat.*'new'"):
        write([record], copy)
    assert snapshot(copy) == before


class Disk:
    """Counts calls that change a disk; the chosen one fails."""

    def __init__(self, monkeypatch, fail_at, error):
        self.calls, self.fail_at, self.error = 0, fail_at, error
        for name in ("replace", "mkdir", "rename"):
            self._wrap(monkeypatch, name, getattr(os, name))
        self._wrap(monkeypatch, "fsync", lambda handle: None)  # slow, and no test of it
        self._wrap_open(monkeypatch)

    def _count(self):
        self.calls += 1
        if self.calls == self.fail_at and self.error is None:
            os._exit(9)  # killed
        if self.calls == self.fail_at:
            raise OSError(self.error, os.strerror(self.error))

    def _wrap(self, monkeypatch, name, real):
        def call(*words, **options):
            self._count()
            return real(*words, **options)

        monkeypatch.setattr(os, name, call)

    def _wrap_open(self, monkeypatch):
        import pathlib

        real = pathlib.Path.open

        def call(path, mode="r", *words, **options):
            file = real(path, mode, *words, **options)
            return Faulty(file, self) if set(mode) & set("wxa+") else file

        monkeypatch.setattr(pathlib.Path, "open", call)


class Faulty:
    """A file whose writes the disk counts; a refused one is half done."""

    def __init__(self, file, disk):
        self._file, self._disk = file, disk

    def write(self, data):
        try:
            self._disk._count()
        except OSError:
            self._file.write(bytes(data)[: len(data) // 2])
            raise
        return self._file.write(data)

    def __getattr__(self, name):
        return getattr(self._file, name)

    def __enter__(self):
        self._file.__enter__()
        return self

    def __exit__(self, *error):
        return self._file.__exit__(*error)


@pytest.fixture(scope="module")
def number_of_calls(library, tmp_path_factory):
    path = tmp_path_factory.mktemp("count") / "lib"
    with pytest.MonkeyPatch.context() as patch:
        disk = Disk(patch, -1, errno.EIO)
        write([make_record("new", 9, [make_box()], 0)], path)
    return disk.calls


@pytest.mark.parametrize("has_old", [False, True], ids=["first", "renewed"])
def test_a_disk_that_refuses_leaves_the_old_or_the_new(
    number_of_calls, copy, record, tmp_path, monkeypatch, has_old
):
    assert number_of_calls > 100
    path = copy if has_old else tmp_path / "fresh"
    for fail_at in range(1, number_of_calls + 1):
        error = (errno.ENOSPC, errno.EIO, errno.EROFS)[fail_at % 3]
        with monkeypatch.context() as patch:
            Disk(patch, fail_at, error)
            try:
                write([record], path)
                told = ""
            except LibraryError as fault:
                told = str(fault)
        if os.strerror(error) in told and not has_old:
            assert not path.exists() or names_of(path) == ["new"], fail_at
            shutil.rmtree(path, ignore_errors=True)
            continue
        assert told == "" or "could not write" in told, fail_at
        found = names_of(path)
        assert found in (["new"], ["right_box", "left_ball", "both"]), fail_at
        left = [name for name in os.listdir(path) if "data-" in name]
        assert len(left) == 1, fail_at


def test_a_kill_at_any_call_leaves_the_old_or_the_new(
    number_of_calls, library, copy, record, tmp_path
):
    """The writer is a process that ends without a word; the next one cleans up."""
    for fail_at in range(3, number_of_calls + 1, number_of_calls // 12):
        child = os.fork()
        if child == 0:
            with pytest.MonkeyPatch.context() as patch:
                Disk(patch, fail_at, None)
                write([record], copy)
            os._exit(0)
        os.waitpid(child, 0)
        assert names_of(copy) in (["new"], library.names), fail_at
    write([record], copy)
    assert names_of(copy) == ["new"]
    assert len([name for name in os.listdir(copy) if "data-" in name]) == 1
