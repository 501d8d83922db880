"""Films: the camera against MuJoCo's own, and pictures where a back end draws."""

import json
import os
import subprocess
import sys
from dataclasses import replace

import imageio_ffmpeg
import numpy as np
import pytest
import yaml
from PIL import Image

import flashdex
from flashdex.reports.render import films
from flashdex.reports.render.films import NO_GRAPHICS, Film, draw_films, find_backend
from flashdex.reports.render.rollout import HEIGHT, WIDTH, Painter, write_film
from flashdex.reports.render.scene import MARGIN, fit_view, view_axes
from flashdex.reports.run.report import write_report
from flashdex.system.names import file_stem
from flashdex.system.run_files import write_recipe

DRAW = """
import sys, numpy as np
from flashdex.rollouts.rollout import Rollout
from flashdex.reports.render.rollout import Painter
painter = Painter(Rollout.load(sys.argv[1]))
np.save(sys.argv[2], painter.draw(20))
"""


@pytest.fixture
def backend():
    found = find_backend()
    if found is None:
        pytest.skip("no off-screen graphics: install libosmesa6 or libegl1")
    return found


def draw(rollout, folder, backend):
    """One picture, made in a process of its own."""
    stored, target = rollout.save(folder / "one.npz"), folder / "one.npy"
    assert (
        films.run_drawer(["-c", DRAW, str(stored), str(target)], backend, timeout=120)
        == ""
    )
    return np.load(target).astype(int)


def blue(picture):
    """Number of pixels of the ghost's colour, which nothing else in the scene has."""
    red, _, strong = (picture[..., i] for i in range(3))
    return int((strong > red + 60).sum())


def test_axes_are_an_orthonormal_right_handed_frame():
    forward, right, up = axes = view_axes(135.0, -22.0)
    assert np.stack(axes) @ np.stack(axes).T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.cross(right, forward) == pytest.approx(up)
    assert up[2] > 0
    assert forward[2] < 0
    # azimuth 90 looks along y, as MuJoCo's free camera does
    assert view_axes(90.0, 0.0)[0] == pytest.approx([0, 1, 0], abs=1e-12)


def test_axes_agree_with_mujoco(backend):
    code = (
        "import mujoco, json; m = mujoco.MjModel.from_xml_string('<mujoco><worldbody>"
        '<geom size=".1"/></worldbody></mujoco>\'); d = mujoco.MjData(m); '
        "mujoco.mj_forward(m, d); c = mujoco.MjvCamera(); "
        "c.azimuth, c.elevation = 35, -22; "
        "r = mujoco.Renderer(m, 16, 16); r.update_scene(d, c); g = r.scene.camera[0]; "
        "print(json.dumps([g.forward.tolist(), g.up.tolist()]))"
    )
    env = {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend, "PATH": ""}
    out = subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, check=True
    )
    forward, _, up = view_axes(35.0, -22.0)
    theirs = json.loads(out.stdout.splitlines()[-1])
    assert np.array(theirs) == pytest.approx(np.stack([forward, up]), abs=1e-5)


def test_every_point_is_inside_centred_and_one_touches_the_border():
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3))
    points += np.array([3, -2, 1])
    forward, right, up = axes = view_axes(45.0, -22.0)
    lookat, distance = fit_view(points, axes, fovy=45.0, aspect=4 / 3)
    rel = points - lookat
    x, y, depth = rel @ right, rel @ up, distance + rel @ forward
    half = np.tan(np.radians(22.5)) * depth
    room = np.minimum(half * 4 / 3 - abs(x), half - abs(y))
    assert room.min() == pytest.approx(MARGIN)
    for seen in (x / depth, y / depth):
        assert seen.max() == pytest.approx(-seen.min(), abs=0.01)


def test_the_picture_shows_object_and_ghost(rollout, tmp_path, backend):
    shifted = rollout.ref_object_pos + np.array([0, 0, 0.1])
    apart = draw(replace(rollout, ref_object_pos=shifted), tmp_path, backend)
    same = draw(replace(rollout, ref_object_pos=rollout.object_pos), tmp_path, backend)
    assert apart.shape == (384, 512, 3)
    assert apart.std() > 10
    red = (apart[..., 0] > apart[..., 2] + 60).sum()
    assert red > 500  # the box itself
    assert blue(apart) > 500  # the ghost above it
    assert blue(same) < 50  # no ghost where there is no error


def test_the_folder_we_are_in_is_no_code(tmp_path, monkeypatch):
    (tmp_path / "mujoco.py").write_text("raise SystemExit('ran')")
    monkeypatch.chdir(tmp_path)
    assert films.run_drawer(["-c", "import mujoco"], "none", timeout=60) != "ran"


