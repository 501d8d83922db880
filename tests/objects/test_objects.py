"""Objects against closed forms, trimesh's signed distance and brute force."""

import dataclasses
import logging
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

from flashdex.errors import MeshError
from flashdex.objects.asset import ObjectSettings, default_cache_dir, make_object
from flashdex.objects.meshes import clean_mesh, load_mesh, reduce_mesh
from flashdex.objects.signed_distance import winding_number

SMALL = ObjectSettings(sdf_resolution=24)
SHARED = Path(
    os.environ.get("FLASHDEX_SHARED", Path(__file__).parents[2].parent / "shared")
)


def torus():
    return trimesh.creation.torus(major_radius=0.04, minor_radius=0.012)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def box(cache):
    mesh = trimesh.creation.box(extents=(0.04, 0.06, 0.1))
    mesh.apply_translation((0.01, -0.02, 0.03))
    return make_object(mesh, settings=SMALL, cache_dir=cache, name="box")


@pytest.fixture(scope="module")
def ring(cache):
    settings = ObjectSettings(sdf_resolution=32)
    return make_object(torus(), settings=settings, cache_dir=cache, name="ring")


def grid_points(asset):
    axis = np.arange(len(asset.sdf)) * asset.sdf_spacing
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return nodes + asset.sdf_origin


def change(file, **values):
    """Write a file of the cache anew, sound but with other values."""
    with np.load(file) as stored:
        arrays = dict(stored) | values
    np.savez_compressed(file, **arrays)


def box_distance(points, centre, half):
    over = np.abs(points - centre) - half
    outside = np.linalg.norm(over.clip(0), axis=-1)
    return outside + over.max(axis=-1).clip(max=0)


def test_box_mass_and_inertia_are_the_closed_form(box):
    a, b, c = 0.04, 0.06, 0.1
    mass = 800 * a * b * c
    moments = mass / 12 * np.array([b * b + c * c, a * a + c * c, a * a + b * b])
    assert box.mass == pytest.approx(mass, rel=1e-9)
    np.testing.assert_allclose(box.com, (0.01, -0.02, 0.03), atol=1e-8)
    np.testing.assert_allclose(box.inertia, np.diag(moments), rtol=1e-5, atol=1e-10)
    np.testing.assert_allclose(box.aabb, [[-0.01, -0.05, -0.02], [0.03, 0.01, 0.08]])


def test_sphere_mass_inertia_and_single_reduced_part(cache):
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.045)
    asset = make_object(mesh, settings=SMALL, cache_dir=cache)
    volume = 4 / 3 * np.pi * 0.045**3
    assert asset.mass == pytest.approx(800 * volume, rel=0.01)
    expected = 0.4 * asset.mass * 0.045**2 * np.eye(3)
    np.testing.assert_allclose(asset.inertia, expected, rtol=0.005, atol=1e-9)
    assert len(asset.parts) == 1
    assert len(asset.parts[0]) <= 64
    hull = trimesh.convex.convex_hull(asset.parts[0])
    assert hull.volume == pytest.approx(mesh.volume, rel=1e-3)
    assert asset.radius == pytest.approx(0.045, rel=0.01)


@pytest.mark.parametrize(("side", "mass"), [(0.02, 0.05), (0.2, 0.5)])
def test_mass_is_clamped_and_inertia_follows(cache, side, mass):
    mesh = trimesh.creation.box(extents=(side,) * 3)
    asset = make_object(mesh, settings=SMALL, cache_dir=cache)
    assert asset.mass == mass
    np.testing.assert_allclose(
        asset.inertia, mass * side**2 / 6 * np.eye(3), rtol=1e-5, atol=1e-12
    )


