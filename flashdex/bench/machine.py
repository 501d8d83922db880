"""What a measurement ran on: processor, versions, commit."""

from __future__ import annotations

import platform
import subprocess
from pathlib import Path

import torch


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


def describe_commit() -> str:
    """Commit of the source tree, ``+`` when it was changed; empty outside of git."""
    folder = Path(__file__).parent

    def git(*words: str) -> str:
        done = subprocess.run(
            ["git", *words], cwd=folder, capture_output=True, text=True, check=False
        )
        return done.stdout.strip() if done.returncode == 0 else ""

    commit = git("rev-parse", "--short", "HEAD")
    return commit + ("+" if commit and git("status", "--porcelain", "-uno") else "")
