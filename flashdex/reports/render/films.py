"""Films of the conversions of a run: drawn once, in a process that can draw."""

from __future__ import annotations

import functools
import logging
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from flashdex.errors import RunError
from flashdex.system.children import PYTHON
from flashdex.system.files import open_plain, own_file, own_folder
from flashdex.system.run_files import FILMS as FOLDER

_LOG = logging.getLogger(__name__)
MAX_BYTES = 64 << 20  # of one film; they have half a megabyte
NO_GRAPHICS = "no pictures: install libosmesa6 or libegl1"
_SECONDS_A_FILM = 120
_PROBE = (
    "import mujoco; m = mujoco.MjModel.from_xml_string('<mujoco><worldbody>"
    '<geom size=".1"/></worldbody></mujoco>\'); r = mujoco.Renderer(m, 16, 16); '
    "d = mujoco.MjData(m); mujoco.mj_forward(m, d); r.update_scene(d); "
    "assert r.render().max() > 0"  # one that draws nothing is none
)


@dataclass(frozen=True)
class Film:
    """Files of one drawn rollout: mp4; as png, pictures side by side and the first."""

    video: Path
    stills: Path
    poster: Path

    @classmethod
    def at(cls, base: Path) -> Film:
        """Files that have the name ``base``, which has no suffix."""
        # no motion's file has a "~" in it: "lift" and "lift_poster" stay apart
        endings = (".mp4", ".png", "~poster.png")
        return cls(*(base.with_name(base.name + ending) for ending in endings))

    @classmethod
    def of(cls, rollout: Path) -> Film:
        """Where the pictures of ``rollouts/<motion>.npz`` of a run lie."""
        return cls.at(rollout.parent.parent / FOLDER / rollout.stem)

    @property
    def files(self) -> dict[Path, tuple[str, bytes]]:
        """Each file, with its type and what stands at the beginning of such files."""
        picture = ("image/png", b"\x89PNG\r\n\x1a\n")
        films = {self.video: ("video/mp4", b"ftyp")}
        return {**films, self.stills: picture, self.poster: picture}

    @property
    def is_whole(self) -> bool:
        """All files are there and what they should be: a page may show them."""
        return all(self.read(path) for path in self.files)

    def read(self, path: Path) -> bytes:
        """One of the files, empty where it is missing, too large or something else.

        Raises:
            RunError: it is a link, or no file.
        """
        own = own_file(path.parent.parent, path.parent.name, path.name)
        _, mark = self.files[path]
        try:
            with open_plain(own) as file:
                content = file.read(MAX_BYTES + 1)
        except OSError:
            return b""
        is_right = mark in content[:12] and len(content) <= MAX_BYTES
        return content if is_right else b""

    def is_newer_than(self, rollout: Path) -> bool:
        """All files exist and were drawn after the rollout was stored."""
        stored = rollout.stat().st_mtime
        return all(f.is_file() and f.stat().st_mtime >= stored for f in self.files)


def draw_films(rollouts: list[Path]) -> str:
    """Draw what is not drawn yet of the stored rollouts of a run.

    Returns why pictures are missing, empty when all are there. Never raises: a run is
    worth reporting without pictures.
    """
    try:
        return _draw_films(rollouts)
    except (OSError, RunError) as error:
        return f"no pictures: {error}"


def _draw_films(rollouts: list[Path]) -> str:
    todo = [r for r in rollouts if r.is_file() and not Film.of(r).is_newer_than(r)]
    if not todo:
        return ""
    backend = find_backend()
    if backend is None:
        return NO_GRAPHICS
    _LOG.info("drawing %d films", len(todo))
    folder = own_folder(todo[0].parent.parent, FOLDER)
    words = ["-m", "flashdex.reports.render.rollout", *map(str, todo), str(folder)]
    fault = run_drawer(words, backend, timeout=60 + _SECONDS_A_FILM * len(todo))
    missing = [r.stem for r in todo if not Film.of(r).is_newer_than(r)]
    if not missing:
        return ""
    return f"no pictures of {', '.join(missing)}: {fault or 'unknown fault'}"


@functools.cache
def find_backend() -> str | None:
    """First value of MUJOCO_GL that draws on this computer; what the user set wins."""
    for backend in usual_backends():
        if not run_drawer(["-c", _PROBE], backend, timeout=60):
            return backend
    return None


def usual_backends() -> tuple[str, ...]:
    """Values of MUJOCO_GL that may draw here without a screen."""
    if asked := os.environ.get("MUJOCO_GL"):
        return (asked,)
    return ("egl", "osmesa") if sys.platform.startswith("linux") else ("glfw",)


def run_drawer(words: list[str], backend: str, *, timeout: float) -> str:
    """Run Python with a graphics back end; return what went wrong, in one line."""
    package = Path(__file__).parents[3]  # the folder that flashdex lies in
    paths = [str(package), os.environ.get("PYTHONPATH", "")]
    environment = {
        **os.environ,
        "MUJOCO_GL": backend,
        "PYOPENGL_PLATFORM": backend,
        "PYTHONPATH": os.pathsep.join(p for p in paths if p),
    }
    try:
        done = subprocess.run(
            [*PYTHON, *words],
            env=environment,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    if done.returncode == 0:
        return ""
    lines = done.stderr.strip().splitlines()
    return lines[-1] if lines else f"exit code {done.returncode}"
