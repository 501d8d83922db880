"""The reader of OakInk2, on folders written by ``layouts.oakink2``."""

import json
import os
import pickle

import numpy as np
import pytest
import trimesh
from layouts import oakink2 as layout
from layouts.mano_files import write_mano
from layouts.scene import make_scene
from layouts.taco import matrices

from flashdex.datasets.oakink2.annotation import parse_intervals
from flashdex.datasets.oakink2.reader import SOURCE as OAKINK2
from flashdex.datasets.source import SourceOptions
from flashdex.errors import DemoError
from flashdex.keys import SIDES

BOX, BLOCK = layout.IDS
FRAMES = 240
BOTH = layout.primitive("pour", [BLOCK], [BOX])
PROGRAM = {
    "((30, 120), (60, 200))": BOTH,
    "(None, (0, 240))": layout.primitive("pick_up", [], [BOX]),
    "((10, 30), None)": layout.primitive("hold", [BLOCK], []),
}


@pytest.fixture(scope="module")
def scene():
    return make_scene(120.0, seconds=2.0)


@pytest.fixture(scope="module")
def mano(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mano")
    write_mano(folder)
    return folder


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, scene):
    """A dataset with one sequence and a program; tests do not change it."""
    root = tmp_path_factory.mktemp("oakink2")
    return layout.write(root, scene, program=PROGRAM)


@pytest.fixture
def read(mano):
    """Read the only sequence of a root."""

    def run(root, **options):
        recordings = OAKINK2.list(SourceOptions(path=root, mano=mano, **options))
        (recording,) = recordings
        return recording.read()

    return run


@pytest.fixture
def change(tmp_path, recorded, read):
    """Refuse a copy of the dataset in which something of the annotation is changed."""

    def run(words, **fields):
        file = recorded / "anno_preview" / f"{layout.TOKEN}.pkl"
        annotation = pickle.loads(file.read_bytes()) | fields
        annotation = {k: v for k, v in annotation.items() if v is not None}
        layout.dump(tmp_path, annotation)
        (tmp_path / "object_repair").symlink_to(recorded / "object_repair")
        refused(read, tmp_path, layout.TOKEN, *words)

    return run


def refused(read, root, *words, **options):
    """The reader refuses the root; its message holds all words."""
    with pytest.raises(DemoError) as error:
        read(root, **options)
    for word in words:
        assert word in str(error.value)


def z_up(points):
    """From y up: (x, y, z) -> (x, -z, y)."""
    return np.stack([points[..., 0], -points[..., 2], points[..., 1]], axis=-1)


def assert_is_scene(demo, scene, start, end, *, slots):
    """Keypoints and poses are frames start to end of the scene."""
    demo.validate()
    assert demo.num_frames == end - start
    for side in SIDES:
        wanted = scene.hands[side].keypoints[start:end]
        assert np.abs(z_up(demo.keypoints[side]) - wanted).max() < 1e-5
    for body, slot in zip(demo.objects, slots, strict=True):
        made = scene.objects[slot]
        found, wanted = matrices(body.pose), matrices(made.pose[start:end])
        error = layout.TO_Y_UP.T @ found[:, :3] - wanted[:, :3]
        assert np.abs(error).max() < 1e-5
        assert np.abs(body.load_mesh().bounds - made.mesh.bounds).max() < 1e-6


def test_a_motion_is_a_primitive(read, recorded, scene):
    pick, pour = read(recorded)  # in time order, without "hold"
    assert [pick.name, pour.name] == [
        f"{layout.TOKEN}_0_240",
        f"{layout.TOKEN}_30_200",
    ]
    assert_is_scene(pick, scene, 0, 240, slots=[0])
    # both hands from the first begin to the last end, each outside its interval too
    assert_is_scene(pour, scene, 30, 200, slots=[1, 0])
    assert [body.name for body in pour.objects] == ["C12001", "O02-0206-00001"]
    assert pour.hand_object == {"left": 0, "right": 1}
    assert pick.hand_object == {"right": 0}
    assert [pick.task, pour.task] == ["pick_up", "pour"]
    assert pour.fps == 120
    assert pour.up == "y"
    assert not pour.needs_cutting
    assert pour.provenance["frames"] == [30, 200]
    assert pour.provenance["intervals"] == {"left": [30, 120], "right": [60, 200]}
    assert pour.provenance["objects"] == [BLOCK, BOX]
    json.dumps(pour.provenance)


