import numpy as np
import pytest
import trimesh

from flashdex.datasets.support import estimate_support, still_runs
from flashdex.motions.contact.fingertips import (
    CONTACT_DISTANCE,
    blend,
    contact_runs,
    tip_distances,
)
from flashdex.motions.contact.roles import choose_object
from flashdex.motions.contact.support import support_disks

FPS = 60.0
BOX = trimesh.creation.box((0.08, 0.06, 0.04))
CORNERS = np.asarray(BOX.vertices)


def lift_track(rest, height=0.15, frames=180):
    """At rest for a second, up and down within a second, at rest for a second."""
    pose = np.zeros((frames, 7))
    pose[:, 3] = 1.0
    pose[:, 2] = rest
    phase = np.clip((np.arange(frames) - 60) / 60, 0, 1)
    pose[:, 2] += height * np.sin(np.pi * phase)
    pose[:, 0] = 0.1 * phase
    return pose


def test_table_is_where_the_lowest_vertex_rests():
    height, found = estimate_support([lift_track(0.57)], [CORNERS], FPS)
    assert found
    assert height == pytest.approx(0.55, abs=1e-6)
    # lying on its side the same box has its origin higher, not its table
    turned = lift_track(0.58)
    turned[:, 3:] = [np.sqrt(0.5), np.sqrt(0.5), 0, 0]
    assert estimate_support([turned], [CORNERS], FPS)[0] == pytest.approx(
        0.55, abs=1e-6
    )


def test_without_rest_the_lowest_point_serves():
    pose = lift_track(0.3)
    pose[:, 1] = np.arange(180) * 0.1 / FPS * 1.0
    height, found = estimate_support([pose], [CORNERS], FPS)
    assert not found
    assert height == pytest.approx(0.28, abs=1e-6)


def test_still_runs_start_and_end():
    spans = still_runs(lift_track(0.02), FPS)
    assert len(spans) == 2
    assert spans[0][0] == 0
    assert spans[1][1] == 180
    assert 55 <= spans[0][1] <= 61
    assert 119 <= spans[1][0] <= 125


def test_disks_carry_raised_objects_only():
    shelf = lift_track(0.02 + 0.30)
    shelf[:, 1] = 0.5
    disks = support_disks([lift_track(0.02), shelf], [CORNERS, CORNERS], FPS)
    used = ~np.isnan(disks[:, 0])
    assert used.tolist() == [True, True, True, False]
    assert disks[0, 2] == 0.0
    reach = np.linalg.norm(shelf[:, :2] - disks[0, :2], axis=1).max()
    assert disks[0, 3] > reach + 0.2
    np.testing.assert_allclose(disks[1:3, 2], 0.30, atol=1e-6)
    np.testing.assert_allclose(np.sort(disks[1:3, 0]), [0.0, 0.1], atol=1e-6)


def test_tip_distance_to_a_box_in_closed_form():
    pose = np.array([[0.3, -0.2, 0.5, np.cos(0.4), 0, 0, np.sin(0.4)]])
    local = np.zeros((1, 21, 3))
    local[0, [4, 8, 12, 16, 20]] = [
        [0.05, 0.0, 0.0],  # beside a face
        [0.0, 0.0, 0.015],  # inside: distances are unsigned
        [0.04, 0.03, 0.02],  # at a corner
        [0.043, 0.034, 0.0],  # off an edge
        [0.0, 0.0, 0.52],
    ]
    turn = trimesh.transformations.quaternion_matrix(pose[0, 3:])[:3, :3]
    distances = tip_distances(local @ turn.T + pose[0, :3], pose, BOX)
    np.testing.assert_allclose(distances[0], [0.01, 0.005, 0.0, 0.005, 0.5], atol=1e-9)


def test_contact_runs_close_gaps_and_drop_touches():
    near, far = CONTACT_DISTANCE - 0.001, CONTACT_DISTANCE + 0.001
    distances = np.full((120, 5), far)
    distances[20:60, 1] = near
    distances[35:40, 1] = far  # a gap of 83 ms
    distances[80:84, 1] = near  # a touch of 67 ms
    mask = contact_runs(distances, FPS)
    assert mask[20:60, 1].all()
    assert mask.sum() == 40
    weight = blend(mask)
    assert weight[40, 1] == 1.0
    assert weight[10, 1] == 0.0
    assert 0 < weight[19, 1] < 1


def test_hand_takes_the_object_it_touches_longest():
    brief, long = np.full((50, 5), 0.1), np.full((50, 5), 0.1)
    brief[:5] = 0.0
    long[10:40] = 0.01
    assert choose_object([brief, long]) == 1
    assert choose_object([np.full((50, 5), 0.3), np.full((50, 5), 0.2)]) == 1
