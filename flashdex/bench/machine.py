"""What a measurement ran on: processor, GPU, versions, commit, load."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

PACKAGES = {"warp": "warp-lang", "mujoco_warp": "mujoco-warp", "jax": "jax"}


def describe_hardware() -> str:
    """Processor and number of cores."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        lines = info.read_text(encoding="utf-8").splitlines()
        models = [
            x.split(":", 1)[1].strip() for x in lines if x.startswith("model name")
        ]
        name = models[0] if models else name
    return f"{name}, {torch.multiprocessing.cpu_count()} cores"


def describe_machine() -> dict[str, Any]:
    """Processor, GPU, driver and versions; what is absent is None.

    ``load_1m`` is the number of busy processes at that moment: above the benchmark's
    own threads, absolute figures are too low and only ratios mean something.
    """
    found: dict[str, Any] = {
        "processor": describe_hardware(),
        "gpu": None,
        "driver": None,
        "cuda": torch.version.cuda,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "mujoco": _version("mujoco"),
        **{name: _version(package) for name, package in PACKAGES.items()},
        "load_1m": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
    }
    if torch.cuda.is_available():
        properties = torch.cuda.get_device_properties(torch.cuda.current_device())
        found["gpu"] = properties.name
        found["gpu_memory_gb"] = round(properties.total_memory / 1e9, 1)
        found["driver"] = _driver()
    return found


def describe_commit() -> str:
    """Commit of the source tree, ``+`` when it was changed.

    Outside of git it is what ``FLASHDEX_COMMIT`` says, else empty.
    """
    folder = Path(__file__).parent

    def git(*words: str) -> str:
        try:
            done = subprocess.run(
                ["git", *words], cwd=folder, capture_output=True, text=True, check=False
            )
        except OSError:  # a machine without git
            return ""
        return done.stdout.strip() if done.returncode == 0 else ""

    commit = git("rev-parse", "--short", "HEAD")
    if not commit:
        return os.environ.get("FLASHDEX_COMMIT", "")
    return commit + ("+" if git("status", "--porcelain", "-uno") else "")


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _driver() -> str | None:
    words = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        done = subprocess.run(
            words, capture_output=True, text=True, check=False, timeout=20
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    lines = done.stdout.split()
    return lines[0] if done.returncode == 0 and lines else None
