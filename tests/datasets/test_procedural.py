import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flashdex.datasets.body_models.human_hand import (
    LOWER,
    PHALANGES,
    THUMB_BONES,
    UPPER,
    hand_keypoints,
)
from flashdex.datasets.procedural.reader import (
    KINDS,
    NOISE_POINT,
    QUICKSTART,
    procedural,
    smooth_noise,
)
from flashdex.datasets.support import lowest_points
from flashdex.errors import UnknownSourceError
from flashdex.keys import SIDES
from flashdex.motions.contact.fingertips import tip_distances

SINGLE = [k for k in KINDS if k.startswith("pick") and k.endswith("right")]
CARRY = slice(60, 110)  # frames in which the hand surely holds the object


@pytest.fixture(scope="module")
def quickstart():
    return procedural(0)


def test_keypoints_have_the_bones_of_the_model():
    rng = np.random.default_rng(0)
    points = hand_keypoints(rng.uniform(LOWER, UPPER, size=(50, 16)))
    bones = np.linalg.norm(np.diff(points, axis=1), axis=-1)
    np.testing.assert_allclose(bones[:, 1:4], np.tile(THUMB_BONES, (50, 1)))
    for finger in range(4):
        chain = bones[:, 5 + 4 * finger : 8 + 4 * finger]
        np.testing.assert_allclose(chain, np.tile(PHALANGES[finger], (50, 1)))


def test_quickstart_is_sound(quickstart):
    assert [d.name for d in quickstart] == list(QUICKSTART)
    for demo in quickstart:
        demo.validate()
        assert 2.0 < demo.seconds <= 3.2
    assert set(quickstart[-1].keypoints) == set(SIDES)
    assert len(quickstart[-1].objects) == 2


def test_same_seed_same_motion_whatever_else_is_made(quickstart):
    again = procedural(0, kinds=["turn_capsule_right"])[0]
    first = quickstart[QUICKSTART.index("turn_capsule_right")]
    np.testing.assert_array_equal(first.keypoints["right"], again.keypoints["right"])
    np.testing.assert_array_equal(first.objects[0].pose, again.objects[0].pose)
    other = procedural(1, kinds=["turn_capsule_right"])[0]
    assert other.num_frames != first.num_frames or not np.allclose(
        other.objects[0].pose, first.objects[0].pose
    )


def test_repetitions_differ():
    first, second = procedural(0, 2, ["pick_sphere_right"])
    assert (first.name, second.name) == ("pick_sphere_right_00", "pick_sphere_right_01")
    assert not np.allclose(
        first.objects[0].mesh.extents, second.objects[0].mesh.extents
    )


def test_unknown_kind_names_the_nearest():
    with pytest.raises(UnknownSourceError, match="Did you mean 'pick_box_right'"):
        procedural(0, kinds=["pick_box_rigth"])


@pytest.mark.parametrize(
    "kind", [*SINGLE, "tilt_cylinder_left", "pick_bowl_spoon_both"]
)
def test_tips_hold_the_object_with_gaps_and_the_thumb_opposes(kind):
    demo = procedural(3, kinds=[kind])[0]
    for side, slot in demo.hand_object.items():
        body = demo.objects[slot]
        near = tip_distances(demo.keypoints[side], body.pose, body.mesh)[CARRY, :3]
        assert np.median(near) < 0.009
        assert np.median(near) > 0.001
        rot = Rotation.from_quat(body.pose[CARRY, 3:], scalar_first=True)
        tips = demo.keypoints[side][CARRY][:, [4, 8, 12]] - body.pose[CARRY, None, :3]
        local = np.stack([rot.inv().apply(tips[:, i]) for i in range(3)], axis=1)
        # thumb and fingers on opposite sides of the grasp axis, object frame x
        assert (local[:, 0, 0] * local[:, 1, 0] < 0).all()
        assert (local[:, 0, 0] * local[:, 2, 0] < 0).all()


@pytest.mark.parametrize("kind", ["pick_box_right", "pick_box_cylinder_both"])
def test_objects_rest_at_both_ends_and_frozen_ones_would_fail(kind):
    demo = procedural(5, kinds=[kind])[0]
    for body in demo.objects:
        low = lowest_points(body.pose, body.mesh.vertices)
        np.testing.assert_allclose(low[[0, 5, -5, -1]], 0.0, atol=1e-9)
        assert low.min() > -1e-9
        moved = np.linalg.norm(body.pose[:, :3] - body.pose[0, :3], axis=-1)
        assert moved.mean() > 0.03
        assert 0.08 <= np.ptp(body.pose[:, 2]) <= 0.151


@pytest.mark.parametrize("seed", range(3))
def test_hands_stay_above_the_table(seed):
    for demo in procedural(seed, kinds=["pick_spoon_right", "pick_cylinder_left"]):
        assert min(k[..., 2].min() for k in demo.keypoints.values()) > 0.003


def test_turns_are_twenty_to_sixty_degrees():
    for demo in procedural(0, 4, ["turn_box_right", "turn_sphere_left"]):
        rot = Rotation.from_quat(demo.objects[0].pose[[0, -1], 3:], scalar_first=True)
        angle = np.rad2deg((rot[1] * rot[0].inv()).magnitude())
        assert 19.9 < angle < 60.1


def test_noise_is_there_and_smooth(quickstart):
    demo = quickstart[0]
    points = demo.keypoints["right"]
    bones = np.linalg.norm(np.diff(points[:, 5:9], axis=1), axis=-1)
    # independent noise on both ends of a bone of constant length
    assert bones.std(axis=0).mean() == pytest.approx(2**0.5 * NOISE_POINT, rel=0.5)
    noise = smooth_noise((20000, 4), np.random.default_rng(0))
    assert noise.std() == pytest.approx(1.0, abs=0.05)
    lag = [np.mean(noise[k:] * noise[:-k]) for k in (1, 12, 48)]
    assert lag[0] > 0.97
    assert 0.2 < lag[1] < 0.6
    assert abs(lag[2]) < 0.1
