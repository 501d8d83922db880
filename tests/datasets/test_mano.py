"""Our MANO layer against its identities and against plain loops over 4x4 matrices."""

import shutil

import numpy as np
import pytest
from layouts.mano_files import PARENTS, TIPS, mano_hand, write_mano
from layouts.reference_fk import rodrigues, shaped, skin_frame, wrist_keypoints
from layouts.scene import BETAS, make_scene
from scipy.spatial.transform import Rotation

from flashdex.datasets.body_models.mano import (
    load_mano,
    mano_file,
    rotations_from_axis_angle,
    rotations_from_quats,
)
from flashdex.errors import DemoError

SIDES = ("left", "right")
FRAMES = 5


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("mano")
    write_mano(path)
    return path


@pytest.fixture(params=SIDES)
def model(request, folder):
    return load_mano(folder, request.param)


@pytest.fixture
def pose():
    """Axis-angle (T, 48), betas (10,) and translation (T, 3), all far from zero."""
    rng = np.random.default_rng(1)
    turns = 0.6 * rng.standard_normal((FRAMES, 48))
    return turns, rng.standard_normal(10), rng.standard_normal((FRAMES, 3))


def reference(hand, betas, turns):
    """Joints (T, 16, 3) and vertices (T, 778, 3), the root at J0, without offset."""
    rest = shaped(hand, betas)
    local = [[rodrigues(v) for v in frame.reshape(16, 3)] for frame in turns]
    frames = [skin_frame(hand, rest, frame) for frame in local]
    return tuple(np.array(part) for part in zip(*frames, strict=True))


def skin_of(model, rotations, betas, shift):
    """All vertices, (T, 778, 3)."""
    rows = list(range(778))
    return model.pose(rotations, model.shape(betas), shift, rows, convention="joint")[
        :, 16:
    ]


def test_vertices_and_keypoints_agree_with_the_reference(model, pose):
    turns, betas, shift = pose
    hand = mano_hand(model.side)
    joints, vertices = reference(hand, betas, turns)
    rotations = rotations_from_axis_angle(turns)
    skin = skin_of(model, rotations, betas, shift)
    points = model.keypoints(rotations, betas, shift, convention="joint")
    assert np.abs(skin - vertices - shift[:, None]).max() < 1e-10
    tips = skin[:, TIPS[model.side]]
    assert np.array_equal(points[:, [4, 8, 12, 16, 20]], tips)
    fingers = [0, 13, 14, 15, 1, 2, 3, 4, 5, 6, 10, 11, 12, 7, 8, 9]
    rows = [0, 1, 2, 3, 5, 6, 7, 9, 10, 11, 13, 14, 15, 17, 18, 19]
    wanted = joints[:, fingers] + shift[:, None]
    assert np.abs(points[:, rows] - wanted).max() < 1e-10


def test_the_wrist_convention_puts_the_wrist_at_the_translation(model, pose):
    turns, betas, shift = pose
    rotations = rotations_from_axis_angle(turns)
    joint = model.keypoints(rotations, betas, shift, convention="joint")
    wrist = model.keypoints(rotations, betas, shift, convention="wrist")
    assert np.abs(wrist[:, 0] - shift).max() < 1e-10
    # the root turns about its rest place, whatever the rotation
    assert np.abs(joint[:, 0] - shift - model.rest_wrist(betas)).max() < 1e-10
    assert np.abs(joint - wrist - model.rest_wrist(betas)).max() < 1e-10
    assert np.linalg.norm(model.rest_wrist(betas)) > 0.08


def test_the_rest_pose_is_the_shaped_template(model):
    betas = np.linspace(-1, 1, 10)
    flat = rotations_from_axis_angle(np.zeros((1, 48)))
    skin = skin_of(model, flat, betas, np.zeros((1, 3)))[0]
    points = model.keypoints(flat, betas, np.zeros((1, 3)), convention="joint")[0]
    hand = mano_hand(model.side)
    assert np.abs(skin - shaped(hand, betas)).max() < 1e-10
    joints = hand.regressor @ skin
    assert np.abs(points[[0, 1, 5, 9, 13, 17]] - joints[[0, 13, 1, 4, 10, 7]]).max() < (
        1e-10
    )


