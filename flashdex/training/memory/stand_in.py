"""What memory use depends on in a collection, and two made-up motions of such sizes.

A library of many motions is not opened frame by frame to know its sizes, and one that
is not prepared yet has none.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from flashdex import keys
from flashdex.envs.scene.scene import SceneLayout
from flashdex.motions.library import MotionLibrary
from flashdex.motions.library_format import FRAME_KEYS, NUM_OBJECT_SLOTS
from flashdex.objects.asset import ObjectSettings
from flashdex.recipe import Recipe
from flashdex.training.build import library_name, select_motions

# Assumed of motions that are not prepared yet: motions, seconds, support discs.
MOTIONS, SECONDS, SUPPORTS = 100, 20.0, 4
# Rows of the stand-in, all different: what has as many rows grows with that count.
_MOTIONS, _OBJECTS, _FRAMES = 2, 3, 22


@dataclass(frozen=True)
class Collection:
    """What memory depends on in the motions of a recipe."""

    known: bool  # read from a prepared library; the worst case otherwise
    layout: SceneLayout
    motions: int
    frames: int  # of all motions
    longest: int  # frames of the longest motion
    objects: int
    points: int  # surface points of an object
    nodes: int  # of a distance grid along each axis
    slots: int  # object slots of the library
    fps: float

    @classmethod
    def of(cls, library: MotionLibrary) -> Collection:
        """Sizes of a prepared library, of all its motions."""
        length, objects = library.motions["length"], library.objects
        return cls(
            known=True,
            layout=SceneLayout.of(library),
            motions=library.num_motions,
            frames=int(length.sum()),
            longest=int(length.max()),
            objects=len(objects),
            points=objects["points"].shape[1],
            nodes=objects["sdf"].shape[1],
            slots=library.motions["object_index"].shape[1],
            fps=library.fps,
        )

    @classmethod
    def assumed(cls, recipe: Recipe) -> Collection:
        """The worst case, as far as the recipe says anything of its motions.

        Both hands, all slots full, every object of the most parts and its own for each
        motion; ``motions.count`` motions, or `MOTIONS`, of `SECONDS`.
        """
        settings, slots = ObjectSettings(), NUM_OBJECT_SLOTS
        count = recipe.motions.count or MOTIONS
        longest = round(SECONDS * recipe.motions.control_hz)
        parts = (settings.max_parts,) * slots
        return cls(
            known=False,
            layout=SceneLayout(keys.SIDES, slots, parts, SUPPORTS),
            motions=count,
            frames=count * longest,
            longest=longest,
            objects=slots * count,
            points=settings.num_points,
            nodes=settings.sdf_resolution,
            slots=slots,
            fps=recipe.motions.control_hz,
        )


def find_library(recipe: Recipe) -> MotionLibrary | None:
    """The prepared library of a recipe with the motions it selects, or None.

    Its frames are left out: only their number counts here.

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


class StandIn(MotionLibrary):
    """Two motions and three objects of the sizes of a collection, all else made up."""

    num_parts: int = 1

    def parts(self, object_row: int) -> list[np.ndarray]:
        """Balls of the most vertices, one beside the other, m, (V, 3) each."""
        g = np.random.default_rng(object_row)
        # as many as any part may have; the files of all parts are not read for that
        ball = g.normal(size=(ObjectSettings().max_vertices, 3))
        ball *= (0.02 + 0.01 * object_row) / np.linalg.norm(ball, axis=-1)[:, None]
        steps = np.arange(self.num_parts) * 0.05
        # Rounded as library files are: models are compiled from text.
        shifts = steps[:, None] * np.array([1.0, 0.0, 0.0])
        return [np.round(ball + s, 4).astype(np.float32) for s in shifts]

    @classmethod
    def of(cls, sizes: Collection, *, joints: int, hand: str) -> StandIn:
        """Make it, for a hand of so many joints."""
        layout, half = sizes.layout, _FRAMES // _MOTIONS
        index = torch.full((_MOTIONS, sizes.slots), -1)
        for slot in range(layout.num_objects):  # the objects change places
            index[:, slot] = (torch.arange(_MOTIONS) + slot) % 2
        owner = [min(hand, layout.num_objects - 1) for hand in range(2)]
        discs = torch.full((_MOTIONS, SUPPORTS, 5), torch.nan)
        discs[:, : layout.num_supports] = torch.tensor([0.0, 0.0, 0.0, 0.3, 0.02])
        motions = {
            "start": torch.tensor([0, half]),
            "length": torch.tensor([half, half]),
            "hand_active": torch.tensor([[s in layout.sides for s in keys.SIDES]] * 2),
            "hand_object": torch.tensor([owner] * 2),
            "object_index": index,
            "support_disks": discs,
        }
        names = [{"name": f"motion{i}"} for i in range(_MOTIONS)]
        library = cls(
            path=Path("stand-in"),
            frames=_made_up_frames(joints, sizes.slots),
            motions=TensorDict(motions, batch_size=[_MOTIONS]),
            objects=_made_up_objects(sizes),
            manifest={"fps": sizes.fps, "hand": hand, "motions": names},
        )
        library.num_parts = max(layout.num_parts, default=1)
        return library

    @staticmethod
    def scale(buffers: list[Tensor], sizes: Collection) -> tuple[int, int]:
        """Bytes in the collection of tensors of the stand-in: frames, and objects.

        Each has a row a frame, a motion or an object.
        """
        counts = {_FRAMES: sizes.frames, _MOTIONS: sizes.motions}
        counts[_OBJECTS] = sizes.objects
        found = {True: 0, False: 0}
        for rows in buffers:
            found[len(rows) == _OBJECTS] += (
                rows.nbytes * counts.get(len(rows), len(rows)) // len(rows)
            )
        return found[False], found[True]


def _made_up_frames(joints: int, slots: int) -> TensorDict:
    widths = {"pos": 3, "quat": 4, "linvel": 3, "angvel": 3}
    shapes: dict[str, tuple[int, ...]] = {
        f"{what}_{name}": (rows, width)
        for what, rows in (("wrist", 2), ("object", slots))
        for name, width in widths.items()
    }
    shapes |= dict.fromkeys(("joint_pos", "joint_vel"), (2, joints))
    shapes |= dict.fromkeys(("keypoints", "keypoint_linvel"), (2, 21, 3))
    shapes["tip_dist"] = (2, 5)
    frames = {name: torch.zeros(_FRAMES, *shapes[name]) for name in FRAME_KEYS}
    for name in ("wrist_quat", "object_quat"):
        frames[name][..., 0] = 1.0
    return TensorDict(frames, batch_size=[_FRAMES])


def _made_up_objects(sizes: Collection) -> TensorDict:
    count, grid = _OBJECTS, (sizes.nodes,) * 3
    objects = {
        "points": torch.zeros(count, sizes.points, 3),
        "radius": torch.ones(count),
        "sdf": torch.ones(count, *grid),
        "sdf_origin": torch.zeros(count, 3),
        "sdf_spacing": torch.ones(count),
        "mass": 0.1 + 0.1 * torch.arange(count),
        "com": torch.zeros(count, 3),
        "inertia": 1e-4 * torch.eye(3).repeat(count, 1, 1),
    }
    return TensorDict(objects, batch_size=[count])