def test_points_lie_on_the_box_evenly_with_its_normals(box):
    centre, half = np.array([0.01, -0.02, 0.03]), np.array([0.02, 0.03, 0.05])
    assert box.points.shape == box.normals.shape == (128, 3)
    assert np.abs(box_distance(box.points, centre, half)).max() < 1e-7
    ahead = box_distance(box.points + 1e-3 * box.normals, centre, half)
    np.testing.assert_allclose(ahead, 1e-3, atol=1e-6)
    gaps = np.linalg.norm(box.points[:, None] - box.points, axis=-1)
    gaps[np.eye(128, dtype=bool)] = np.inf
    # An even spread of 128 discs over the area; a random one has points that touch.
    even = np.sqrt(2 * (0.04 * 0.06 + 0.06 * 0.1 + 0.04 * 0.1) / 128)
    assert gaps.min() > 0.6 * even
    # Farthest-point order: every new point is closer to the old ones than the last.
    fresh = [np.min(gaps[i, :i]) for i in range(1, 128)]
    assert (np.diff(fresh) < 1e-6).all()
    assert box.radius == pytest.approx(np.linalg.norm(box.points, axis=1).max())


def test_box_distance_grid_is_the_closed_form(box):
    nodes = grid_points(box)
    expected = box_distance(nodes, (0.01, -0.02, 0.03), (0.02, 0.03, 0.05))
    np.testing.assert_allclose(box.sdf, expected, atol=1e-6)
    assert (nodes[0, 0, 0] <= box.aabb[0] - 0.05 + 1e-6).all()
    assert (nodes[-1, -1, -1] >= box.aabb[1] + 0.05 - 1e-6).all()


def assert_matches_trimesh(asset, mesh, count=1500):
    rng = np.random.default_rng(0)
    near = np.argwhere(np.abs(asset.sdf) < 2 * asset.sdf_spacing)
    picks = np.concatenate(
        (
            near[rng.integers(0, len(near), count)],
            rng.integers(0, len(asset.sdf), (count, 3)),
        )
    )
    nodes = asset.sdf_origin + picks * asset.sdf_spacing
    expected = -trimesh.proximity.signed_distance(mesh, nodes)
    got = asset.sdf[tuple(picks.T)]
    far = np.abs(expected) > 1e-6
    assert (np.sign(got[far]) == np.sign(expected[far])).all()
    # Exact but for nodes on a medial axis, where h^2 / 2d is the stated bound.
    assert np.abs(got - expected).max() < 1e-4
    assert np.quantile(np.abs(got - expected), 0.95) < 1e-6