def test_turning_the_world_turns_the_hand(model, pose):
    turns, betas, shift = pose
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7])
    rotations = rotations_from_axis_angle(turns)
    before = model.keypoints(rotations, betas, shift, convention="joint")
    turned = rotations.copy()
    turned[:, 0] = turn.as_matrix() @ rotations[:, 0]
    rest = model.rest_wrist(betas)
    moved = turn.apply(rest + shift) - rest
    after = model.keypoints(turned, betas, moved, convention="joint")
    wanted = turn.apply(before.reshape(-1, 3)).reshape(before.shape)
    assert np.abs(after - wanted).max() < 1e-10
    # and in the other convention the translation turns like any point
    before = model.keypoints(rotations, betas, shift, convention="wrist")
    after = model.keypoints(turned, betas, turn.apply(shift), convention="wrist")
    wanted = turn.apply(before.reshape(-1, 3)).reshape(before.shape)
    assert np.abs(after - wanted).max() < 1e-10


def test_bones_keep_their_length(model, pose):
    turns, betas, shift = pose
    rotations = rotations_from_axis_angle(turns)
    points = model.keypoints(rotations, betas, shift, convention="wrist")
    rest = mano_hand(model.side).regressor @ shaped(mano_hand(model.side), betas)
    bones = {1: 13, 2: 14, 3: 15, 5: 1, 6: 2, 7: 3, 10: 5, 15: 12, 17: 7, 19: 9}
    for point, joint in bones.items():
        parent = 0 if PARENTS[joint] == 0 else point - 1
        found = np.linalg.norm(points[:, point] - points[:, parent], axis=-1)
        wanted = np.linalg.norm(rest[joint] - rest[PARENTS[joint]])
        assert np.abs(found - wanted).max() < 1e-10


def test_quaternions_and_axis_angle_agree(pose):
    turns = pose[0]
    quats = Rotation.from_rotvec(turns.reshape(-1, 3)).as_quat(scalar_first=True)
    quats = (
        quats.reshape(FRAMES, 16, 4) * np.array([2.0, -1, 0.5, -3, 1])[:, None, None]
    )
    wanted = np.array([[rodrigues(v) for v in f.reshape(16, 3)] for f in turns])
    assert np.abs(rotations_from_axis_angle(turns) - wanted).max() < 1e-12
    assert np.abs(rotations_from_quats(quats) - wanted).max() < 1e-12


def test_principal_components(model):
    hand = mano_hand(model.side)
    coefficients = np.random.default_rng(2).standard_normal((FRAMES, 15))
    wanted = sum(
        coefficients[:, i : i + 1] * hand.hands_components[i] for i in range(15)
    )
    flat = model.finger_pose(coefficients, flat=True)
    bent = model.finger_pose(coefficients, flat=False)
    assert np.abs(flat - wanted).max() < 1e-12
    assert np.abs(bent - wanted - hand.hands_mean).max() < 1e-12
    assert np.array_equal(model.add_mean(flat), bent)
    whole = model.finger_pose(np.eye(45), flat=True)
    assert np.abs(whole - hand.hands_components).max() < 1e-12
    with pytest.raises(DemoError, match="n <= 45"):
        model.finger_pose(np.zeros((2, 48)), flat=True)


