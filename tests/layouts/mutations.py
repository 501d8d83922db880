"""Every layout, mutated: a seeded list of cases that write a recording and spoil it."""

from __future__ import annotations

import copy
import shutil
import zipfile
import zlib
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from layouts import arctic, fdr, grab, hot3d, myodm, oakink2, spider, taco
from layouts.faulty_files import edits_of
from layouts.faulty_scenes import FAULTS, LIES
from layouts.faulty_trees import CHANGES, NAMES, change_part, load, save
from layouts.scene import make_scene

SECONDS = 2.0
TREES = (".npz", ".npy", ".pkl", ".pt", ".json", ".jsonl")
ROUNDS = 2  # of random changes a kind and file


@dataclass(frozen=True)
class Kept:
    """How one dataset keeps the scene.

    Args:
        source: name of the reader.
        fps: of its files.
        files: that can be spoilt, below its root.
        fixed: the left hand's shape is corrected.
        mano: whether the reader is given MANO.
        has_knuckles: whether it keeps more of a hand than its wrist and tips.
        own_rate: the files tell the rate, so that it can be told wrongly.
        named: files and keys in them that name an object or a task.
    """

    source: str
    fps: float
    files: tuple[str, ...]
    fixed: bool = False
    mano: bool = True
    own_rate: bool = True
    named: tuple[tuple[str, tuple[Any, ...]], ...] = field(default=())


_TACO = f"{taco.TRIPLET}/{taco.SEQUENCE}"
_TACO_FILES = (
    *(f"Hand_Poses/{_TACO}/{side}_hand_shape.pkl" for side in ("left", "right")),
    f"Object_Poses/{_TACO}/tool_003.npy",
    *("Object_Models/003_cm.obj", "Object_Models/112_cm.obj"),
)
_HOT3D = "P0003_c701bd11"
_HOT3D_FILES = (
    *(f"{_HOT3D}/{kind}_hand_pose_trajectory.jsonl" for kind in ("mano", "umetrack")),
    *(f"{_HOT3D}/{name}" for name in ("dynamic_objects.csv", "metadata.json")),
    *(f"{_HOT3D}/headset_trajectory.csv", f"object_library/{hot3d.FIRST_UID}.glb"),
    f"{_HOT3D}/masks/mask_object_pose_available.csv",
    *(f"{_HOT3D}/umetrack_hand_user_profile.json", "object_library/instance.json"),
)
_OAK = f"anno_preview/{oakink2.TOKEN}.pkl"
_OAK_PROGRAM = f"program/program_info/{oakink2.TOKEN}.json"
_OAK_MESH = f"object_repair/align_ds/{oakink2.IDS[0]}/scan.ply"
_SPIDER = "processed/made_up/mano/bimanual/lift_box"
_GRAB = "grab/s1/mug_drink_1.npz"
_INSTANCE = ("object_library/instance.json", (str(hot3d.FIRST_UID), "instance_name"))

