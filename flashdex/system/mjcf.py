"""Models that others wrote: what may stand in one, and a trial before it is ours.

An MJCF text can read any file, repeat a body a million times or ask for a terabyte. So
only known elements pass, of bounded count, depth and size, with bounded numbers; then
the model is compiled and stepped in a child process with limits, and only then here.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Collection, Mapping
from xml.parsers import expat

import mujoco
import numpy as np

from flashdex.errors import FlashdexError
from flashdex.system.limited import LimitError, run_limited

MAX_BYTES = 32 << 20  # of text; scenes of ours have less than a megabyte
MAX_ELEMENTS, MAX_DEPTH = 20_000, 64
MAX_NUMBER = 1e12
MAX_MEMORY, MAX_SECONDS = 3 << 29, 20  # of the trial, bytes and s
TRIAL_STEPS = 5

# What reads files (include, model, attach, skin, hfield), multiplies (replicate,
# composite, flexcomp), loads code (extension, plugin) or reserves (custom) is missing.
ALLOWED = """
mujoco compiler lengthrange option flag size statistic
visual global quality headlight map scale rgba
default asset mesh material texture layer
worldbody body frame inertial joint freejoint geom site camera light
contact pair exclude equality connect weld tendon fixed spatial pulley
actuator general motor position velocity intvelocity damper cylinder muscle adhesion
sensor touch accelerometer velocimeter gyro force torque magnetometer rangefinder
jointpos jointvel tendonpos tendonvel actuatorpos actuatorvel actuatorfrc
jointactuatorfrc tendonactuatorfrc ballquat ballangvel jointlimitpos jointlimitvel
jointlimitfrc tendonlimitpos tendonlimitvel tendonlimitfrc framepos framequat
framexaxis frameyaxis framezaxis framelinvel frameangvel framelinacc frameangacc
subtreecom subtreelinvel subtreeangmom distance normal fromto e_potential e_kinetic
clock keyframe key
"""
ELEMENTS = frozenset(ALLOWED.split())
# attributes that name files (or folders of files), or code
FILES = re.compile(r"file\w*")
FOLDERS = frozenset({"meshdir", "texturedir", "assetdir"})
CODE = frozenset({"plugin", "instance", "builtin_plugin"})
# lowest and highest value by element and attribute
ITERATIONS = (0, 10_000)
RANGES: dict[tuple[str, str], tuple[float, float]] = {
    ("option", "timestep"): (1e-5, 0.1),
    **{
        ("option", f"{kind}iterations"): ITERATIONS
        for kind in ("", "ls_", "noslip_", "ccd_", "sdf_")
    },
    ("option", "sdf_initpoints"): ITERATIONS,
    **{("size", name): (-1, 100_000) for name in ("njmax", "nconmax", "nstack")},
    **{("size", name): (-1, 10_000) for name in ("nkey", "nuserdata")},
    ("size", "nuser_sensor"): (-1, 100),
    **{
        ("size", f"nuser_{kind}"): (-1, 100)
        for kind in ("body", "jnt", "geom", "site", "cam", "tendon", "actuator")
    },
    **{("texture", side): (0, 4096) for side in ("width", "height")},
    **{("global", side): (0, 8192) for side in ("offwidth", "offheight")},
    **{("quality", name): (0, 8192) for name in ("shadowsize", "offsamples")},
    **{("quality", f"num{name}"): (0, 256) for name in ("slices", "stacks", "quads")},
}
MEMORY = re.compile(r"-1|(\d{1,15})([KMGTPE]?)")
POWERS = {unit: 1 << (10 * i) for i, unit in enumerate(("", *"KMGTPE"))}
MAX_SIZE_MEMORY = 256 << 20  # bytes, of ``<size memory>``
_passed: set[str] = set()  # models that passed their trial, by hash


class ModelError(FlashdexError):
    """A model that cannot be used: not allowed, too large, or MuJoCo refuses it."""


def check_mjcf(text: str, *, where: str, assets: Collection[str] = ()) -> None:
    """Refuse a model's text that holds more than bodies, joints, meshes and the like.

    Nothing is compiled and no file is opened.

    Args:
        text: MJCF.
        where: file or motion, for the message.
        assets: names of files that are given along with it; no other may be named.

    Raises:
        ModelError: no XML, too large or too deep, an element or a file that is not
            allowed, or a number out of range.
    """
    _Reader(where, assets).read(text)


def compile_mjcf(
    text: str, *, where: str, assets: Mapping[str, bytes] | None = None
) -> mujoco.MjModel:
    """The model of a foreign text: checked, tried in a child process, then compiled.

    The trial costs a third of a second, once a text.

    Raises:
        ModelError: see ``check_mjcf``; or MuJoCo refuses it, here or there.
    """
    check_mjcf(text, where=where, assets=assets or ())
    key = hashlib.sha256(text.encode()).hexdigest()
    for name, content in sorted((assets or {}).items()):
        key += hashlib.sha256(name.encode() + b"\0" + content).hexdigest()
    try:
        if key not in _passed:
            hexed = {name: data.hex() for name, data in (assets or {}).items()}
            limits = {"memory": MAX_MEMORY, "seconds": MAX_SECONDS}
            run_limited(_try_model, text, hexed, TRIAL_STEPS, **limits)
            _passed.add(key)
        return mujoco.MjModel.from_xml_string(text, dict(assets or {}))
    except (LimitError, ValueError) as error:
        told = " ".join(str(error).split())[:300]
        raise ModelError(f"{where}: the model cannot be used: {told}.") from error


def _try_model(text: str, assets: dict[str, str], steps: int) -> bool:
    """Compile and step a model; runs in the child."""
    given = {name: bytes.fromhex(data) for name, data in assets.items()}
    model = mujoco.MjModel.from_xml_string(text, given)
    for name in dir(model):
        value = None if name.startswith("_") else getattr(model, name)
        if not isinstance(value, np.ndarray) or value.dtype.kind != "f":
            continue
        if np.isnan(value).any():
            raise ValueError(f"{name} holds NaN")
    data = mujoco.MjData(model)
    for _ in range(steps):
        mujoco.mj_step(model, data)
    return True


class _Reader:
    """Goes once over a text, and ends at the first thing that is not allowed."""

    def __init__(self, where: str, assets: Collection[str]) -> None:
        self._where, self._assets = where, assets
        self._depth = self._count = 0

    def read(self, text: str) -> None:
        data = text.encode("utf-8", errors="replace")
        if len(data) > MAX_BYTES:
            self._refuse(f"{len(data) / 2**20:.0f} MiB of text; at most 32")
        # one encoding whatever the text says of itself, as MuJoCo reads it
        parser = expat.ParserCreate("utf-8")
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.StartDoctypeDeclHandler = self._no("a DOCTYPE")
        parser.EntityDeclHandler = self._no("an entity")
        parser.ProcessingInstructionHandler = self._no("a processing instruction")
        parser.StartCdataSectionHandler = self._no("a CDATA section")
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            raise ModelError(f"{self._where}: not MJCF: {error}.") from error

    def _refuse(self, what: str) -> None:
        raise ModelError(
            f"{self._where}: {what}. Allowed is one text of bodies, joints, geoms, "
            f"inline meshes, actuators and sensors; get the file from whom you trust."
        )

    def _no(self, what: str):  # noqa: ANN202 - expat takes any callable
        return lambda *_: self._refuse(f"{what} stands in the model")

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        self._count += 1
        if self._count == 1 and tag != "mujoco":
            self._refuse(f"the first element is <{tag[:40]}>, not <mujoco>")
        if self._depth > MAX_DEPTH or self._count > MAX_ELEMENTS:
            text = f"more than {MAX_DEPTH} levels or {MAX_ELEMENTS} elements"
            self._refuse(text)
        if tag not in ELEMENTS:
            self._refuse(f"<{tag[:40]}> is not allowed")
        for name, value in attributes.items():
            self._check(tag, name, value)

    def _end(self, tag: str) -> None:
        self._depth -= 1

    def _check(self, tag: str, name: str, value: str) -> None:
        shown = f'<{tag} {name}="{value[:40]}">'
        is_file = FILES.fullmatch(name) is not None
        if (is_file and value not in self._assets) or name in FOLDERS:
            self._refuse(f"{shown} names files outside of the model")
        if name in CODE or (tag == "mesh" and name == "builtin"):
            self._refuse(f"{shown} is not allowed")
        if tag == "geom" and name == "type" and value in ("sdf", "hfield"):
            self._refuse(f"{shown} is not allowed")
        if (tag, name) == ("size", "memory"):
            self._check_memory(shown, value)
            return
        low, high = RANGES.get((tag, name), (-MAX_NUMBER, MAX_NUMBER))
        for word in value.split():
            number = _number(word)
            # a comparison that NaN fails
            if number is not None and not low <= number <= high:
                self._refuse(f"{shown}: {word[:40]} is not from {low:g} to {high:g}")
            if number is None and (tag, name) in RANGES:
                self._refuse(f"{shown} is not a number")

    def _check_memory(self, shown: str, value: str) -> None:
        match = MEMORY.fullmatch(value)
        if match is None or (
            match[1] and int(match[1]) * POWERS[match[2]] > MAX_SIZE_MEMORY
        ):
            self._refuse(f"{shown}: at most 256M")


def _number(word: str) -> float | None:
    """A number as C reads it: ``nan(1)`` and ``0x1p9`` are some, names are none."""
    try:
        return float(word)
    except ValueError:
        pass
    if re.match(r"[+-]?nan\b", word, re.IGNORECASE):
        return math.nan
    try:
        return float.fromhex(word) if re.match(r"[+-]?0[xX]", word) else None
    except (ValueError, OverflowError):
        return math.inf
