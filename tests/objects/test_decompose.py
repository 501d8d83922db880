"""CoACD apart: the same parts as here; what it does not survive costs one object."""

import os
import time

import coacd
import numpy as np
import pytest
import trimesh

from flashdex.objects import convex, decompose
from flashdex.objects.convex import compute_convex_parts
from flashdex.objects.decompose import run_coacd
from flashdex.objects.fit import measure_fit
from flashdex.objects.simplify import simplify
from flashdex.system import limited

OPTIONS = {"threshold": 0.3, "max_convex_hull": 4, "mcts_iterations": 20, "seed": 1}
RING = trimesh.creation.torus(0.04, 0.015, major_sections=12, minor_sections=6)


def parts_of(name="ring", threshold=0.3):
    given = {"seed": 1, "max_parts": 4, "max_vertices": 32}
    return compute_convex_parts(RING, name=name, threshold=threshold, **given)


def test_parts_are_those_of_the_same_process():
    vertices, faces = np.asarray(RING.vertices), np.asarray(RING.faces)
    coacd.set_log_level("off")
    want = coacd.run_coacd(coacd.Mesh(vertices, faces), **OPTIONS)
    found = run_coacd(vertices, faces, **OPTIONS)
    assert len(found) == len(want) > 1
    for part, (corners, _) in zip(found, want, strict=True):
        np.testing.assert_array_equal(part, corners)


def replace_child(monkeypatch, function, *args):
    """Something else runs in the child."""
    real = decompose.run_limited

    def run(_, *__, **limits):
        return real(function, *args, **limits)

    monkeypatch.setattr(decompose, "run_limited", run)


@pytest.mark.parametrize("signal", [6, 9, 11])
def test_a_crash_is_told_and_ends_nothing(monkeypatch, signal):
    replace_child(monkeypatch, os._exit, 0)
    with pytest.raises(MemoryError, match="CoACD: it ended the process"):
        parts_of()
    replace_child(monkeypatch, _kill_itself, signal)
    with pytest.raises(MemoryError, match="CoACD: "):
        parts_of()


def _kill_itself(signal):
    os.kill(os.getpid(), signal)


def test_what_never_ends_becomes_one_hull(monkeypatch, caplog):
    monkeypatch.setattr(decompose, "MAX_SECONDS", 1)
    monkeypatch.setattr(limited, "WALL", 1.0)
    monkeypatch.setattr(limited, "GRACE", 0.5)
    replace_child(monkeypatch, time.sleep, 600)
    (hull,) = parts_of("endless")
    assert len(hull) <= 32
    assert "endless: CoACD failed (it took more than 1 s)" in caplog.text


def test_want_of_memory_is_not_one_hull(monkeypatch):
    replace_child(monkeypatch, bytes, 1 << 40)
    with pytest.raises(MemoryError, match="more than 8"):
        parts_of()


FINE = trimesh.creation.torus(0.04, 0.015, major_sections=64, minor_sections=32)


def test_fewer_triangles_keep_a_mesh_closed_and_its_hole():
    small = simplify(FINE, max_faces=500)
    assert len(small.faces) <= 500
    assert small.is_volume
    assert small.euler_number == FINE.euler_number == 0
    # distance to a torus in closed form
    ring = np.hypot(small.vertices[:, 0], small.vertices[:, 1]) - 0.04
    off = np.hypot(ring, small.vertices[:, 2]) - 0.015
    assert np.abs(off).max() < 1e-3
    assert small.volume == pytest.approx(FINE.volume, rel=0.02)


def test_what_cannot_lose_triangles_keeps_its_shape():
    box = trimesh.creation.box((0.1, 0.1, 0.1)).subdivide().subdivide()
    small = simplify(box, max_faces=4)
    assert small.is_volume
    assert small.volume == pytest.approx(box.volume, rel=0.05)
    loose = trimesh.Trimesh(box.vertices, box.faces[:-3], process=False)
    assert simplify(loose, max_faces=20).area == pytest.approx(loose.area, rel=0.05)


@pytest.mark.parametrize(
    ("parts", "good"),
    [
        pytest.param(lambda cuts: cuts, True, id="all"),
        pytest.param(lambda cuts: cuts[1:], False, id="a part is missing"),
        pytest.param(lambda cuts: [np.vstack(cuts)], False, id="over the hole"),
    ],
)
def test_parts_are_held_to_the_surface(parts, good):
    turn = np.arctan2(FINE.vertices[:, 1], FINE.vertices[:, 0])
    edges = np.linspace(-np.pi, np.pi, 17)
    pairs = zip(edges - 1e-6, edges[1:] + 1e-6, strict=False)
    cuts = [FINE.vertices[(turn >= a) & (turn <= b)] for a, b in pairs]
    assert measure_fit(FINE, parts(cuts), seed=0).is_within(0.004) == good


def test_parts_off_the_surface_are_cut_again_the_slow_way(monkeypatch, caplog):
    caplog.set_level("INFO")
    ways = []

    def run(vertices, faces, **options):
        ways.append(options.get("preprocess_mode"))
        return [vertices] if len(ways) == 1 else run_coacd(vertices, faces, **OPTIONS)

    monkeypatch.setattr(convex, "run_coacd", run)
    assert len(parts_of("ring7", threshold=0.1)) > 1
    assert ways == ["off", None]
    assert "ring7: convex parts the slow way" in caplog.text