def test_what_draws_is_this_very_flashdex(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = f"import flashdex; assert flashdex.__file__ == {flashdex.__file__!r}"
    assert films.run_drawer(["-c", text], "none", timeout=60) == ""


def test_files_of_two_films_are_never_the_same(tmp_path):
    stems = ("lift", "lift_poster", "lift.poster", "lift~poster")
    rollouts = [tmp_path / f"rollouts/{file_stem(stem)}.npz" for stem in stems]
    every = [file for rollout in rollouts for file in Film.of(rollout).files]
    assert len(set(every)) == len(every)


def test_the_encoder_follows_no_link(rollout, tmp_path, monkeypatch):
    kept = tmp_path / "kept"
    kept.write_text("mine")
    film = Film.at(tmp_path / "films" / "one")
    film.video.parent.mkdir()
    half = film.video.with_name(f".one.{os.getpid()}.tmp.mp4")
    half.symlink_to(kept)

    class Still(Painter):
        def __init__(self, rollout):
            pass

        def draw(self, frame):
            return np.zeros((HEIGHT, WIDTH, 3), np.uint8)

        draw_still = draw

        def close(self):
            pass

    monkeypatch.setattr("flashdex.reports.render.rollout.Painter", Still)
    write_film(rollout, film)
    assert film.is_whole
    assert kept.read_text() == "mine"


def test_films_of_a_run(run_dir, backend):
    recipe = yaml.safe_load((run_dir / "recipe.yaml").read_text())
    recipe["train"]["render_conversions"] = True
    write_recipe(run_dir, yaml.safe_dump(recipe))
    text = write_report(run_dir).read_text()
    assert "data:video/mp4;base64," in text
    assert "data:image/png;base64," in text
    drawn = Film.of(run_dir / "rollouts" / "push.npz")
    assert np.asarray(Image.open(drawn.stills).convert("RGB")).std() > 10
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(drawn.video))
    assert frames == 18  # 36 rows at 60 Hz, shown at 30
    assert seconds == pytest.approx(0.6, abs=0.05)
    before = drawn.video.stat().st_mtime_ns
    write_report(run_dir)
    assert drawn.video.stat().st_mtime_ns == before  # drawn once


def test_without_graphics_the_report_says_so_and_goes_on(run_dir, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "no_such_back_end")
    find_backend.cache_clear()
    recipe = yaml.safe_load((run_dir / "recipe.yaml").read_text())
    recipe["train"]["render_conversions"] = True
    write_recipe(run_dir, yaml.safe_dump(recipe))
    text = write_report(run_dir).read_text()
    find_backend.cache_clear()
    assert NO_GRAPHICS in text
    assert "12,345" in text


def test_a_rollout_that_cannot_be_drawn_is_named(run_dir, backend):
    broken = run_dir / "rollouts" / "broken.npz"
    broken.write_bytes(b"nothing")
    fault = draw_films([broken])
    assert fault.startswith("no pictures of broken: ")
    assert "not a readable rollout" in fault


WALLED = """
import sys, mujoco, numpy as np
from flashdex.reports.render.scene import ScenePainter

XML = '''<mujoco><worldbody><body name="thing" mocap="true">
<geom type="sphere" size=".03" rgba="1 0 0 1"/></body>
<body name="palm" mocap="true"><geom type="box" size=".005 .12 .1"/></body>
</worldbody></mujoco>'''

class Walled(ScenePainter):
    def _place(self, frame):
        turn = np.radians([135.0, 225.0, 45.0, 315.0][frame])
        side = np.array([np.cos(turn), np.sin(turn), 0.0])
        self._data.mocap_pos[:] = [0, 0, 0], -0.06 * side
        self._data.mocap_quat[1] = [np.cos(turn / 2), 0, 0, np.sin(turn / 2)]
    def _points(self, frame):
        return self._data.mocap_pos.copy()
    def _is_object(self):
        return np.array([False, True, False])

painter = Walled(mujoco.MjSpec.from_string(XML), size=(128, 96), middle=0)
red = lambda p: int((p[..., 0] > p[..., 2] + 60.0).sum())
print([[red(painter.draw(t)), red(painter.draw_still(t))] for t in range(4)])
"""


def test_a_still_is_taken_from_where_the_object_shows(backend):
    """A palm stands before the object, each time on another side."""
    env = {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend, "PATH": ""}
    words = [sys.executable, "-c", WALLED]
    out = subprocess.run(words, env=env, capture_output=True, check=True)
    counts = json.loads(out.stdout.splitlines()[-1])
    assert min(fixed for fixed, _ in counts) == 0  # one side hides it at some time
    assert min(still for _, still in counts) > 100
    assert all(still >= fixed for fixed, still in counts)
