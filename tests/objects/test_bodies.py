"""Bodies of a mesh: whichever way round a file has them, the mass is the right one."""

import time

import numpy as np
import pytest
import trimesh

from flashdex.errors import MeshError
from flashdex.objects.asset import ObjectSettings, make_object
from flashdex.objects.bodies import bounds_volume, fault_of_mass
from flashdex.objects.convex import compute_mass_properties
from flashdex.objects.meshes import clean_mesh

BOUNDS = np.array([[-1.0, -1, -1], [1, 1, 1]])


def box(*extents, at=(0.0, 0, 0), inside_out=False):
    mesh = trimesh.creation.box(extents)
    mesh.apply_translation(at)
    if inside_out:
        mesh.invert()
    return mesh


def join(*meshes):
    return trimesh.util.concatenate(list(meshes))


def flip_faces(mesh, *faces):
    turned = mesh.faces.copy()
    turned[list(faces)] = turned[list(faces)][:, ::-1]
    return trimesh.Trimesh(mesh.vertices, turned, process=False)


def tool(*, head=False, handle=False):
    """A handle and a head that do not touch; 40 and 96 cm3."""
    return join(
        box(0.1, 0.02, 0.02, inside_out=handle),
        box(0.04, 0.06, 0.04, at=(0.08, 0.01, 0), inside_out=head),
    )


def shell(*, outer=False, inner=True):
    return join(box(0.06, 0.06, 0.06, inside_out=outer), box(0.05, 0.05, 0.05,
                inside_out=inner))  # fmt: skip


def onion(*senses):
    sizes = (0.08, 0.06, 0.04, 0.02)
    return join(*(box(s, s, s, inside_out=i) for s, i in zip(sizes, senses)))  # noqa: B905


@pytest.mark.parametrize(
    ("mesh", "volume"),
    [
        pytest.param(tool(), 136, id="as_it_should_be"),
        pytest.param(tool(head=True), 136, id="large_part_inside_out"),
        pytest.param(tool(handle=True), 136, id="small_part_inside_out"),
        pytest.param(tool(head=True, handle=True), 136, id="all_inside_out"),
        pytest.param(flip_faces(tool(), 1, 15), 136, id="single_faces_turned"),
        pytest.param(shell(), 91, id="cavity"),
        pytest.param(shell(outer=True, inner=False), 91, id="cavity_inside_out"),
        pytest.param(flip_faces(shell(), 0), 91, id="cavity_with_a_turned_face"),
        pytest.param(flip_faces(shell(), 13), 91, id="cavity_with_a_turned_inner_face"),
        pytest.param(shell(inner=False), 216, id="solid_inside_of_a_solid"),
        pytest.param(onion(0, 1, 0), 512 - 216 + 64, id="core_in_a_cavity"),
        pytest.param(onion(1, 0, 1), 512 - 216 + 64, id="core_in_a_cavity_inside_out"),
        pytest.param(onion(0, 0, 1), 512 - 64, id="cavity_in_a_doubled_solid"),
        pytest.param(onion(0, 1, 1, 0), 512 - 216 + 8, id="doubled_cavity"),
    ],
)
def test_volume_and_centre_do_not_depend_on_the_sense_of_bodies(mesh, volume):
    mesh = mesh.copy()
    mesh.apply_translation((0.3, -0.2, 0.1))  # nothing depends on the origin
    clean = clean_mesh(mesh, name="object")
    assert clean.volume * 1e6 == pytest.approx(volume)
    assert bounds_volume(clean)
    low, high = clean.bounds
    assert ((clean.center_mass > low) & (clean.center_mass < high)).all()
    assert np.linalg.eigvalsh(clean.moment_inertia)[0] > 0


def test_nesting_is_not_sought_among_thousands():
    grid = np.stack(np.meshgrid(*[np.arange(14.0)] * 3), -1).reshape(-1, 3)
    cube = trimesh.creation.box([0.002] * 3)
    many = trimesh.util.concatenate(
        [cube.copy().apply_translation(p / 200) for p in grid]
    )
    start = time.process_time()
    assert clean_mesh(many, name="many").volume == pytest.approx(len(grid) * 8e-9)
    assert time.process_time() - start < 10


