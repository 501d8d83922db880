import dataclasses

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from flashdex.datasets.procedural.reader import procedural
from flashdex.motions.align import align
from flashdex.motions.checks.aligned import check_aligned, check_up
from flashdex.motions.checks.objects import check_objects, check_overlap
from flashdex.motions.contact.fingertips import tip_distances
from flashdex.motions.contact.roles import find_roles
from flashdex.motions.findings import Finding, make_strict, status_of
from flashdex.motions.repair.jumps import outliers
from flashdex.objects.asset import ObjectAsset, ObjectSettings, make_object
from flashdex.objects.solid import make_slot_grid
from flashdex.objects.symmetry import revolution_axis

FPS = 60.0
QUICK = ObjectSettings(sdf_resolution=32, max_parts=1)
SIDE = 0.06


def codes(findings):
    return [(f.code, f.level) for f in findings]


def mug(handle=0.03):
    """A cup without lid, and a handle, in one mesh."""
    cup = trimesh.creation.annulus(r_min=0.036, r_max=0.04, height=0.09, sections=64)
    floor = trimesh.creation.cylinder(radius=0.038, height=0.004, sections=64)
    floor.apply_translation([0, 0, -0.043])
    ring = trimesh.creation.torus(handle, 0.005)
    ring.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    ring.apply_translation([0.055, 0, 0])
    return trimesh.util.concatenate([cup, floor, ring])


def turned(mesh):
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])
    mesh.apply_transform(turn)
    mesh.apply_translation([0.3, -0.2, 0.1])
    return mesh, turn[:3, :3]


def cone():
    return trimesh.creation.cone(radius=0.03, height=0.05, sections=48)


@pytest.mark.parametrize(
    "shape",
    [
        lambda: trimesh.creation.cylinder(radius=0.03, height=0.12, sections=32),
        lambda: trimesh.creation.cylinder(radius=0.10, height=0.01, sections=32),
        lambda: trimesh.creation.cylinder(radius=0.03, height=0.0735, sections=48),
        lambda: trimesh.creation.capsule(radius=0.02, height=0.1),
        cone,
    ],
    ids=["bottle", "plate", "equal moments", "capsule", "cone"],
)
def test_bodies_of_revolution(shape):
    mesh, turn = turned(shape())
    axis = revolution_axis(mesh)
    assert axis is not None
    assert abs(axis @ turn[:, 2]) > 0.999


def test_open_surfaces_of_revolution():
    mesh, turn = turned(cone())
    mesh.update_faces(np.abs(mesh.face_normals @ turn[:, 2]) < 0.99)  # no floor
    assert not mesh.is_watertight
    axis = revolution_axis(mesh)
    assert axis is not None
    assert abs(axis @ turn[:, 2]) > 0.999
    assert revolution_axis(trimesh.creation.icosphere(subdivisions=3)) is not None


@pytest.mark.parametrize(
    "shape",
    [
        lambda: trimesh.creation.box((0.04, 0.05, 0.09)),
        lambda: trimesh.creation.box((0.05, 0.05, 0.12)),
        lambda: trimesh.creation.box((0.05, 0.05, 0.05)),
        lambda: trimesh.creation.box((0.01, 0.01, 0.20)),
        lambda: trimesh.creation.cylinder(radius=0.03, height=0.1, sections=6),
        mug,
    ],
    ids=["box", "square box", "cube", "rod", "hexagon", "mug"],
)
def test_no_bodies_of_revolution(shape):
    mesh, _ = turned(shape())
    assert revolution_axis(mesh) is None


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    mesh = trimesh.creation.box((SIDE, SIDE, SIDE))
    return make_object(
        mesh, settings=QUICK, cache_dir=tmp_path_factory.mktemp("cache"), name="box"
    )


def change(asset, mesh=None, **values) -> ObjectAsset:
    if mesh is not None:
        values["visual_vertices"] = np.asarray(mesh.vertices, np.float32)
        values["visual_faces"] = np.asarray(mesh.faces, np.int32)
        values["sha256"] = f"{mesh.area}"
    return dataclasses.replace(asset, **values)


def test_objects_and_their_parts(box):
    assert check_objects([box]) == []
    cup, two = mug(), [box.parts[0]] * 2
    (hull,) = check_objects([change(box, cup, parts=two)])
    assert (hull.code, hull.level) == ("W_HULL", "info")
    ratio = cup.convex_hull.volume / cup.volume
    assert ratio > 3
    assert f"hull/mesh volume {ratio:.1f}; 2 convex parts" in hull.text
    assert codes(check_objects([change(box, cup)])) == [("W_HULL", "warn")]
    bar = trimesh.creation.box((0.1, 0.02, 0.02))
    leg = trimesh.creation.box((0.02, 0.1, 0.02))
    leg.apply_translation([0.04, 0.06, 0])
    corner = trimesh.util.concatenate([bar, leg])
    (parts,) = check_objects([change(box, corner)])
    assert (parts.code, parts.level) == ("W_PARTS", "warn")
    many = change(box, parts=[box.parts[0]] * 33)
    assert codes(check_objects([many])) == [("W_PARTS", "warn")]
    round_one = trimesh.creation.cylinder(radius=0.03, height=0.1)
    (symmetric,) = check_objects([change(box, round_one)])
    assert (symmetric.code, symmetric.level) == ("W_SYM", "info")
    open_one = change(box, watertight=False)
    assert codes(check_objects([open_one])) == [("W_WATER", "info")]
    large = change(box, aabb=box.aabb * 30)
    assert codes(check_objects([large])) == [("E_UNIT", "reject")]


