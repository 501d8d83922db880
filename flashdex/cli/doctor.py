"""What this computer has of what flashdex can use: versions, GPU, GL, disk, extras."""

from __future__ import annotations

import os
import platform
import re
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

import flashdex

Status = Literal["ok", "note", "missing"]

_GL_PACKAGES = {"egl": "libegl1", "osmesa": "libosmesa6"}


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    status: Status
    """ok; note = works, with a limit; missing = flashdex will not run."""
    what: str
    """Subject."""
    detail: str
    """What was found, and what to do about it."""

    def __str__(self) -> str:
        """A line of the report."""
        sign = self.status.upper() if self.status == "missing" else self.status
        return f"{sign:<7}  {self.what:<14}  {self.detail}"


def examine() -> Iterator[Finding]:
    """Look at everything; a missing package is a finding, never an exception."""
    yield _python()
    yield from _packages()
    yield _cpu()
    yield _gpu()
    yield _graphics()
    yield _disk(Path.cwd())
    yield from _extras()


def examine_recipe(name: str, overrides: list[str]) -> tuple[str, bool]:
    """Say what memory a recipe needs here and on other cards.

    Args:
        name: name or path of a recipe.
        overrides: ``key=value`` changes of it.

    Returns:
        The report, and whether the recipe fits this machine.

    Raises:
        FlashdexError: the recipe has mistakes or trains no motions.
    """
    from flashdex.algorithms import find_algorithm
    from flashdex.cli.memory_report import format_cards, format_plan, format_work
    from flashdex.recipe import Recipe, compose, expect_kind
    from flashdex.training.build import learner_device
    from flashdex.training.memory.plan import plan_memory
    from flashdex.training.run_dir import default_run_dir

    recipe = expect_kind(compose(name, overrides), Recipe, where="doctor")
    # of a recipe for a GPU the need is of interest also where there is none
    on_gpu = recipe.algo.device != "cpu" and (
        recipe.physics.engine != "cpu" or learner_device(recipe).type == "cuda"
    )
    plan = plan_memory(
        recipe, device="gpu" if on_gpu else "host", run_dir=default_run_dir(recipe)
    )
    parts = [format_plan(plan)]
    if find_algorithm(recipe.algo.kind).has_replay:
        parts += [format_cards(plan)] * on_gpu + [format_work(plan)]
    return "\n\n".join(parts), plan.fits and not (on_gpu and plan.machine.gpu is None)


def _python() -> Finding:
    version = platform.python_version()
    status: Status = "ok" if sys.version_info >= (3, 11) else "missing"
    return Finding(
        status, "python", f"{version} on {platform.system()} {platform.machine()}"
    )


def _requirements() -> list[tuple[str, str]]:
    """Return (package, extra) of the installed flashdex, extra "" for the core."""
    try:
        lines = metadata.requires("flashdex") or []
    except metadata.PackageNotFoundError:
        return []
    pairs = []
    for line in lines:
        name = re.split(r"[<>=!~;\[ ]", line, maxsplit=1)[0]
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", line)
        pairs.append((name, extra.group(1) if extra else ""))
    return pairs


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _packages() -> list[Finding]:
    core = [name for name, extra in _requirements() if not extra]
    if not core:
        detail = f"{flashdex.__version__}, not installed: pip install --editable ."
        return [Finding("note", "flashdex", detail)]
    found = [Finding("ok", "flashdex", flashdex.__version__)]
    for name in core:
        version = _version(name)
        if version is None:
            found.append(Finding("missing", name, f"run: pip install {name}"))
        else:
            found.append(Finding("ok", name, version))
    return found


def _cpu() -> Finding:
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    cores = usable or os.cpu_count() or 1
    memory = ""
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        memory = f", {size / 2**30:.0f} GiB memory"
    return Finding("ok", "cpu", f"{cores} cores{memory}")


def _gpu() -> Finding:
    try:
        import torch
    except ImportError:
        return Finding("missing", "gpu", "torch is not installed")
    if torch.cuda.is_available():
        device = torch.cuda.get_device_properties(0)
        size = device.total_memory / 2**30
        count = torch.cuda.device_count()
        return Finding("ok", "gpu", f"{count} x {device.name}, {size:.0f} GiB")
    reason = "this torch is a CPU build" if torch.version.cuda is None else "no device"
    return Finding("note", "gpu", f"none ({reason}): use physics=cpu")


def _graphics() -> Finding:
    """Render one picture with each off-screen back end until one works."""
    from flashdex.reports.render.films import find_backend, usual_backends

    asked, backend = os.environ.get("MUJOCO_GL"), find_backend()
    if backend is not None:
        hint = "" if asked else f" (export MUJOCO_GL={backend})"
        return Finding("ok", "graphics", f"{backend} renders{hint}")
    tried = usual_backends()
    packages = " or ".join(_GL_PACKAGES.get(b, b) for b in tried)
    return Finding(
        "note",
        "graphics",
        f"none of {', '.join(tried)} renders: no films, training is not affected. "
        f"Install {packages} (apt-get install ...)",
    )


def _disk(folder: Path) -> Finding:
    free = shutil.disk_usage(folder).free / 2**30
    status: Status = "ok" if free > 5 else "note"
    return Finding(status, "disk", f"{free:.0f} GiB free in {folder}")


def _extras() -> list[Finding]:
    """List the extras of which a package is missing, with the command."""
    extras: dict[str, list[str]] = {}
    for name, extra in _requirements():
        if extra:
            extras.setdefault(extra, []).append(name)
    found = []
    for extra, names in extras.items():
        absent = [name for name in names if _version(name) is None]
        if absent:
            detail = (
                f"without {', '.join(absent)}: pip install '.[{extra}]' in the clone"
            )
            found.append(Finding("note", f"extra {extra}", detail))
        else:
            found.append(Finding("ok", f"extra {extra}", ", ".join(names)))
    return found