@pytest.mark.parametrize("convention", ["joint", "wrist"])
def test_frames_that_were_not_tracked_are_nan(model, pose, convention):
    turns, betas, shift = (part.copy() for part in pose)
    whole = model.keypoints(
        rotations_from_axis_angle(turns), betas, shift, convention=convention
    )
    turns[1, 7], shift[3, 2] = np.nan, np.nan
    found = model.keypoints(
        rotations_from_axis_angle(turns), betas, shift, convention=convention
    )
    assert np.isnan(found[[1, 3]]).all()
    assert np.array_equal(found[[0, 2, 4]], whole[[0, 2, 4]])
    quats = np.ones((2, 16, 4))
    quats[0, 5], quats[1, 2, 1] = 0.0, np.nan
    assert np.isnan(rotations_from_quats(quats)).all()
    none = np.full((2, 48), np.nan)
    assert np.isnan(rotations_from_axis_angle(none)).all()


def test_a_template_replaces_the_shape(model, pose):
    turns, betas, shift = pose
    rotations = rotations_from_axis_angle(turns)
    template = shaped(mano_hand(model.side), betas)
    shaped_by_file = model.keypoints(
        rotations, None, shift, convention="joint", template=template
    )
    by_betas = model.keypoints(rotations, betas, shift, convention="joint")
    mean = model.keypoints(rotations, None, shift, convention="joint")
    assert np.abs(shaped_by_file - by_betas).max() < 1e-12
    assert np.abs(mean - by_betas).max() > 1e-3
    assert np.allclose(model.rest_wrist(None, template), model.rest_wrist(betas))


def test_the_left_shape_is_fixed_only_where_it_is_wrong(folder, tmp_path, pose):
    turns, betas, shift = pose[0], BETAS, pose[2]
    raw = load_mano(folder, "left")
    fixed = load_mano(folder, "left", fix_left_shape=True)
    right = load_mano(folder, "right", fix_left_shape=True)
    assert (raw.left_shape_fixed, fixed.left_shape_fixed) == (False, True)
    assert not right.left_shape_fixed
    # fixed, the left hand is the right one's mirror image for every shape
    mirror = np.array([-1.0, 1, 1])
    gap = fixed.rest_wrist(betas) - mirror * right.rest_wrist(betas)
    assert np.abs(gap).max() < 1e-12
    assert np.abs(raw.rest_wrist(betas) - fixed.rest_wrist(betas)).max() > 1e-3
    # the decision rests on the data: a sound file is left alone
    write_mano(tmp_path)
    sound = mano_hand("left", fix_left_shape=True).shapedirs
    write_mano(tmp_path, sides=("left",), shapedirs=sound)
    kept = load_mano(tmp_path, "left", fix_left_shape=True)
    assert not kept.left_shape_fixed
    rotations = rotations_from_axis_angle(turns)
    one, two = (
        m.keypoints(rotations, betas, shift, convention="joint") for m in (kept, fixed)
    )
    assert np.array_equal(one, two)


@pytest.mark.parametrize("place", [".", "models", "mano", "mano_v1_2/models"])
@pytest.mark.parametrize("npz", [False, True])
def test_files_are_found_in_every_usual_place(tmp_path, folder, place, npz):
    write_mano(tmp_path / place, npz=npz, sides=("right",))
    file = mano_file(tmp_path, "right")
    assert file.parent.samefile(tmp_path / place)
    assert file.suffix == (".npz" if npz else ".pkl")
    found, wanted = load_mano(tmp_path, "right"), load_mano(folder, "right")
    assert np.array_equal(found.arrays.shape_dirs, wanted.arrays.shape_dirs)
    assert np.array_equal(found.arrays.regressor, wanted.arrays.regressor)


def test_missing_files_are_told_with_every_place(tmp_path):
    with pytest.raises(DemoError) as caught:
        load_mano(tmp_path, "left")
    text = str(caught.value)
    assert text.startswith("E_MANO: no MANO_LEFT.pkl")
    for place in (".", "models", "mano", "mano_v1_2/models"):
        assert f"{tmp_path / place}" in text
    assert "mano.is.tue.mpg.de" in text


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"posedirs": np.zeros((778, 3, 90))}, "posedirs has shape .* expected"),
        ({"shapedirs": None}, "lacks shapedirs"),
        ({"v_template": np.full((778, 3), np.nan)}, "v_template holds NaN"),
        ({"weights": "none"}, r"weights has shape \(\), expected"),
        ({"weights": np.full((778, 16), "x")}, "weights does not hold numbers"),
        ({"kintree_table": np.zeros((2, 16))}, "not the tree of MANO"),
    ],
)
def test_a_wrong_model_is_told(tmp_path, changes, told):
    write_mano(tmp_path, sides=("right",), **changes)
    with pytest.raises(DemoError, match=f"E_MANO: .*MANO_RIGHT.pkl.*{told}"):
        load_mano(tmp_path, "right")


