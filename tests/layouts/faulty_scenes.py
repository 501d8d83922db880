"""What a recording can tell wrongly: edits of a scene before any layout is written.

An edit with a name in ``LIES`` changes what the recording means physically, in silence:
a unit, the order of a quaternion, a side, a clock. A reader must not let it pass.
"""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation


def scale_meshes(scene, factor):
    for body in scene.objects:
        body.mesh.apply_scale(factor)


def scale_poses(scene, factor):
    for body in scene.objects:
        body.pose[:, :3] *= factor


def scale_hands(scene, factor):
    for hand in scene.hands.values():
        hand.wrist *= factor
        hand.keypoints *= factor


def put_scalar_last(scene):
    for body in scene.objects:
        body.pose[:, 3:] = np.roll(body.pose[:, 3:], -1, axis=1)


def conjugate(scene):
    for body in scene.objects:
        body.pose[:, 4:] *= -1


def swap_sides(scene):
    left, right = scene.hands["left"], scene.hands["right"]
    scene.hands["left"], scene.hands["right"] = right, left


def swap_poses(scene):
    first, second = scene.objects
    first.pose, second.pose = second.pose, first.pose


def delay_hands(scene, frames):
    for hand in scene.hands.values():
        for name in ("rotations", "axis_angle", "wrist", "keypoints", "coefficients"):
            track = getattr(hand, name)
            late = np.concatenate([np.repeat(track[:1], frames, axis=0), track])
            setattr(hand, name, late[: len(track)])


def _turn_all(scene, turn):
    for body in scene.objects:
        body.pose[:, :3] = turn.apply(body.pose[:, :3])
        quats = turn * Rotation.from_quat(body.pose[:, 3:], scalar_first=True)
        body.pose[:, 3:] = quats.as_quat(scalar_first=True)
    for hand in scene.hands.values():
        hand.wrist = turn.apply(hand.wrist)
        flat = turn.apply(hand.keypoints.reshape(-1, 3))
        hand.keypoints = flat.reshape(hand.keypoints.shape)
        root = turn * Rotation.from_rotvec(hand.axis_angle[:, :3])
        hand.axis_angle[:, :3] = root.as_rotvec()
        hand.rotations[:, 0] = root.as_matrix()


def lay_world_down(scene):
    """What was z up becomes y up (or -y up in a world that is y up)."""
    _turn_all(scene, Rotation.from_euler("x", -90, degrees=True))


def stand_world_on_its_head(scene):
    _turn_all(scene, Rotation.from_euler("x", 180, degrees=True))


def change_rate(scene, factor):
    """Tell another number of frames a second than the tracks have."""
    scene.fps *= factor


def shift_world(scene, far):
    for body in scene.objects:
        body.pose[:, :2] += far
    for hand in scene.hands.values():
        hand.wrist[:, :2] += far
        hand.keypoints[:, :, :2] += far


def shift_hands(scene, far):
    for hand in scene.hands.values():
        hand.wrist[:, 0] += far
        hand.keypoints[:, :, 0] += far


def spoil_objects(scene, frames, value):
    for body in scene.objects:
        body.pose[_chosen(scene, frames)] = value


def spoil_hands(scene, frames, value):
    chosen = _chosen(scene, frames)
    for hand in scene.hands.values():
        for name in ("axis_angle", "wrist", "keypoints", "coefficients"):
            getattr(hand, name)[chosen] = value


def spoil_one_number(scene, value):
    middle = len(scene.times) // 2
    scene.objects[0].pose[middle, 1] = value
    hand = scene.hands["right"]
    hand.wrist[middle, 2] = hand.keypoints[middle, 8, 2] = value


def _chosen(scene, frames):
    """Frames of a run in the middle, or every second one, or all."""
    count = len(scene.times)
    if frames == "all":
        return np.arange(count)
    if frames == "alternate":
        return np.arange(0, count, 2)
    first = count // 2
    return np.arange(first, min(first + frames, count))


def scale_quats(scene, factor):
    for body in scene.objects:
        body.pose[:, 3:] *= factor


def zero_some_quats(scene):
    for body in scene.objects:
        body.pose[_chosen(scene, 1), 3:] = 0.0


def teleport(scene, frames):
    places = np.linspace(3, len(scene.times) - 4, frames).astype(int)
    for body in scene.objects:
        body.pose[places, 0] += 0.4


def shake(scene):
    noise = np.random.default_rng(3).normal(
        scale=0.02, size=scene.objects[0].pose.shape
    )
    scene.objects[0].pose[:, :3] += noise[:, :3]