def test_the_table_comes_from_the_whole_sequence(read, tmp_path, scene):
    # nothing rests between 100 and 150, but everything did before
    program = {"((100, 150), (100, 150))": BOTH}
    (demo,) = read(layout.write(tmp_path, scene, program=program))
    assert demo.support_z == pytest.approx(scene.table_z, abs=1e-3)


def test_nothing_rests(read, tmp_path):
    scene = make_scene(120.0, seconds=2.0)
    for body in scene.objects:
        body.pose = body.pose.copy()
        body.pose[:, 2] += 0.1 * np.arange(FRAMES) / 120  # 0.1 m/s
    (demo,) = read(layout.write(tmp_path, scene))
    assert demo.support_z == 0.0  # the origin lies on the table
    assert "y = 0" in demo.provenance["notes"][0]


def test_ids_are_no_positions(read, tmp_path, scene):
    program = {"((300, 360), (320, 480))": BOTH, "(None, (240, 300))": BOTH}
    demos = read(layout.write(tmp_path, scene, first=240, program=program))
    assert_is_scene(demos[0], scene, 0, 60, slots=[1, 0])
    assert_is_scene(demos[1], scene, 60, 240, slots=[1, 0])
    assert demos[1].provenance["frames"] == [300, 480]


@pytest.mark.parametrize("key", ["((0, 120), (60, 240))", "(None, (400, 481))"])
def test_primitive_outside_of_the_sequence(read, tmp_path, scene, key):
    layout.write(tmp_path, scene, first=240, program={key: BOTH})
    refused(read, tmp_path, "E_LEN", "'pour'", "240 to 480", f"{layout.TOKEN}.json")


def test_without_a_program(read, tmp_path, scene):
    (demo,) = read(layout.write(tmp_path, scene))
    assert demo.name == layout.TOKEN
    assert demo.needs_cutting
    assert demo.task == ""
    assert demo.hand_object == {}
    assert_is_scene(demo, scene, 0, FRAMES, slots=[0, 1])


def test_objects_of_a_primitive(read, tmp_path, scene):
    program = {
        "(None, (0, 120))": layout.primitive("a", [], [], every=[BLOCK]),
        "((0, 130), None)": layout.primitive("b", [], []),
        "((0, 140), None)": layout.primitive("c", [BOX, BLOCK], [BOX]),
    }
    item, unknown, several = read(layout.write(tmp_path, scene, program=program))
    assert item.provenance["objects"] == [BLOCK]
    assert unknown.provenance["objects"] == [BOX, BLOCK]
    assert several.provenance["objects"] == [BOX, BLOCK]
    # the left hand's is left to contact: it has two
    assert several.hand_object == {"right": 0}


def test_equal_ranges_have_two_names(read, tmp_path, scene):
    program = {"((0, 90), None)": BOTH, "(None, (0, 90))": BOTH}
    names = [demo.name for demo in read(layout.write(tmp_path, scene, program=program))]
    assert names == [f"{layout.TOKEN}_0_90", f"{layout.TOKEN}_0_90_2"]


@pytest.mark.parametrize("name", ["hold", "rearrange", "swap", "?(unk)"])
def test_transient_primitives(read, tmp_path, scene, name):
    program = {"((0, 90), None)": layout.primitive(name, [BLOCK], [])}
    layout.write(tmp_path, scene, program=program)
    refused(read, tmp_path, "no primitive to use", name)


def test_frames_without_entries_are_nan(read, tmp_path, scene):
    layout.write(tmp_path, scene, missing=(50, 51), objects_missing=(7,))
    (demo,) = read(tmp_path)
    assert demo.num_frames == FRAMES  # time stays even
    gone = np.isnan(demo.keypoints["right"]).all(axis=(1, 2))
    assert np.flatnonzero(gone).tolist() == [50, 51]
    gone = [np.flatnonzero(np.isnan(b.pose).all(axis=1)).tolist() for b in demo.objects]
    assert gone == [[7, 50, 51], [50, 51]]
    error = z_up(demo.keypoints["right"]) - scene.hands["right"].keypoints
    assert np.nanmax(np.abs(error)) < 1e-5


