"""Names that come from outside: what one may be, and the file that may carry it."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from typing import Any

from flashdex.errors import FlashdexError

NAME_BYTES = 255  # of UTF-8; what one component of a path may be long anywhere
STEM = re.compile(r"[A-Za-z0-9_@+()][A-Za-z0-9_@+().-]{0,95}")
# what Windows takes for a device, whatever the ending; folders are shared
DEVICES = re.compile(r"(?i)(con|prn|aux|nul|com\d|lpt\d)(\..*)?")
NO_STEM = re.compile(r"[^A-Za-z0-9_@+()]+")


def check_name(name: Any, *, what: str, where: str = "") -> str:
    """Return a name of a motion, an object, a hand or a file, as it is.

    A name is one line of printable text, at most ``NAME_BYTES`` long, and no path: no
    slash, no backslash, not ``.`` or ``..``. It may hold spaces and any script.

    Args:
        name: what was found where a name should be.
        what: what it names, such as ``motion``; for the message.
        where: the file it was found in; for the message.

    Raises:
        FlashdexError: it is something else.
    """
    fault = _fault(name)
    if fault:
        shown = ascii(name)
        shown = shown if len(shown) < 80 else f"{shown[:80]}..."
        place = f"{where}: " if where else ""
        article = "an" if what[0] in "aeiou" else "a"
        raise FlashdexError(
            f"{place}{shown} is no name of {article} {what}: {fault}. A name is one "
            f"line of printable text of at most {NAME_BYTES} bytes, without / and \\."
        )
    return name


def check_names(names: Iterable[Any], *, what: str, where: str = "") -> list[str]:
    """Check names that stand beside each other: no two may share a file, either.

    Raises:
        FlashdexError: one is no name, or two are the same.
    """
    checked = [check_name(name, what=what, where=where) for name in names]
    seen: dict[str, str] = {}
    for name in checked:
        key = file_stem(name).casefold()  # some file systems ignore case
        if key in seen:
            place = f"{where}: " if where else ""
            raise FlashdexError(
                f"{place}two {what}s are called {seen[key]!a} and {name!a}; their "
                "files would be the same. Rename one."
            )
        seen[key] = name
    return checked


def plain_name(name: str, *, limit: int = NAME_BYTES) -> str:
    """The nearest name: what one may not hold is "_", what is too long is cut.

    Example:
        >>> plain_name("s1/mug"), plain_name("")
        ('s1_mug', '_')
    """
    text = "".join(c if c.isprintable() and c not in "/\\" else "_" for c in name)
    text = text.encode("utf-8")[:limit].decode("utf-8", errors="ignore")
    return text if not _fault(text) else f"_{text.strip('. ')}"


def _fault(name: Any) -> str:
    if not isinstance(name, str):
        return f"it is of type {type(name).__name__}"
    if not name.strip():
        return "it is empty"
    if not name.isprintable():
        return "it holds what cannot be printed"
    if "/" in name or "\\" in name or name in (".", ".."):
        return "it is a path"
    if len(name.encode("utf-8")) > NAME_BYTES:
        return f"it has {len(name.encode('utf-8'))} bytes"
    return ""


def file_stem(name: str) -> str:
    """Stem of the files of a checked name: plain ASCII, short, the same every time.

    A plain name is its own stem; of any other some letters and a hash are kept.

    Example:
        >>> file_stem("lift_cube"), file_stem("päck aus")
        ('lift_cube', 'p_ck_aus-07b9bde0')
    """
    if STEM.fullmatch(name) and not DEVICES.fullmatch(name):
        return name
    plain = NO_STEM.sub("_", name)[:64].strip("_") or "name"
    # eight digits more: the stem of a name that holds the hash of another is not its
    return f"{plain}-{hashlib.sha256(name.encode('utf-8')).hexdigest()[:8]}"
