"""Mesh files made to harm: refused by what they announce, or before they grow."""

import json
import os
import struct
import time
import tracemalloc

import numpy as np
import pytest
import trimesh

from flashdex.errors import MeshError
from flashdex.objects import mesh_files
from flashdex.objects.meshes import clean_mesh, load_mesh

BOX = trimesh.creation.box((0.05, 0.05, 0.05))
MANY = 10**12


def glb(change):
    """The box as a scene whose JSON was changed."""
    data = trimesh.Scene(BOX).export(file_type="glb")
    (length,) = struct.unpack_from("<I", data, 12)
    scene = json.loads(data[20 : 20 + length])
    change(scene)
    return pack(json.dumps(scene).encode(), data[20 + length :])


def pack(text, rest=b""):
    text += b" " * (-len(text) % 4)
    size = struct.pack("<II", 20 + len(text) + len(rest), len(text))
    return b"glTF\2\0\0\0" + size + b"JSON" + text + rest


def zeros(scene):
    for accessor in scene["accessors"]:
        accessor.pop("bufferView")
        accessor["count"] = 3 * 10**8


def repeat(scene):
    scene["nodes"] = [{"children": [i + 1, i + 1]} for i in range(40)] + [{"mesh": 0}]
    scene["scenes"] = [{"nodes": [0]}]


def circle(scene):
    scene["nodes"] = [{"children": [1]}, {"children": [0], "mesh": 0}]
    scene["scenes"] = [{"nodes": [0]}]


def deep(scene):
    scene["nodes"] = [{"children": [i + 1]} for i in range(9000)] + [{"mesh": 0}]
    scene["scenes"] = [{"nodes": [0]}]


def crowd(scene):
    scene["nodes"] = [{"mesh": 0}] * 20_000
    scene["scenes"] = [{"nodes": list(range(20_000))}]


def short_steps(scene):
    view = {**scene["bufferViews"][0], "byteStride": 1}
    scene["bufferViews"].append(view)
    odd = {"bufferView": len(scene["bufferViews"]) - 1, "type": "MAT4"}
    odd |= {"componentType": 5126, "count": 5_000_000}
    scene["accessors"] += [odd]


def negative(scene):
    """Many numbers more, and as many less."""
    more = {"bufferView": 0, "type": "VEC3", "componentType": 5126, "count": 9**9}
    scene["accessors"] += [more, {**more, "count": -(9**9)}]


def elsewhere(scene):
    scene["buffers"] = [{"uri": "secret.bin", "byteLength": 8}]


def ply(vertices, faces, kind="binary_little_endian"):
    head = f"ply\nformat {kind} 1.0\nelement vertex {vertices}\nproperty float x\n"
    head += f"property float y\nproperty float z\nelement face {faces}\n"
    return (head + "property list uchar int vertex_indices\nend_header\n").encode()


