"""XHand models against the vendor's facts."""

from __future__ import annotations

import json
import os
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flashdex.errors import UnknownHandError
from flashdex.hands.attach import add_hand
from flashdex.hands.spec import HandError, load_hand
from flashdex.keys import SIDES

ROOT = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("FLASHDEX_SHARED", ROOT.parent / "shared"))

# finger joints of the right hand: lower, upper
RIGHT_JOINTS = {
    "hand_thumb_bend_joint": (0.0, 1.83),
    "hand_thumb_rota_joint1": (-1.05, 1.57),
    "hand_thumb_rota_joint2": (-0.175, 1.83),
    "hand_index_bend_joint": (-0.175, 0.175),
    "hand_index_joint1": (0.0, 1.92),
    "hand_index_joint2": (0.0, 1.92),
    "hand_mid_joint1": (0.0, 1.92),
    "hand_mid_joint2": (0.0, 1.92),
    "hand_ring_joint1": (0.0, 1.92),
    "hand_ring_joint2": (0.0, 1.92),
    "hand_pinky_joint1": (0.0, 1.92),
    "hand_pinky_joint2": (0.0, 1.92),
}
# vendor fingertips in the base at all joints zero
TIPS_Q0 = {
    "right": [
        [0.15701, 0.02212, -0.02872],
        [0.0265, 0.0065, -0.206],
        [0.004, 0.0065, -0.20611],
        [-0.016, 0.0065, -0.2035],
        [-0.036, 0.0065, -0.2005],
    ],
    "left": [
        [0.15701, -0.02212, -0.02872],
        [0.0265, -0.0065, -0.206],
        [0.004, -0.0065, -0.2065],
        [-0.016, -0.0065, -0.2035],
        [-0.036, -0.0065, -0.2005],
    ],
}
MIRROR = np.array([1.0, -1.0, 1.0])


def facts_tips(facts, qpos):
    """Fingertips from the fact table alone, with SciPy's rotations."""
    turn = Rotation.from_euler("ZXY", [qpos[3], qpos[4], -qpos[5]])
    pose = {None: (turn, qpos[:3])}
    joints = {j["body"]: (j, q) for j, q in zip(facts["joints"], qpos[6:], strict=True)}
    for body in facts["bodies"]:
        parent_turn, parent_pos = pose[body["parent"]]
        pos = parent_pos + parent_turn.apply(body["pos"])
        turn = parent_turn * Rotation.from_quat(body["quat_wxyz"], scalar_first=True)
        if body["name"] in joints:
            joint, angle = joints[body["name"]]
            turn = turn * Rotation.from_rotvec(np.array(joint["axis"]) * angle)
        pose[body["name"]] = turn, pos
    tips = []
    for tip in facts["fingertips"]:
        turn, pos = pose[tip["body"]]
        tips.append(pos + turn.apply(tip["pos"]))
    return np.array(tips)


@pytest.mark.parametrize("side", SIDES)
def test_vendor_tips_match_fact_table_over_random_poses(
    side, make_model, sample_qpos, sites
):
    path = SHARED / "hands" / f"xhand_{side}.json"
    if not path.exists():
        pytest.skip(f"no fact table at {path}; set FLASHDEX_SHARED")
    facts = json.loads(path.read_text())
    rng = np.random.default_rng(0)
    hand, model = load_hand("xhand")[side], make_model(side)
    data = mujoco.MjData(model)
    for _ in range(50):
        data.qpos = sample_qpos(hand, rng)
        mujoco.mj_kinematics(model, data)
        error = sites(model, data, side, "tip") - facts_tips(facts, data.qpos)
        assert np.abs(error).max() < 1e-6


@pytest.mark.parametrize("side", SIDES)
def test_vendor_tips_at_zero_are_the_pinned_ones(side, make_model, sites):
    model = make_model(side)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    assert sites(model, data, side, "tip") == pytest.approx(
        np.array(TIPS_Q0[side]), abs=6e-6
    )


