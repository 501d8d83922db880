"""Findings of a verification, and where two JSON values differ."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import datetime
from typing import Any


@dataclass(frozen=True)
class Finding:
    """One thing that is not as it should be, or that could not be checked."""

    file: str  # below the run, or as it was named
    what: str  # field, number or element
    text: str  # difference, with what was expected and found
    is_fault: bool = True  # else it was not checked

    def __str__(self) -> str:
        word = "" if self.is_fault else "not checked: "
        return f"{self.file}: {word}{self.what}: {self.text}"


class Notes:
    """Findings of one file, as they come up."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.findings: list[Finding] = []

    def fault(self, what: str, text: str, *, file: str = "") -> None:
        """Note a difference."""
        self.findings.append(Finding(file or self.file, what, text))

    def skip(self, what: str, text: str, *, file: str = "") -> None:
        """Note what could not be checked."""
        self.findings.append(Finding(file or self.file, what, text, is_fault=False))


def faults(findings: Iterable[Finding]) -> list[Finding]:
    """Those that are not only unchecked."""
    return [finding for finding in findings if finding.is_fault]


def differences(
    stored: Any,
    expected: Any,
    *,
    tolerance: float = 1e-9,
    at: str = "",
    skip: Callable[[str], bool] = lambda _: False,
) -> list[str]:
    """Where two JSON values differ, by dotted name.

    Numbers may differ by a share ``tolerance`` of the expected one, or as much.
    """
    if skip(at):
        return []
    if isinstance(stored, dict) and isinstance(expected, dict):
        out = []
        for key in [*expected, *(k for k in stored if k not in expected)]:
            name = f"{at}.{key}" if at else str(key)
            if key not in stored or key not in expected:
                word = "is missing" if key not in stored else "is too much"
                out += [] if skip(name) else [f"{name} {word}"]
                continue
            pair = stored[key], expected[key]
            out += differences(*pair, tolerance=tolerance, at=name, skip=skip)
        return out
    if isinstance(stored, list) and isinstance(expected, list):
        if len(stored) != len(expected):
            return [f"{at} has {len(stored)} entries, expected {len(expected)}"]
        return [
            text
            for i, pair in enumerate(zip(stored, expected, strict=True))
            for text in differences(
                *pair, tolerance=tolerance, at=f"{at}[{i}]", skip=skip
            )
        ]
    if _is_number(stored) and _is_number(expected):
        if abs(stored - expected) <= tolerance * max(1.0, abs(expected)):
            return []
    elif type(stored) is type(expected) and stored == expected:
        return []
    return [f"{at} is {short(stored)}, expected {short(expected)}"]


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def short(value: Any) -> str:
    """A value in at most 60 characters."""
    text = value if isinstance(value, str) else json.dumps(value, default=str)
    return text if len(text) <= 60 else f"{text[:60]}..."


def at(value: Any, *names: str) -> Any:
    """What lies under these keys of nested JSON objects, None where nothing does."""
    for name in names:
        value = value.get(name) if isinstance(value, dict) else None
    return value


def is_date(text: Any) -> bool:
    """Whether a text is a moment, with its time zone."""
    try:
        return datetime.fromisoformat(str(text)).tzinfo is not None
    except ValueError:
        return False
