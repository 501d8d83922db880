"""Files that are there complete, or not at all."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, BinaryIO, cast

from filelock import FileLock, Timeout

from flashdex.errors import RunError

try:
    import fcntl as _fcntl
except ImportError:  # Windows
    _fcntl = None
fcntl: Any = _fcntl

# of an open file: a link in its place is an error, a pipe is not waited for
MAX_TEXT = 64 << 20  # bytes of a text file of a run
_PLAIN = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)


def own_file(root: Path, *parts: str) -> Path:
    """Path of a file that a run or a library may read, write and delete as its own.

    ``root`` may be a link, as its user chose it; below it there is none: a link would
    lead what is written, deleted or shown out of the folder. A pipe or a device in its
    place would be waited for.

    Args:
        root: folder of the run or library.
        parts: of the path below it; a part may hold slashes, as manifests do.

    Raises:
        RunError: the path leaves the folder, or something else stands there.
    """
    path = root.joinpath(*parts)
    names = Path(*parts).parts
    if not names or ".." in names or Path(*parts).is_absolute():
        raise RunError(f"{root}: '{Path(*parts)}' is not a file below it.")
    for depth in range(1, len(names) + 1):
        below = root.joinpath(*names[:depth])
        try:
            mode = below.lstat().st_mode
        except FileNotFoundError:
            return path
        except (OSError, ValueError) as error:  # NUL, over-long, not a folder
            raise RunError(f"{str(below)!a}: cannot be read ({error}).") from error
        is_right = stat.S_ISREG(mode) if depth == len(names) else stat.S_ISDIR(mode)
        if not is_right:
            kind = "a file" if depth == len(names) else "a folder"
            raise RunError(
                f"{below}: is {_kind(mode)}, not {kind} of its own. Only files and "
                f"folders that lie in {root} are used; put {kind} there, or remove it."
            )
    return path


def own_files(root: Path, folder: str, pattern: str) -> list[Path]:
    """Files of a folder of a run or library, sorted; as ``own_file`` each."""
    found = sorted((root / folder).glob(pattern))
    return [own_file(root, folder, path.name) for path in found]


def remove_own(root: Path, *parts: str) -> None:
    """Delete a file of a run or library, if it is there; see ``own_file``."""
    own_file(root, *parts).unlink(missing_ok=True)


@contextmanager
def open_own(root: Path, *parts: str) -> Iterator[BinaryIO]:
    """Write a file of a run or library as ``open_atomic`` does; see ``own_file``.

    The folder ``root`` is not made: one that was moved away while somebody worked in it
    does not come up again, empty but for this file.
    """
    path = own_file(root, *parts)
    if not root.is_dir():
        raise FileNotFoundError(errno.ENOENT, "the folder is gone", str(root))
    with open_atomic(path) as file:
        yield file


def read_own(root: Path, *parts: str, limit: int = MAX_TEXT) -> str | None:
    """Text of a file of a run or library, None where there is none; see ``own_file``.

    Raises:
        RunError: it is a link or no file, too large, or no UTF-8.
    """
    path = own_file(root, *parts)
    try:
        with open_plain(path) as file:
            content = file.read(limit + 1)
        if len(content) > limit:
            raise RunError(
                f"{path}: larger than {limit >> 20} MiB, which no such file is."
            )
        return content.decode("utf-8-sig")
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RunError(f"{path}: cannot be read ({error.strerror}).") from error
    except UnicodeDecodeError as error:
        raise RunError(
            f"{path}: not UTF-8 text ({error.reason} at byte {error.start}). Restore "
            "it from a copy."
        ) from error


def own_folder(root: Path, name: str) -> Path:
    """A folder directly below a run or library, made where it is missing.

    Raises:
        RunError: a link or a file stands there.
    """
    path = root / name
    if path.is_symlink() or (path.exists() and not path.is_dir()):
        raise RunError(
            f"{path}: is {_kind(path.lstat().st_mode)}, not a folder of its own. Only "
            f"what lies in {root} is used; remove it."
        )
    path.mkdir(exist_ok=True)
    return path


def _kind(mode: int) -> str:
    kinds = {stat.S_IFLNK: "a link", stat.S_IFDIR: "a folder", stat.S_IFREG: "a file"}
    return kinds.get(stat.S_IFMT(mode), "a pipe or a device")


def open_plain(path: Path, mode: str = "rb") -> BinaryIO:
    """Open a file itself: not what a link names, no pipe, no device.

    Args:
        path: of the file.
        mode: ``rb``, ``ab`` or ``r+b``.

    Raises:
        OSError: it is something else, or cannot be opened.
    """
    handle = _open(path, mode)
    if mode != "rb" and os.fstat(handle).st_nlink > 1:
        # a copy made by hard links ('cp -al') must not change with the original
        os.close(handle)
        with path.open("rb") as old, open_atomic(path) as new:
            shutil.copyfileobj(old, new)
        handle = _open(path, mode)
    return cast(BinaryIO, os.fdopen(handle, mode))


def _open(path: Path, mode: str) -> int:
    flags = {"rb": os.O_RDONLY, "ab": os.O_WRONLY | os.O_APPEND | os.O_CREAT}
    handle = os.open(path, flags.get(mode, os.O_RDWR) | _PLAIN, 0o666)
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return handle


@contextmanager
def open_atomic(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing; it takes its name only when the block succeeds.

    A reader, or a run that continues after a crash, finds the old file or the whole new
    one. What was written is on the disk when the block ends.

    Example:
        >>> with open_atomic(Path("notes.bin")) as file:  # doctest: +SKIP
        ...     file.write(b"all of it")
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # beside the target, as a rename is atomic within one file system only
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        # a link that waits under this name is not followed
        temporary.unlink(missing_ok=True)
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL
        with os.fdopen(os.open(temporary, flags, 0o666), "r+b") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        with suppress(OSError):  # of a disk that fails: the first error is the one
            temporary.unlink(missing_ok=True)


def write_atomic(path: Path, text: str) -> None:
    """Write a text file, UTF-8, as ``open_atomic`` does."""
    with open_atomic(path) as file:
        file.write(text.encode("utf-8"))


@contextmanager
def waiting_lock(path: Path) -> Iterator[None]:
    """Hold ``<path>.lock`` while the block runs; other processes wait for it.

    It goes with the process, however that ends. Without file locks, or where the file
    cannot be made, the block runs without one.

    Args:
        path: what is being made; its directory is made.
    """
    with ExitStack() as held:
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            lock = path.with_name(f".{path.name}.lock")
            if fcntl is None:
                held.enter_context(FileLock(lock, fallback_to_soft=False))
            else:  # closing lets go, also where a disk refuses to be asked for it
                handle = os.open(lock, os.O_RDWR | os.O_CREAT | _PLAIN, 0o666)
                held.callback(os.close, handle)
                fcntl.flock(handle, fcntl.LOCK_EX)
        yield


def hash_file(path: Path) -> str:
    """SHA-256 of a file's content; read once while size and time stay the same."""
    found = path.stat()
    return _hash_file(path, found.st_size, found.st_mtime_ns)