HOSTILE = {
    "ply_vertices": ("a.ply", ply(MANY, 1) + bytes(100)),
    "ply_faces": ("a.ply", ply(3, MANY) + bytes(100)),
    "ply_text": ("a.ply", ply(MANY, MANY, "ascii") + b"0 0 0\n" * 9),
    "ply_negative": ("a.ply", ply(-5, 1) + bytes(100)),
    "ply_list_of_billions": (
        "a.ply",
        ply(1, 1).replace(b"list uchar", b"list uint") + bytes(12) + b"\xff" * 12,
    ),
    "ply_not_a_number": ("a.ply", ply("1e99", 1) + bytes(100)),
    "stl_count": ("a.stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(100)),
    "stl_empty": ("a.stl", b""),
    "off_counts": ("a.off", f"OFF\n{MANY} {MANY} 0\n0 0 0\n".encode()),
    "off_polygon": ("a.off", f"OFF\n1 1 0\n0 0 0\n{MANY} 0 0 0\n".encode()),
    "obj_index": ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 999999999999\n"),
    "obj_negative_index": ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -99999999\n"),
    "obj_flat_points": ("a.obj", b"v 0 0\nv 1 0\nv 0 1\nv 1 1\nf 1 2 3\nf 2 3 4\n"),
    "obj_lines": ("a.obj", b"v 0\nv 1\nv 2\nf 1 2 3\n"),
    "obj_nul": ("a.obj", bytes(5000)),
    "glb_zeros": ("a.glb", glb(zeros)),
    "glb_repeated": ("a.glb", glb(repeat)),
    "glb_circle": ("a.glb", glb(circle)),
    "glb_deep": ("a.glb", glb(deep)),
    "glb_crowd": ("a.glb", glb(crowd)),
    "glb_short_steps": ("a.glb", glb(short_steps)),
    "glb_other_file": ("a.glb", glb(elsewhere)),
    "glb_deep_json": ("a.glb", pack(b"[" * 100_000)),
    "glb_negative": ("a.glb", glb(negative)),
    "glb_short": ("a.glb", b"glTF\2\0\0\0"),
    "glb_length": ("a.glb", b"glTF\2\0\0\0" + b"\xff" * 8 + b"JSON{}"),
}


@pytest.mark.parametrize(("name", "content"), HOSTILE.values(), ids=HOSTILE)
def test_hostile_mesh_is_refused_and_costs_nothing(tmp_path, name, content):
    (tmp_path / "secret.bin").write_bytes(bytes(8))
    (tmp_path / name).write_bytes(content)
    tracemalloc.start()
    with pytest.raises(MeshError, match=name):
        clean_mesh(load_mesh(tmp_path / name), name=name)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6


def test_repeated_parts_are_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(mesh_files, "MAX_REPEATED", 100)

    def place(scene):
        scene["nodes"] = [{"mesh": 0}] * 9
        scene["scenes"] = [{"nodes": list(range(9))}]

    (tmp_path / "a.glb").write_bytes(glb(place))
    with pytest.raises(MeshError, match="108 triangles by repeating"):
        load_mesh(tmp_path / "a.glb")


def test_groups_by_material_cost_no_time(tmp_path):
    triangle = " usemtl m{}\nf 1 2 3\n"
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "".join(map(triangle.format, range(20_000)))
    (tmp_path / "a.obj").write_text(text)
    start = time.process_time()
    assert len(load_mesh(tmp_path / "a.obj").faces) == 20_000
    assert time.process_time() - start < 5


def test_many_solids_are_refused(tmp_path):
    (tmp_path / "a.stl").write_text("solid a\nendsolid a\n" * 2000)
    with pytest.raises(MeshError, match="1000 solids"):
        load_mesh(tmp_path / "a.stl")


@pytest.mark.parametrize("suffix", [".obj", ".off", ".stl", ".ply"])
def test_lines_without_end_are_not_parsed(tmp_path, monkeypatch, suffix):
    monkeypatch.setattr(mesh_files.trimesh, "load_scene", None)
    monkeypatch.setattr(mesh_files, "MAX_LINES", 1000)
    (tmp_path / f"a{suffix}").write_bytes(b"v 0 0 0\n" * 1001)
    with pytest.raises(MeshError, match="1001 lines; at most 1000"):
        load_mesh(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("join", [b" ", b" \\\n"], ids=["one", "joined"])
def test_a_polygon_without_end_is_not_parsed(tmp_path, monkeypatch, join):
    monkeypatch.setattr(mesh_files.trimesh, "load_scene", None)
    (tmp_path / "a.obj").write_bytes(b"v 0 0 0\n" * 4 + b"f" + (join + b"1") * 99_999)
    with pytest.raises(MeshError, match="a line of more than 128 KiB"):
        load_mesh(tmp_path / "a.obj")


def test_large_file_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(mesh_files, "MAX_FILE", 1 << 20)
    with (tmp_path / "a.stl").open("wb") as file:
        file.truncate(1 << 40)  # a hole of a terabyte
    with pytest.raises(MeshError, match="more than 1 MiB"):
        load_mesh(tmp_path / "a.stl")


@pytest.mark.parametrize("name", ["a.obj", "a.glb", "a.ply"])
def test_a_mesh_opens_no_other_file(tmp_path, name, monkeypatch):
    textured = BOX.copy()
    textured.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)))
    trimesh.Scene(textured).geometry  # noqa: B018 - exports need a scene
    textured.export(tmp_path / name)
    if name == "a.obj":
        text = (tmp_path / name).read_text()
        (tmp_path / name).write_text(f"mtllib pipe.mtl\nusemtl m\n{text}")
    os.mkfifo(tmp_path / "pipe.mtl")  # would be waited for
    assert len(load_mesh(tmp_path / name).faces) == 12


def test_pipes_and_devices_are_no_meshes(tmp_path):
    os.mkfifo(tmp_path / "pipe.obj")
    (tmp_path / "zero.obj").symlink_to("/dev/zero")
    for name in ("pipe.obj", "zero.obj"):
        with pytest.raises(MeshError, match=f"{name}: mesh file not found"):
            load_mesh(tmp_path / name)


@pytest.mark.parametrize("suffix", mesh_files.MESH_SUFFIXES)
def test_every_kind_is_read(tmp_path, suffix):
    file = tmp_path / f"box{suffix}"
    BOX.export(file)
    mesh = load_mesh(file)
    assert len(mesh.faces) == 12
    np.testing.assert_allclose(np.abs(mesh.vertices), 0.025, atol=1e-7)
