"""Libraries for measuring: parts that fill the body, and everything else as it was."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from benchmarks.common.library import (
    bench_library,
    cut_hull,
    describe_scene,
    recut_library,
)
from flashdex.errors import FlashdexError
from flashdex.motions.library_format import FRAME_KEYS


def ball(points=60):
    draw = np.random.default_rng(0).normal(size=(points, 3))
    return draw / np.linalg.norm(draw, axis=-1, keepdims=True)


@pytest.mark.parametrize("count", [1, 2, 5, 16])
def test_the_parts_fill_the_body_without_overlap(count):
    body = ball() * [0.02, 0.03, 0.08]
    parts = cut_hull(body, count)
    assert len(parts) == count
    volumes = [ConvexHull(part).volume for part in parts]
    assert volumes == sorted(volumes, reverse=True)
    assert sum(volumes) == pytest.approx(ConvexHull(body).volume, rel=1e-9)
    # a point inside the body lies in exactly one part
    inside = ball(40) * [0.01, 0.015, 0.04]
    planes = [ConvexHull(part).equations for part in parts]
    hits = [
        sum(bool((p[:, :3] @ x + p[:, 3] <= 0).all()) for p in planes) for x in inside
    ]
    assert hits == [1] * len(inside)


def test_only_the_parts_change(library, tmp_path):
    cut = recut_library(library, 4, tmp_path / "cut")
    assert describe_scene(library) == {"motions": 3, "objects": 2, "hulls": [1, 1]}
    assert describe_scene(cut) == {"motions": 3, "objects": 2, "hulls": [4, 4]}
    assert cut.names == library.names
    for key in FRAME_KEYS:
        assert torch.equal(cut.frames[key], library.frames[key])
    for key, value in library.motions.items():
        assert torch.equal(cut.motions[key].nan_to_num(), value.nan_to_num())
    for key, value in library.objects.items():
        assert torch.equal(cut.objects[key], value)


@pytest.mark.parametrize(("objects", "hulls"), [(3, 1), (2, 0), (1, 17)])
def test_numbers_that_cannot_be_made_are_refused(objects, hulls, tmp_path):
    with pytest.raises(FlashdexError, match=r"--objects 1 or 2, --hulls 1 to 16"):
        bench_library(objects, hulls, folder=tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_library_that_is_there_is_taken(library, tmp_path):
    path = tmp_path / "xhand-o2-h3"
    recut_library(library, 3, path)
    before = (path / "manifest.json").stat().st_mtime_ns
    assert bench_library(2, 3, folder=tmp_path) == path
    assert (path / "manifest.json").stat().st_mtime_ns == before