LAYOUTS = {
    "keypoints": Kept(
        "keypoints",
        60,
        ("clip.npz", "meshes/box.obj", "segments.json"),
        mano=False,
        named=(("clip.npz", ("object", 0)), ("segments.json", (0, "clip"))),
    ),
    "taco": Kept(
        "taco",
        30,
        (f"Hand_Poses/{_TACO}/right_hand.pkl", *_TACO_FILES),
        own_rate=False,
    ),
    "taco_files": Kept(
        "taco",
        30,
        (f"Hand_Poses/{_TACO}/right_hand/hand_00007.pkl",),
        own_rate=False,
    ),
    "oakink2": Kept(
        "oakink2",
        120,
        (_OAK, _OAK_MESH),
        own_rate=False,
        named=((_OAK, ("obj_list", 0)),),
    ),
    "oakink2_program": Kept(
        "oakink2",
        120,
        (_OAK_PROGRAM,),
        own_rate=False,
        named=(
            (_OAK_PROGRAM, ("((0, 240), (0, 240))", "primitive")),
            (_OAK_PROGRAM, ("((0, 240), (0, 240))", "obj_list_rh", 0)),
        ),
    ),
    "hot3d_quest": Kept(
        "hot3d", 30, _HOT3D_FILES, fixed=True, own_rate=False, named=(_INSTANCE,)
    ),
    "hot3d_aria": Kept("hot3d", 30, _HOT3D_FILES[2:6], fixed=True, own_rate=False),
    "hot3d_umetrack": Kept("hot3d", 30, _HOT3D_FILES[1:2], mano=False, own_rate=False),
    "arctic": Kept(
        "arctic",
        30,
        (
            *(f"raw_seqs/s01/box_use_01.{kind}.npy" for kind in ("mano", "object")),
            *("meta/object_vtemplates/box/top.obj", "splits_json/protocol_p1.json"),
        ),
        own_rate=False,
    ),
    "grab": Kept(
        "grab",
        120,
        (
            *(_GRAB, f"{grab.MESHES}/mug.ply", f"{grab.MESHES}/table.ply"),
            "tools/subject_meshes/male/s1_rhand.ply",
        ),
        named=(
            *((_GRAB, (key,)) for key in ("obj_name", "motion_intent")),
            *((_GRAB, ("object", key)) for key in ("object_mesh",)),
        ),
    ),
    "spider": Kept(
        "spider",
        50,
        (
            f"{_SPIDER}/0/trajectory_keypoints.npz",
            f"{_SPIDER}/task_info.json",
            "processed/made_up/assets/objects/box/visual.obj",
        ),
        mano=False,
        named=tuple(
            (f"{_SPIDER}/task_info.json", (key,))
            for key in ("task", "right_object_mesh_dir")
        ),
    ),
    "fdr": Kept(
        "fdr",
        60,
        ("human_demo/clip_a.npz", "objects/box/visual.obj"),
        mano=False,
        named=(("human_demo/clip_a.npz", ("obj_right_id",)),),
    ),
    "fdr_pack": Kept(
        "fdr",
        60,
        ("motion.pt", "objects/box/visual.obj"),
        mano=False,
        own_rate=False,
        named=(
            ("motion.pt", ("motion_filename", 0)),
            ("motion.pt", ("right_object_mesh_dirs", 1)),
        ),
    ),
    "myodm": Kept(
        "myodm",
        50,
        ("clips/cup_lift.npz", "meshes/cup.stl", "myohand_body.xml", "source.json"),
        mano=False,
    ),
}
# Their writers turn poses or build axes, which numbers that are none do not survive;
# the random changes of files bring such numbers into these layouts.
NO_NUMBERS = ("hot3d_quest", "hot3d_aria", "hot3d_umetrack", "arctic", "spider")
NUMBERLESS = (
    "spoil_",
    "scale_quats_0.0",
    "scale_quats_1e",
    "zero_some",
    "shift_world_1e+",
)
WITH_SCENE = tuple(name for name in LAYOUTS if name != "myodm")
MANO_FILES = ("MANO_RIGHT.pkl", "MANO_LEFT.pkl")


@cache
def _scene(fps, fixed):
    return make_scene(fps, seconds=SECONDS, fix_left_shape=fixed)


def write(root: Path, layout: str, edit=None) -> None:
    """Write the scene, as an edit of it leaves it, in one layout."""
    kept = LAYOUTS[layout]
    scene = copy.deepcopy(_scene(kept.fps, kept.fixed))
    if edit is not None:
        function, given = edit
        function(scene, *given)
    root.mkdir(parents=True)
    WRITERS[layout](root, scene)


def _keypoints(root, scene):
    (root / "meshes").mkdir()
    for body in scene.objects:
        body.mesh.export(root / "meshes" / f"{body.name}.obj")
    (root / "segments.json").write_text("[]")
    np.savez(
        root / "clip.npz",
        fps=scene.fps,
        object=[body.name for body in scene.objects],
        obj_pose=np.stack([body.pose for body in scene.objects], axis=1),
        **{f"kp_{side}": hand.keypoints for side, hand in scene.hands.items()},
    )


def _oakink2_program(root, scene):
    last = len(scene.times)
    ids = list(oakink2.IDS)
    item = oakink2.primitive("lift", ids[1:], ids[:1])
    oakink2.write(root, scene, program={f"((0, {last}), (0, {last}))": item})


def _myodm(root, scene):
    wheel = myodm.write_wheel(root / "wheel")
    with zipfile.ZipFile(wheel) as archive:
        for name in archive.namelist():
            place = Path(name)
            if place.name.startswith("MyoHand_"):
                target = root / "clips" / place.name.removeprefix("MyoHand_")
            elif place.name in ("cup.stl", "knife.stl"):
                target = root / "meshes" / place.name
            elif place.suffix == ".xml":
                target = root / place.name
            else:
                continue
            target.parent.mkdir(exist_ok=True)
            target.write_bytes(archive.read(name))
    wheel.unlink()
    (root / "source.json").write_text('{"source": "made up", "sha256": "0"}')


