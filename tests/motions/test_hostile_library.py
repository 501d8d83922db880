"""Libraries that were tampered with, damaged, or made to attack whoever opens them."""

import json
import os
import pickle
import shutil

import numpy as np
import pytest
from mutations import KINDS, plan, snapshot
from synthetic import data_of, edit_manifest, forge_library

from flashdex.errors import FlashdexError, LibraryError
from flashdex.motions import library_check
from flashdex.motions.library import MotionLibrary
from flashdex.motions.library_format import ARRAYS
from flashdex.motions.velocities import SOURCES
from flashdex.system.arrays import hash_content


class Bomb:
    """Unpickling it makes a file."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return (os.mkdir, (str(self.mark),))


@pytest.mark.parametrize("schema", [1, 2], ids=["old", "new"])
def test_metadata_of_the_old_kind_runs_nothing(copy, tmp_path, schema):
    mark = tmp_path / "ran"
    kind = "subprocess.Popen"
    meta = {"_type": kind, "_is_shared": False, "device": "cpu", "shape": [1]}
    meta["x"] = {"type": kind, "dtype": "torch.float32", "shape": [1]}
    for folder in (copy, data_of(copy)):
        for part in ("frames", "motions", "objects", "quality"):
            (folder / part).mkdir(exist_ok=True)
            (folder / part / "meta.json").write_text(json.dumps(meta))
            (folder / part / "other.pickle").write_bytes(pickle.dumps(Bomb(mark)))
    if schema == 1:
        edit_manifest(copy, lambda m: m.update(schema=1))
        with pytest.raises(LibraryError, match=r"schema 1, this version .*again"):
            MotionLibrary.load(copy)
    else:
        assert MotionLibrary.load(copy).num_motions == 3
    assert not mark.exists()


def pickled(path):
    """An array of objects whose loading runs a command."""
    mark = path.parents[1] / "ran"
    np.save(path, np.array([Bomb(mark)], object), allow_pickle=True)
    return mark


@pytest.mark.parametrize("name", ["frames/joint_pos", "motions/start", "objects/mass"])
def test_pickled_arrays_run_nothing(copy, name):
    mark = pickled(data_of(copy) / f"{name}.npy")
    with pytest.raises(LibraryError, match=name):
        MotionLibrary.load(copy)
    assert not mark.exists()


def put(name, index, value):
    def edit(entries, arrays):
        arrays[name][index] = value

    return edit


def scale(name, by, index=slice(None)):
    def edit(entries, arrays):
        arrays[name][index] = arrays[name][index] * np.float32(by)

    return edit


def add(name, by, index=slice(None)):
    def edit(entries, arrays):
        arrays[name][index] += np.float32(by)

    return edit


def roll(name):
    def edit(entries, arrays):
        arrays[name][:] = np.roll(arrays[name], 1, axis=0)

    return edit


def turn(grids):
    grids[:] = grids[:, ::-1, :, :].transpose(0, 2, 1, 3) + np.float32(0.004)


FLOATS = [n for n, (dtype, _) in ARRAYS.items() if dtype == "float32"]
FLOATS = [n for n in FLOATS if n.split("/")[0] != "quality"]
ONE = {name: (1,) + (0,) * (len(shape) - 1) for name, (_, shape) in ARRAYS.items()}
NUMBERS = {
    **{f"{n}-nan": put(n, ONE[n], np.nan) for n in FLOATS},
    **{f"{n}-inf": put(n, ONE[n], np.inf) for n in FLOATS},
    **{f"{n}-huge": put(n, ONE[n], -1e30) for n in FLOATS},
    "wrist-quat-zero": put("frames/wrist_quat", 0, 0.0),
    "object-quat-zero": put("frames/object_quat", slice(5, 9), 0.0),
    "object-quat-scaled": scale("frames/object_quat", 1.01),
    "tip-dist-negative": put("frames/tip_dist", (3, 0, 0), -0.01),
    "far-away": put("frames/object_pos", (3, 0, 0), 1000.0),
    "millimetres": scale("frames/object_pos", 1e5),
    "radius-zero": put("objects/radius", 0, 0.0),
    "spacing-zero": put("objects/sdf_spacing", 0, 0.0),
    "spacing-negative": put("objects/sdf_spacing", 0, -0.005),
    "mass-zero": put("objects/mass", 0, 0.0),
    "mass-negative": put("objects/mass", 0, -0.1),
    "mass-tonnes": put("objects/mass", 0, 1e4),
    "mass-tiny": scale("objects/mass", 1e-3),
    "inertia-zero": put("objects/inertia", 0, 0.0),
    "inertia-of-a-speck": scale("objects/inertia", 1e-12),
    "grid-too-small": scale("objects/sdf_spacing", 1e-3),
    "grid-elsewhere": put("objects/sdf_origin", 0, 0.05),
    "inertia-negative": scale("objects/inertia", -1),
    "inertia-of-no-body": put("objects/inertia", (0, 0, 0), 1e-2),
    "inertia-not-symmetric": put("objects/inertia", (0, 0, 1), 5e-5),
    "inertia-large": scale("objects/inertia", 1e3),
    "mass-of-a-man": lambda e, a: a["objects/mass"].fill(70.0),
    **{
        f"{name}-{word}": edit
        for name in SOURCES
        for word, edit in {
            "of-nobody": put(f"frames/{name}", 7, 199.0),
            "one-number": add(f"frames/{name}", 0.05, (9, 1, 0)),
            "of-the-frame-before": roll(f"frames/{name}"),
            "zero": scale(f"frames/{name}", 0),
            "per-frame": scale(f"frames/{name}", 1 / 60),
        }.items()
    },
    "position-of-one-frame": add("frames/object_pos", 0.02, (60, 0, 2)),
    "normals-zero": scale("objects/normals", 0),
    "normals-inward": scale("objects/normals", -1),
    "grid-zero": scale("objects/sdf", 0),
    "grid-inside-out": scale("objects/sdf", -1),
    "grid-in-millimetres": scale("objects/sdf", 1000),
    "grid-half": scale("objects/sdf", 0.5),
    "grid-twice": scale("objects/sdf", 2),
    "grid-thick": add("objects/sdf", -0.02),
    "grid-thin": add("objects/sdf", 0.02),
    "grid-never-inside": lambda e, a: np.abs(a["objects/sdf"], out=a["objects/sdf"]),
    "grid-turned": lambda e, a: turn(a["objects/sdf"]),
    "grid-of-the-other": roll("objects/sdf"),
    "grid-moved": add("objects/sdf_origin", 0.012),
    "grid-one-node": put("objects/sdf", (0, 18, 18, 18), 0.05),
    "com-outside": put("objects/com", (0, 0), 0.2),
    "points-outside": scale("objects/points", 3, (0, 5)),
    "radius-of-others": scale("objects/radius", 1.5),
    "box-inside-out": scale("objects/aabb", -1),
    "start-later": put("motions/start", 1, 41),
    "start-overlaps": put("motions/start", 1, 0),
    "start-negative": put("motions/start", 0, -1),
    "length-zero": put("motions/length", slice(None), [0, 71, 52]),
    "length-negative": put("motions/length", slice(None), [-10, 81, 52]),
    "length-less": put("motions/length", 2, 51),
    "length-overflow": put("motions/length", 2, 2**62),
    "object-not-there": put("motions/object_index", (0, 0), 2),
    "object-below": put("motions/object_index", (0, 0), -2),
    "slot-not-there": put("motions/hand_object", (0, 1), 2),
    "slot-below": put("motions/hand_object", (0, 1), -2),
    "slot-empty": put("motions/hand_object", (0, 1), 1),
    "no-object": lambda e, a: [
        a[f"motions/{key}"].fill(-1) for key in ("object_index", "hand_object")
    ],
    "no-hand": put("motions/hand_active", 0, False),
    "disc-partly-nan": put("motions/support_disks", (0, 0, 2), np.nan),
    "disc-of-no-radius": put("motions/support_disks", (0, 0, 3), 0.0),
    "disc-of-hardly-any": put("motions/support_disks", (0, 0, 3), 1e-45),
    "disc-after-a-gap": put("motions/support_disks", (0, 2), [0, 0, 0, 0.5, 0.02]),
    "disc-infinite": put("motions/support_disks", (0, 0, 0), np.inf),
}


@pytest.mark.parametrize("case", NUMBERS)
def test_numbers_of_no_motion_are_refused_though_hashes_fit(copy, case):
    forge_library(copy, NUMBERS[case])
    with pytest.raises(LibraryError) as caught:
        MotionLibrary.load(copy)
    assert "hash" not in str(caught.value)


def test_a_fault_is_told_with_array_motion_and_frame(copy):
    forge_library(copy, put("frames/object_pos", (45, 1, 2), np.nan))
    text = r"frames/object_pos: holds nan at frame 5 of motion 'left_ball'"
    with pytest.raises(LibraryError, match=text):
        MotionLibrary.load(copy)


MESHES = {
    "empty": b"",
    "nan": b"v nan 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\n",
    "flat": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "no-faces": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n",
    "face-outside": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 9\n",
    "face-zero": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 0 1 2\n",
    "face-of-30-digits": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 " + b"9" * 30,
    "words": b"v a b c\nf 1 2 3\n",
    "face-of-70-bits": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 %d\n" % (2**70),
    "many-faces": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n" + b"f 1 2 3\n" * 20_001,
    "short": b"v 1 2\nf 1 2 3\n",
    "binary": bytes(range(256)),
}


@pytest.mark.parametrize("file", ["part_000.obj", "visual.obj"])
@pytest.mark.parametrize("case", MESHES)
def test_meshes_of_no_body_are_refused_though_hashes_fit(copy, case, file):
    (data_of(copy) / "meshes/box" / file).write_bytes(MESHES[case])
    forge_library(copy, lambda entries, arrays: None)
    with pytest.raises(LibraryError, match=f"meshes/box/{file}: cannot be read"):
        MotionLibrary.load(copy)


def moved(vertices):
    return vertices + 0.2


def flat(vertices):
    return vertices * [1, 1, 0]


def many(vertices):
    return np.random.default_rng(0).uniform(-0.02, 0.02, (10_001, 3))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda v: v / 2, "its convex parts end 0.015 m before its box does"),
        (moved, "lies outside of the box of its object"),
        (lambda v: 1000 * v, "lies outside of the box of its object"),
        (flat, "is flat"),
        (many, "has 10001 vertices, 10000 are allowed"),
    ],
    ids=["half", "moved", "millimetres", "flat", "bomb"],
)
def test_parts_that_no_simulation_takes_are_refused(copy, change, text):
    file = data_of(copy) / "meshes/box/part_000.obj"
    lines = [line.split() for line in file.read_text().splitlines()]
    vertices = change(
        np.array([words[1:] for words in lines if words[0] == "v"], float)
    )
    rows = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices]
    file.write_text("\n".join([*rows, "f 1 2 3", ""]))
    forge_library(copy, lambda entries, arrays: None)
    with pytest.raises(LibraryError, match=rf"(part_000.obj|object 'box'): {text}"):
        MotionLibrary.load(copy)


def test_truth_values_of_no_kind_are_refused(copy):
    file = data_of(copy) / "motions/hand_active.npy"
    data = file.read_bytes()
    file.write_bytes(data[:-1] + b"\x07")  # neither true nor false
    entry_hash = hash_content(file)
    edit_manifest(
        copy,
        lambda m: m["arrays"]["motions/hand_active"].update(sha256=entry_hash),
    )
    with pytest.raises(LibraryError, match="motions/hand_active: holds"):
        MotionLibrary.load(copy)


def test_a_mesh_opens_no_other_file(copy, tmp_path):
    file = data_of(copy) / "meshes/box/visual.obj"
    os.mkfifo(tmp_path / "pipe")  # whoever opens it waits for ever
    text = file.read_text()
    file.write_text(f"mtllib {tmp_path}/pipe\nusemtl a\ncall {tmp_path}/pipe\n{text}")
    forge_library(copy, lambda entries, arrays: None)
    assert len(MotionLibrary.load(copy).visual(0).faces) == 12


FILES = ["manifest.json", "frames/joint_pos.npy", "objects/mass.npy"]
FILES += ["meshes/box/part_000.obj", "meshes/box/visual.obj"]


def path_of(copy, file):
    return copy / file if file == "manifest.json" else data_of(copy) / file


@pytest.mark.parametrize("kind", ["link", "dangling", "folder", "fifo", "remove"])
@pytest.mark.parametrize("file", FILES)
def test_what_is_no_file_of_its_own_is_refused(copy, tmp_path, file, kind):
    KINDS[kind](path_of(copy, file), np.random.default_rng(0))
    with pytest.raises(LibraryError, match=file.split("/")[-1].replace(".", r"\.")):
        MotionLibrary.load(copy)


@pytest.mark.parametrize("folder", ["", "frames", "meshes", "meshes/box"])
def test_a_linked_folder_is_refused(copy, tmp_path, folder):
    path = data_of(copy) / folder
    path.rename(tmp_path / "aside")
    path.symlink_to(tmp_path / "aside")
    with pytest.raises(LibraryError, match="a link, not a folder of its own"):
        MotionLibrary.load(copy)


def test_a_link_to_the_whole_library_is_a_choice_of_its_user(copy, tmp_path):
    (tmp_path / "link").symlink_to(copy)
    assert MotionLibrary.load(tmp_path / "link").num_motions == 3


CHANGES = {
    "reference-20-cm-higher": ("frames/object_pos", lambda v: v + 0.2),
    "mass-times-ten": ("objects/mass", lambda v: v * 10),
    "one-bit": ("frames/joint_pos", lambda v: np.where(v == v.max(), v * 1.0001, v)),
    "other-roles": ("motions/hand_object", lambda v: v[::-1]),
}


@pytest.mark.parametrize("is_known", [False, True], ids=["new", "opened-before"])
@pytest.mark.parametrize("case", CHANGES)
def test_a_library_changed_in_place_is_refused(copy, case, is_known):
    if is_known:
        MotionLibrary.load(copy)
    name, change = CHANGES[case]
    file = data_of(copy) / f"{name}.npy"
    times = os.stat(file)
    stored = np.load(file, mmap_mode="r+")
    stored[:] = change(np.array(stored))
    stored.flush()
    os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))  # as if nothing was
    with pytest.raises(LibraryError, match=f"{name}: was changed"):
        MotionLibrary.load(copy)


@pytest.mark.parametrize("kind", ["truncate", "grow", "empty"])
@pytest.mark.parametrize("name", ["frames/object_quat", "motions/length"])
def test_opening_never_repairs_what_is_torn(copy, name, kind):
    KINDS[kind](data_of(copy) / f"{name}.npy", np.random.default_rng(1))
    before = snapshot(copy)
    with pytest.raises(LibraryError, match=name):
        MotionLibrary.load(copy)
    assert snapshot(copy) == before


def test_no_write_to_an_open_library_reaches_its_files(copy):
    before = snapshot(copy)
    library = MotionLibrary.load(copy)
    library.frames["joint_pos"].fill_(3.0)
    library.objects["mass"] *= 10
    del library
    assert snapshot(copy) == before


def test_what_was_checked_is_not_read_again(copy, monkeypatch):
    MotionLibrary.load(copy)

    def read(*_):
        raise AssertionError("read again")

    monkeypatch.setattr(library_check, "hash_content", read)
    library = MotionLibrary.load(copy)
    with pytest.raises(AssertionError, match="read again"):
        library.verify()


@pytest.mark.parametrize("fault", ["no-home", "read-only", "file-in-the-way"])
def test_without_a_cache_a_library_is_checked_again(copy, tmp_path, monkeypatch, fault):
    cache = tmp_path / "cache"
    shutil.rmtree(cache, ignore_errors=True)
    if fault == "file-in-the-way":
        cache.write_text("")
    elif fault == "read-only":
        monkeypatch.setenv("FLASHDEX_CACHE", "/proc/no/cache")
    else:
        monkeypatch.delenv("FLASHDEX_CACHE")
        monkeypatch.setattr("pathlib.Path.home", no_home)
    for _ in range(2):
        assert MotionLibrary.load(copy).num_motions == 3


def no_home():
    raise RuntimeError("Could not determine home directory.")


def test_the_memory_of_libraries_stays_small(copy, tmp_path, monkeypatch):
    monkeypatch.setattr(library_check, "MAX_MARKS", 4)
    folder = tmp_path / "cache" / "libraries"
    folder.mkdir(parents=True)
    (folder / "notes.txt").write_text("mine")
    for i in range(6):
        (folder / f"{i:064d}").touch()
        os.utime(folder / f"{i:064d}", (i, i))
    MotionLibrary.load(copy)
    held = sorted(path.name for path in folder.iterdir())
    assert len(held) == 3
    assert f"{5:064d}" in held
    assert "notes.txt" in held


def test_verify_names_every_fault(copy, library):
    opened = MotionLibrary.load(copy)
    assert opened.verify() == []
    for name in ("frames/joint_pos", "objects/mass"):
        with (data_of(copy) / f"{name}.npy").open("r+b") as file:
            file.seek(-1, 2)
            last = file.read(1)
            file.seek(-1, 2)
            file.write(bytes([last[0] ^ 1]))
    found = "\n".join(opened.verify())
    assert "frames/joint_pos: was changed" in found
    assert "objects/mass: was changed" in found
    edit_manifest(copy, lambda m: m.update(source="another"))
    assert "not the one that was opened" in opened.verify()[0]


# what hand, rate, names or notes a manifest tells is bound by its own hash only: a
# change there is another library, and a run knows it by MotionLibrary.content_hash
HARMLESS = ("report.csv",)


@pytest.mark.parametrize("case", [pytest.param(i, id=f"{i}") for i in range(8)])
def test_random_changes_are_found_or_harmless(library, copy, case):
    wanted = MotionLibrary.load(copy)
    for mutation in plan(library.path, count=16, seed=case):
        shutil.rmtree(copy)
        shutil.copytree(library.path, copy)
        mutation.apply(copy)
        before = snapshot(copy)
        try:
            found = MotionLibrary.load(copy)
        except FlashdexError:
            pass
        else:
            assert is_same(found, wanted, mutation), mutation
        assert snapshot(copy) == before, mutation


def is_same(found, wanted, mutation):
    """Whether nothing changed, or only what the manifest tells beside the motions."""
    if mutation.file in HARMLESS or mutation.file.startswith("."):
        return found.content_hash == wanted.content_hash
    assert mutation.file == "manifest.json"
    rows = range(wanted.num_motions)
    same = [found.motion_hash(i) == wanted.motion_hash(i) for i in rows]
    told = found.content_hash != wanted.content_hash
    is_free = found.manifest["fps"] == wanted.manifest["fps"]
    return all(same) and is_free and (told or found.manifest == wanted.manifest)
