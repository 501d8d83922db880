"""The embedded collection: made-up human motions that look like reconstructed mocap.

A parametric human hand grasps a simple object, lifts, moves and turns it, and puts it
down. Keypoints carry smooth noise, and fingertips stay some millimetres off the
surface, as in real recordings. Everything follows from the seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from flashdex.datasets.demo import DemoObject, HumanDemo
from flashdex.datasets.procedural.carry import SHAPES, CarryPlan, Track, carry_track
from flashdex.datasets.source import Recording, Source, SourceOptions
from flashdex.datasets.tracks import continuous, to_quat
from flashdex.errors import UnknownSourceError
from flashdex.keys import SIDES, Side

Action = Literal["pick", "turn", "tilt"]
FPS = 60.0
NOISE_RIGID = 0.0018  # m, of the whole hand
NOISE_TURN = np.deg2rad(1.0)
NOISE_POINT = 0.0015  # m, of each keypoint
NOISE_SECONDS = 0.2
MIRROR = np.array([-1.0, 1.0, 1.0])  # of the left hand: all shapes are symmetric in x
HAND_X = 0.16  # m, how far beside the middle each hand works when both do


@dataclass(frozen=True)
class Kind:
    """What a motion shows: an action, and per acting hand the shape it moves."""

    action: Action
    shapes: dict[Side, str]

    @property
    def name(self) -> str:
        """For example ``pick_box_right`` or ``pick_bowl_spoon_both``."""
        shapes = "_".join(self.shapes[s] for s in SIDES if s in self.shapes)
        hands = "both" if len(self.shapes) == 2 else next(iter(self.shapes))
        return f"{self.action}_{shapes}_{hands}"


def _kinds() -> dict[str, Kind]:
    kinds = [
        Kind(action, {side: shape})
        for action in ("pick", "turn", "tilt")
        for side in ("right", "left")
        for shape in ("box", "cylinder", "sphere", "capsule", "bowl", "spoon")
    ]
    kinds += [
        Kind(action, {"left": left, "right": right})
        for action in ("pick", "turn")
        for left in ("bowl", "box")
        for right in ("spoon", "cylinder")
    ]
    return {k.name: k for k in kinds}


KINDS = _kinds()
QUICKSTART = (
    "pick_box_right",
    "pick_cylinder_left",
    "turn_capsule_right",
    "pick_box_cylinder_both",
)


def procedural(
    seed: int = 0, count: int | None = None, kinds: Sequence[str] = QUICKSTART
) -> list[HumanDemo]:
    """Human demonstrations, named by their kind; repetitions get a number.

    Args:
        seed: of everything; a motion does not depend on how many others are made.
        count: the kinds are gone through again and again; by default one of each.
        kinds: names in ``KINDS``.
    """
    listed = _list(seed, count, kinds)
    return [demo for recording in listed for demo in recording.read()]


def _list(seed: int, count: int | None, kinds: Sequence[str]) -> list[Recording]:
    for kind in kinds:
        if kind not in KINDS:
            raise UnknownSourceError(kind, KINDS, where="procedural motions")
    count = len(kinds) if count is None else count
    listed = []
    for i in range(count):
        kind, again = kinds[i % len(kinds)], i // len(kinds)
        name = kind if count <= len(kinds) else f"{kind}_{again:02d}"
        read = partial(_make, kind, name, seed, again)
        listed.append(Recording(name=name, read=read, key=f"{seed} {again}"))
    return listed


def list_procedural(options: SourceOptions) -> list[Recording]:
    """``path`` chooses: quickstart (default), all, or kinds separated by commas."""
    chosen = str(options.path or "quickstart")
    presets = {"quickstart": list(QUICKSTART), "all": list(KINDS)}
    kinds = presets.get(chosen) or [k.strip() for k in chosen.split(",")]
    return _list(options.seed, options.limit, kinds)


def _make(name_of_kind: str, name: str, seed: int, again: int) -> list[HumanDemo]:
    kind = KINDS[name_of_kind]
    rng = np.random.default_rng([seed, again, *kind.name.encode()])
    tracks: dict[Side, Track] = {}
    bodies: dict[Side, tuple[str, trimesh.Trimesh]] = {}
    for side, shape_name in kind.shapes.items():
        shape = SHAPES[shape_name](rng)
        plan = _plan(kind, rng)
        tracks[side] = carry_track(shape, plan, rng, fps=FPS)
        bodies[side] = (shape_name, shape.mesh)
    frames = min(len(t.object_pos) for t in tracks.values())
    keypoints, objects = {}, []
    for side, track in tracks.items():
        track = track.mirrored(MIRROR) if side == "left" else track
        points = track.keypoints[:frames]
        keypoints[side] = points + _noise(points, rng)
        quats = continuous(to_quat(track.object_rot))
        pose = np.concatenate([track.object_pos, quats], axis=1)[:frames]
        objects.append(DemoObject(*bodies[side], pose))
    demo = HumanDemo(
        name=name,
        fps=FPS,
        keypoints=keypoints,
        objects=objects,
        hand_object={side: i for i, side in enumerate(tracks)},
        source=SOURCE.name,
        licence=SOURCE.licence,
        support_z=0.0,
        task=kind.action,
        provenance={"seed": seed, "again": again},
    )
    return [demo]


def _plan(kind: Kind, rng: np.random.Generator) -> CarryPlan:
    both = len(kind.shapes) == 2
    angle = np.deg2rad(rng.uniform(-60, 60) if both else rng.uniform(-180, 180))
    turn = np.deg2rad(rng.uniform(20, 60)) * rng.choice([-1, 1])
    tilt = np.deg2rad(rng.uniform(15, 30)) * rng.choice([-1, 1])
    return CarryPlan(
        start=np.array([HAND_X if both else 0.0, 0.0]) + rng.uniform(-0.02, 0.02, 2),
        # with both hands at work the objects move outwards, away from one another
        move=rng.uniform(0.08, 0.15) * np.array([np.cos(angle), np.sin(angle)]),
        lift=rng.uniform(0.08, 0.15),
        turn=turn if kind.action == "turn" else 0.15 * turn,
        tilt=tilt if kind.action == "tilt" else 0.0,
        yaw=np.pi / 2 + np.deg2rad(rng.uniform(-20, 20)),
        speed=rng.uniform(0.95, 1.05),
    )


def _noise(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Smooth reconstruction noise of keypoints (T, 21, 3), m: rigid and single."""
    frames = len(points)
    shift = NOISE_RIGID * smooth_noise((frames, 1, 3), rng)
    turn = Rotation.from_rotvec(NOISE_TURN * smooth_noise((frames, 3), rng))
    arms = points - points[:, 9:10]
    turned = np.einsum("tij,tkj->tki", turn.as_matrix(), arms) - arms
    return shift + turned + NOISE_POINT * smooth_noise(points.shape, rng)


def smooth_noise(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Unit-variance Gaussian noise along axis 0, correlated over about 0.2 s."""
    sigma = NOISE_SECONDS * FPS / 2
    pad = int(4 * sigma)
    white = rng.standard_normal((shape[0] + 2 * pad, *shape[1:]))
    smooth = gaussian_filter1d(white, sigma, axis=0)[pad:-pad]
    # variance that a Gaussian filter of this width leaves of white noise
    return smooth * np.sqrt(2 * np.sqrt(np.pi) * sigma)


SOURCE = Source(
    name="procedural",
    list=list_procedural,
    about="nothing: makes motions up. --input quickstart, all, or kinds with commas",
    licence="Apache-2.0",
    needs=(),
    made_up=True,
)