@cache
def _hash_file(path: Path, size: int, changed: int) -> str:
    del size, changed  # they are part of the cache's key only
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


LOCK = ".lock"


@dataclass(frozen=True)
class RunHold:
    """A run directory that is held, whatever becomes of its path."""

    path: Path
    handles: tuple[int, ...]  # of the folder, where it can be locked, and of LOCK

    def check(self) -> None:
        """Refuse to go on where another folder, or none, has taken the path.

        Raises:
            RunError: the folder was moved or replaced, or its lock was taken away.
        """
        held, below = self.handles[0], len(self.handles) < 2
        path = self.path / LOCK if below else self.path
        try:
            if os.path.samestat(os.fstat(held), path.lstat() if below else path.stat()):
                return
        except OSError:
            pass
        with suppress(OSError):
            path = Path(os.readlink(f"/proc/self/fd/{held}"))
        where = path.parent if below else path
        raise RunError(
            f"{self.path}: was moved, replaced or taken by another process while it "
            "trained. The run stopped; nothing is written any more. Continue it where "
            f"it lies now: flashdex train --resume {where}"
        )


@contextmanager
def run_lock(run_dir: Path) -> Iterator[RunHold]:
    """Hold a run directory; a second training process there is refused.

    Folder and lock file are both locked: to remove or to rename one of them lets nobody
    in. File systems without locks are used without one.

    Raises:
        OSError: it cannot be written.
        RunError: another process trains in it.
    """
    path = own_file(run_dir, LOCK)
    with ExitStack() as held:
        handle = held.enter_context(open_plain(path, "ab")).fileno()
        if fcntl is None:
            _take(lambda: held.enter_context(FileLock(path, blocking=False)), run_dir)
            yield RunHold(run_dir, (handle,))
            return
        folder = os.open(run_dir, os.O_RDONLY | os.O_DIRECTORY)
        held.callback(os.close, folder)
        handles = [
            h for h in (folder, handle) if _take(partial(_flock, h), run_dir)
        ] or [handle]
        yield RunHold(run_dir, tuple(handles))


def _flock(handle: int) -> None:
    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _take(lock: Callable[[], object], run_dir: Path) -> bool:
    """Whether the file system could lock."""
    try:
        lock()
    except (Timeout, BlockingIOError) as error:
        raise RunError(
            f"{run_dir}: another process is training in this folder. Wait for it, "
            "stop it, or choose another folder with run_dir=..."
        ) from error
    except OSError:
        return False
    return True
