"""Folders as they are found on disks: twins of macOS, links, other cases, pipes."""

import os
import shutil
from pathlib import Path

import pytest
from layouts import mutations
from layouts.mano_files import write_mano

from flashdex.datasets import list_recordings
from flashdex.datasets.roots import listed, listed_below, on_disk
from flashdex.datasets.source import SourceOptions
from flashdex.errors import DemoError
from flashdex.objects.mesh_files import MESH_SUFFIXES

LAYOUTS = sorted(mutations.LAYOUTS)


@pytest.fixture(scope="module")
def mano(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mano")
    write_mano(folder)
    return folder


def read_all(layout, root, mano):
    kind = mutations.LAYOUTS[layout]
    models = root / "object_library" if kind.source == "hot3d" else None
    options = SourceOptions(path=root, mano=mano if kind.mano else None, models=models)
    found = {}
    for recording in list_recordings(kind.source, options):
        demos = recording.read()
        found[recording.name] = [[b.name for b in d.objects] for d in demos]
    return found


def folders(root):
    return [Path(place) for place, *_ in os.walk(root)]


def twins(root):
    """What macOS and Windows leave in every folder."""
    for place in folders(root):
        for file in [f for f in place.iterdir() if f.is_file()]:
            (place / f"._{file.name}").write_bytes(b"\0\5\x16\7" + bytes(4000))
        (place / ".DS_Store").write_bytes(bytes(100))
        (place / "Thumbs.db").write_bytes(bytes(64))
    (root / "__MACOSX").mkdir()


def upper_meshes(root):
    for place in folders(root):
        for file in [f for f in place.iterdir() if f.suffix in MESH_SUFFIXES]:
            file.rename(file.with_suffix(file.suffix.upper()))


def upper_names(root):
    for place in folders(root):
        for file in [f for f in place.iterdir() if f.suffix in MESH_SUFFIXES]:
            file.rename(file.with_name(file.name.upper()))


def linked_entries(root):
    real = root.with_name("real")
    root.rename(real)
    root.mkdir()
    for entry in real.iterdir():
        (root / entry.name).symlink_to(entry)


def linked_folders(root):
    """Every folder lies elsewhere: a dataset spread over disks."""
    store = root.with_name("store")
    store.mkdir()
    for number, place in enumerate(folders(root)[:0:-1]):
        shutil.move(place, store / str(number))
        place.symlink_to(store / str(number))


def linked_files(root):
    """Every file is a link to one without a suffix, as snapshots of a hub are."""
    store = root.with_name("store")
    store.mkdir()
    for number, file in enumerate([f for f in root.rglob("*") if f.is_file()]):
        shutil.move(file, store / str(number))
        file.symlink_to(store / str(number))


def hidden_rest(root):
    for place in folders(root):
        (place / ".ipynb_checkpoints").mkdir()
        (place / "README.md").write_text("x")
        (place / ".download.part").write_bytes(b"")


DISKS = [
    *(twins, upper_meshes, upper_names, linked_entries, linked_folders),
    *(linked_files, hidden_rest),
]


@pytest.mark.parametrize("disk", DISKS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_layout_reads_the_same_on_every_disk(tmp_path, mano, layout, disk):
    root = tmp_path / "root"
    mutations.write(root, layout)
    wanted = read_all(layout, root, mano)
    disk(root)
    assert read_all(layout, root, mano) == wanted


@pytest.mark.parametrize("disk", [twins, upper_names, linked_files])
def test_hand_models_are_found_on_every_disk(tmp_path, mano, disk):
    root = tmp_path / "root"
    mutations.write(root, "taco")
    models = tmp_path / "models"
    shutil.copytree(mano, models)
    for file in models.iterdir():
        file.rename(file.with_name(file.name.lower()))
    disk(models)
    assert read_all("taco", root, models) == read_all("taco", root, mano)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_pipe_among_the_files_costs_one_recording(tmp_path, mano, layout):
    root = tmp_path / "root"
    mutations.write(root, layout)
    whole = read_all(layout, root, mano)
    file = max(
        (f for f in root.rglob("*.*") if f.is_file()), key=lambda f: len(f.parts)
    )
    file.unlink()
    os.mkfifo(file)
    told, found = str(root), {}
    try:  # some layouts can do without that file; none waits
        found = read_all(layout, root, mano)
    except DemoError as error:
        told = str(error)
    assert str(root) in told
    assert found.items() <= whole.items()


def test_accents_are_the_same_in_both_their_forms(tmp_path):
    (tmp_path / "e\u0301.obj").touch()  # as macOS stores them
    assert on_disk(tmp_path / "\u00e9.OBJ") == tmp_path / "e\u0301.obj"


def test_links_in_a_circle_end(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "b" / "up").symlink_to(tmp_path)
    (tmp_path / "a" / "file.npz").write_text("")
    assert listed_below(tmp_path, "*.npz") == [tmp_path / "a" / "file.npz"]


def test_endless_folders_end(tmp_path):
    place = tmp_path
    for _ in range(40):
        place = place / "d"
        place.mkdir()
    with pytest.raises(DemoError, match="more than 32 levels"):
        listed_below(tmp_path, "*.npz")


def test_listing_of_nothing_is_empty(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "broken").symlink_to(tmp_path / "nowhere")
    assert listed(tmp_path / "absent", "*") == []
    assert listed(tmp_path / "file", "*") == []
    assert listed(tmp_path, "*/*") == []