def test_torus_distance_grid_matches_trimesh_and_closed_form(ring):
    assert_matches_trimesh(ring, torus())
    nodes = grid_points(ring)
    rim = np.linalg.norm(nodes[..., :2], axis=-1) - 0.04
    exact = np.hypot(rim, nodes[..., 2]) - 0.012
    # The mesh is a polyhedron inscribed in the torus.
    assert np.abs(ring.sdf - exact).max() < 1e-3
    assert ring.sdf[len(ring.sdf) // 2, len(ring.sdf) // 2, len(ring.sdf) // 2] > 0


def test_torus_parts_cover_it_and_leave_the_hole_open(ring):
    mesh = torus()
    assert 1 < len(ring.parts) <= 16
    assert all(4 <= len(p) <= 64 and p.dtype == np.float32 for p in ring.parts)
    hulls = [trimesh.convex.convex_hull(p) for p in ring.parts]
    total = sum(h.volume for h in hulls)
    assert mesh.volume * 0.95 < total < mesh.volume * 1.6
    inside = trimesh.sample.volume_mesh(mesh, 2000)
    covered = np.zeros(len(inside), dtype=bool)
    for hull in hulls:
        normals, offsets = hull.face_normals, hull.triangles[:, 0]
        above = (inside[:, None] - offsets) * normals
        covered |= above.sum(-1).max(axis=1) < 5e-4
        hole = -(offsets * normals).sum(-1)
        assert hole.max() > 0, "a part covers the hole's centre"
    assert covered.mean() > 0.98


def test_inertia_is_physical_for_a_thin_object(cache):
    mesh = trimesh.creation.box(extents=(0.2, 0.03, 0.0005))
    asset = make_object(mesh, settings=SMALL, cache_dir=cache)
    low, mid, high = np.linalg.eigvalsh(np.float64(asset.inertia))
    assert low > 0
    assert low + mid > high


def open_cylinder():
    mesh = trimesh.creation.annulus(r_min=0.028, r_max=0.03, height=0.08)
    keep = mesh.face_normals[:, 2] < 0.9
    return trimesh.Trimesh(mesh.vertices, mesh.faces[keep], process=False)


@pytest.mark.parametrize(
    "settings",
    [
        ObjectSettings(sdf_resolution=24, max_parts=1),
        pytest.param(
            ObjectSettings(sdf_resolution=24, threshold=0.5, max_parts=4),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["hull", "parts"],
)
def test_open_mesh_warns_and_takes_mass_from_its_parts(cache, caplog, settings):
    for told in (1, 0):  # computed, then read from the cache
        caplog.clear()
        with caplog.at_level(logging.WARNING, logger="flashdex"):
            asset = make_object(
                open_cylinder(), settings=settings, cache_dir=cache, name="pipe"
            )
        assert caplog.text.count("pipe: the mesh is not watertight") == told
    assert not asset.watertight
    volume = sum(trimesh.convex.convex_hull(p).volume for p in asset.parts)
    assert asset.mass == pytest.approx(np.clip(800 * volume, 0.05, 0.5), rel=1e-5)
    assert len(asset.parts) <= settings.max_parts
    low, mid, high = np.linalg.eigvalsh(np.float64(asset.inertia))
    assert low > 0
    assert low + mid > high


def test_winding_number_of_a_box():
    mesh = trimesh.creation.box(extents=(1, 1, 1))
    points = np.array([[0, 0, 0], [0.49, 0.4, -0.49], [0.51, 0, 0], [3, 3, 3]])
    np.testing.assert_allclose(
        winding_number(mesh.triangles, points), [1, 1, 0, 0], atol=1e-4
    )
    # Without its lid, a point at the centre misses one of six equal solid angles.
    bare = mesh.triangles[mesh.face_normals[:, 2] < 0.5]
    np.testing.assert_allclose(winding_number(bare, points[:1]), [5 / 6], atol=1e-4)


def assert_same(a, b):
    for field in dataclasses.fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if field.name == "parts":
            assert len(x) == len(y)
            assert all(np.array_equal(p, q) for p, q in zip(x, y, strict=True))
        elif isinstance(x, np.ndarray):
            assert x.dtype == y.dtype
            assert np.array_equal(x, y)
        else:
            assert type(x) is type(y)
            assert x == y


def test_cache_hit_is_identical_and_computes_nothing(ring, cache, monkeypatch):
    monkeypatch.setattr("flashdex.objects.asset.clean_mesh", None)
    settings = ObjectSettings(sdf_resolution=32)
    assert_same(
        ring, make_object(torus(), settings=settings, cache_dir=cache, name="ring")
    )


def test_settings_and_shape_change_the_key(box, cache):
    mesh = trimesh.creation.box(extents=(0.04, 0.06, 0.1))
    moved = make_object(mesh, settings=SMALL, cache_dir=cache)
    lighter = dataclasses.replace(SMALL, density=600.0)
    other = make_object(mesh, settings=lighter, cache_dir=cache)
    assert len({box.sha256, moved.sha256, other.sha256}) == 3
    assert other.mass == pytest.approx(0.75 * moved.mass)


@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.write_bytes(b""),
        lambda file: file.write_bytes(b"not a zip"),
        lambda file: file.write_bytes(file.read_bytes()[:-400]),
        lambda file: file.write_bytes(bytes(reversed(file.read_bytes()))),
        lambda file: np.savez(file, points=np.zeros(3)),
        lambda file: np.savez(file, points=np.array([{}], dtype=object)),
        lambda file: change(file, mass=np.array(np.nan)),
        lambda file: change(file, mass=np.array(-0.1)),
        lambda file: change(file, mass=np.array("heavy")),
        lambda file: change(file, com=np.float32([1.0, 0, 0])),
        lambda file: change(file, inertia=-np.eye(3, dtype="f4")),
        lambda file: change(file, inertia=np.diag(np.float32([1, 1, 9]))),
        lambda file: change(file, sdf=np.full((24, 24, 24), np.nan, "f4")),
        lambda file: change(file, part_vertices=np.full((8, 3), np.inf, "f4")),
        lambda file: change(file, part_sizes=np.zeros((), int)),
        lambda file: change(file, points=np.zeros((9000, 9000))),
    ],
    ids=[
        *("empty", "text", "cut", "reversed", "fields", "pickle"),
        *("mass_nan", "mass_negative", "mass_text", "com_outside", "inertia_negative"),
        *("inertia_of_no_body", "sdf_nan", "part_infinite", "sizes_shape", "bomb"),
    ],
)
def test_damaged_cache_file_is_computed_again(tmp_path, caplog, damage):
    mesh = trimesh.creation.box(extents=(0.05, 0.05, 0.05))
    first = make_object(mesh, settings=SMALL, cache_dir=tmp_path)
    (file,) = tmp_path.rglob("*.npz")
    damage(file)
    with caplog.at_level(logging.WARNING, logger="flashdex"):
        again = make_object(mesh, settings=SMALL, cache_dir=tmp_path)
    assert "computing the object again" in caplog.text
    assert_same(first, again)
    caplog.clear()
    assert_same(first, make_object(mesh, settings=SMALL, cache_dir=tmp_path))
    assert not caplog.text
    assert [p.name for p in tmp_path.rglob("*.npz")] == [file.name]
    assert not list(tmp_path.rglob("*.tmp"))


def test_unwritable_cache_only_warns(tmp_path, caplog):
    blocked = tmp_path / "file"
    blocked.write_text("")
    mesh = trimesh.creation.box(extents=(0.05, 0.05, 0.05))
    with caplog.at_level(logging.WARNING, logger="flashdex"):
        asset = make_object(mesh, settings=SMALL, cache_dir=blocked)
    assert asset.mass == pytest.approx(0.1)
    assert "not cached" in caplog.text


def test_cache_directory_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("FLASHDEX_CACHE", str(tmp_path))
    assert default_cache_dir() == tmp_path
    monkeypatch.delenv("FLASHDEX_CACHE")
    assert default_cache_dir() == Path.home() / ".cache" / "flashdex"


def test_scene_file_keeps_its_node_transforms(tmp_path):
    box = trimesh.creation.box(extents=(40, 60, 100))
    scene = trimesh.Scene()
    shrink = trimesh.transformations.scale_matrix(0.001)
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, (0, 0, 1))
    shift = trimesh.transformations.translation_matrix((0, 0, 0.2))
    scene.add_geometry(box, transform=turn @ shrink)
    scene.add_geometry(box, transform=shift @ shrink)
    scene.export(tmp_path / "two.glb")
    mesh = load_mesh(tmp_path / "two.glb")
    np.testing.assert_allclose(
        mesh.bounds, [[-0.03, -0.03, -0.05], [0.03, 0.03, 0.25]], atol=1e-7
    )