def test_repaired_meshes_go_first(read, tmp_path, scene, mano):
    layout.write(tmp_path, scene, release="object_raw", program=PROGRAM)
    for number, release in enumerate(("object_scan", "object_preview"), start=1):
        folder = tmp_path / release / "align_ds" / BOX
        folder.mkdir(parents=True)
        trimesh.creation.box([0.01 * number] * 3).export(folder / "scan.ply")
    folder = tmp_path / "object_repair" / "align_ds" / BLOCK
    folder.mkdir(parents=True)
    trimesh.creation.box([0.03] * 3).export(folder / "repaired.obj")
    block, box = read(tmp_path)[1].objects
    assert block.load_mesh().extents[0] == pytest.approx(0.03)
    assert box.load_mesh().extents[0] == pytest.approx(0.02)  # preview before raw
    (recording,) = OAKINK2.list(SourceOptions(path=tmp_path, mano=mano))
    files = {"/".join(file.parts[-4:]) for file in recording.files}
    assert f"object_repair/align_ds/{BLOCK}/repaired.obj" in files
    assert f"object_preview/align_ds/{BOX}/scan.ply" in files
    assert f"object_raw/align_ds/{BOX}/scan.ply" not in files
    # a folder that the user names goes before all
    elsewhere = tmp_path / "elsewhere"
    layout.write(elsewhere, scene, release="models")
    models = elsewhere / "models"
    extents = read(tmp_path, models=models)[1].objects[0].load_mesh().extents
    assert extents[0] == pytest.approx(scene.objects[1].mesh.extents[0])


def test_mesh_files(read, tmp_path, scene):
    layout.write(tmp_path, scene)
    folder = tmp_path / "object_repair" / "align_ds" / BOX
    (folder / "other.obj").write_text("")
    refused(read, tmp_path, "E_FILE", str(folder), "2 meshes")
    for file in folder.iterdir():
        file.unlink()
    refused(read, tmp_path, "E_FILE", f"no mesh of object '{BOX}'", "align_ds")
    (folder / "scan.ply").write_text("version https://git-lfs.github.com/spec/v1")
    refused(read, tmp_path, "Git-LFS pointer", "scan.ply")
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    flat.export(folder / "scan.ply")
    refused(read, tmp_path, "E_MESH", "scan.ply")


def test_recordings_can_be_sent_and_are_keyed_by_all_files(recorded, mano):
    (recording,) = OAKINK2.list(SourceOptions(path=recorded, mano=mano))
    assert recording.name == layout.TOKEN
    assert len(pickle.loads(pickle.dumps(recording)).read()) == 2
    assert {file.name for file in recording.files} == {
        f"{layout.TOKEN}.pkl",
        f"{layout.TOKEN}.json",
        "scan.ply",
        "scan.obj",
        "MANO_LEFT.pkl",
        "MANO_RIGHT.pkl",
    }


def test_wrong_root(read, recorded, tmp_path):
    refused(read, recorded.parent, "E_ROOT", "anno_preview", str(recorded))
    inside = recorded / "anno_preview"
    refused(read, inside, "E_ROOT", "inside the root", str(recorded))
    (tmp_path / "anno_preview.tar").write_bytes(b"")
    refused(read, tmp_path, "E_ROOT", "Unpack anno_preview.tar")
    (tmp_path / "anno_preview").mkdir()
    refused(read, tmp_path, "E_ROOT", "object_repair/align_ds", "--models")
    (tmp_path / "object_raw" / "align_ds").mkdir(parents=True)
    pointer = tmp_path / "anno_preview" / f"{layout.TOKEN}.pkl"
    pointer.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0")
    refused(read, tmp_path, "Git-LFS pointer", pointer.name)


