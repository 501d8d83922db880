"""Observation blocks against a slow second computation with MuJoCo and scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation

from flashdex import keys
from flashdex.envs.config import EnvConfig
from flashdex.envs.transforms.assembly import make_transforms
from flashdex.envs.transforms.contact import decode_contact

ROWS = 6
WIDTHS = {  # a hand; both hands give the widths of method section 6
    "proprioception": 97,
    "reference_delta": 204 // 2 + 7,
    "object_state": 13,
    "object_points": 768,
    "surface_distance": 24,
    "contact": 208 // 2 + 78 // 2,
}


@pytest.fixture(params=[0, 1])
def offset(request):
    """First reference frame shown: the scored one, or the one after it."""
    return request.param


@pytest.fixture
def blocks(make_state, bank, hands, offset):
    """State, and its blocks (ROWS, 2, width) by name, future window included."""
    state = make_state(ROWS)
    transforms = make_transforms(
        EnvConfig().transforms, bank, hands, reference_offset=offset
    )
    td = state.copy()
    for transform in transforms[:-1]:
        td = transform(td)
    out = {n: td[keys.BLOCKS, n].unflatten(-1, (2, -1)).double() for n in WIDTHS}
    return state, out, td[keys.FUTURE].unflatten(1, (2, -1)).double()


class View:
    """One hand of one row: robot, own object, reference, in numpy."""

    def __init__(self, state, library, robot, row, side, offset):
        self.kin = robot(state, row, side)
        self.wrist = Rotation.from_matrix(self.kin["wrist"])
        slot = int(library.motions["hand_object"][2, side])
        self.asset = library.objects[int(library.motions["object_index"][2, slot])]
        pose = state[keys.OBJECT_POSE][row, slot].double().numpy()
        self.pos, self.turn = pose[:3], rotation(pose[3:])
        self.vel = state[keys.OBJECT_VEL][row, slot].double().numpy()
        self.library, self.side, self.slot = library, side, slot
        self.frame = int(state[keys.FRAME][row]) + offset

    def ref(self, name, *, ahead=0):
        start, length = (int(self.library.motions[k][2]) for k in ("start", "length"))
        values = self.library.frames[name][start + min(self.frame + ahead, length - 1)]
        index = self.slot if name.startswith("object") else self.side
        return values[index].double().numpy()

    def ref_turn(self, *, ahead=0):
        return rotation(self.ref("object_quat", ahead=ahead))

    def local(self, vectors):
        return self.wrist.inv().apply(vectors)


def rotation(wxyz):
    return Rotation.from_quat(np.roll(wxyz, -1, -1))


def wxyz(turn):
    quat = np.roll(turn.as_quat(), 1, -1)
    return -quat if quat[0] < 0 else quat


def compare(blocks, name, slow, state, library, robot, offset):
    for row in range(ROWS):
        for side in range(2):
            view = View(state, library, robot, row, side, offset)
            np.testing.assert_allclose(
                blocks[name][row, side], slow(view, row, side), atol=2e-4, rtol=2e-4
            )


def test_proprioception(blocks, library, robot, offset):
    state, got, _ = blocks

    def slow(view, row, side):
        kin = view.kin
        pos, vel, target = (
            state[k][row, side].double().numpy()
            for k in (keys.JOINT_POS, keys.JOINT_VEL, keys.JOINT_TARGET)
        )
        quat = np.roll(view.wrist.as_quat(), 1)
        shown = got["proprioception"][row, side, 3:7].numpy()
        quat = quat if quat @ shown > 0 else -quat
        parts = [
            kin["wrist_pos"],
            quat,
            kin["wrist_vel"][:3] * 2,
            kin["wrist_vel"][3:] / 4,
        ]
        parts += [pos, vel * 0.1, view.local(kin["tip_pos"] - kin["wrist_pos"])]
        parts += [view.local(kin["tip_linvel"]) * 2, target - pos]
        return np.concatenate([np.ravel(p) for p in parts])

    compare(got, "proprioception", slow, state, library, robot, offset)


def test_reference_delta(blocks, library, robot, hands, offset):
    state, got, _ = blocks

    def slow(view, row, side):
        pairs = hands[keys.SIDES[side]].keypoint_links
        links, points = (list(column) for column in zip(*pairs, strict=True))
        points += list(keys.TIP_KEYPOINTS)
        kin = view.kin
        pos = np.concatenate([kin["link_pos"][links], kin["tip_pos"]])
        vel = np.concatenate([kin["link_linvel"][links], kin["tip_linvel"]])
        turn = view.ref_turn() * view.turn.inv()
        parts = [
            view.ref("keypoints")[points] - pos,
            view.ref("keypoint_linvel")[points] - vel,
            view.local(view.ref("object_pos") - view.pos),
            wxyz(view.wrist.inv() * turn * view.wrist),
        ]
        return np.concatenate([np.ravel(p) for p in parts])

    compare(got, "reference_delta", slow, state, library, robot, offset)


def test_object_state(blocks, library, robot, offset):
    state, got, _ = blocks

    def slow(view, row, side):
        return np.concatenate(
            [
                view.local(view.pos - view.kin["wrist_pos"]),
                wxyz(view.wrist.inv() * view.turn),
                view.local(view.vel[:3]) * 2,
                view.local(view.vel[3:]) / 4,
            ]
        )

    compare(got, "object_state", slow, state, library, robot, offset)


def test_object_points(blocks, library, robot, offset):
    state, got, _ = blocks

    def slow(view, row, side):
        points = view.asset["points"].double().numpy()
        now = view.local(view.turn.apply(points) + view.pos - view.kin["wrist_pos"])
        ref = view.ref_turn().apply(points) + view.ref("object_pos")
        ref = view.local(ref - view.kin["wrist_pos"])
        return np.concatenate([now.ravel(), (ref - now).ravel()])

    compare(got, "object_points", slow, state, library, robot, offset)


def test_surface_distance(blocks, library, robot, hands, offset):
    state, got, _ = blocks
    inside = 0

    def slow(view, row, side):
        nonlocal inside
        origin, step = (
            view.asset["sdf_origin"].numpy(),
            float(view.asset["sdf_spacing"]),
        )
        axes = [origin[i] + step * np.arange(37) for i in range(3)]
        grid = RegularGridInterpolator(axes, view.asset["sdf"].double().numpy())
        low, high = np.array([[a[0], a[-1]] for a in axes]).T

        def distance(points):
            near = points.clip(low, high)
            return grid(near) + np.linalg.norm(points - near, axis=-1)

        probes = np.concatenate([view.kin["wrist_pos"][None], view.kin["tip_center"]])
        local = view.turn.inv().apply(probes - view.pos)
        inside += int(((local > low) & (local < high)).all(-1).sum())
        radius = np.r_[0.0, hands[keys.SIDES[side]].tip_radius]
        nudge = 1e-6 * np.eye(3)
        slope = [distance(local + n) - distance(local - n) for n in nudge]
        normal = np.stack(slope, -1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        normal = view.local(view.turn.apply(normal))
        return np.concatenate([distance(local) - radius, normal.ravel()])

    compare(got, "surface_distance", slow, state, library, robot, offset)
    assert inside > 10  # the lookup was tested, not only its outside


def test_contact(blocks, library, robot, offset):
    state, got, _ = blocks

    def slow(view, row, side):
        parts = decode_contact(state[keys.CONTACT][row, side])
        direction, log_force, lever = (p.double().numpy() for p in parts)
        out = []
        for link in range(13):
            turn = Rotation.from_matrix(view.kin["link"][link])
            force = turn.apply(direction[link]) * np.expm1(log_force[link])
            arm = turn.apply(lever[link])
            torque = np.cross(arm, force)
            point = view.local(view.kin["link_pos"][link] + arm - view.kin["wrist_pos"])
            touches = log_force[link] > 0
            out.append(
                np.concatenate(
                    [coded(view, force), coded(view, torque), point * touches]
                )
            )
        return np.concatenate(out)

    compare(got, "contact", slow, state, library, robot, offset)


def coded(view, vector):
    """(unit * log(1 + n), log(1 + n)) in the wrist frame."""
    size = np.linalg.norm(vector)
    unit = view.local(vector) / max(size, 1e-12)
    return np.r_[unit * np.log1p(size), np.log1p(size)]


def test_future_window(blocks, library, robot, offset):
    state, _, got = blocks

    def slow(view, row, side):
        columns = []
        for ahead in range(10):
            turn = view.ref_turn(ahead=ahead) * view.turn.inv()
            wrist = rotation(view.ref("wrist_quat", ahead=ahead)) * view.wrist.inv()
            tips = view.ref("keypoints", ahead=ahead)[list(keys.TIP_KEYPOINTS)]
            parts = [
                view.local(view.ref("object_pos", ahead=ahead) - view.pos),
                two_columns(view.wrist.inv() * turn * view.wrist),
                view.local(view.ref("object_linvel", ahead=ahead) - view.vel[:3]),
                view.local(view.ref("object_angvel", ahead=ahead) - view.vel[3:]),
                view.local(view.ref("wrist_pos", ahead=ahead) - view.kin["wrist_pos"]),
                two_columns(view.wrist.inv() * wrist * view.wrist),
                view.local(tips - view.kin["tip_pos"]),
            ]
            columns.append(np.concatenate([np.ravel(p) for p in parts]))
        return np.stack(columns, -1)

    compare({"window": got}, "window", slow, state, library, robot, offset)


def two_columns(turn):
    return turn.as_matrix()[:, :2].T.ravel()


def test_widths(blocks):
    _, got, window = blocks
    assert {name: values.shape[-1] for name, values in got.items()} == WIDTHS
    assert window.shape == (ROWS, 2, 39, 10)
    # method section 6: 3,088 numbers, 780 of them in the window
    assert 2 * sum(WIDTHS.values()) + 780 == 3088
