import numpy as np
import pytest
import trimesh

from flashdex.datasets.demo import DemoObject, HumanDemo
from flashdex.motions.checks.recording import check_demo
from flashdex.motions.contact.activity import nearest_tips, touches
from flashdex.motions.contact.fingertips import tip_distances
from flashdex.motions.findings import concerning, status_of
from flashdex.motions.repair.repair import repair
from flashdex.motions.repair.segment import segment

FPS = 30
SIZE = 0.06
TABLE = 0.4
PLACES = {"a": 0.0, "b": 0.3, "c": 0.6, "d": 0.9}
FAR = np.array([0.0, -0.5, TABLE + 0.3])


class Script:
    """A session in seconds: boxes rest on a table, hands visit and carry them."""

    def __init__(self, seconds, names="abc"):
        self.frames = int(seconds * FPS)
        box = trimesh.creation.box((SIZE, SIZE, SIZE))
        self.objects = {}
        for name in names:
            pose = np.tile(
                [PLACES[name], 0, TABLE + SIZE / 2, 1, 0, 0, 0.0], (self.frames, 1)
            )
            self.objects[name] = DemoObject(name, box, pose)
        self.hands = {s: np.tile(FAR, (self.frames, 1)) for s in ("left", "right")}

    def span(self, start, end):
        return slice(int(start * FPS), int(end * FPS))

    def touch(self, side, name, start, end, gap=0.01):
        """Fingertips this far above the top of a box."""
        rows = self.span(start, end)
        top = self.objects[name].pose[rows, :3] + [0, 0, SIZE / 2 + gap]
        self.hands[side][rows] = top

    def lift(self, name, start, end, height=0.2):
        """Up and down again, to where it was."""
        rows = self.span(start, end)
        phase = np.linspace(0, 1, rows.stop - rows.start)
        self.objects[name].pose[rows, 2] += height * np.sin(np.pi * phase) ** 2

    def lose(self, side, start, end):
        self.hands[side][self.span(start, end)] = np.nan

    def demo(self, **fields):
        points = {s: np.repeat(p[:, None], 21, axis=1) for s, p in self.hands.items()}
        palm = {}
        for side, way in self.hands.items():
            palm[side] = np.concatenate(
                [way, np.tile([1.0, 0, 0, 0], (len(way), 1))], 1
            )
            palm[side][np.isnan(way[:, 0])] = np.nan
        bodies = list(self.objects.values())
        return HumanDemo("day", FPS, points, palm, bodies, needs_cutting=True, **fields)


def spans(pieces):
    return [[f / FPS for f in p.provenance["frames"]] for p in pieces]


def kept(piece):
    return [b.name for b in piece.objects]


MARGIN = 10 / FPS  # a third of a second


def test_pieces_begin_and_end_around_contact():
    script = Script(30)
    script.lift("a", 4, 7)
    script.touch("right", "a", 3, 5)
    script.touch("right", "a", 5.4, 8)  # 0.4 s away: no interruption
    script.touch("left", "b", 15, 18)
    script.touch("left", "b", 18.6, 21)  # 0.6 s away, but the margins meet
    script.touch("right", "c", 25, 25.2)  # a brush
    demo = script.demo()
    pieces, found = segment(demo)
    np.testing.assert_allclose(
        spans(pieces), [[3 - MARGIN, 8 + MARGIN], [15 - MARGIN, 21 + MARGIN]]
    )
    assert [p.name for p in pieces] == ["day_80_250", "day_440_640"]
    assert [p.hand_object for p in pieces] == [{"right": 0}, {"left": 0}]
    assert [kept(p) for p in pieces] == [["a"], ["b"]]
    assert not any(p.needs_cutting for p in pieces)
    assert all(p.support_z == pytest.approx(TABLE, abs=1e-9) for p in pieces)
    assert demo.support_z is None
    (finding,) = found
    assert (finding.code, finding.level) == ("R_INACTIVE", "info")
    # also the brush is left out: 30 s less the pieces
    assert finding.text.startswith("2 pieces of 12.3 s in all; 17.7 s inactive, 0.0 s")
    for piece in pieces:
        piece.validate()


def test_two_gaps_of_margins_do_not_bridge():
    script = Script(12)
    script.touch("right", "a", 2, 4)
    script.touch("right", "a", 5, 7)  # one second away
    pieces, _ = segment(script.demo())
    np.testing.assert_allclose(
        spans(pieces), [[2 - MARGIN, 4 + MARGIN], [5 - MARGIN, 7 + MARGIN]]
    )


