"""Keypoints of the MyoHand model from its joint positions (MuJoCo kinematics)."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

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
    """Keypoints of joint positions; no joint is clamped to its range.

    Args:
        tree: ``myohand_body.xml``.
        joint_pos: six root joints, then the hand's, m and rad, (T, 29).

    Returns:
        m, world, (T, 21, 3).
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
    import mujoco

    text = _read(tree)
    try:
        root = ET.fromstring(text)
        model = mujoco.MjModel.from_xml_string(_plain_xml(root))
        owners = tuple(_owner(model, name) for name in ELEMENTS)
    except (ET.ParseError, ValueError, KeyError) as error:
        raise DemoError(f"{tree}: not the MyoHand tree ({error}).") from error
    if model.nq != NUM_JOINTS:
        raise DemoError(f"{tree}: {model.nq} joints, expected {NUM_JOINTS}.")
    return model, owners


def _read(tree: Path) -> str:
    try:
        data = tree.read_bytes()
    except OSError as error:
        raise DemoError(f"{tree}: cannot be read ({error}).") from error
    if len(data) > MAX_BYTES or b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise DemoError(f"{tree}: not the MyoHand tree (too large, or a DOCTYPE).")
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
    is_site = name.startswith("site:")
    if is_site:
        return True, model.site(name.removeprefix("site:")).id
    return False, model.body(name).id
