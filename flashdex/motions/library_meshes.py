"""Meshes of a motion library: OBJ text, of which only vertices and triangles count."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from flashdex.errors import LibraryError
from flashdex.motions.library_format import AGAIN, as_library_error
from flashdex.objects.asset import ObjectAsset
from flashdex.system.files import open_plain, own_file
from flashdex.system.names import file_stem

MAX_MESH = 8 << 20  # bytes; a visual mesh has 5,000 triangles, 0.3 million bytes
MAX_FACES = 20_000  # a convex part has twice its vertices
Mesh = tuple[NDArray[np.float32], NDArray[np.int64]]


def write_meshes(data: Path, name: str, asset: ObjectAsset) -> tuple[dict, dict]:
    """Write the convex parts and the visual mesh of an object.

    Returns:
        ``parts`` and ``visual``, paths below ``data``; and the hash of each path.
    """
    folder, hashes = f"meshes/{file_stem(name)}", {}
    (data / folder).mkdir(parents=True)
    for i, part in enumerate(asset.parts):
        hull = trimesh.convex.convex_hull(part)
        # its faces, of the part's vertices in the order that they have
        gaps = np.linalg.norm(hull.vertices[:, None] - part[None], axis=-1)
        faces = gaps.argmin(axis=1)[hull.faces]
        file = f"{folder}/part_{i:03d}.obj"
        hashes[file] = _write_obj(data / file, part, faces)
    parts, visual = list(hashes), f"{folder}/visual.obj"
    vertices, faces = asset.visual_vertices, asset.visual_faces
    hashes[visual] = _write_obj(data / visual, vertices, faces)
    return {"parts": parts, "visual": visual}, hashes


def _write_obj(file: Path, vertices: np.ndarray, faces: np.ndarray) -> str:
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in np.asarray(vertices)]
    lines += [f"f {a} {b} {c}" for a, b, c in np.asarray(faces) + 1]
    text = ("\n".join(lines) + "\n").encode("ascii")
    with file.open("xb") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())
    return hashlib.sha256(text).hexdigest()


def read_mesh(path: Path, data: str, name: str, sha256: str) -> Mesh:
    """Vertices (V, 3), float32, m, and triangles (F, 3), int64, of a library's mesh.

    Nothing else of the format is read: other files that it names are not opened.

    Raises:
        LibraryError: it is missing, not what the manifest announces, or empty.
    """
    with as_library_error():
        file = own_file(path, data, name)
    try:
        with open_plain(file) as stream:
            text = stream.read(MAX_MESH + 1)
        fault = ""
        if len(text) > MAX_MESH:
            fault = f"is larger than {MAX_MESH >> 20} MiB"
        elif hashlib.sha256(text).hexdigest() != sha256:
            fault = "is not the mesh that the library was made with"
        else:
            return _parse_obj(text.decode("ascii"))
    except FileNotFoundError:
        fault = "is missing"
    except (OSError, ValueError, OverflowError) as error:
        fault = f"cannot be read ({error})"
    raise LibraryError(f"{file}: {fault}. {AGAIN}")


def _parse_obj(text: str) -> Mesh:
    lines = text.splitlines()
    if (count := sum(line.startswith("f ") for line in lines)) > MAX_FACES:
        raise ValueError(f"it has {count} triangles, {MAX_FACES} are allowed")
    vertices = np.array(_words(lines, "v "), np.float32).reshape(-1, 3)
    faces = np.array(_words(lines, "f "), np.int64).reshape(-1, 3) - 1
    if not np.isfinite(vertices).all() or len(vertices) < 4 or len(faces) < 1:
        raise ValueError("it has no body, or numbers that are not finite")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError("a triangle names a vertex that is not there")
    return vertices, faces


def _words(lines: list[str], kind: str) -> list[float] | list[int]:
    # one split of all lines of a kind: a library holds a million of them
    words = " ".join([line[2:] for line in lines if line.startswith(kind)]).split()
    return list(map(float if kind == "v " else int, words))