def test_cut_where_a_hand_turns_to_another_object():
    script = Script(12)
    script.touch("left", "a", 2, 10)
    script.touch("right", "a", 2, 5)
    script.touch("right", "b", 5.2, 10)
    pieces, _ = segment(script.demo())
    np.testing.assert_allclose(
        spans(pieces), [[2 - MARGIN, 5.1], [5.1, 10 + MARGIN]], atol=1 / FPS
    )
    assert pieces[0].hand_object == {"left": 0, "right": 0}
    assert kept(pieces[0]) == ["a"]
    assert {s: kept(pieces[1])[i] for s, i in pieces[1].hand_object.items()} == {
        "left": "a",
        "right": "b",
    }


def test_hands_on_different_objects_stay_together():
    script = Script(12)
    script.touch("left", "c", 2, 8)
    script.touch("right", "a", 3, 9)
    (piece,), _ = segment(script.demo())
    assert sorted(kept(piece)) == ["a", "c"]
    assert kept(piece)[piece.hand_object["left"]] == "c"
    assert kept(piece)[piece.hand_object["right"]] == "a"


def test_target_is_kept_though_no_hand_touches_it():
    script = Script(12)
    script.touch("right", "a", 2, 8)
    tool = script.objects["a"].pose
    tool[script.span(4, 6), :3] = [PLACES["c"] - SIZE - 0.005, 0, TABLE + SIZE / 2]
    script.touch("right", "a", 2, 8)
    (piece,), _ = segment(script.demo())
    assert kept(piece) == ["a", "c"]
    tool[script.span(4, 6), 0] -= 0.02  # 25 mm from each other
    script.touch("right", "a", 2, 8)
    (piece,), _ = segment(script.demo())
    assert kept(piece) == ["a"]


def test_at_most_two_objects_and_the_rest_is_told():
    script = Script(14, names="abcd")
    script.touch("left", "a", 2, 10)
    script.touch("right", "b", 3, 9)
    script.lift("d", 4, 6)  # flies: no hand, no object is there
    # a falls against c, which moves
    script.objects["c"].pose[script.span(5, 14), 0] = PLACES["a"] + SIZE + 0.004
    (piece,), found = segment(script.demo())
    assert sorted(kept(piece)) == ["a", "b"]
    assert piece.provenance["objects_left_out"] == ["c", "d"]
    assert ("I_OBJECTS", "info") in [(f.code, f.level) for f in found]
    assert f"{piece.name}: without c, d" in [f.text for f in found]


def test_an_acting_hand_is_never_missing_in_a_piece():
    script = Script(14)
    script.touch("right", "a", 2, 12)
    script.lose("right", 6, 6.4)
    script.lose("left", 3, 5)  # idle: costs nothing but the hand
    demo = script.demo()
    pieces, found = segment(demo)
    np.testing.assert_allclose(spans(pieces), [[2 - MARGIN, 6], [6.4, 12 + MARGIN]])
    assert [list(p.keypoints) for p in pieces] == [["right"], ["left", "right"]]
    for piece in pieces:
        piece.validate()
    assert "0.4 s too short or not tracked" in found[-1].text


def test_lost_objects_cut_only_where_they_matter():
    script = Script(14)
    script.touch("right", "a", 2, 12)
    script.objects["b"].pose[script.span(4, 9)] = np.nan
    (piece,), _ = segment(script.demo())
    assert kept(piece) == ["a"]
    script.objects["a"].pose[script.span(8, 9)] = np.nan
    pieces, _ = segment(script.demo())
    np.testing.assert_allclose(
        spans(pieces), [[2 - MARGIN, 8], [9 - MARGIN, 12 + MARGIN]], atol=MARGIN + 0.01
    )
    for piece in pieces:
        piece.validate()


def test_hands_that_are_seen_in_turn():
    script = Script(14)
    script.touch("right", "a", 2, 6)
    script.lose("right", 6, 14)
    script.touch("left", "a", 6, 10)
    script.lose("left", 0, 6)
    pieces, _ = segment(script.demo())
    assert [list(p.hand_object) for p in pieces] == [["right"], ["left"]]
    np.testing.assert_allclose(spans(pieces), [[2 - MARGIN, 6], [6, 10 + MARGIN]])


def test_long_pieces_are_cut_where_all_is_still():
    script = Script(33)
    script.touch("right", "a", 1, 32)
    way = 0.1 * np.sin(2 * np.arange(script.frames) / FPS)
    way[script.span(13, 14)] = way[13 * FPS]  # the only moment of rest
    way[script.span(14, 33)] += way[13 * FPS] - way[14 * FPS]
    script.objects["a"].pose[script.span(1, 32), 1] += way[script.span(1, 32)]
    script.touch("right", "a", 1, 32)
    pieces, _ = segment(script.demo())
    assert len(pieces) == 2
    assert 13 <= spans(pieces)[0][1] <= 14
    assert spans(pieces)[0][1] == spans(pieces)[1][0]
    assert max(p.seconds for p in pieces) <= 20
    assert "R_LONG" not in [f.code for p in pieces for f in check_demo(p)]


