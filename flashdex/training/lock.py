"""One process a run directory: the lock goes with the process, however it ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from flashdex.errors import RunError

try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None

LOCK = ".lock"


@contextmanager
def run_lock(run_dir: Path) -> Iterator[None]:
    """Hold a run directory; a second training process there is refused.

    File systems without locks are used without one.

    Args:
        run_dir: existing run directory.

    Raises:
        RunError: another process trains in it.
    """
    if fcntl is None:
        yield
        return
    with (run_dir / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RunError(
                f"{run_dir}: another process is training in this folder. Wait for it, "
                "stop it, or choose another folder with run_dir=..."
            ) from error
        except OSError:
            pass
        yield
