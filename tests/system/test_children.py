"""Python processes that we start run nothing that lies in the folder we are in."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
POOL = """
from flashdex.system.children import spawning_pool
if __name__ == "__main__":
    with spawning_pool(1, int) as pool:
        print(pool.submit(abs, -3).result())
"""
AFTER = """
import os
if __name__ == "__main__":
    assert "PYTHONSAFEPATH" not in os.environ
"""
OTHERS = """
import subprocess, sys
from flashdex.system.children import safe_path
with safe_path():
    subprocess.run([sys.executable, "-c", "import multiprocessing; print(3)"])
"""


@pytest.mark.parametrize("script", [POOL, OTHERS], ids=["pool", "others"])
def test_the_folder_we_are_in_is_not_imported_from(script, tmp_path):
    here = tmp_path / "here"
    here.mkdir()
    (here / "multiprocessing.py").write_text("open('ran', 'w'); raise SystemExit(9)")
    file = tmp_path / "script.py"
    file.write_text(script + AFTER)
    env = {k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"}
    done = subprocess.run(
        [sys.executable, file],
        cwd=here,
        env={**env, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert not (here / "ran").exists()
    assert (done.stdout, done.returncode) == ("3\n", 0), done.stderr