def test_nothing_touched_is_rejected():
    script = Script(10)
    script.lift("a", 2, 6)
    pieces, found = segment(script.demo())
    assert pieces == []
    assert [(f.code, f.level) for f in found] == [("R_INACTIVE", "reject")]
    assert status_of(found) == "rejected"


def test_a_bad_mesh_costs_its_object_only():
    script = Script(10)
    script.touch("right", "b", 3, 6)
    script.objects["a"].mesh = trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]])
    (piece,), found = segment(script.demo())
    assert kept(piece) == ["b"]
    assert next((f.code, f.level) for f in found) == ("E_MESH", "warn")


def test_support_in_a_world_that_is_y_up():
    script = Script(10)
    script.touch("right", "b", 3, 6)
    demo = script.demo()
    back = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # z up to y up
    quat = [np.sqrt(0.5), -np.sqrt(0.5), 0, 0]
    for body in demo.objects:
        body.pose = np.concatenate(
            [body.pose[:, :3] @ back.T, np.tile(quat, (len(body.pose), 1))], axis=1
        )
    demo.keypoints = {s: p @ back.T for s, p in demo.keypoints.items()}
    demo.up = "y"
    (piece,), _ = segment(demo)
    assert piece.support_z == pytest.approx(TABLE, abs=1e-9)


def test_support_given_by_the_reader_is_kept():
    script = Script(10)
    script.touch("right", "b", 3, 6)
    (piece,), _ = segment(script.demo(support_z=0.39))
    assert piece.support_z == 0.39


def test_touch_has_hysteresis():
    near = np.array([4, 2.5, 1.5, 2.5, 3.5, 2.5, 4, 1, 1]) / 100
    assert touches(near).tolist() == [0, 1, 1, 1, 0, 0, 0, 1, 1]


def test_near_distances_are_exact():
    rng = np.random.default_rng(0)
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    points = rng.uniform(-0.08, 0.08, (200, 21, 3))
    pose = np.tile([0.01, 0.02, 0.03, 0.6, 0, 0.8, 0], (200, 1))
    near = nearest_tips([points], pose, mesh)[0]
    exact = tip_distances(points, pose, mesh).min(axis=1)
    close = exact < 0.03
    assert close.sum() > 50
    np.testing.assert_allclose(near[close], exact[close], atol=1e-9)
    assert (near[~close] >= 0.03).all()


def test_filled_frames_and_findings_go_to_their_piece():
    script = Script(14)
    script.touch("right", "a", 2, 5)
    script.touch("right", "a", 8, 11)
    script.lose("right", 3, 3.1)
    (demo,), repaired = repair(script.demo())
    pieces, found = segment(demo)
    assert [p.provenance["filled"] for p in pieces] == [{"right hand": [[90, 93]]}, {}]
    findings = repaired + found
    assert [[f.code for f in concerning(findings, p)] for p in pieces] == [
        ["E_NAN", "R_INACTIVE"],
        ["R_INACTIVE"],
    ]


def test_a_hundred_seconds_with_dense_meshes_are_cut():
    script = Script(100, names="abcd")
    dense = trimesh.creation.box((SIZE, SIZE, SIZE))
    for _ in range(6):
        dense = dense.subdivide()
    for k in range(10):
        script.touch("right", "abcd"[k % 4], 10 * k + 1, 10 * k + 8)
        script.touch("left", "abcd"[k % 4], 10 * k + 1, 10 * k + 8, gap=0.015)
    for body in script.objects.values():
        body.mesh = dense
    pieces, _ = segment(script.demo())
    assert len(pieces) == 10


def test_recordings_are_cut_near_the_human_reference(demos):
    from flashdex.datasets.keypoints import read_file

    (demo,), _ = repair(read_file(demos / "manipnet" / "mug1.npz"))
    pieces, _ = segment(demo)
    # the reference begins at 83; the last piece ends with the recording
    assert pieces[0].provenance["frames"][0] == pytest.approx(83, abs=15)
    assert all(1 <= p.seconds <= 20 for p in pieces)
    assert sum(p.seconds for p in pieces) > 0.9 * (1999 - 83) / 60
    assert pieces[0].support_z == pytest.approx(0.251, abs=0.002)
    for piece in pieces:
        piece.validate()
