"""Findings: what is remarkable about a motion, and what it costs.

A rejected motion stays out of the library; a flagged one is in it and is reported.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

from flashdex.datasets.demo import HumanDemo
from flashdex.errors import DemoError, MeshError, is_of_machine

Level = Literal["info", "warn", "reject"]
Status = Literal["kept", "flagged", "rejected"]
# codes of the remarks of readers that flag: one that goes on after an error mended it
FLAGGING = ("W_", "E_")


@dataclass(frozen=True)
class Finding:
    """One remark about a motion."""

    code: str  # one of the codes of the documentation
    level: Level  # whether it costs the motion anything
    text: str  # what was measured, and what to do
    frames: tuple[int, ...] = ()  # in the recording's numbers; none: it concerns all


def info(code: str, text: str, frames: tuple[int, ...] = ()) -> Finding:
    """A finding that costs nothing."""
    return Finding(code, "info", text, frames)


def warn(code: str, text: str, frames: tuple[int, ...] = ()) -> Finding:
    """A finding that flags the motion."""
    return Finding(code, "warn", text, frames)


def reject(code: str, text: str) -> Finding:
    """A finding that keeps the motion out of the library."""
    return Finding(code, "reject", text)


def of_error(error: Exception) -> Finding:
    """The rejection that an error about a recording comes to."""
    if isinstance(error, DemoError | MeshError):
        usual = "E_MESH" if isinstance(error, MeshError) else "E_DEMO"
        return reject(error.code or usual, error.text)
    if is_of_machine(error):
        text = (
            f"{str(error) or 'not enough memory'}; not the recording's fault, so the "
        )
        return reject("E_MACHINE", f"{text}same command tries it again")
    if isinstance(error, OSError):  # a name too long, a folder that may not be entered
        return reject("E_FILE", f"cannot be read: {error}")
    return reject("E_READ", f"unforeseen {type(error).__name__}: {error}")


def of_reader(demo: HumanDemo) -> list[Finding]:
    """Remarks that a reader left in the provenance, each ``CODE: text``."""
    notes = [str(n).partition(": ") for n in demo.provenance.get("notes", [])]
    return [
        warn(code, text) if code.startswith(FLAGGING) else info(code, text)
        for code, _, text in notes
    ]


def status_of(findings: Iterable[Finding]) -> Status:
    """Kept, flagged (a warning) or rejected."""
    levels = {f.level for f in findings}
    if "reject" in levels:
        return "rejected"
    return "flagged" if "warn" in levels else "kept"


def reason_of(findings: Iterable[Finding]) -> str:
    """Findings as the report shows them."""
    return "; ".join(f"{f.code}: {f.text}" for f in findings)


def make_strict(findings: Iterable[Finding]) -> list[Finding]:
    """The same findings with every warning turned into a rejection."""
    return [replace(f, level="reject") if f.level == "warn" else f for f in findings]


def concerning(findings: Iterable[Finding], demo: HumanDemo) -> list[Finding]:
    """Findings about a whole recording that concern one piece of it."""
    start, end = demo.provenance.get("frames", [0, demo.num_frames])
    return [
        f for f in findings if not f.frames or any(start <= i < end for i in f.frames)
    ]
