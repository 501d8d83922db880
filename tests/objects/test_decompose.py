"""CoACD apart: the same parts as here; what it does not survive costs one object."""

import os
import time

import coacd
import numpy as np
import pytest
import trimesh

from flashdex.objects import decompose
from flashdex.objects.convex import compute_convex_parts
from flashdex.objects.decompose import run_coacd
from flashdex.system import limited

OPTIONS = {"threshold": 0.3, "max_convex_hull": 4, "mcts_iterations": 20, "seed": 1}
RING = trimesh.creation.torus(0.04, 0.015, major_sections=12, minor_sections=6)


def parts_of(name="ring"):
    given = {"threshold": 0.3, "seed": 1, "max_parts": 4, "max_vertices": 32}
    return compute_convex_parts(RING, name=name, **given)


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