def spin(scene):
    """A turn of 2 rad at every frame."""
    turns = Rotation.from_euler("z", 2.0 * np.arange(len(scene.times))[:, None])
    body = scene.objects[0]
    quats = turns * Rotation.from_quat(body.pose[:, 3:], scalar_first=True)
    body.pose[:, 3:] = quats.as_quat(scalar_first=True)


def freeze(scene):
    for body in scene.objects:
        body.pose[:] = body.pose[0]


def cut(scene, frames):
    scene.times = scene.times[:frames]
    for body in scene.objects:
        body.pose = body.pose[:frames]
    for hand in scene.hands.values():
        for name in ("rotations", "axis_angle", "wrist", "keypoints", "coefficients"):
            setattr(hand, name, getattr(hand, name)[:frames])


def mirror_poses(scene):
    """A left-handed world for the objects only."""
    for body in scene.objects:
        body.pose[:, 1] *= -1
        body.pose[:, [4, 6]] *= -1


def _meshes(scene, change):
    for body in scene.objects:
        body.mesh = change(body.mesh)


def opened(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces[: len(mesh.faces) // 2])


def flat(mesh):
    return trimesh.Trimesh(mesh.vertices * [1, 1, 0], mesh.faces, process=False)


def inside_out(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


def one_triangle(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:1], process=False)


def far_vertex(mesh):
    vertices = np.asarray(mesh.vertices).copy()
    vertices[0] = 100.0
    return trimesh.Trimesh(vertices, mesh.faces, process=False)


def with_crumb(mesh):
    crumb = trimesh.creation.box([1e-3] * 3)
    crumb.apply_translation([50, 0, 0])
    return trimesh.util.concatenate([mesh, crumb])


def one_point(mesh):
    return trimesh.Trimesh(mesh.vertices * 0, mesh.faces, process=False)


def soup(mesh):
    points = np.random.default_rng(0).uniform(-0.04, 0.04, (60, 3))
    return trimesh.Trimesh(points, np.arange(60).reshape(-1, 3), process=False)


def _calls(function, *options):
    """Edits by name; an option that is a tuple holds several arguments."""
    found = {}
    for option in options:
        given = option if isinstance(option, tuple) else (option,)
        label = "_".join(str(g) for g in given)
        found[f"{function.__name__}_{label}"] = (function, given)
    return found


LIES = {
    **_calls(scale_meshes, 1000, 100, 10, 0.1, 0.01, 0.001),
    **_calls(scale_poses, 1000, 100, 10, 0.1, 0.01, 0.001),
    **_calls(scale_hands, 1000, 100, 10, 0.1, 0.01, 0.001),
    **_calls(delay_hands, 20, 6),
    **_calls(change_rate, 4, 0.25),
    **_calls(shift_hands, 0.1),
    **{
        edit.__name__: (edit, ())
        for edit in (
            put_scalar_last,
            conjugate,
            swap_sides,
            swap_poses,
            lay_world_down,
            stand_world_on_its_head,
            mirror_poses,
        )
    },
}
FAULTS = {
    **_calls(delay_hands, 1, 2),
    **_calls(shift_world, 30.0, 1e4, 1e6, 1e30),
    **_calls(shift_hands, 0.02),
    **{
        f"{what.__name__}_{label}_{value}": (what, (frames, value))
        for what in (spoil_objects, spoil_hands)
        for label, frames in (("1", 1), ("5", 5), ("20", 20), ("all", "all"))
        for value in (np.nan, np.inf)
    },
    **_calls(spoil_objects, ("alternate", np.nan), (3, 1e30), (3, 1e308), (2, 0.0)),
    **_calls(spoil_hands, ("alternate", np.nan), (3, 1e30), (2, 0.0)),
    **_calls(spoil_one_number, np.nan, -np.inf, 1e30, 1e308),
    **_calls(scale_quats, 0.0, 0.5, 0.97, 1e-30, 1e200, -1.0),
    **_calls(teleport, 1, 12),
    **_calls(cut, 1, 2, 9, 20),
    **{e.__name__: (e, ()) for e in (zero_some_quats, shake, spin, freeze)},
    **_calls(
        _meshes,
        *(opened, flat, inside_out, one_triangle),
        *(far_vertex, with_crumb, one_point, soup),
    ),
}
FAULTS = {
    (f"mesh_{call[1][0].__name__}" if call[0] is _meshes else name): call
    for name, call in FAULTS.items()
}
