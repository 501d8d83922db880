"""What memory use depends on in a collection, and a tiny library with the same shapes.

A library of many motions is not opened frame by frame to know its sizes, and one that
is not prepared yet has none: sizes are read off a stand-in of two motions with as many
hands, slots, parts, points and grid nodes.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from flashdex.envs.scene.scene import SceneLayout
from flashdex.keys import SIDES
from flashdex.motions.library import NUM_OBJECT_SLOTS, MotionLibrary
from flashdex.objects.asset import ObjectSettings
from flashdex.recipe import Recipe
from flashdex.training.build import library_name, select_motions

# Assumed of recordings that are not prepared yet.
MOTIONS = 100
SECONDS = 20.0
SUPPORTS = 4  # discs a motion can have
# Rows of a stand-in, all different: what has as many rows grows with that count.
STAND_IN_MOTIONS, STAND_IN_OBJECTS, STAND_IN_FRAMES = 2, 3, 22
_KEYPOINTS, _TIPS = 21, 5


@dataclass(frozen=True)
class Collection:
    """Sizes of a collection.

    Attributes:
        known: read from a prepared library; the worst case otherwise.
        motions: motions M.
        frames: frames of all motions F.
        longest: frames of the longest motion.
        objects: objects Q.
        points: surface points of an object.
        nodes: nodes of a distance grid along each axis.
        slots: object slots of the library.
        hands: which hands any motion uses, [left, right].
        parts: convex parts of each slot that is used.
        supports: support discs.
        vertices: most vertices of a convex part.
        fps: frames a second.
    """

    known: bool
    motions: int
    frames: int
    longest: int
    objects: int
    points: int
    nodes: int
    slots: int
    hands: tuple[bool, bool]
    parts: tuple[int, ...]
    supports: int
    vertices: int
    fps: float


def find_library(recipe: Recipe) -> MotionLibrary | None:
    """The prepared library of a recipe with the motions it selects, or None.

    Its frames are left out: only their number counts here.

    Args:
        recipe: validated recipe.

    Raises:
        LibraryError: it is broken, or nothing in it is selected.
    """
    folder = recipe.motions.library
    path = Path(folder) if folder else Path("libraries") / library_name(recipe)
    if not (path / "manifest.json").is_file():
        return None
    library = MotionLibrary.load(path)
    empty = TensorDict({}, batch_size=library.frames.batch_size)
    return select_motions(dataclasses.replace(library, frames=empty), recipe)


def read_sizes(library: MotionLibrary) -> Collection:
    """Sizes of a prepared library, of all its motions."""
    layout, objects = SceneLayout.of(library), library.objects
    # as many as any part may have; the files of all parts are not read for that
    length = library.motions["length"]
    return Collection(
        known=True,
        motions=library.num_motions,
        frames=int(length.sum()),
        longest=int(length.max()),
        objects=len(objects),
        points=objects["points"].shape[1],
        nodes=objects["sdf"].shape[1],
        slots=library.motions["object_index"].shape[1],
        hands=("left" in layout.sides, "right" in layout.sides),
        parts=layout.num_parts,
        supports=layout.num_supports,
        vertices=ObjectSettings().max_vertices,
        fps=library.fps,
    )


def worst_sizes(recipe: Recipe) -> Collection:
    """Sizes that recordings have at most, as far as the recipe says anything of them.

    Both hands, all slots full, every object of the most parts and its own for each
    motion; ``motions.count`` motions, or `MOTIONS`, of `SECONDS`.
    """
    settings, motions = ObjectSettings(), recipe.motions
    count = motions.count or MOTIONS
    longest = round(SECONDS * motions.control_hz)
    return Collection(
        known=False,
        motions=count,
        frames=count * longest,
        longest=longest,
        objects=NUM_OBJECT_SLOTS * count,
        points=settings.num_points,
        nodes=settings.sdf_resolution,
        slots=NUM_OBJECT_SLOTS,
        hands=(True, True),
        parts=(settings.max_parts,) * NUM_OBJECT_SLOTS,
        supports=SUPPORTS,
        vertices=settings.max_vertices,
        fps=motions.control_hz,
    )


class StandIn(MotionLibrary):
    """Two motions and three objects of the sizes of a collection, all else made up."""

    num_parts: int = 1
    num_vertices: int = 8

    def parts(self, object_row: int) -> list[np.ndarray]:
        """Balls of the most vertices, one beside the other, m, (V, 3) each."""
        g = np.random.default_rng(object_row)
        ball = g.normal(size=(self.num_vertices, 3))
        ball *= (0.02 + 0.01 * object_row) / np.linalg.norm(ball, axis=-1)[:, None]
        steps = np.arange(self.num_parts) * 0.05
        # Rounded as library files are: models are compiled from text.
        shifts = steps[:, None] * np.array([1.0, 0.0, 0.0])
        return [np.round(ball + s, 4).astype(np.float32) for s in shifts]


def stand_in(sizes: Collection, *, joints: int, hand: str) -> StandIn:
    """Make the small library.

    Args:
        sizes: of the collection.
        joints: joints J of a hand.
        hand: its name.
    """
    names = [f"motion{i}" for i in range(STAND_IN_MOTIONS)]
    library = StandIn(
        path=Path("stand-in"),
        frames=_frames(joints, sizes.slots),
        motions=_motions(sizes),
        objects=_objects(sizes),
        manifest={
            "fps": sizes.fps,
            "hand": hand,
            "motions": [{"name": name} for name in names],
        },
    )
    library.num_parts = max(sizes.parts, default=1)
    library.num_vertices = sizes.vertices
    return library


def _frames(joints: int, slots: int) -> TensorDict:
    rows, hands = STAND_IN_FRAMES, len(SIDES)
    quat = torch.zeros(rows, 2, 4)
    quat[..., 0] = 1.0
    frames = {
        "joint_pos": torch.zeros(rows, hands, joints),
        "joint_vel": torch.zeros(rows, hands, joints),
        "wrist_pos": torch.zeros(rows, hands, 3),
        "wrist_quat": quat.clone(),
        "wrist_linvel": torch.zeros(rows, hands, 3),
        "wrist_angvel": torch.zeros(rows, hands, 3),
        "keypoints": torch.zeros(rows, hands, _KEYPOINTS, 3),
        "keypoint_linvel": torch.zeros(rows, hands, _KEYPOINTS, 3),
        "tip_dist": torch.zeros(rows, hands, _TIPS),
        "object_pos": torch.zeros(rows, slots, 3),
        "object_quat": quat[:, :1].repeat(1, slots, 1),
        "object_linvel": torch.zeros(rows, slots, 3),
        "object_angvel": torch.zeros(rows, slots, 3),
    }
    return TensorDict(frames, batch_size=[rows])


def _motions(sizes: Collection) -> TensorDict:
    used, half = len(sizes.parts), STAND_IN_FRAMES // STAND_IN_MOTIONS
    index = torch.full((2, sizes.slots), -1)
    for slot in range(used):  # the objects change places
        index[:, slot] = torch.tensor([slot % 2, (slot + 1) % 2])
    owner = [min(hand, used - 1) for hand in range(2)]
    discs = torch.full((2, SUPPORTS, 5), torch.nan)
    discs[:, : sizes.supports] = torch.tensor([0.0, 0.0, 0.0, 0.3, 0.02])
    return TensorDict(
        {
            "start": torch.tensor([0, half]),
            "length": torch.tensor([half, half]),
            "hand_active": torch.tensor([sizes.hands] * 2),
            "hand_object": torch.tensor([owner] * 2),
            "object_index": index,
            "support_disks": discs,
        },
        batch_size=[2],
    )


def _objects(sizes: Collection) -> TensorDict:
    count, grid = STAND_IN_OBJECTS, (sizes.nodes,) * 3
    objects = {
        "points": torch.zeros(count, sizes.points, 3),
        "normals": torch.zeros(count, sizes.points, 3),
        "radius": torch.ones(count),
        "sdf": torch.ones(count, *grid),
        "sdf_origin": torch.zeros(count, 3),
        "sdf_spacing": torch.ones(count),
        "mass": 0.1 + 0.1 * torch.arange(count),
        "com": torch.zeros(count, 3),
        "inertia": 1e-4 * torch.eye(3).repeat(count, 1, 1),
        "aabb": torch.zeros(count, 2, 3),
    }
    return TensorDict(objects, batch_size=[count])