@pytest.mark.parametrize("mesh", [tool(head=True), tool(handle=True)])
def test_object_with_a_part_inside_out_is_the_right_one(tmp_path, mesh):
    settings = ObjectSettings(sdf_resolution=16, max_parts=1)
    right = make_object(tool(), settings=settings, cache_dir=tmp_path)
    found = make_object(mesh, settings=settings, cache_dir=tmp_path)
    assert found.mass == pytest.approx(right.mass)
    np.testing.assert_allclose(found.com, right.com, atol=1e-6)
    np.testing.assert_allclose(found.inertia, right.inertia, atol=1e-9)
    np.testing.assert_allclose(found.sdf, right.sdf, atol=1e-6)


def loose_triangles():
    """A box whose triangles do not meet: each is a hole of its own."""
    corners = box(0.06, 0.05, 0.04).subdivide().triangles
    shrunk = 0.97 * corners + 0.03 * corners.mean(axis=1, keepdims=True)
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    return trimesh.Trimesh(shrunk.reshape(-1, 3), faces, process=False)


def test_loose_triangles_are_not_closed_by_their_own_backs(tmp_path):
    clean = clean_mesh(loose_triangles(), name="soup")
    assert not bounds_volume(clean)
    settings = ObjectSettings(sdf_resolution=16, max_parts=1, density=1000.0)
    made = make_object(loose_triangles(), settings=settings, cache_dir=tmp_path)
    assert not made.watertight
    assert made.mass == pytest.approx(0.12, rel=0.1)
    np.testing.assert_allclose(made.com, 0, atol=2e-3)


@pytest.mark.parametrize(
    ("mass", "com", "inertia", "told"),
    [
        pytest.param(1.0, [2, 0, 0], np.eye(3), "outside", id="com_outside"),
        pytest.param(-1.0, [0, 0, 0], np.eye(3), "mass is -1", id="mass_negative"),
        pytest.param(0.0, [0, 0, 0], np.eye(3), "mass is 0", id="no_mass"),
        pytest.param(np.nan, [0, 0, 0], np.eye(3), "finite", id="mass_nan"),
        pytest.param(1.0, [0, np.inf, 0], np.eye(3), "finite", id="com_infinite"),
        pytest.param(1.0, [0, 0, 0], -np.eye(3), "no body", id="inertia_negative"),
        pytest.param(1.0, [0, 0, 0], np.diag([1, 1, 3]), "no body", id="triangle_rule"),
        pytest.param(1.0, [0, 0, 0], 99 * np.eye(3), "too large", id="inertia_huge"),
    ],
)
def test_impossible_mass_is_told(mass, com, inertia, told):
    assert told in fault_of_mass(mass, np.array(com), inertia, BOUNDS)
    assert not fault_of_mass(1.0, np.zeros(3), np.eye(3), BOUNDS)


def test_centre_outside_of_the_hull_but_inside_of_the_box_is_told():
    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert "outside" in fault_of_mass(1.0, np.full(3, 0.5), np.eye(3), corner)
    assert not fault_of_mass(1.0, np.full(3, 0.2), np.eye(3), corner)


def test_a_mesh_with_impossible_mass_takes_that_of_its_parts(monkeypatch):
    good = box(0.04, 0.05, 0.06)
    parts = [np.float32(good.vertices)]
    limits = {"density": 1000.0, "mass_limits": (0.0, 1.0), "name": "box"}
    right = compute_mass_properties(good, parts, **limits)
    monkeypatch.setattr("flashdex.objects.convex.bounds_volume", lambda mesh: True)
    wrong = join(good, box(0.03, 0.03, 0.03, at=(0.05, 0, 0), inside_out=True))
    found = compute_mass_properties(wrong, parts, **limits)
    for a, b in zip(found, right, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6)
    far = [np.float32(good.vertices) + 1]
    with pytest.raises(MeshError, match=r"box: its centre of mass lies outside"):
        compute_mass_properties(wrong, far, **limits)