def test_file_and_memory_give_the_same_object(tmp_path, cache, box):
    mesh = trimesh.creation.box(extents=(0.04, 0.06, 0.1))
    mesh.apply_translation((0.01, -0.02, 0.03))
    path = tmp_path / "crate.ply"
    mesh.export(path)
    asset = make_object(path, settings=SMALL, cache_dir=cache)
    assert asset.name == "crate"
    np.testing.assert_allclose(asset.sdf, box.sdf, atol=1e-6)


def test_inverted_and_unmerged_mesh_is_repaired():
    mesh = trimesh.creation.box(extents=(0.04, 0.06, 0.1))
    soup = trimesh.Trimesh(
        mesh.triangles.reshape(-1, 3),
        np.arange(36).reshape(12, 3)[:, ::-1],
        process=False,
    )
    crumb = trimesh.creation.icosphere(subdivisions=1, radius=0.0005)
    crumb.apply_translation((0.2, 0, 0))
    both = trimesh.util.concatenate([soup, crumb])
    clean = clean_mesh(both, name="box")
    assert clean.is_volume
    assert clean.volume == pytest.approx(0.04 * 0.06 * 0.1)
    assert len(clean.vertices) == 8


def test_reduced_mesh_stays_close_to_the_surface():
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    small = reduce_mesh(mesh, max_faces=5000)
    assert 2000 < len(small.faces) <= 5000
    assert np.abs(np.linalg.norm(small.vertices, axis=1) - 0.05).max() < 5e-4
    assert reduce_mesh(small, max_faces=5000) is small


