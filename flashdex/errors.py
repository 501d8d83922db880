"""Every error a user can meet: what, where, what is allowed, what to do."""

from __future__ import annotations

import difflib
import errno
from collections.abc import Iterable


class FlashdexError(Exception):
    """Base of all errors caused by input; the command line exits with 2 on them.

    Args:
        text: what, where, what is allowed, what to do.
        code: what kind of mistake it is, in one word of ``docs/data.md`` such as
            ``E_KEYS``; shown before the text, and in the report of a library.
    """

    def __init__(self, text: str = "", *, code: str | None = None) -> None:
        super().__init__(text)
        self.text, self.code = text, code

    def __str__(self) -> str:
        return f"{self.code}: {self.text}" if self.code else str(self.text)


def printable(text: str) -> str:
    r"""Return a text whose control characters, but line ends, are shown as escapes.

    What comes from a file must neither steer the terminal nor hide in it.

    Example:
        >>> printable("a\x1b[31mb")
        'a\\x1b[31mb'
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)


def nearest(name: str, known: Iterable[str]) -> str:
    """Return ``" Did you mean 'x'?"`` for the closest known name, or nothing.

    Args:
        name: the word the user wrote.
        known: the words that would have been accepted.
    """
    plain = {word.lower(): word for word in known}
    close = difflib.get_close_matches(name.lower(), plain, n=1)
    return f" Did you mean '{plain[close[0]]}'?" if close else ""


# an OSError that the data cause: nothing there, or a name that no file can have
_OF_THE_DATA = {
    *(errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG),
    *(errno.EINVAL, errno.EILSEQ, None),
}


# torch and MuJoCo have no type for it that every version and device shares
_NO_MEMORY = ("allocate memory", "out of memory", "bad_alloc", "start new thread")
_NO_MEMORY += ("error -4 while",)  # of zlib


def is_of_machine(error: BaseException | None) -> bool:
    """Whether memory or a disk failed, here or in the cause: nothing about the data.

    The same call may go well the next time, so nobody turns it into a fault of the
    data, and nobody keeps it.
    """
    if error is None or isinstance(error, MemoryError):
        return error is not None
    if isinstance(error, OSError):
        return error.errno not in _OF_THE_DATA
    if isinstance(error, FlashdexError):
        return is_of_machine(error.__cause__)
    return any(words in str(error).lower() for words in _NO_MEMORY)


class UnknownNameError(FlashdexError):
    """A name that is not in a registry; the message lists the known ones."""

    kind = "name"

    def __init__(self, name: str, known: Iterable[str], *, where: str = "") -> None:
        known = sorted(known)
        place = f"{where}: " if where else ""
        super().__init__(
            f"{place}'{name}' is not a known {self.kind}. "
            f"Known: {', '.join(known)}.{nearest(name, known)}"
        )


class UnknownHandError(UnknownNameError):
    """A hand that is not built in."""

    kind = "hand"


class UnknownSourceError(UnknownNameError):
    """A motion source (reader) that does not exist."""

    kind = "motion source"


class UnknownRecipeError(UnknownNameError):
    """A recipe that is neither a file nor a name in the search path."""

    kind = "recipe"


class UnknownOptionError(UnknownNameError):
    """An option of a group of recipes that does not exist."""

    kind = "option"


class RecipeError(FlashdexError):
    """All mistakes of a recipe at once, each with its YAML path."""

    def __init__(self, problems: list[str], *, where: str = "recipe") -> None:
        self.problems = problems
        shown = [_one_line(problem) for problem in problems]
        lines = "\n".join(f"  {i + 1}. {p}" for i, p in enumerate(shown))
        count = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
        super().__init__(f"{where}: {count}\n{lines}")


def _one_line(text: str, most: int = 800) -> str:
    text = printable(text).replace("\n", " ")
    return text if len(text) <= most else f"{text[: most - 103]}...{text[-100:]}"


class DemoError(FlashdexError):
    """A recording that cannot be read or used."""


class MeshError(FlashdexError):
    """A mesh that is missing, empty or has no volume."""


class LibraryError(FlashdexError):
    """A motion library that is missing, incomplete or of another schema."""


class RunError(FlashdexError):
    """A run directory that is missing or incomplete."""


class MissingExtraError(FlashdexError):
    """An optional package that the requested feature needs."""

    def __init__(self, package: str, *, extra: str) -> None:
        super().__init__(
            f"'{package}' is not installed. It is needed here and comes with the "
            f"extra '{extra}': pip install '.[{extra}]' in the clone"
        )