def test_annotations_run_nothing(change, tmp_path):
    class Attack:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "made"),)

    change(["E_PICKLE", "mkdir"], cam_def=Attack())
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"raw_mano": None, "obj_list": None}, ["lacks obj_list, raw_mano"]),
        ({"mocap_frame_id_list": ["a"]}, ["not a list of integers"]),
        ({"obj_list": "C12001"}, ["obj_list is not a list"]),
        ({"obj_list": ["C99"]}, ["obj_transf['C99']"]),
        ({"obj_list": ["a/../b"], "obj_transf": {"a/../b": {0: np.eye(4)}}}, ["'a/.."]),
        ({"raw_mano": {"0": {}}}, ["none of the mocap ids"]),
        ({"raw_mano": {0: {"rh__tsl": np.zeros(3)}}}, ["lacks lh__pose_coeffs"]),
        (
            {"raw_mano": {0: {"lh__pose_coeffs": np.zeros((1, 16, 3))}}},
            ["lh__pose_coeffs", "(1, 16, 3)", "64 numbers"],
        ),
        (
            {"obj_list": ["a"], "obj_transf": {"a": {0: np.zeros((3, 4))}}},
            ["obj_transf['a']", "(3, 4)", "16 numbers"],
        ),
    ],
)
def test_wrong_keys(change, fields, words):
    change(["E_KEYS", *words], **fields)


@pytest.mark.parametrize(
    "ids",
    [
        list(range(0, 240, 4)),
        list(range(0, 240, 2)),
        [0, 1, 2, 10**9],
        [-1, 0, 1, 2],
        [5],
    ],
)
def test_ids_at_another_rate(change, ids):
    change(["W_FPS", "120 Hz"], mocap_frame_id_list=ids)


def test_reflections_are_refused(change):
    mirror = np.diag([1.0, 1, -1, 1])
    track = {i: np.eye(4) for i in range(FRAMES)} | {9: mirror}
    change(["E_ROT", "frame 9"], obj_list=["a"], obj_transf={"a": track})


def test_quaternions_of_another_length(read, tmp_path, scene):
    layout.write(tmp_path, scene)
    file = tmp_path / "anno_preview" / f"{layout.TOKEN}.pkl"
    annotation = pickle.loads(file.read_bytes())
    annotation["raw_mano"][5]["lh__pose_coeffs"] *= 1.1
    annotation["raw_mano"][6]["lh__pose_coeffs"] *= 0.0
    layout.dump(tmp_path, annotation)
    (demo,) = read(tmp_path)
    assert demo.provenance["notes"] == ["E_ROT: left hand: 32 quaternions made unit"]
    error = z_up(demo.keypoints["left"]) - scene.hands["left"].keypoints
    assert np.abs(error[:6]).max() < 1e-5
    assert np.isnan(error[6]).all()


@pytest.mark.parametrize(
    ("key", "intervals"),
    [
        ("(None, (0, 240))", {"right": (0, 240)}),
        ("((0, 120), (60, 240))", {"left": (0, 120), "right": (60, 240)}),
        (" ((3, 4), None) ", {"left": (3, 4)}),
    ],
)
def test_intervals(key, intervals):
    assert parse_intervals(key, where="x") == intervals


@pytest.mark.parametrize(
    "key",
    [
        "(None, None)",
        "((0, 120),)",
        "((0, 120), (60, 240), (0, 1))",
        "((120, 0), None)",
        "((-4, 9), None)",
        "((0.0, 9.0), None)",
        "((False, True), None)",
        "('ab', (0, 3))",
        "__import__('os').getcwd()",
        "(None, (0, 240)",
        "{[]: 1}",
        "\0",
        "(" * 150 + ")" * 150,
        "((0, 1), None)" + " " * 200,
    ],
)
def test_wrong_intervals(key):
    with pytest.raises(DemoError, match=r"^E_KEYS: x.json: key") as error:
        parse_intervals(key, where="x.json")
    assert len(str(error.value)) < 400


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", ["not a readable program"]),
        ("[" * 100000, ["not a readable program"]),
        ("[1]", ["holds a list"]),
        ('{"((0, 9), None)": 3}', ["holds a int"]),
        ('{"((0, 9), None)": {"obj_list_lh": "C12001"}}', ["obj_list_lh"]),
        ('{"((0, 9), None)": {"obj_list_lh": ["C99"]}}', ["'C99' is not in", BOX]),
    ],
)
def test_wrong_program(read, tmp_path, scene, text, words):
    layout.write(tmp_path, scene, program=PROGRAM)
    file = tmp_path / "program" / "program_info" / f"{layout.TOKEN}.json"
    file.write_text(text)
    refused(read, tmp_path, "E_KEYS", file.name, *words)