def triangles(vertices, faces):
    return trimesh.Trimesh(np.array(vertices, float), np.array(faces), process=False)


BOX = trimesh.creation.box(extents=(0.1, 0.1, 0.1))
NAN = BOX.vertices.copy()
NAN[3, 1] = np.nan
FLAT = [[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]]


@pytest.mark.parametrize(
    ("mesh", "reason"),
    [
        (trimesh.Trimesh(), "empty"),
        (triangles(FLAT[:3], [[0, 1, 2]]), "3 distinct vertices"),
        (triangles(NAN, BOX.faces), "1 vertices are not finite"),
        (triangles(FLAT, [[0, 1, 2], [0, 2, 3]]), "no volume"),
        (trimesh.creation.box(extents=(40, 60, 100)), "centimetres"),
        (trimesh.creation.box(extents=(1e-4, 1e-4, 1e-3)), "another unit"),
    ],
    ids=["empty", "vertices", "nan", "flat", "too-large", "too-small"],
)
def test_unusable_mesh_is_refused_by_name(cache, mesh, reason):
    with pytest.raises(MeshError, match=f"^mug: .*{reason}"):
        make_object(mesh, settings=SMALL, cache_dir=cache, name="mug")


def test_missing_and_unreadable_files_are_refused_by_path(tmp_path, cache):
    with pytest.raises(MeshError, match=r"gone\.obj: mesh file not found"):
        make_object(tmp_path / "gone.obj", cache_dir=cache)
    odd = tmp_path / "notes.xyzw"
    odd.write_text("hello")
    with pytest.raises(MeshError, match=r"notes\.xyzw: not readable"):
        make_object(odd, cache_dir=cache)
    hollow = tmp_path / "hollow.obj"
    hollow.write_text("v 0 0 0\nv 0 0 1\n")
    with pytest.raises(MeshError, match=r"hollow\.obj: "):
        make_object(hollow, cache_dir=cache)
    broken = tmp_path / "broken.obj"
    broken.write_text("v 0 0 0\nv 0 0 .1\nv 0 .1 0\nv .1 0 nan\nf 1 2 3\nf 1 2 4\n")
    with pytest.raises(MeshError, match=r"broken\.obj: .*not finite"):
        make_object(broken, cache_dir=cache)


@pytest.mark.assets
def test_real_mug_matches_trimesh(cache):
    path = SHARED / "demos" / "myodm" / "meshes" / "mug.obj"
    if not path.is_file():
        pytest.skip(f"{path} is absent; set FLASHDEX_SHARED to the recordings")
    settings = ObjectSettings(sdf_resolution=48)
    asset = make_object(path, settings=settings, cache_dir=cache)
    mesh = clean_mesh(load_mesh(path), name="mug")
    assert_matches_trimesh(asset, mesh)
    assert asset.mass == pytest.approx(800 * mesh.volume, rel=1e-6)
    assert 1 < len(asset.parts) <= 16
    assert len(asset.visual_faces) <= 5000