def test_swapped_sides_and_other_pickles_are_told(tmp_path, folder):
    shutil.copy(folder / "MANO_LEFT.pkl", tmp_path / "MANO_RIGHT.pkl")
    with pytest.raises(DemoError, match=r"E_MANO.*is a left hand.*swapped"):
        load_mano(tmp_path, "right")
    (tmp_path / "MANO_LEFT.pkl").write_bytes(b"]q\x00.")
    with pytest.raises(DemoError, match=r"E_MANO.*holds a list"):
        load_mano(tmp_path, "left")
    (tmp_path / "MANO_LEFT.pkl").write_bytes(b"cposix\nsystem\n(S'true'\ntR.")
    with pytest.raises(DemoError, match=r"posix\.system"):
        load_mano(tmp_path, "left")


def test_wrong_arguments_are_told(model, pose):
    turns, betas, shift = pose
    rotations = rotations_from_axis_angle(turns)
    for bad in (
        (rotations[:, :15], betas, shift),
        (rotations, betas[:9], shift),
        (rotations, betas, shift[:-1]),
    ):
        with pytest.raises(DemoError, match="expected"):
            model.keypoints(*bad, convention="wrist")


@pytest.mark.parametrize("side", SIDES)
def test_the_scene_is_one_motion_at_every_rate(side):
    """The layouts' common scene: rates agree, hands carry rigidly and touch."""
    slow, fast = make_scene(30), make_scene(120)
    hand, body = slow.hands[side], slow.objects[side == "left"]
    assert np.allclose(hand.keypoints, fast.hands[side].keypoints[::4], atol=1e-12)
    assert np.allclose(body.pose, fast.objects[side == "left"].pose[::4], atol=1e-12)
    carried = (slow.times > 0.5) & (slow.times < 2.4)
    turns = Rotation.from_quat(body.pose[:, 3:], scalar_first=True)
    local = np.array(
        [
            turn.inv().apply(points - place)
            for turn, points, place in zip(
                turns, hand.keypoints, body.pose[:, :3], strict=True
            )
        ]
    )
    assert np.ptp(local[carried], axis=0).max() < 1e-12
    low, high = body.mesh.bounds
    tips = local[carried][0, [4, 12, 16]]
    outside = np.maximum(np.maximum(low - tips, tips - high), 0)
    assert np.linalg.norm(outside, axis=1).min() < 0.002
    assert 0.08 < np.ptp(body.pose[:, 2]) < 0.16
    lowest = body.mesh.vertices @ turns[0].as_matrix().T + body.pose[0, :3]
    assert abs(lowest[:, 2].min() - slow.table_z) < 1e-12


def test_the_scene_agrees_with_its_own_parameters(folder):
    scene = make_scene(30, seconds=2.0)
    for side, hand in scene.hands.items():
        model = load_mano(folder, side)
        fingers = model.finger_pose(hand.coefficients, flat=False)
        assert np.abs(fingers - hand.axis_angle[:, 3:]).max() < 1e-12
        args = (hand.rotations, hand.betas, hand.wrist - hand.j0)
        points = model.keypoints(*args, convention="joint")
        assert np.abs(points - hand.keypoints).max() < 1e-10
        rest = shaped(mano_hand(side), hand.betas)
        again = wrist_keypoints(
            side, mano_hand(side), rest, hand.rotations[:2], hand.wrist[:2]
        )
        assert np.array_equal(again, hand.keypoints[:2])
