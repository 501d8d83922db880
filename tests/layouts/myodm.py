"""A package file with the layout of MyoDM's, content made up."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import trimesh

CLIPS = "myosuite/envs/myo/myodm/data"
FRAMES = 60
BONE = 0.03
FINGERS = {2: "IF", 3: "MF", 4: "RF", 5: "LF"}
PALM = (0.05, 0.04, 0.02)  # elbow to wrist and to the hand's parts


def hand_tree() -> str:
    """Bodies, joints and tips with the names of MyoHand, plus things to be ignored."""
    fingers = "".join(_finger(f, site) for f, site in FINGERS.items())
    return f"""
<mujocoinclude>
  <body childclass="myohand" name="full_body">
    <geom name="body" type="mesh" mesh="no_such_mesh"/>
    <body name="radius" pos="0 0 1.4">
      <joint name="pro_sup" axis="1 0 0" class="wrist"/>
      <body name="lunate" pos="0 {PALM[0]} 0">
        <site name="some_muscle" pos="0 0 0"/>
        <joint name="deviation" axis="0 0 1"/>
        <joint name="flexion" axis="0 1 0"/>
        <body name="firstmc" pos="{PALM[1]} 0 0">
          <joint name="cmc_abduction" axis="0 0 1"/>
          <joint name="cmc_flexion" axis="0 1 0"/>
          <body name="proximal_thumb" pos="0 {BONE} 0">
            <joint name="mp_flexion" axis="1 0 0"/>
            <body name="distal_thumb" pos="0 {BONE} 0">
              <joint name="ip_flexion" axis="1 0 0"/>
              <site name="THtip" pos="0 0.02 0"/>
            </body>
          </body>
        </body>{fingers}
      </body>
    </body>
  </body>
</mujocoinclude>"""


def _finger(number: int, site: str) -> str:
    x = PALM[2] * (3.5 - number)
    return f"""
        <body name="proxph{number}" pos="{x} 0.09 0">
          <joint name="mcp{number}_flexion" axis="1 0 0"/>
          <joint name="mcp{number}_abduction" axis="0 0 1"/>
          <body name="midph{number}" pos="0 {BONE} 0">
            <joint name="pm{number}_flexion" axis="1 0 0"/>
            <body name="distph{number}" pos="0 {BONE} 0">
              <joint name="md{number}_flexion" axis="1 0 0"/>
              <site name="{site}tip" pos="0 0.02 0"/>
            </body>
          </body>
        </body>"""


def write_wheel(file: Path) -> Path:
    """Two clips: heights above the slide's body, and absolute ones (six entries)."""
    cup = trimesh.creation.box((0.05, 0.05, 0.08)).export(file_type="stl")
    robot = np.zeros((FRAMES, 29))
    robot[:, 2] = np.linspace(0.0, 0.1, FRAMES)  # the arm rises
    pose = np.tile([0.1, 0.2, 0.04, 1.0, 0, 0, 0], (FRAMES, 1))
    with zipfile.ZipFile(file, "w") as wheel:
        for name, entries in (("cup_lift", 7), ("knife_lift", 6)):
            data = io.BytesIO()
            np.savez(
                data,
                time=np.arange(FRAMES) * 0.02,
                robot=robot,
                object=pose,
                robot_init=np.zeros(29),
                object_init=np.zeros(entries),
            )
            wheel.writestr(f"{CLIPS}/MyoHand_{name}.npz", data.getvalue())
        for name in ("cup", "knife", "unused"):
            folder = f"myosuite/simhive/object_sim/{name}"
            wheel.writestr(f"{folder}/{name}.stl", cup)
            wheel.writestr(f"{folder}/contact0.stl", cup)
        tree = "myosuite/simhive/myo_sim/hand/assets/myohand_body.xml"
        wheel.writestr(tree, hand_tree())
        for licence in (
            "myosuite-2.12.2.dist-info/licenses/LICENSE",
            "myosuite/simhive/myo_sim/LICENSE",
            "myosuite/simhive/object_sim/LICENSE",
        ):
            wheel.writestr(licence, "terms")
    return file
