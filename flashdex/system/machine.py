"""This machine: memory it has left, hardware, versions of what runs on it."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import mujoco
import torch

Pool = Literal["gpu", "host", "disk"]
_MEMINFO, _CGROUP = Path("/proc/meminfo"), Path("/sys/fs/cgroup")


@dataclass(frozen=True)
class Machine:
    """Free bytes of each pool; None where it does not exist or nobody tells.

    Attributes:
        gpu: free memory of the current CUDA device.
        host: what processes can still take, the container's limit included.
        disk: free where the run directory is or will be.
        gpu_name: of the device.
    """

    gpu: int | None
    host: int | None
    disk: int | None
    gpu_name: str = ""

    def free(self, pool: Pool) -> int | None:
        """Free bytes of one pool."""
        return getattr(self, pool)


def look_at_machine(run_dir: Path) -> Machine:
    """Ask the device, the kernel and the file system."""
    gpu, name = None, ""
    if torch.cuda.is_available():
        gpu, _ = torch.cuda.mem_get_info()
        name = torch.cuda.get_device_name()
    return Machine(gpu, free_host(), _free_disk(run_dir), name)


def free_host(meminfo: Path = _MEMINFO, cgroup: Path | None = None) -> int | None:
    """Bytes of host memory that can still be taken.

    Args:
        meminfo: the kernel's table; its MemAvailable counts caches as free.
        cgroup: folder of this process's version 2 control group; None finds it. Each
            group above it may have a limit, too.

    Returns:
        The smallest of what the machine has and what each container limit leaves; the
        installed memory where there is no table, None where that is unknown, too.
    """
    found = [_available(meminfo)]
    folder = _own_cgroup() if cgroup is None else cgroup
    for group in (folder, *folder.parents):
        if not (group / "cgroup.controllers").is_file():
            break
        found.append(_left_in(group))
    known = [size for size in found if size is not None]
    return min(known) if known else None


def _available(meminfo: Path) -> int | None:
    with suppress(OSError):
        for line in meminfo.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return None


def _own_cgroup() -> Path:
    folder = _CGROUP
    with suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            if line.startswith("0::"):
                folder = _CGROUP / line[3:].lstrip("/")
    # inside a container the path may be the host's, which is not mounted here
    return folder if folder.is_dir() else _CGROUP


def _left_in(group: Path) -> int | None:
    """Limit less use, in which file caches do not count; None without a limit."""
    try:
        limit = int((group / "memory.max").read_text())  # or the word "max"
        used = int((group / "memory.current").read_text())
        stat = (group / "memory.stat").read_text().split()
    except (OSError, ValueError):
        return None
    table = dict(zip(stat[::2], stat[1::2], strict=False))
    cached = int(table.get("inactive_file", 0)) + int(table.get("active_file", 0))
    return max(0, limit - used + min(cached, used))


def _free_disk(folder: Path) -> int | None:
    folder = folder.absolute()
    there = next((p for p in (folder, *folder.parents) if p.exists()), None)
    if there is None:
        return None
    # a run that goes on replaces the checkpoints that it has
    own = folder / "checkpoints"
    had = sum(p.stat().st_size for p in own.rglob("*") if p.is_file())
    return shutil.disk_usage(there).free + had


def describe_hardware() -> str:
    """Processor and number of cores."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                name = line.split(":", 1)[1].strip()
                break
    return f"{name}, {torch.multiprocessing.cpu_count()} cores"


def describe_machine() -> dict[str, Any]:
    """Processor, GPU, driver and versions; what is absent is None.

    ``load_1m`` is the number of busy processes at that moment: above the benchmark's
    own threads, absolute figures are too low and only ratios mean something.
    """
    packages = {"mujoco": "mujoco", "warp": "warp-lang", "mujoco_warp": "mujoco-warp"}
    found: dict[str, Any] = {
        "processor": describe_hardware(),
        "gpu": None,
        "driver": None,
        "cuda": torch.version.cuda,
        "python": platform.python_version(),
        "torch": torch.__version__,
        **{name: _version(p) for name, p in {**packages, "jax": "jax"}.items()},
        "load_1m": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
    }
    if torch.cuda.is_available():
        properties = torch.cuda.get_device_properties(torch.cuda.current_device())
        found["gpu"] = properties.name
        found["gpu_memory_gb"] = round(properties.total_memory / 1e9, 1)
        words = ("nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader")
        found["driver"] = next(iter((_output(*words) or "").split()), None)
    return found


def describe_commit() -> str:
    """Commit of the source tree, ``+`` when it was changed.

    Outside of git it is what ``FLASHDEX_COMMIT`` says, else empty.
    """
    commit = _output("git", "rev-parse", "--short", "HEAD")
    if not commit:
        return os.environ.get("FLASHDEX_COMMIT", "")
    return commit + ("+" if _output("git", "status", "--porcelain", "-uno") else "")


DIFF_BYTES = 8 << 20  # of changes that are worth keeping


def source_changes() -> bytes:
    """Uncommitted changes of flashdex's own checkout, empty where that fails.

    Commands that a git configuration names for diffs do not run, nor is the index
    written. Long ones are cut off, and say so.
    """
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return b""
    words = ["git", "--no-optional-locks", "-c", "core.fsmonitor=false", "-C"]
    words += [str(root), "diff", "--no-ext-diff", "--no-textconv", "--no-color", "HEAD"]
    # variables that name another repository or a command of their own
    environment = {k: v for k, v in os.environ.items() if not k.startswith("GIT_")}
    try:
        done = subprocess.run(
            words,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=10,
            check=True,
        )
    except (OSError, ValueError, subprocess.SubprocessError):
        return b""
    if len(done.stdout) > DIFF_BYTES:
        return done.stdout[:DIFF_BYTES] + b"\n(cut off)\n"
    return done.stdout


def _output(*words: str) -> str | None:
    """What a program prints, run beside this file; None where it fails."""
    options: Any = {"capture_output": True, "text": True, "timeout": 20}
    try:
        done = subprocess.run(words, cwd=Path(__file__).parent, check=True, **options)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


ENGINE_PACKAGES = {
    "warp": ("mujoco-warp", "warp-lang"),
    "brax": ("mujoco-mjx", "jax", "brax"),
}


def versions(engine: str = "cpu", device: torch.device | None = None) -> dict[str, Any]:
    """Package versions, engine and hardware that produce a rollout."""
    own = ("flashdex", "torch", "torchrl", "tensordict")
    found = {name: _version(name) or "source" for name in own}
    found |= {name: version(name) for name in ENGINE_PACKAGES.get(engine, ())}
    hardware = f"{platform.machine()}, {os.cpu_count()} CPU cores"
    if device is not None and device.type == "cuda":
        hardware = f"{torch.cuda.get_device_name(device)}, {hardware}"
    return {
        **found,
        "mujoco": mujoco.__version__,
        "python": platform.python_version(),
        "engine": engine,
        "hardware": hardware,
    }