WRITERS = {
    "keypoints": _keypoints,
    "taco": taco.write,
    "taco_files": lambda r, s: taco.write(r, s, frame_files=("left", "right")),
    "oakink2": oakink2.write,
    "oakink2_program": _oakink2_program,
    "hot3d_quest": lambda r, s: hot3d.write(r, s, headset="Quest3"),
    "hot3d_aria": lambda r, s: hot3d.write(r, s, headset="Aria"),
    "hot3d_umetrack": lambda r, s: hot3d.write(r, s, headset="Quest3"),
    "arctic": lambda r, s: arctic.write(r, s, split="train"),
    "grab": grab.write,
    "spider": spider.write,
    "fdr": fdr.write,
    "fdr_pack": lambda r, s: fdr.write_pack(r, [s], fps=s.fps),
    "myodm": _myodm,
}


@dataclass(frozen=True)
class Case:
    """One mutation.

    Args:
        layout: that is written.
        name: of the mutation; with the layout it seeds what is random.
        edit: of the scene before it is written.
        file: below the root, or one of MANO's, that is spoilt then.
        spoil: called with the file and a generator.
        lies: whether it silently changes what the recording means.
    """

    layout: str
    name: str
    edit: Any = None
    file: str = ""
    spoil: Any = None
    lies: bool = False

    def __str__(self):
        return f"{self.layout}-{self.name}"

    def write(self, root: Path, mano: Path) -> None:
        """Write the recording and spoil it; MANO's folder is a copy of its own."""
        write(root, self.layout, self.edit)
        if self.file:
            rng = np.random.default_rng(zlib.crc32(str(self).encode()))
            folder = mano if self.file in MANO_FILES else root
            self.spoil(folder / self.file, rng)


def all_cases() -> list[Case]:
    """Every mutation, in a fixed order."""
    return [*_scene_cases(), *_file_cases(), *_tree_cases(), *_name_cases(), *_mano()]


def _scene_cases():
    for layout in WITH_SCENE:
        for lies, edits in ((True, LIES), (False, FAULTS)):
            for name, edit in edits.items():
                if name.startswith("change_rate") and not LAYOUTS[layout].own_rate:
                    continue  # the rate belongs to the dataset
                if layout in NO_NUMBERS and name.startswith(NUMBERLESS):
                    continue
                if (layout, name) == ("fdr_pack", "cut_1"):
                    continue  # no velocity of one frame can be written
                if layout == "taco_files" and not lies:
                    continue  # as taco
                yield Case(layout, name, edit=edit, lies=lies)


def _file_cases():
    for layout, kept in LAYOUTS.items():
        for file in kept.files:
            for spoil in edits_of(file):
                label = f"{spoil.__name__}:{Path(file).name}"
                yield Case(layout, label, file=file, spoil=spoil)


def _tree_cases():
    for layout, kept in LAYOUTS.items():
        for file in kept.files:
            if Path(file).suffix not in TREES:
                continue
            for change in CHANGES:
                for turn in range(ROUNDS):
                    label = f"{change.__name__}{turn}:{Path(file).name}"
                    yield Case(layout, label, file=file, spoil=_changer(change))


def _changer(change):
    def spoil(file, rng):
        save(file, change_part(load(file), rng, change))

    return spoil


def _name_cases():
    for layout, kept in LAYOUTS.items():
        for file, keys in kept.named:
            for place, name in enumerate(NAMES):
                label = f"name{place}:{keys[-1]}:{Path(file).name}"
                yield Case(layout, label, file=file, spoil=_namer(keys, name))


def _namer(keys, name):
    def spoil(file, rng):
        tree = load(file)
        if file.name == "segments.json":
            tree = [{"clip": "clip", "start": 0, "end": 100}]
        part = tree
        for key in keys[:-1]:
            part = part[key]
        part = part if len(keys) > 1 else tree
        if isinstance(part, np.ndarray):
            tree[keys[0]] = np.array([name, *part[1:].tolist()])
        else:
            part[keys[-1]] = name
        save(file, tree)

    return spoil


def _mano():
    for file in MANO_FILES:
        for spoil in edits_of(file):
            yield Case("taco", f"{spoil.__name__}:{file}", file=file, spoil=spoil)
        for change in CHANGES:
            for turn in range(2 * ROUNDS):
                label = f"{change.__name__}{turn}:{file}"
                yield Case("taco", label, file=file, spoil=_model_changer(change))
    yield Case("taco", "swapped:MANO", file=MANO_FILES[0], spoil=_swap_models)


def _model_changer(change):
    def spoil(file, rng):
        from flashdex.datasets.files import load_pickle  # stand-ins for chumpy

        parts = load_pickle(file)
        parts["J_regressor"] = parts["J_regressor"].toarray()
        save(file.with_suffix(".npz"), change_part(parts, rng, change))
        file.unlink()

    return spoil


def _swap_models(file, rng):
    other = file.with_name(MANO_FILES[1])
    first = file.read_bytes()
    shutil.copy(other, file)
    other.write_bytes(first)