@pytest.mark.parametrize("side", SIDES)
def test_joints_and_ranges(side, make_model):
    hand, model = load_hand("xhand")[side], make_model(side)
    table = dict(RIGHT_JOINTS)
    if side == "left":  # the vendor's own deviation
        table["hand_thumb_rota_joint2"] = (-0.17, 1.83)
    assert hand.joint_names[6:] == tuple(f"{side}_{n}" for n in table)
    wanted = [(-5, 5)] * 3 + [(-6.2, 6.2)] * 3 + list(table.values())
    assert hand.joint_range == pytest.approx(np.array(wanted))
    assert model.jnt_range == pytest.approx(hand.joint_range)
    assert model.actuator_ctrlrange == pytest.approx(hand.joint_range)
    assert [model.joint(i).name for i in range(18)] == list(hand.joint_names)
    assert [model.actuator(i).name for i in range(18)] == list(hand.joint_names)
    assert (model.nv, model.nu, hand.num_links) == (18, 18, 13)
    assert model.jnt_limited.all()


def test_masses(make_model):
    for side, total in (("left", 1.122254), ("right", 1.122385)):
        model = make_model(side)
        assert model.body_mass.sum() - 0.5 == pytest.approx(total, abs=2e-6)
        assert model.body(f"{side}_hand_link").mass == pytest.approx(0.53003, abs=1e-4)


def test_left_is_the_reflection_of_right(make_model, sample_qpos, sites):
    hands, rng = load_hand("xhand"), np.random.default_rng(1)
    left, right = hands["left"], hands["right"]
    # axial vectors mirror with the opposite sign: (a_x, a_y, a_z) -> (-a_x, a_y, -a_z)
    assert left.joint_axis[6:] == pytest.approx(right.joint_axis[6:] * -MIRROR)
    models = {s: make_model(s) for s in SIDES}
    data = {s: mujoco.MjData(models[s]) for s in SIDES}
    for _ in range(20):
        fingers = sample_qpos(right, rng)[6:]
        for side in SIDES:
            data[side].qpos[6:] = fingers
            mujoco.mj_kinematics(models[side], data[side])
        links = [data["left"].body(n).xpos for n in left.link_names]
        twins = [data["right"].body(n).xpos * MIRROR for n in right.link_names]
        assert np.abs(np.array(links) - twins).max() < 1e-5
        # the right middle tip is 0.4 mm shorter at the vendor; thumb fits differ a bit
        for kind, limit in (("tip", 5e-4), ("pad", 1e-3)):
            mirrored = sites(models["right"], data["right"], "right", kind) * MIRROR
            error = sites(models["left"], data["left"], "left", kind) - mirrored
            assert np.linalg.norm(error, axis=-1).max() < limit


@pytest.mark.parametrize("side", SIDES)
def test_tracking_point_lies_on_the_palmar_side_of_the_end_sphere(side, make_model):
    hand, model = load_hand("xhand")[side], make_model(side)
    data = mujoco.MjData(model)
    arm = hand.tip_pos - hand.tip_center
    assert np.linalg.norm(arm, axis=-1) == pytest.approx(hand.tip_radius)
    for finger, link in enumerate(hand.tip_link):
        name = hand.link_names[link]
        (geom,) = [
            i for i in range(model.ngeom) if model.geom_bodyid[i] == model.body(name).id
        ]
        axis = Rotation.from_quat(model.geom_quat[geom], scalar_first=True).apply(
            [0, 0, 1]
        )
        half = model.geom_size[geom, 1] * axis
        ends = model.geom_pos[geom] + np.array([half, -half])
        gap = np.linalg.norm(ends - hand.tip_center[finger], axis=-1)
        assert gap.min() < 1e-6
        assert hand.tip_radius[finger] == pytest.approx(model.geom_size[geom, 0])
        # flexing carries the tip to the palmar side, extension of the link is distal
        joint = int(np.flatnonzero(hand.joint_link == link)[0])
        flexion = np.cross(hand.joint_axis[joint], hand.vendor_tip_pos[finger])
        distal = hand.vendor_tip_pos[finger] / np.linalg.norm(
            hand.vendor_tip_pos[finger]
        )
        flexion /= np.linalg.norm(flexion)
        unit = arm[finger] / hand.tip_radius[finger]
        assert unit @ flexion == pytest.approx(np.sqrt(0.5), abs=1e-6)
        assert unit @ distal == pytest.approx(np.sqrt(0.5), abs=1e-6)
    mujoco.mj_kinematics(model, data)
    assert data.site(f"{side}_palm").xpos == pytest.approx(np.zeros(3))


