"""Mesh files of others: what one announces is compared with what it holds.

The readers of trimesh allocate what a head says, follow what a scene repeats and open
what a file names. So a file is read whole first, of bounded size; its head is checked;
and a reader gets the bytes alone, without the folder that they come from.
"""

from __future__ import annotations

import io
import os
import re
import struct
from pathlib import Path
from typing import Any

import trimesh

from flashdex.system.jsonl import parse_json

# others of trimesh unpack archives, or read what they name from other files
MESH_SUFFIXES = (".obj", ".ply", ".stl", ".glb", ".off")
MAX_FACES = 5_000_000  # a scene may hold the same geometry any number of times
MAX_REPEATED = 500_000  # as small as the file may be, cleaning takes its time
MAX_FILE = 1 << 29  # bytes; text takes three times as much while it is parsed
# lines of text, of bytes each: five million triangles have nine million, a polygon of
# ten thousand corners one; those take twenty seconds, and larger ones never end
MAX_LINES, MAX_LINE = 12_000_000, 1 << 17
MAX_NODES, MAX_DEPTH = 10_000, 64  # of a scene
MAX_GROUPS = 1000  # of triangles, each a mesh of its own; time grows with the square
# bytes of an entry, at most; what a glb unpacks to below MIN_GROWTH is let pass
GLB_BYTES = {"SCALAR": 4, "VEC2": 8, "VEC3": 12, "VEC4": 16, "MAT2": 16, "MAT3": 36}
MIN_GROWTH = 256 << 20
MATERIAL = re.compile(rb"usemtl[^\r\n]*")
PLY_HEAD = 1 << 16  # bytes
PLY_ELEMENT = re.compile(rb"^\s*element\s+\S+\s+(\S+)\s*$", re.MULTILINE)


def read_scene(path: Path) -> trimesh.Scene:
    """What a mesh file holds; materials are left out, other files are not opened.

    Raises:
        OSError: the disk fails.
        MemoryError: there is not enough.
        ValueError: too large, or it announces what it does not hold; and nearly any
            other exception, as each reader of trimesh fails in its own way.
    """
    with path.open("rb") as file:
        if os.fstat(file.fileno()).st_size > MAX_FILE:
            raise ValueError(f"more than {MAX_FILE >> 20} MiB")
        data = file.read()
    kind = path.suffix.lower().removeprefix(".")
    if kind != "glb" and (count := data.count(b"\n")) > MAX_LINES:
        raise ValueError(f"{count} lines; at most {MAX_LINES}")
    if kind == "ply":
        _check_ply(data)
    elif kind == "glb":
        _check_glb(data)
    elif kind in ("obj", "off"):
        _check_lines(data)
        if data.count(b"usemtl") > MAX_GROUPS:
            data = MATERIAL.sub(b"", data)
    elif kind == "stl" and data.count(b"endsolid") > MAX_GROUPS:
        raise ValueError(f"more than {MAX_GROUPS} solids; join them to one")
    scene = trimesh.load_scene(
        io.BytesIO(data), file_type=kind, process=False, skip_materials=True
    )
    shapes = [scene.graph[node][1] for node in scene.graph.nodes_geometry]
    faces = sum(len(getattr(scene.geometry[s], "faces", ())) for s in shapes)
    if faces > MAX_FACES:
        raise ValueError(f"{faces} triangles; at most {MAX_FACES}")
    if len(shapes) > len(set(shapes)) and faces > MAX_REPEATED:
        text = f"{faces} triangles by repeating parts; at most {MAX_REPEATED}"
        raise ValueError(text)
    return scene


def _check_lines(data: bytes) -> None:
    start = 0
    while start + MAX_LINE < len(data):
        end = max(data.rfind(mark, start, start + MAX_LINE) for mark in b"\n\r")
        # a backslash at its end joins a line with the next
        if end < 0 or data.count(b"\\\n", start, end + 2) > MAX_GROUPS:
            raise ValueError(f"a line of more than {MAX_LINE >> 10} KiB")
        start = end + 1


def _check_ply(data: bytes) -> None:
    head = data[:PLY_HEAD].partition(b"end_header")[0]
    counts = [int(count) for count in PLY_ELEMENT.findall(head)]
    if any(count < 0 for count in counts) or sum(counts) > len(data):
        raise ValueError(f"{counts} elements announced in {len(data)} bytes")


def _check_glb(data: bytes) -> None:
    (length,) = struct.unpack_from("<I", data, 12)
    if 20 + length > len(data):
        raise ValueError("it ends in its head")
    scene = parse_json(data[20 : 20 + length])
    if any("uri" in buffer for buffer in scene.get("buffers", [])):
        raise ValueError("its numbers are in another file")
    total = 0
    for accessor in scene.get("accessors", []):
        if int(accessor["count"]) < 0:  # would make up for the others
            raise ValueError(f"{accessor['count']} numbers announced")
        total += int(accessor["count"]) * GLB_BYTES.get(accessor["type"], 64)
        # without a view it is filled with zeros, as many as it says
        if "bufferView" not in accessor and int(accessor["count"]) * 16 > len(data):
            raise ValueError(f"{accessor['count']} numbers announced and none there")
    # views may overlap, and be walked through in steps shorter than what is read
    if total > max(4 * len(data), MIN_GROWTH):
        raise ValueError(f"{total} bytes announced in {len(data)}")
    _check_nodes(scene.get("nodes", []))


def _check_nodes(nodes: list[dict[str, Any]]) -> None:
    """Refuse graphs that are deep, circular, or repeat their parts without end."""
    if len(nodes) > MAX_NODES:
        raise ValueError(f"{len(nodes)} nodes; at most {MAX_NODES}")
    parents = [0] * len(nodes)
    for node in nodes:
        for child in node.get("children", []):
            parents[child] += 1
    if max(parents, default=0) > 1:
        raise ValueError("a node that hangs on several others")
    level = [i for i, count in enumerate(parents) if not count]
    seen = 0
    for _ in range(MAX_DEPTH):
        seen += len(level)
        level = [child for i in level for child in nodes[i].get("children", [])]
    if level or seen < len(nodes):
        raise ValueError(f"nodes in a circle, or more than {MAX_DEPTH} levels")
