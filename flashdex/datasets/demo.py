"""A human demonstration: what a recording must hold before it can be prepared."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh

from flashdex.datasets.roots import refuse_odd_name
from flashdex.datasets.tracks import blank_fillers, palm_frame
from flashdex.errors import DemoError
from flashdex.keys import SIDES, Side
from flashdex.objects.meshes import load_mesh

MIN_SECONDS, MAX_SECONDS = 1.0, 20.0  # of a motion
LEAST_FRAMES, LEAST_SECONDS = 10, 0.5  # below, a recording is refused as it is read
QUAT_TOLERANCE = 1e-2
# turns a recording's up axis into +z: y-up is (x, y, z) -> (x, -z, y)
UP_ROTATION = {"z": 0.0, "y": np.pi / 2, "-y": -np.pi / 2}


@dataclass
class DemoObject:
    """One rigid object of a demonstration."""

    name: str  # unique within a library together with the mesh's content
    mesh: Path | trimesh.Trimesh  # or its file; metres, in the frame of ``pose``
    pose: np.ndarray  # position (m) and quaternion (wxyz) in the world, (T, 7)

    def __post_init__(self) -> None:
        """Blank what was not tracked, see ``blank_fillers``."""
        self.pose = blank_fillers(self.pose)

    def load_mesh(self) -> trimesh.Trimesh:
        """The mesh, read from its file if it is given as one; not cleaned."""
        if isinstance(self.mesh, trimesh.Trimesh):
            return self.mesh
        return load_mesh(self.mesh)


@dataclass
class HumanDemo:
    """One recorded human motion, before any processing; numpy float64.

    A frame in which a hand or an object was not tracked holds NaN in all its tracks;
    the marks that data sets write there (zeros, -1) become NaN here.
    ``flashdex.motions.repair`` closes short gaps and cuts at long ones before a motion
    is validated.
    """

    name: str  # unique in its collection; also the name of files made from it
    fps: float  # frames a second of every track
    # per recorded hand (T, 21, 3), m, world; 0 wrist, then four a finger, thumb first
    keypoints: dict[Side, np.ndarray]
    # per recorded hand (T, 7): wrist position (m) and quaternion (wxyz) of the palm
    # frame: x to the middle MCP, z out of the palm; by default that of the keypoints
    palm: dict[Side, np.ndarray] = field(default_factory=dict)
    objects: list[DemoObject] = field(default_factory=list)
    # place in ``objects`` of what a hand uses; a hand missing here: by contact
    hand_object: dict[Side, int] = field(default_factory=dict)
    source: str = ""  # the reader's name
    licence: str = ""  # of the recording
    up: Literal["z", "y", "-y"] = "z"  # axis of the recording's world
    support_z: float | None = None  # height of the table in it, m, if known
    # a session of many actions, to be cut where contact begins and ends
    needs_cutting: bool = False
    split: str = ""  # of the dataset's own partition (train, test, ...)
    task: str = ""  # in the dataset's words
    # files, frame range, and what the reader decided; JSON values, for the manifest
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Blank what was not tracked, fill in the palms; validation tells the rest."""
        self.keypoints = {s: blank_fillers(p) for s, p in self.keypoints.items()}
        self.palm = {s: blank_fillers(p) for s, p in self.palm.items()}
        for side, points in self.keypoints.items():
            if side not in self.palm and points.shape[1:] == (21, 3):
                self.palm[side] = palm_frame(points, side)

    @property
    def num_frames(self) -> int:
        """Frames of the first object's track."""
        return len(self.objects[0].pose) if self.objects else 0

    @property
    def seconds(self) -> float:
        """Duration, s."""
        return self.num_frames / self.fps

    def validate(self, *, complete: bool = True) -> None:
        """Refuse a recording that cannot be used: motion, track and first frame.

        With ``complete`` every frame must be tracked, and there must be enough of them;
        before repair, only what repair cannot mend counts.
        """
        refuse_odd_name(self.name, what="motion")
        for body in self.objects:
            refuse_odd_name(body.name, what="object", where=self.name)
        if not self.keypoints:
            raise DemoError(
                f"{self.name}: no hand. Give keypoints for 'left', 'right'."
            )
        if not self.objects:
            raise DemoError(f"{self.name}: no object. Give a mesh and its poses.")
        if not np.isfinite(self.fps) or self.fps <= 0:
            raise DemoError(f"{self.name}: fps is {self.fps}; it must be positive.")
        self._check_shapes()
        for body in self.objects:
            self._check_mesh(body)
        if complete:
            self._check_values()
            self._check_length()

    def _check_shapes(self) -> None:
        frames = self.num_frames
        for side, track in self.keypoints.items():
            if side not in SIDES:
                raise DemoError(f"{self.name}: hand '{side}'; allowed: left, right.")
            self._check_shape(f"keypoints of the {side} hand", track, (frames, 21, 3))
            if side not in self.palm:
                raise DemoError(f"{self.name}: the {side} hand has no palm pose.")
            self._check_shape(f"palm of the {side} hand", self.palm[side], (frames, 7))
        for body in self.objects:
            self._check_shape(f"pose of object '{body.name}'", body.pose, (frames, 7))
        for side, slot in self.hand_object.items():
            if side not in self.keypoints or not 0 <= slot < len(self.objects):
                raise DemoError(
                    f"{self.name}: hand_object[{side!r}] = {slot}, but there are "
                    f"{len(self.objects)} objects and hands {sorted(self.keypoints)}."
                )

    def _check_shape(self, what: str, array: np.ndarray, shape: tuple) -> None:
        if array.shape != shape:
            raise DemoError(
                f"{self.name}: {what} has shape {array.shape}, expected {shape} "
                f"(all tracks of a motion have the same number of frames)."
            )

    def _check_values(self) -> None:
        tracks = {f"keypoints of the {s} hand": k for s, k in self.keypoints.items()}
        tracks |= {f"palm of the {s} hand": p for s, p in self.palm.items()}
        tracks |= {f"pose of object '{b.name}'": b.pose for b in self.objects}
        for what, track in tracks.items():
            bad = ~np.isfinite(track.reshape(len(track), -1)).all(axis=1)
            if bad.any():
                raise DemoError(
                    f"{self.name}: {what} holds NaN or infinity in {bad.sum()} frames, "
                    f"first in frame {int(bad.argmax())}. Interpolate or cut them."
                )
            if track.shape[-1] == 7:
                self._check_quats(what, track[:, 3:])

    def _check_quats(self, what: str, quats: np.ndarray) -> None:
        off = np.abs(np.linalg.norm(quats, axis=-1) - 1)
        if (off > QUAT_TOLERANCE).any():
            frame = int(off.argmax())
            raise DemoError(
                f"{self.name}: {what}: quaternion of frame {frame} has norm "
                f"{np.linalg.norm(quats[frame]):.3f}. Quaternions are wxyz, unit."
            )

    def _check_mesh(self, body: DemoObject) -> None:
        if isinstance(body.mesh, trimesh.Trimesh):
            if len(body.mesh.faces) < 4:
                raise DemoError(f"{self.name}: mesh of '{body.name}' has no volume.")
        elif not Path(body.mesh).is_file():
            raise DemoError(
                f"{self.name}: mesh of object '{body.name}' not found: {body.mesh}"
            )

    def _check_length(self) -> None:
        if self.num_frames < LEAST_FRAMES or self.seconds < LEAST_SECONDS:
            raise DemoError(
                f"{self.name}: too short: {self.num_frames} frames, "
                f"{self.seconds:.2f} s; at least {LEAST_FRAMES} frames and "
                f"{LEAST_SECONDS} s are needed."
            )

    def cut(self, start: int, end: int, *, name: str) -> HumanDemo:
        """The frames ``start`` (included) to ``end`` (excluded) as a motion."""
        first = self.provenance.get("frames", [0])[0]
        return replace(
            self,
            name=name,
            keypoints={s: k[start:end] for s, k in self.keypoints.items()},
            palm={s: p[start:end] for s, p in self.palm.items()},
            objects=[
                DemoObject(b.name, b.mesh, b.pose[start:end]) for b in self.objects
            ],
            hand_object=dict(self.hand_object),
            needs_cutting=False,
            provenance=self.provenance | {"frames": [first + start, first + end]},
        )