@pytest.mark.parametrize("side", SIDES)
def test_wrist_from_palm_turns_the_palm_axes_onto_the_base(side):
    hand = load_hand("xhand")[side]
    palm_from_base = Rotation.from_quat(hand.wrist_from_palm, scalar_first=True)
    normal = 1.0 if side == "right" else -1.0
    # palm x runs to the fingers (base -z), palm z out of the palm (base +-y)
    assert palm_from_base.apply([0, 0, -1]) == pytest.approx([1, 0, 0], abs=1e-12)
    assert palm_from_base.apply([0, normal, 0]) == pytest.approx([0, 0, 1], abs=1e-12)


def test_twelve_links_stand_for_human_keypoints():
    hand = load_hand("xhand")["left"]
    links, keypoints = zip(*hand.keypoint_links, strict=True)
    assert sorted(links) == list(range(1, 13))
    assert keypoints == (1, 2, 3, 5, 5, 6, 9, 10, 13, 14, 17, 18)
    assert [k for _, k in hand.level1_links] == [2, 5, 9, 13, 17]
    assert [k for _, k in hand.distal_links] == [3, 6, 10, 14, 18]
    assert tuple(link for link, _ in hand.distal_links) == tuple(hand.tip_link)


def test_no_self_contact_at_zero_and_fixed_base_agrees_with_moving(
    make_model, sample_qpos
):
    rng = np.random.default_rng(3)
    for side, hand in load_hand("xhand").items():
        moving = make_model(side)
        fixed = mujoco.MjSpec.from_string(hand.mjcf).compile()
        data, fixed_data = mujoco.MjData(moving), mujoco.MjData(fixed)
        mujoco.mj_forward(moving, data)
        assert data.ncon == 0
        touched = 0
        for _ in range(50):
            data.qpos[6:] = fixed_data.qpos[:] = sample_qpos(hand, rng)[6:]
            mujoco.mj_forward(moving, data)
            mujoco.mj_forward(fixed, fixed_data)
            assert data.ncon == fixed_data.ncon
            touched += data.ncon > 0
        # real self-contacts (thumb against palm and fingers) stay on
        assert 0 < touched < 50


def test_scene_in_radians_and_saved_scene_are_the_same_model(make_model):
    scene = mujoco.MjSpec()
    for side in SIDES:
        add_hand(scene, "xhand", side)
    model = scene.compile()
    for other in (
        make_model(degree=False),
        mujoco.MjModel.from_xml_string(scene.to_xml()),
    ):
        assert other.jnt_range == pytest.approx(model.jnt_range)
        # saved models keep six digits
        assert other.body_mass == pytest.approx(model.body_mass, rel=1e-5)
        assert other.body_gravcomp == pytest.approx(model.body_gravcomp)
        assert other.nexclude == model.nexclude == 26
        assert other.actuator_forcerange == pytest.approx(model.actuator_forcerange)


def test_mistakes_are_named():
    with pytest.raises(UnknownHandError, match="Did you mean 'xhand'"):
        load_hand("xhnad")
    right = load_hand("xhand")["right"]
    with pytest.raises(HandError, match="contradicts"):
        add_hand(mujoco.MjSpec(), right, "left")
    with pytest.raises(HandError, match="Give left or right"):
        add_hand(mujoco.MjSpec(), "xhand")
    with pytest.raises(HandError, match="paper, vendor"):
        add_hand(mujoco.MjSpec(), right, gains="stiff")
