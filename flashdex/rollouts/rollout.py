"""A stored rollout: states, controls, reference and model in one npz file.

The file replays without the motion library: the MJCF is inside, meshes included. No
pickle is written or read.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from flashdex.errors import RunError
from flashdex.metrics.errors import Signals, compute_signals
from flashdex.system.files import open_atomic

ROLLOUT_SCHEMA = 1

# shape symbols: T control steps, O object slots, M joints of joint_error, H = 2 hands
SHAPES: dict[str, str] = {
    "qpos0": "nq",
    "qvel0": "nv",
    "ctrl": "T nu",
    "qpos": "T nq",
    "qvel": "T nv",
    "object_pos": "T O 3",
    "object_quat": "T O 4",
    "ref_object_pos": "T O 3",
    "ref_object_quat": "T O 4",
    "fingertips": "T 2 5 3",
    "ref_fingertips": "T 2 5 3",
    "joints": "T 2 M 3",
    "ref_joints": "T 2 M 3",
    "hand_active": "2",
    "hand_object": "2",
    "object_qpos_adr": "O",
    "object_qvel_adr": "O",
    "actions": "T 2 A",
    "wrist_pos": "T 2 3",
    "ref_wrist_pos": "T 2 3",
    "act0": "na",
    "wrench": "T O 6",
}


def check_schema(data: Mapping[str, np.ndarray], path: str | Path) -> None:
    """Refuse files of another format or version.

    Args:
        data: arrays of the file.
        path: file name for the message.
    """
    if "schema" not in data:
        raise RunError(f"{path}: missing key schema; this is not a flashdex rollout.")
    if int(data["schema"]) != ROLLOUT_SCHEMA:
        raise RunError(
            f"{path}: schema {int(data['schema'])}, this version reads "
            f"{ROLLOUT_SCHEMA}. Store the rollout again or use the matching version."
        )


def check_shape(
    key: str, value: np.ndarray, symbols: str, sizes: dict[str, int], where: str
) -> None:
    """Compare a shape with its symbols; a symbol keeps the size it first had.

    Args:
        key: name of the array.
        value: the array.
        symbols: e.g. ``T 2 5 3``.
        sizes: sizes seen so far; new symbols are added.
        where: file name for the message.
    """
    names = symbols.split()
    fits = value.ndim == len(names) and all(
        size == (int(name) if name.isdigit() else sizes.setdefault(name, size))
        for name, size in zip(names, value.shape, strict=True)
    )
    if not fits:
        known = ", ".join(f"{n}={sizes[n]}" for n in names if n in sizes)
        raise RunError(
            f"{where}: {key} has shape {value.shape}, expected ({symbols})"
            f"{' with ' + known if known else ''}. Store the rollout again."
        )


def check_json(key: str, text: str, where: str) -> None:
    """Refuse a field that is not JSON; ``wrist_bodies`` may be empty.

    Args:
        key: name of the field.
        text: its content.
        where: file name for the message.
    """
    if not text and key == "wrist_bodies":
        return
    try:
        json.loads(text)
    except json.JSONDecodeError as error:
        raise RunError(f"{where}: {key} is not JSON ({error}).") from error


@dataclass
class Rollout:
    """One attempt, with everything that is needed to replay and to judge it.

    Row t of every (T, ...) array belongs to control step t: ``ctrl[t]`` is applied for
    ``decimation`` substeps, the states are those AFTER it, and ``ref_*[t]`` is the
    reference it is scored on. World frame, metres, radians, quaternions wxyz.

    Args:
        motion: motion id.
        hand: name of the hand model.
        fps: control rate, Hz.
        decimation: substeps a control step.
        grace: first steps that the ManipTrans family does not score.
        qpos0: first state, (nq,).
        qvel0: (nv,).
        ctrl: position targets, (T, nu).
        qpos: (T, nq).
        qvel: (T, nv).
        object_pos: object frames, m, (T, O, 3).
        object_quat: (T, O, 4).
        ref_object_pos: (T, O, 3).
        ref_object_quat: (T, O, 4).
        fingertips: pad points, m, (T, 2, 5, 3).
        ref_fingertips: human tips, m, (T, 2, 5, 3).
        joints: level-1 links, then distal links, m, (T, 2, M, 3).
        ref_joints: human joints in the same order, m, (T, 2, M, 3).
        hand_active: hands [left, right] that take part, (2,) bool.
        hand_object: object slot of each hand, -1 without object, (2,).
        object_qpos_adr: address of each free joint, -1 for an empty slot, (O,).
        object_qvel_adr: (O,).
        joint_bodies: JSON, per hand the M body names behind ``joints``.
        model_xml: self-contained MJCF.
        criterion: name of the criterion the rollout was stored for.
        errors: JSON, numbers of that criterion.
        versions: JSON, package versions and the engine that produced the states.
        seed: seed of the run.
        env_steps: env steps at which the rollout was made.
        actions: policy outputs, (T, 2, A).
        model_sha256: hash of ``model_xml``; computed when empty.
        num_ref_frames: length of the whole reference, -1 when it is T.
        wrist_pos: m, (T, 2, 3), or None.
        ref_wrist_pos: m, (T, 2, 3), or None.
        wrist_bodies: JSON, the two body names behind ``wrist_pos``, or empty.
        act0: first actuator state, (na,), or None for zeros.
        wrench: assist force and torque on each object, (T, O, 6), or None.
        provenance: JSON: recipe hash, collection hash, checkpoint hash, date, hardware.

    Example:
        >>> Rollout.load("runs/demo/rollouts/lift.npz").num_frames  # doctest: +SKIP
        240
    """

    motion: str
    hand: str
    fps: float
    decimation: int
    grace: int
    qpos0: np.ndarray
    qvel0: np.ndarray
    ctrl: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    object_pos: np.ndarray
    object_quat: np.ndarray
    ref_object_pos: np.ndarray
    ref_object_quat: np.ndarray
    fingertips: np.ndarray
    ref_fingertips: np.ndarray
    joints: np.ndarray
    ref_joints: np.ndarray
    hand_active: np.ndarray
    hand_object: np.ndarray
    object_qpos_adr: np.ndarray
    object_qvel_adr: np.ndarray
    joint_bodies: str
    model_xml: str
    criterion: str
    errors: str
    versions: str
    seed: int
    env_steps: int
    actions: np.ndarray
    model_sha256: str = ""
    num_ref_frames: int = -1
    wrist_pos: np.ndarray | None = None
    ref_wrist_pos: np.ndarray | None = None
    wrist_bodies: str = ""
    act0: np.ndarray | None = None
    wrench: np.ndarray | None = None
    provenance: str = "{}"

    def __post_init__(self) -> None:
        if not self.model_sha256:
            self.model_sha256 = xml_sha256(self.model_xml)
        self.validate()

    @property
    def num_frames(self) -> int:
        """Control steps, T."""
        return len(self.ctrl)

    def signals(self) -> Signals:
        """Errors of the STORED states, as training saw them."""
        names = ("object_pos", "object_quat", "fingertips", "joints", "wrist_pos")
        data = {key: getattr(self, key) for n in names for key in (n, f"ref_{n}")}
        return compute_signals(
            data,
            hand_active=self.hand_active.tolist(),
            hand_object=self.hand_object.tolist(),
            fps=self.fps,
            num_ref_frames=self.reference_length,
        )

    @property
    def reference_length(self) -> int:
        """Rows of the whole reference."""
        return self.num_frames if self.num_ref_frames < 0 else self.num_ref_frames

    def validate(self, *, where: str = "rollout") -> None:
        """Check shapes, JSON fields and the model hash; raise RunError on the first.

        Args:
            where: file name for the message.
        """
        sizes: dict[str, int] = {"T": len(self.ctrl)}
        for key, symbols in SHAPES.items():
            value = getattr(self, key)
            if value is not None:
                check_shape(key, np.asarray(value), symbols, sizes, where)
        for key in ("joint_bodies", "errors", "versions", "provenance", "wrist_bodies"):
            check_json(key, getattr(self, key), where)
        if self.model_sha256 != xml_sha256(self.model_xml):
            raise RunError(
                f"{where}: model_sha256 does not match model_xml: the model was "
                "changed after the rollout was stored. Store the rollout again."
            )
        slots = self.hand_object[self.hand_active.astype(bool)]
        if (slots >= sizes["O"]).any():
            raise RunError(
                f"{where}: hand_object {slots.tolist()} names a slot beyond the "
                f"{sizes['O']} objects of object_pos. Allowed: -1 to {sizes['O'] - 1}."
            )

    def save(self, path: str | Path) -> Path:
        """Write the file in one piece: a reader never sees half of it.

        Args:
            path: target, usually ``rollouts/<motion>.npz``.
        """
        self.validate(where=str(path))
        path = Path(path)
        arrays = {f.name: getattr(self, f.name) for f in fields(self)}
        arrays = {k: v for k, v in arrays.items() if v is not None}
        with open_atomic(path) as file:
            np.savez_compressed(file, schema=ROLLOUT_SCHEMA, **arrays)
        return path

    @classmethod
    def load(cls, path: str | Path) -> Rollout:
        """Read and check a file; every fault is a RunError that names the key.

        Args:
            path: file written by :meth:`save`.
        """
        data = _read(Path(path))
        check_schema(data, path)
        required = {f.name for f in fields(cls) if f.default is MISSING}
        known = {f.name: str(f.type) for f in fields(cls)}
        absent = sorted(required - data.keys())
        if absent:
            raise RunError(
                f"{path}: missing keys {', '.join(absent)}. A rollout holds "
                f"{', '.join(sorted(required))}. Store the rollout again."
            )
        values = {k: _plain(data[k], known[k]) for k in known if k in data}
        try:
            return cls(**values)
        except RunError as error:
            raise RunError(str(error).replace("rollout:", f"{path}:", 1)) from None


def xml_sha256(xml: str) -> str:
    """Hash of an MJCF text.

    Args:
        xml: the text.
    """
    return hashlib.sha256(xml.encode()).hexdigest()


def _read(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise RunError(f"{path}: no such file. Stored rollouts end in .npz.")
    try:
        with np.load(path, allow_pickle=False) as file:
            return {key: file[key] for key in file.files}
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise RunError(
            f"{path}: not a readable rollout ({error}). It must be an .npz of plain "
            "arrays, without pickled objects."
        ) from error


def _plain(value: np.ndarray, kind: str) -> Any:
    casts = {"str": str, "int": int, "float": float}
    return casts[kind](value) if kind in casts else value
