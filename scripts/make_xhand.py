"""Write the XHand MJCF of one side from a table of facts.

Usage: python scripts/make_xhand.py FACTS.json OUTPUT.xml

The table lists bodies, joints, fingertips and fitted primitives (metres, kilograms,
radians, quaternions wxyz). The output holds the hand only: wrist joints, actuators and
gains belong to ``flashdex.hands.attach``, so that they can change without a new model.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

# the rota link crosses the palm box in every pose: its parent, the bend link, is only
# a short stub inside the palm
GRANDPARENT_EXCLUDES = [("hand_index_rota_link1", "hand_link")]
SOURCE = " masses, frames and ranges: XHAND1 URDF, BSD-3-Clause, (c) 2024 RobotEra "


def text(values: Any) -> str:
    """Format numbers for an attribute: nine digits, no negative zero."""
    return " ".join(f"{v + 0.0:.9g}" for v in np.atleast_1d(values))


def short(name: str) -> str:
    """Drop the side, which comes back as the prefix of the attached hand."""
    return name.removeprefix("left_").removeprefix("right_")


def select_geoms(primitives: dict[str, Any]) -> list[dict[str, Any]]:
    """Take the narrow capsules where they exist: the fitted ones overlap neighbours."""
    narrow = {g["body"]: g for g in primitives["narrow_finger_alternative"]["geoms"]}
    return [{**g, **narrow.get(g["body"], {})} for g in primitives["geoms"]]


def compute_pad(geom: dict[str, Any], finger: str, side: str) -> tuple[Any, Any]:
    """Return centre of the distal end sphere and the tracking point on the pad, m.

    The tracking point lies on the sphere, halfway between distal and palmar.
    """
    palmar_y = 1.0 if side == "right" else -1.0
    ends = np.asarray(geom["fromto"], dtype=float).reshape(2, 3)
    if finger == "thumb":
        distal, palmar = np.array([1.0, 0, 0]), np.array([0, 0, -1.0])
    else:
        distal, palmar = np.array([0, 0, -1.0]), np.array([0, palmar_y, 0])
    center = ends[np.argmax(ends @ distal)]
    return center, center + geom["radius"] * (distal + palmar) / np.sqrt(2.0)


def add_geoms(element: ET.Element, body: str, geoms: list[dict[str, Any]]) -> None:
    """Append the primitives of one body."""
    for geom in (g for g in geoms if g["body"] == body):
        item = ET.SubElement(element, "geom", name=geom["name"], type=geom["type"])
        if geom["type"] == "box":
            item.set("pos", text(geom["pos"]))
            item.set("size", text(geom["half"]))
        else:
            item.set("fromto", text(geom["fromto"]))
            item.set("size", text(geom["radius"]))


def add_sites(
    element: ET.Element, body: str, facts: dict[str, Any], geoms: list[dict[str, Any]]
) -> None:
    """Append vendor tip, pad (tracking point) and end sphere of a distal link."""
    for tip in (t for t in facts["fingertips"] if t["body"] == body):
        finger = tip["finger"]
        geom = next(g for g in geoms if g["body"] == body)
        center, pad = compute_pad(geom, finger, facts["side"])
        ET.SubElement(element, "site", name=f"tip_{finger}", pos=text(tip["pos"]))
        ET.SubElement(element, "site", name=f"pad_{finger}", pos=text(pad))
        size = text(geom["radius"])
        name = f"center_{finger}"
        ET.SubElement(element, "site", name=name, pos=text(center), size=size)


def add_body(
    parent: ET.Element, row: dict[str, Any], facts: dict[str, Any]
) -> ET.Element:
    """Append one link with its joint, inertia, geoms and sites."""
    body = ET.SubElement(parent, "body", name=short(row["name"]))
    if row["parent"] is not None:
        body.set("pos", text(row["pos"]))
        body.set("quat", text(row["quat_wxyz"]))
    ET.SubElement(
        body,
        "inertial",
        pos=text(row["com"]),
        mass=text(row["mass"]),
        fullinertia=text(row["fullinertia_xx_yy_zz_xy_xz_yz"]),
    )
    for joint in (j for j in facts["joints"] if j["body"] == row["name"]):
        ET.SubElement(
            body,
            "joint",
            name=short(joint["name"]),
            axis=text(joint["axis"]),
            range=text(joint["range"]),
        )
    geoms = select_geoms(facts["recommended_primitives"])
    add_geoms(body, row["name"], geoms)
    if row["parent"] is None:
        ET.SubElement(body, "site", name="palm")
    add_sites(body, row["name"], facts, geoms)
    return body


def make_mjcf(facts: dict[str, Any]) -> str:
    """Return the MJCF of one side."""
    root = ET.Element("mujoco", model=f"xhand_{facts['side']}")
    root.append(ET.Comment(SOURCE))
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    default = ET.SubElement(root, "default")
    ET.SubElement(
        default,
        "geom",
        contype="1",
        conaffinity="1",
        condim="3",
        friction="1 .005 .0001",
    )
    ET.SubElement(default, "site", size=".002", group="4")
    world = ET.SubElement(root, "worldbody")
    contact = ET.SubElement(root, "contact")
    elements: dict[str, ET.Element] = {}
    for row in facts["bodies"]:
        parent = world if row["parent"] is None else elements[row["parent"]]
        elements[row["name"]] = add_body(parent, row, facts)
    pairs = [(b["name"], b["parent"]) for b in facts["bodies"] if b["parent"]]
    for first, second in [*pairs, *GRANDPARENT_EXCLUDES]:
        ET.SubElement(contact, "exclude", body1=short(first), body2=short(second))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def main() -> None:
    """Read the table, write the model."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("facts", type=Path)
    parser.add_argument("output", type=Path)
    args = parser.parse_args()
    args.output.write_text(make_mjcf(json.loads(args.facts.read_text())))


if __name__ == "__main__":
    main()
