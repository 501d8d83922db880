"""A stored rollout: states, controls, reference and model in one npz file.

The file replays without the motion library: the MJCF is inside, meshes included. No
pickle is written or read.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Annotated, Any, get_origin, get_type_hints

import numpy as np

from flashdex.errors import FlashdexError, RunError, is_of_machine
from flashdex.keys import SIDES
from flashdex.metrics.criteria import score, worst_movement
from flashdex.metrics.criteria_table import Verdict, limits_of
from flashdex.metrics.errors import TrackingErrors, compute_tracking_errors
from flashdex.system.archives import read_npz
from flashdex.system.files import open_atomic
from flashdex.system.names import check_name

ROLLOUT_SCHEMA = 1
REFERENCE = ("ref_object_pos", "ref_object_quat", "ref_fingertips", "ref_joints")
MAX_BYTES = 256 << 20  # of the arrays of a file; a minute of two hands has 20 MB
MAX_FILE = 2 * MAX_BYTES  # bytes of the file, packed as badly as may be
_WHOLE = ("hand_active", "hand_object", "object_qpos_adr", "object_qvel_adr")
MAX_FPS, MAX_DECIMATION = 1000, 1000
# JSON fields and what they hold
_JSON: dict[str, type] = {
    "joint_bodies": list,
    "errors": dict,
    "versions": dict,
    "provenance": dict,
    "wrist_bodies": list,
}


@dataclass
class Rollout:
    """One attempt, with everything that is needed to replay and to score it.

    Row t of every (T, ...) array belongs to control step t: ``ctrl[t]`` is applied for
    ``decimation`` substeps, the states are those AFTER it, and ``ref_*[t]`` is the
    reference it is scored on. World frame, metres, radians, quaternions wxyz.

    T control steps, O object slots, M joints of the criteria, 2 hands [left, right], 5
    fingers [thumb, index, middle, ring, pinky].

    Example:
        >>> Rollout.load("runs/demo/rollouts/lift.npz").num_frames  # doctest: +SKIP
        240
    """

    motion: str
    hand: str  # name of the hand model
    fps: float  # control rate, Hz
    decimation: int  # substeps a control step
    grace: int  # first steps that the ManipTrans family does not score
    qpos0: Annotated[np.ndarray, "nq"]
    qvel0: Annotated[np.ndarray, "nv"]
    ctrl: Annotated[np.ndarray, "T nu"]  # position targets
    qpos: Annotated[np.ndarray, "T nq"]
    qvel: Annotated[np.ndarray, "T nv"]
    object_pos: Annotated[np.ndarray, "T O 3"]  # object frames
    object_quat: Annotated[np.ndarray, "T O 4"]
    ref_object_pos: Annotated[np.ndarray, "T O 3"]
    ref_object_quat: Annotated[np.ndarray, "T O 4"]
    fingertips: Annotated[np.ndarray, "T 2 5 3"]  # pad points
    ref_fingertips: Annotated[np.ndarray, "T 2 5 3"]  # human tips
    joints: Annotated[np.ndarray, "T 2 M 3"]  # level-1 links, then distal links
    ref_joints: Annotated[np.ndarray, "T 2 M 3"]  # human joints in the same order
    hand_active: Annotated[np.ndarray, "2"]  # hands that take part
    hand_object: Annotated[np.ndarray, "2"]  # object slot, -1 without object
    object_qpos_adr: Annotated[np.ndarray, "O"]  # of the free joint, -1: empty slot
    object_qvel_adr: Annotated[np.ndarray, "O"]
    joint_bodies: str  # JSON, per hand the M body names behind joints
    model_xml: str  # self-contained MJCF
    criterion: str  # that the rollout was stored for
    errors: str  # JSON, numbers of that criterion
    versions: str  # JSON, of the packages and the engine that produced the states
    seed: int  # of the run
    env_steps: int  # of the run, when the rollout was made
    actions: Annotated[np.ndarray, "T 2 A"]  # policy outputs
    model_sha256: str = ""  # of model_xml; computed when empty
    num_ref_frames: int = -1  # length of the whole reference, -1 when it is T
    wrist_pos: Annotated[np.ndarray | None, "T 2 3"] = None
    ref_wrist_pos: Annotated[np.ndarray | None, "T 2 3"] = None
    wrist_bodies: str = ""  # JSON, the two body names behind wrist_pos, or empty
    act0: Annotated[np.ndarray | None, "na"] = None  # first actuator state; None: 0
    wrench: Annotated[np.ndarray | None, "T O 6"] = None  # assist force and torque
    provenance: str = "{}"  # JSON: hashes of recipe, library, checkpoint; date

    def __post_init__(self) -> None:
        # what ended it early, cause and hand; in the ledger's line, not in the file
        self.terminations: list[dict[str, str]] = []
        if not self.model_sha256:
            self.model_sha256 = _sha256(self.model_xml)
        self.validate()

    @property
    def num_frames(self) -> int:
        """Control steps, T."""
        return len(self.ctrl)

    @property
    def reference_length(self) -> int:
        """Rows of the whole reference."""
        return self.num_frames if self.num_ref_frames < 0 else self.num_ref_frames

    @property
    def completed(self) -> bool:
        """Reached the end of the reference without failure."""
        # A time-out before the end of the motion is no failure, but not complete.
        return not self.terminations and self.num_frames >= self.reference_length

    def tracking_errors(self) -> TrackingErrors:
        """Errors of the STORED states, as training saw them."""
        names = ("object_pos", "object_quat", "fingertips", "joints", "wrist_pos")
        return self.errors_of({name: getattr(self, name) for name in names})

    def errors_of(
        self, states: dict[str, np.ndarray | None], *, overflow: bool = False
    ) -> TrackingErrors:
        """Errors of any states against the reference of this rollout.

        ``states`` are object_pos, object_quat, fingertips, joints, wrist_pos, shaped as
        the fields of those names or None; ``overflow``: the engine warned.
        """
        reference = {f"ref_{name}": getattr(self, f"ref_{name}") for name in states}
        return compute_tracking_errors(
            states | reference,
            hand_active=self.hand_active.tolist(),
            hand_object=self.hand_object.tolist(),
            fps=self.fps,
            num_ref_frames=self.reference_length,
            overflow=overflow,
        )

    def score(self, *, completed: bool | None = None) -> dict[str, Verdict]:
        """Verdict of every criterion on the stored states.

        ``completed``: it reached the end under the training terminations, if known.
        """
        errors = self.tracking_errors()
        return score(errors, grace=self.grace, completed=completed)

    def summary(self, criterion: str) -> dict[str, Any]:
        """What the ledger's line says of this attempt, scored by ``criterion``."""
        verdicts = self.score(completed=self.completed)
        verdict = verdicts[criterion]
        ratios = worst_movement(self.tracking_errors())
        return {
            "motion": self.motion,
            "converted": verdict.is_passed,
            "certified": None,
            "criterion": criterion,
            "errors": {k: round(v, 6) for k, v in verdict.values.items()},
            **{
                f"{key}_ratio": None if ratio is None else round(ratio, 4)
                for key, ratio in ratios.items()
            },
            "passed": [name for name, v in verdicts.items() if v.is_passed],
            "completed": self.completed,
            "hands": [SIDES[hand] for hand in np.flatnonzero(self.hand_active)],
            "why": self.terminations or _why(verdict),
            "frame": self.num_frames,
            "env_steps": self.env_steps,
        }

    def validate(self, *, where: str = "rollout") -> None:
        """Check shapes, JSON fields and the model hash; RunError on the first fault."""
        sizes: dict[str, int] = {"T": len(self.ctrl)}
        for key, hint in _hints().items():
            value = getattr(self, key)
            if get_origin(hint) is Annotated and value is not None:
                _check_shape(key, value, hint.__metadata__[0], sizes, where)
        for key, kind in _JSON.items():
            if getattr(self, key) or key != "wrist_bodies":  # which may be empty
                _check_json(key, getattr(self, key), kind, where)
        check_name(self.motion, what="motion", where=where)
        check_name(self.hand, what="hand", where=where)
        if not (0 < self.fps <= MAX_FPS and 1 <= self.decimation <= MAX_DECIMATION):
            raise RunError(
                f"{where}: {self.fps:g} control steps a second of {self.decimation} "
                f"substeps. Allowed: up to {MAX_FPS} and {MAX_DECIMATION}."
            )
        if self.model_sha256 != _sha256(self.model_xml):
            raise RunError(
                f"{where}: model_sha256 does not match model_xml: the model was "
                "changed after the rollout was stored. Store the rollout again."
            )
        slots = self.hand_object
        if (slots >= max(1, sizes["O"])).any():
            raise RunError(
                f"{where}: hand_object {slots.tolist()} names a slot beyond the "
                f"{sizes['O']} objects of object_pos. Allowed: -1 to {sizes['O'] - 1}."
            )

    def save(self, path: str | Path) -> Path:
        """Write the file, usually ``rollouts/<motion>.npz``, in one piece."""
        self.validate(where=str(path))
        path = Path(path)
        arrays = {f.name: getattr(self, f.name) for f in fields(self)}
        arrays = {k: v for k, v in arrays.items() if v is not None}
        with open_atomic(path) as file:
            np.savez_compressed(file, schema=ROLLOUT_SCHEMA, **arrays)
        return path

    @property
    def content_sha256(self) -> str:
        """SHA-256 of every field, however a file packs them."""
        found = hashlib.sha256()
        for name in sorted(f.name for f in fields(self)):
            value = getattr(self, name)
            if isinstance(value, np.ndarray):
                kind = value.dtype.newbyteorder("<")
                found.update(f"{name} {kind.str} {value.shape}".encode())
                found.update(np.ascontiguousarray(value, kind).tobytes())
            else:
                found.update(f"{name} {value!r} ".encode())
        return found.hexdigest()

    @classmethod
    def load(cls, path: str | Path) -> Rollout:
        """Read and check a file; every fault is a RunError that names the key."""
        data = _read(Path(path))
        required = {f.name for f in fields(cls) if f.default is not None}
        absent = sorted(required - data.keys())
        if absent:
            raise RunError(
                f"{path}: missing keys {', '.join(absent)}. A rollout holds "
                f"{', '.join(sorted(required))}. Store the rollout again."
            )
        foreign = sorted(data.keys() - {"schema", *_hints()})
        if foreign:
            raise RunError(
                f"{path}: holds {foreign[0]!a}, which no rollout does. Store the "
                "rollout again."
            )
        values = {
            key: _field(key, data[key], hint, path)
            for key, hint in _hints().items()
            if key in data
        }
        try:
            return cls(**values)
        except FlashdexError as error:
            raise RunError(str(error).replace("rollout:", f"{path}:", 1)) from None


