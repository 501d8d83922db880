"""JSON-lines files that survive a crash, and tell when somebody changed them.

Every line ends with a seal, the SHA-256 of the line and of the seal before it: a line
that is edited, doubled, removed or moved breaks the chain. A seal keeps no secret;
whoever writes the whole file anew writes fitting seals, see ``docs/security.md``.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from flashdex.errors import RunError
from flashdex.system.files import open_atomic, open_own, open_plain, read_own

_LOG = logging.getLogger(__name__)
SEAL = re.compile(rb', "sha256": "([0-9a-f]{64})"}\Z')
SEAL_BYTES = 79  # of the end of a line that has one
MAX_BYTES = 512 << 20  # of a file; a week of metrics has fifty million
MAX_VALUES = 20_000_000  # of a text of JSON; they take 70 bytes each
# key of a line -> the type its value has; float takes whole numbers as well
Schema = Mapping[str, type | tuple[type, ...]]


def parse_json(text: bytes) -> Any:
    """The value of a text of JSON, of bounded count: brackets grow thirty times.

    Raises:
        ValueError: it is none, or too much, or too deep.
    """
    check_count(text)
    try:
        return json.loads(text.decode("utf-8"))
    except RecursionError:
        raise ValueError("it is nested too deep") from None


def check_count(text: bytes) -> None:
    """Refuse a text of JSON whose values would fill the memory, before it is parsed."""
    if sum(text.count(mark) for mark in b"[{,") > MAX_VALUES:
        raise ValueError(f"it holds more than {MAX_VALUES:,} values")


def seal(text: str, before: str) -> str:
    """A JSON object as the line that follows the one with the seal ``before``."""
    found = hashlib.sha256((before + text).encode("utf-8")).hexdigest()
    return f'{text[:-1]}, "sha256": "{found}"}}'


def read_lines(path: Path, schema: Schema | None = None) -> list[dict[str, Any]]:
    """Read a JSONL file, the seals left out; what a crash cut off is left out as well.

    Args:
        path: of the file; one that is not there has no lines.
        schema: what every line has to hold.

    Raises:
        RunError: a line is damaged, changed, or of something else.
    """
    content = _read(path)
    whole = content[: _whole(content)]
    if len(whole) < len(content):
        _LOG.warning("%s: its last line is not whole and is left out", path)
    out: list[dict[str, Any]] = []
    before = ""
    for number, raw in enumerate(whole.split(b"\n")[:-1], start=1):
        found = SEAL.search(raw)
        if found is None:
            raise _fault(path, number, "has no seal")
        body = raw[: found.start()] + b"}"
        expected = hashlib.sha256(before.encode() + body).hexdigest()
        before = found.group(1).decode()
        if before != expected:
            raise _fault(path, number, "was changed, or one before it is missing")
        out.append(_parse(path, number, body))
        check_keys(out[-1], schema or {}, path, number)
    return out


def _read(path: Path) -> bytes:
    try:
        with open_plain(path) as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:  # a hole on the disk may be of any size
            raise RunError(f"{path}: larger than {MAX_BYTES >> 20} MiB. Restore it.")
        check_count(content)
        return content
    except FileNotFoundError:
        return b""
    except OSError as error:
        raise RunError(f"{path}: cannot be read ({error.strerror}).") from error
    except ValueError as error:
        raise RunError(f"{path}: cannot be read ({error}). Restore it.") from error


def _whole(content: bytes) -> int:
    """Bytes of the lines that are whole.

    A crash leaves a line without its end, or, where the file system had its length but
    not its content yet, a tail of zeros.
    """
    return content.rstrip(b"\0").rfind(b"\n") + 1


def _parse(path: Path, number: int, raw: bytes) -> dict[str, Any]:
    try:
        line = parse_json(raw)
    except ValueError as error:
        raise _fault(path, number, f"is not JSON ({error})") from error
    if not isinstance(line, dict):
        raise _fault(path, number, "is not a JSON object")
    return line


def check_keys(
    line: Mapping[str, Any], schema: Schema, path: Path, number: int
) -> None:
    """Check the types of what a line has to hold; numbers are finite, true is none.

    Raises:
        RunError: it lacks something, or has something else there.
    """
    for key, kind in schema.items():
        if key not in line:
            raise _fault(path, number, f"lacks '{key}'")
        kinds = kind if isinstance(kind, tuple) else (kind,)
        kinds = (*kinds, int) if float in kinds else kinds
        value = line[key]
        is_flag = isinstance(value, bool) and bool not in kinds
        endless = isinstance(value, float) and not math.isfinite(value)
        if not isinstance(value, kinds) or is_flag or endless:
            raise _fault(path, number, f"has {value!r:.60} as '{key}'")


def _fault(path: Path, number: int | str, what: str) -> RunError:
    return RunError(
        f"{path}: line {number} {what}. flashdex only adds lines to this file; restore "
        "it from a copy."
    )


def append_line(path: Path, line: dict[str, Any]) -> None:
    """Append one line; it is on the disk when this returns, or not in the file.

    Raises:
        OSError: the disk refuses, or a link stands there; the file is as it was.
        RunError: its last line has no seal.
    """
    with open_plain(path, "ab") as file:
        size = file.tell()
        text = seal(json.dumps(line), _last_seal(path, size)) + "\n"
        try:
            file.write(text.encode("utf-8"))
            file.flush()
            os.fsync(file.fileno())
        except OSError:
            os.ftruncate(file.fileno(), size)
            raise


def _last_seal(path: Path, size: int) -> str:
    if size == 0:
        return ""
    with open_plain(path) as file:
        file.seek(max(0, size - SEAL_BYTES - 1))
        found = SEAL.search(file.read().removesuffix(b"\n"))
    if found is None:
        raise _fault(path, "at the end", "has no seal")
    return found.group(1).decode()


def drop_cut_line(path: Path) -> None:
    """Remove what a crash cut off, and tell; the next line would join it."""
    content = _read(path)
    whole = _whole(content)
    if whole < len(content):
        _LOG.warning(
            "%s: its last line was cut off by a crash; %d bytes are removed",
            path,
            len(content) - whole,
        )
        with open_plain(path, "r+b") as file:
            file.truncate(whole)


def keep_lines(path: Path, wanted: Callable[[dict[str, Any]], bool]) -> None:
    """Keep the lines that are wanted, in their order; the file changes in one piece."""
    lines = read_lines(path)
    kept = [line for line in lines if wanted(line)]
    if len(kept) < len(lines):
        write_lines(path, kept)


def write_lines(path: Path, lines: Iterable[dict[str, Any]]) -> None:
    """Write a file of sealed lines in one piece."""
    before = ""
    with open_atomic(path) as file:
        for line in lines:
            text = seal(json.dumps(line), before)
            before = text[-66:-2]
            file.write(text.encode("utf-8") + b"\n")


def write_object(content: dict[str, Any], root: Path, *parts: str) -> None:
    """Write a JSON object, sealed, as a file of a run; see ``open_own``."""
    # a seal that is damaged beyond recognition is missed where this stands
    text = seal(json.dumps({"sealed": True, **content}, indent=1), "")
    with open_own(root, *parts) as file:
        file.write(text.encode("utf-8") + b"\n")


def read_object(root: Path, *parts: str, sealed: bool = True) -> dict[str, Any]:
    """A JSON object of a run, its seal left out; one that is not there is empty.

    Args:
        root: folder of the run.
        parts: of the path below it.
        sealed: it was written by ``write_object``.

    Raises:
        RunError: it is damaged, was changed, or is something else.
    """
    text = read_own(root, *parts)
    if text is None:
        return {}
    path, text = root.joinpath(*parts), text.removesuffix("\n")
    try:
        found = parse_json(text.encode("utf-8"))
    except ValueError as error:
        raise RunError(f"{path}: not JSON ({error}). Restore or remove it.") from error
    if not isinstance(found, dict):
        raise RunError(f"{path}: not a JSON object. Restore or remove it.")
    if not sealed:
        return found
    del_keys = [found.pop(key, None) for key in ("sealed", "sha256")]
    if None in del_keys or seal(text[:-SEAL_BYTES] + "}", "") != text:
        raise RunError(
            f"{path}: was changed or damaged since flashdex wrote it. Restore or "
            "remove it."
        )
    return found
