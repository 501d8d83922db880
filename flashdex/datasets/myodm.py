"""Reads MyoDM: 95 recorded clips of a right hand and one object, 50 frames a second.

``flashdex fetch myodm`` lays the folder out: ``clips/<object>_<action>.npz`` with
``robot`` (T, 29), joint positions of the MyoHand model, and ``object`` (T, 7), position
and quaternion wxyz; ``meshes/<object>.stl``, metres; ``myohand_body.xml``, the hand's
tree. z up, table top at z = 0. Keypoints come from the hand's forward kinematics.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from contextlib import suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flashdex.datasets.demo import DemoObject, HumanDemo
from flashdex.datasets.fetch import NOTE, myodm_dir
from flashdex.datasets.fields import require
from flashdex.datasets.files import load_npz, read_bytes, read_json, told
from flashdex.datasets.roots import listed, on_disk
from flashdex.datasets.source import Recording, Source, SourceOptions
from flashdex.errors import DemoError

if TYPE_CHECKING:
    import mujoco

NUM_JOINTS = 29
# keypoint order: wrist, then thumb to pinky from the palm outwards; "site:" = a tip
ELEMENTS = (
    "lunate",
    *("firstmc", "proximal_thumb", "distal_thumb", "site:THtip"),
    *("proxph2", "midph2", "distph2", "site:IFtip"),
    *("proxph3", "midph3", "distph3", "site:MFtip"),
    *("proxph4", "midph4", "distph4", "site:RFtip"),
    *("proxph5", "midph5", "distph5", "site:LFtip"),
)
TIP_SITES = {name.removeprefix("site:") for name in ELEMENTS if "site:" in name}
# Above the hand's own tree: six root joints in one body, the turned arm in the next.
ROOT_POS, ARM_POS, ARM_EULER = "0.1 -0.55 0.32", "-0.175 0.1 -1.4", "0 0 3.14"
ROOT_JOINTS = (
    *(("ARTx", "slide", "1 0 0"), ("ARTy", "slide", "0 1 0")),
    *(("ARTz", "slide", "0 0 1"), ("ARRx", "hinge", "1 0 0")),
    *(("ARRy", "hinge", "0 1 0"), ("ARRz", "hinge", "0 0 1")),
)
MAX_BYTES = 1_000_000


def myohand_keypoints(tree: Path, joint_pos: np.ndarray) -> np.ndarray:
    """Keypoints, m, world, (T, 21, 3); no joint is clamped to its range.

    Of the tree ``myohand_body.xml`` at joint positions (T, 29), m and rad: six of the
    root, then the hand's.
    """
    import mujoco  # here: sources are listed without it

    model, owners = _model(tree)
    data = mujoco.MjData(model)
    points = np.full((len(joint_pos), len(ELEMENTS), 3), np.nan)
    for t, row in enumerate(joint_pos):
        if not np.isfinite(row).all():
            continue  # MuJoCo would reset it to zero; validation reports the frame
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        for i, (is_site, index) in enumerate(owners):
            points[t, i] = data.site_xpos[index] if is_site else data.xpos[index]
    return points


@lru_cache(maxsize=2)
def _model(tree: Path) -> tuple[mujoco.MjModel, tuple[tuple[bool, int], ...]]:
    # here: sources are listed without MuJoCo
    from flashdex.system.mjcf import ModelError, compile_mjcf

    text = _read(tree)
    try:
        root = ET.fromstring(text)
        model = compile_mjcf(_plain_xml(root), where=str(tree))
        owners = tuple(_owner(model, name) for name in ELEMENTS)
    except ModelError as error:
        raise DemoError(error.text, code="E_FILE") from error
    except (ET.ParseError, ValueError, KeyError, RecursionError) as error:
        raise DemoError(f"{tree}: not the MyoHand tree ({error}).") from error
    if model.nq != NUM_JOINTS:
        raise DemoError(f"{tree}: {model.nq} joints, expected {NUM_JOINTS}.")
    return model, owners


def _read(tree: Path) -> str:
    with told(tree, "not the MyoHand tree"):
        data = read_bytes(tree, most=MAX_BYTES)
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise DemoError(f"{tree}: not the MyoHand tree (a DOCTYPE).")
    return data.decode("utf-8", errors="replace")


def _plain_xml(root: ET.Element) -> str:
    """Bodies, joints and tip sites only: needs no meshes and no defaults."""
    model = ET.Element("mujoco")
    ET.SubElement(model, "compiler", angle="radian")
    world = ET.SubElement(model, "worldbody")
    slides = ET.SubElement(world, "body", pos=ROOT_POS)
    for name, kind, axis in ROOT_JOINTS:
        ET.SubElement(slides, "joint", name=name, type=kind, axis=axis)
    _add_inertia(slides)
    arm = ET.SubElement(slides, "body", pos=ARM_POS, euler=ARM_EULER)
    _add_inertia(arm)
    for body in root.findall("body"):
        _copy(body, arm)
    return ET.tostring(model, encoding="unicode")


def _copy(body: ET.Element, parent: ET.Element) -> None:
    copy = ET.SubElement(parent, "body", _without_class(body))
    _add_inertia(copy)
    for child in body:
        tip = child.tag == "site" and child.get("name") in TIP_SITES
        if child.tag == "joint" or tip:
            ET.SubElement(copy, child.tag, _without_class(child))
        elif child.tag == "body":
            _copy(child, copy)


def _without_class(element: ET.Element) -> dict[str, str]:
    return {k: v for k, v in element.attrib.items() if k not in ("class", "childclass")}


def _add_inertia(body: ET.Element) -> None:
    # moving bodies need one; kinematics does not read it
    ET.SubElement(body, "inertial", pos="0 0 0", mass="1", diaginertia="1 1 1")


def _owner(model: mujoco.MjModel, name: str) -> tuple[bool, int]:
    if name.startswith("site:"):
        return True, model.site(name.removeprefix("site:")).id
    return False, model.body(name).id


FPS = 50.0
# Recorded heights are slides of a body that stands this high, m ...
BODY_HEIGHT = 0.035
# ... except where ``object_init`` has six entries: those heights are absolute.
ABSOLUTE_ENTRIES = 6
# These stand 5 to 6 cm below the table: theirs is estimated from where they rest.
SUNK = {"wineglass"}
KEYS = ("time", "robot", "object", "object_init")
OBJECT_NAME = re.compile(r"[a-z]+")


def list_myodm(options: SourceOptions) -> list[Recording]:
    """Clips of the fetched folder, in name order."""
    root = options.path or myodm_dir()
    hand = root / "myohand_body.xml"
    clips = listed(root / "clips", "*.npz")
    if not clips or not hand.is_file():
        raise DemoError(
            f"{root}: no MyoDM recordings (clips/*.npz and myohand_body.xml). "
            f"Get them with: flashdex fetch myodm"
        )
    return [
        Recording(
            name=clip.stem,
            read=partial(read_clip, clip),
            files=(clip, hand, *([m] if (m := _mesh_file(clip)).is_file() else [])),
        )
        for clip in clips
    ]


def read_clip(file: Path) -> list[HumanDemo]:
    """One clip as one motion."""
    data = _load(file)
    root = file.parent.parent
    points = myohand_keypoints(root / "myohand_body.xml", data["robot"])
    pose = data["object"].astype(np.float64)
    lift = 0.0 if data["object_init"].size == ABSOLUTE_ENTRIES else BODY_HEIGHT
    pose[:, 2] += lift
    name = _object_name(file)
    return [
        HumanDemo(
            name=file.stem,
            fps=FPS,
            keypoints={"right": points},
            objects=[DemoObject(name, _mesh_file(file), pose)],
            source=SOURCE.name,
            licence=SOURCE.licence,
            support_z=None if name in SUNK else 0.0,
            task=file.stem.removeprefix(f"{name}_"),
            provenance={
                "files": [f"clips/{file.name}", f"meshes/{name}.stl"],
                "fps": FPS,
                "object_z_offset": lift,
                **_origin(root),
            },
        )
    ]


def _load(file: Path) -> dict[str, np.ndarray]:
    stored = load_npz(file, only=KEYS, plain=True)
    require(stored, *KEYS, where=f"{file}: not a MyoDM clip")
    data = {key: stored[key] for key in KEYS}
    if data["time"].ndim != 1 or data["time"].dtype.kind != "f":
        raise DemoError(f"{file}: 'time' must be a list of seconds, (T,).")
    frames = len(data["time"])
    expected = {"robot": (frames, NUM_JOINTS), "object": (frames, 7)}
    for key, shape in expected.items():
        if data[key].shape != shape or data[key].dtype.kind != "f":
            raise DemoError(
                f"{file}: '{key}' is {data[key].dtype} {data[key].shape}, expected "
                f"float {shape}."
            )
    steps = np.diff(data["time"])
    if len(steps) and not np.allclose(steps, 1 / FPS, atol=1e-6):
        raise DemoError(f"{file}: time does not advance by {1 / FPS} s a frame.")
    return data


def _object_name(file: Path) -> str:
    match = OBJECT_NAME.match(file.stem)
    if match is None:
        raise DemoError(f"{file}: the name must begin with the object's name.")
    return match[0]


def _mesh_file(clip: Path) -> Path:
    return on_disk(clip.parent.parent / "meshes" / f"{_object_name(clip)}.stl")


def _origin(root: Path) -> dict[str, str]:
    """Package and hash of the fetched folder; nothing for a folder made by hand."""
    file = root / "source.json"
    if not file.is_file():
        return {}
    with suppress(DemoError, KeyError, TypeError):
        stored = read_json(file, "not JSON")
        return {"package": str(stored["source"]), "sha256": str(stored["sha256"])}
    return {}


SOURCE = Source(
    name="myodm",
    list=list_myodm,
    about="the folder of `flashdex fetch myodm` (found by itself)",
    licence=NOTE,
    needs=(),
)