@cache
def _hints() -> dict[str, Any]:
    """Field -> str, int, float, or an array annotated with its shape."""
    return get_type_hints(Rollout, include_extras=True)


def _sha256(xml: str) -> str:
    return hashlib.sha256(xml.encode()).hexdigest()


def _why(verdict: Verdict) -> list[dict[str, Any]]:
    """Which limit which hand crossed, else why there is no such number."""
    if not verdict.blame:
        return [{"cause": verdict.reason}] if verdict.reason else []
    return [
        {"cause": b.term, "hand": b.side, "value": round(b.value, 5), "frame": b.frame}
        for b in verdict.blame
    ]


def _read(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise RunError(f"{path}: no such file. Stored rollouts end in .npz.")
    try:
        data = read_npz(path, limit=MAX_BYTES)
    except (ValueError, OSError) as error:
        if is_of_machine(error):
            raise
        raise RunError(
            f"{path}: not a readable rollout ({error}). It must be an .npz of plain "
            "arrays, without pickled objects, of at most 256 MiB."
        ) from error
    if "schema" not in data:
        raise RunError(f"{path}: missing key schema; this is not a flashdex rollout.")
    schema = _field("schema", data["schema"], int, path)
    if schema != ROLLOUT_SCHEMA:
        raise RunError(
            f"{path}: schema {schema}, this version reads "
            f"{ROLLOUT_SCHEMA}. Store the rollout again or use the matching version."
        )
    return data


def _field(key: str, value: np.ndarray, hint: Any, path: str | Path) -> Any:
    """An array of numbers as it is, or one text or number of it."""
    is_array = get_origin(hint) is Annotated
    kinds = {str: "U", int: "iu", float: "fiu"}.get(hint, "fiub")
    kinds = "iub" if key in _WHOLE else kinds  # these index others
    if value.dtype.kind not in kinds or (not is_array and value.shape != ()):
        raise RunError(
            f"{path}: {key} holds {value.dtype} {value.shape}, which is not what a "
            "rollout has there. Store the rollout again."
        )
    return value if is_array else hint(value)


def _check_json(key: str, text: str, kind: type, where: str) -> None:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise RunError(f"{where}: {key} is not JSON ({error}).") from error
    if not isinstance(found, kind):
        raise RunError(f"{where}: {key} is JSON, but no {kind.__name__}.")


def _check_shape(
    key: str, value: np.ndarray, symbols: str, sizes: dict[str, int], where: str
) -> None:
    """Compare a shape with its symbols; a symbol keeps the size it first had."""
    names, shape = symbols.split(), np.shape(value)
    fits = len(shape) == len(names) and all(
        size == (int(name) if name.isdigit() else sizes.setdefault(name, size))
        for name, size in zip(names, shape, strict=True)
    )
    if not fits:
        known = ", ".join(f"{n}={sizes[n]}" for n in names if n in sizes)
        raise RunError(
            f"{where}: {key} has shape {shape}, expected ({symbols})"
            f"{' with ' + known if known else ''}. Store the rollout again."
        )


def reference_sha256(rollout: Rollout) -> str:
    """SHA-256 of the reference that a rollout was scored on."""
    found = hashlib.sha256()
    for name in REFERENCE:
        value = np.ascontiguousarray(getattr(rollout, name), "<f8")
        found.update(f"{name} {value.shape}".encode())
        found.update(value.tobytes())
    return found.hexdigest()


# what the provenance of a stored rollout says
PROVENANCE: dict[str, type] = {
    **dict.fromkeys(("run", "date", "recipe_sha256", "library_sha256"), str),
    **dict.fromkeys(("motion_sha256", "reference_sha256"), str),
    **dict.fromkeys(("physics", "limits"), dict),
}
# of a search also what it cost, as the line says it, see ``SEARCHED``
OF_SEARCH = "search"
# and its versions, those of an engine's own packages besides
MADE_BY = ("flashdex", "torch", "torchrl", "tensordict", "mujoco", "python")
MADE_BY += ("engine", "hardware")


def is_search_part(said: Any) -> bool:
    """Whether this is what a search says of an attempt: rung, core-seconds, start."""
    kinds = {"rung": (int,), "attempt_s": (float, int), "start": (str,)}
    return (
        isinstance(said, dict)
        and {"rung", "attempt_s"} <= said.keys() <= kinds.keys()
        and all(type(value) in kinds[key] for key, value in said.items())
        and 0 <= said["attempt_s"] < math.inf
    )


def bindings_of(rollout: Rollout) -> dict[str, Any]:
    """What the provenance of a rollout says of it."""
    return {
        "reference_sha256": reference_sha256(rollout),
        "limits": dict(limits_of(rollout.criterion, rollout.grace)),
    }
