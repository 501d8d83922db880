"""Is this folder the root of a dataset? What a wrong root looks like, in words."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from flashdex.errors import DemoError

ARCHIVES = (".zip", ".tar", ".tgz", ".gz", ".7z")
POINTER_START = b"version https://git-lfs"
POINTER_SIZE = 200  # bytes; a pointer holds three short lines
NUM_SHOWN = 8  # entries of a folder that a message shows


def require_folders(root: Path, folders: Sequence[str], *, dataset: str) -> None:
    """Refuse a root that lacks the folders of a dataset.

    Args:
        root: what the user gave.
        folders: all of them must be in the root.
        dataset: for the message.

    Raises:
        DemoError: what was sought, what was found, and what is probably meant.
    """
    missing = [folder for folder in folders if not (root / folder).is_dir()]
    if missing:
        raise DemoError(
            f"{root}: E_ROOT: not the root of {dataset}. Sought the folders "
            f"{', '.join(folders)}; missing: {', '.join(missing)}; "
            f"found: {_found(root)}.{_hint(root, folders)}"
        )


def refuse_pointer(file: Path) -> None:
    """Refuse a Git-LFS pointer, which stands where the file should be.

    Raises:
        DemoError: the file is a pointer, or no file at all but a folder, a pipe, a
            device or a broken link.
        FileNotFoundError: there is nothing.
    """
    if not file.is_file() and (file.exists() or file.is_symlink()):
        raise DemoError(
            f"{file}: E_FILE: not a file but a folder, a pipe, a device or a broken "
            f"link. Put the file itself there."
        )
    if file.stat().st_size >= POINTER_SIZE:
        return
    with file.open("rb") as stream:
        start = stream.read(len(POINTER_START))
    if start == POINTER_START:
        raise DemoError(
            f"{file}: E_ROOT: a Git-LFS pointer, not the file itself. "
            f"Download the content: git lfs pull, or the dataset's own tool."
        )


def refuse_clone(files: Sequence[Path]) -> None:
    """Refuse a clone whose content was not fetched: its first files are pointers.

    Whatever else is wrong with a file costs its own recording only, when it is read.

    Raises:
        DemoError: one of the files is a pointer.
    """
    for file in files:
        if file.is_file():
            refuse_pointer(file)


def relative(file: Path, root: Path) -> str:
    """The path inside the root, for provenance; the bare name of a file elsewhere."""
    return file.relative_to(root).as_posix() if file.is_relative_to(root) else file.name


def _found(root: Path) -> str:
    if not root.exists():
        return "no such path"
    if not root.is_dir():
        return "a file"
    names = sorted(entry.name for entry in root.iterdir())
    more = f" and {len(names) - NUM_SHOWN} more" if len(names) > NUM_SHOWN else ""
    return (", ".join(names[:NUM_SHOWN]) or "an empty folder") + more


def _hint(root: Path, folders: Sequence[str]) -> str:
    if root.suffix in ARCHIVES and root.is_file():
        return " Unpack the archive and give the folder."
    if not root.is_dir():
        return ""
    above = root.resolve().parents[:3]
    inside = sorted(entry for entry in root.iterdir() if entry.is_dir())
    for place, where in [(above, "inside"), (inside, "above")]:
        for folder in place:
            if all((folder / name).is_dir() for name in folders):
                return f" It lies {where} the root: give {folder}."
    packed = [e.name for e in sorted(root.iterdir()) if e.suffix in ARCHIVES]
    return f" Unpack {', '.join(packed[:NUM_SHOWN])}." if packed else ""
