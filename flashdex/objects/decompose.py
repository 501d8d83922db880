"""CoACD in a process of its own: meshes of others can make it crash or never end."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flashdex.system.limited import LimitError, run_limited

# a mesh of 32,000 triangles takes a minute or two; bytes of address space, CPU seconds
MAX_MEMORY, MAX_SECONDS = 8 << 30, 900


def run_coacd(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    *,
    seconds: int | None = None,
    **options: Any,
) -> list[NDArray[np.float64]]:
    """Corners of the convex parts that CoACD finds, each (V, 3).

    ``seconds`` are of CPU time, by default `MAX_SECONDS`.

    Raises:
        LimitError: it failed or took too long: it does so every time.
        MemoryError: it crashed, or the machine has not enough memory for it now.
    """
    given = vertices.tolist(), faces.tolist(), options
    limits = {"memory": MAX_MEMORY, "seconds": min(seconds or MAX_SECONDS, MAX_SECONDS)}
    try:
        return [np.array(part) for part in run_limited(_decompose, *given, **limits)]
    except LimitError as error:
        if error.is_machine:
            raise MemoryError(f"CoACD: {error}") from error
        raise


def _decompose(
    vertices: list[list[float]], faces: list[list[int]], options: dict[str, Any]
) -> list[list[list[float]]]:
    """Runs in the child, which imports little more than CoACD."""
    import coacd

    coacd.set_log_level("off")
    mesh = coacd.Mesh(np.array(vertices), np.array(faces))
    return [np.asarray(part).tolist() for part, _ in coacd.run_coacd(mesh, **options)]