def test_overlap_of_two_objects(box):
    grid = make_slot_grid([box, box], solid=False)
    first = np.tile([0.3, 0.1, 0.2, np.cos(0.5), 0, 0, np.sin(0.5)], (20, 1))
    second = first.copy()
    along = Rotation.from_rotvec([0, 0, 1.0]).apply([1.0, 0, 0])
    second[:, :3] += (SIDE - 0.015) * along
    poses = [first, second]
    assert check_overlap([box, box], poses, grid) == []
    second[:, :3] -= 0.01 * along  # 25 mm inside
    second[1:, 0] += 5.0  # only the first frame counts
    (finding,) = check_overlap([box, box], poses, grid)
    assert (finding.code, finding.level) == ("W_OBJOBJ", "warn")
    depth = float(finding.text.split(" is ")[1].split(" mm")[0])
    assert depth == pytest.approx(25, abs=2)


def lifted(seed=0):
    """A box and a taller one that are moved about a table, one of them lifted."""
    rng = np.random.default_rng(seed)
    boxes = [(0.04, 0.06, 0.08), (0.10, 0.05, 0.16)]
    phase = np.clip((np.arange(180) - 60) / 60, 0, 1)
    hop = np.sin(np.pi * phase) ** 2
    poses, vertices = [], []
    for size in boxes:
        way = rng.uniform(0.1, 0.3, 2) * rng.choice([-1, 1], 2)
        pose = np.zeros((180, 7))
        pose[:, :2] = rng.uniform(-0.3, 0.3, 2) + phase[:, None] * way
        pose[:, 2] = size[2] / 2 + 0.15 * hop
        pose[:, 3:] = [1, 0, 0, 0]
        poses.append(pose)
        vertices.append(np.asarray(trimesh.creation.box(size).vertices))
    return poses, vertices


@pytest.mark.parametrize("name", ["+x", "-x", "+y", "-y", "+z", "-z"])
def test_wrong_up_is_noticed(name):
    axis = np.eye(3)["xyz".index(name[1])] * (1 if name[0] == "+" else -1)
    turn, _ = Rotation.align_vectors([axis], [[0, 0, 1]])
    for seed in range(5):
        poses, vertices = lifted(seed)
        for pose in poses:
            pose[:, :3] = turn.apply(pose[:, :3]) + 0.7
            quats = turn * Rotation.from_quat(pose[:, 3:], scalar_first=True)
            pose[:, 3:] = quats.as_quat(scalar_first=True)
        found = check_up(poses, vertices, FPS)
        if name == "+z":
            assert found == []
        else:
            assert codes(found) == [("W_UP", "warn")]
            assert found[0].text.endswith(f"is up {name}?")


def test_up_is_named_in_the_recordings_own_world():
    poses, vertices = lifted()
    for pose in poses:  # was y up already; the reader said so, and was wrong
        pose[:, :3] = pose[:, [0, 2, 1]] * [1, -1, 1]
        pose[:, 3:] = np.array([np.sqrt(0.5), np.sqrt(0.5), 0, 0])
    (finding,) = check_up(poses, vertices, FPS, up="y")
    # recorded (x, y, z) came as (x, -z, y): what rises along -y had risen along z
    assert finding.text.endswith("is up +z?")


def test_a_shelf_and_a_held_object_are_no_reason():
    poses, vertices = lifted()
    poses[0][120:, 2] += 0.4  # ends on a shelf
    poses[1][60:, 2] = 0.5  # ends in the hand
    assert check_up(poses, vertices, FPS) == []


def aligned_of(change_demo, tmp):
    demo = procedural(0, kinds=["pick_box_right"])[0]
    change_demo(demo)
    aligned = find_roles(align(demo, control_hz=30.0))
    assets = [
        make_object(m, settings=QUICK, cache_dir=tmp, name=n)
        for m, n in zip(aligned.meshes, aligned.object_names, strict=True)
    ]
    return check_aligned(aligned, assets, make_slot_grid(assets, solid=False))


def freeze(demo):
    demo.objects[0].pose[:] = demo.objects[0].pose[0]


def brush(demo):
    """The box stays, and the hand is there for 0.2 s only."""
    freeze(demo)
    points, body = demo.keypoints["right"], demo.objects[0]
    near = tip_distances(points, body.pose, body.load_mesh()).min(axis=1) < 0.012
    first = int(near.argmax())
    points[:first] += [0, 0.3, 0]
    points[first + 12 :] += [0, 0.3, 0]


def leave(demo):
    demo.keypoints["right"] += [0, 0.25, 0]


def test_activity(tmp_path):
    assert aligned_of(lambda demo: None, tmp_path)[0] == []
    assert codes(aligned_of(freeze, tmp_path)[0]) == [("W_STATIC", "warn")]
    found = aligned_of(brush, tmp_path)[0]
    assert codes(found) == [("R_INACTIVE", "reject")]
    assert ("R_CONTACT", "reject") in codes(aligned_of(leave, tmp_path)[0])


def test_outliers_in_turn_are_told_apart():
    pose = np.tile([0.0, 0, 0, 1, 0, 0, 0], (40, 1))
    pose[[10, 12, 20, 21, 30, 31, 32], 0] = 0.4
    assert outliers(pose, 30.0) == [(10, 11), (12, 13), (20, 22)]
    pose[11] = np.nan  # beside a gap nobody knows the way back
    assert outliers(pose, 30.0) == [(20, 22)]


def test_strict_rejects_what_is_flagged():
    found = [Finding("W_A", "warn", "a"), Finding("I_B", "info", "b")]
    assert status_of(found) == "flagged"
    assert codes(make_strict(found)) == [("W_A", "reject"), ("I_B", "info")]
    assert status_of(make_strict(found[1:])) == "kept"
