"""Work on foreign content in a process of its own, with limits on memory and time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from flashdex.errors import FlashdexError

# wall time for each second of CPU time, and s beside: other programs run, too
WALL, GRACE = 3.0, 5.0
# an editable install is found by a hook of site-packages, and stands on no path
ROOT = str(Path(__file__).parents[2])
# The limits stand before anything is imported. What C code prints goes nowhere, and
# nothing but JSON comes back: whatever happens in there, nothing of it is executed.
BOOT = """
import json, os, sys
answer = os.dup(1)
os.dup2(2, 1)
task = json.load(sys.stdin)
sys.path[:] = task["path"]
try:
    import resource
except ImportError:
    pass
else:
    limits = {"AS": task["memory"], "CPU": task["seconds"], "CORE": 0, "FSIZE": 0}
    for name, most in limits.items():
        kind = getattr(resource, "RLIMIT_" + name)
        hard = resource.getrlimit(kind)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        # the hard limit of the time would kill as the system does for want of memory
        resource.setrlimit(kind, (most, hard if name == "CPU" else most))
import importlib
try:
    function = getattr(importlib.import_module(task["module"]), task["function"])
    out = {"value": function(*task["args"])}
except MemoryError:
    out = {"memory": True}
except ImportError:
    out = {"error": "it cannot load its libraries, as for want of memory"}
    out["memory"] = True
except OSError as error:
    out = {"error": f"{type(error).__name__}: {error}"[:1000], "memory": True}
except Exception as error:
    out = {"error": f"{type(error).__name__}: {error}"[:1000]}
os.write(answer, json.dumps(out).encode())
os._exit(0)
"""


class LimitError(FlashdexError):
    """What was tried apart failed there, took too much, or ended its process.

    Attributes:
        is_machine: it crashed, or memory or the disk failed: not by itself a fault of
            the content; another time it may go well.
    """

    def __init__(self, text: str, *, is_machine: bool = False) -> None:
        super().__init__(text)
        self.is_machine = is_machine


def run_limited(
    function: Callable[..., Any], *args: Any, memory: int, seconds: int
) -> Any:
    """What a function returns that runs in a child process with limits.

    The child is a fresh interpreter: it imports the function's module and what that
    imports (keep torch out of it), and has no file of ours open. It writes no files.

    Args:
        function: of a module's top level; its arguments and its value are JSON.
        args: its arguments.
        memory: address space of the child, bytes, what it imports included.
        seconds: of CPU time; the wall time may be three times as long.

    Raises:
        LimitError: it raised, took too much, or crashed; the text says which.
    """
    task = {
        "module": function.__module__,
        "function": function.__qualname__,
        "args": args,
        "path": [*(os.path.abspath(entry) for entry in sys.path), ROOT],
        "memory": memory,
        "seconds": seconds,
    }
    # one arena: every thread would reserve 64 MB of address space otherwise; glfw
    # starts a Python of its own, which must not import from the folder of all users
    env = {**os.environ, "MALLOC_ARENA_MAX": "1", "PYTHONSAFEPATH": "1"}
    try:
        done = subprocess.run(
            # isolated, without site: its path is ours, not that of the folder we are in
            [sys.executable, "-I", "-S", "-c", BOOT],
            input=json.dumps(task).encode(),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=WALL * seconds + GRACE,
            cwd=tempfile.gettempdir(),
            env=env,
            start_new_session=True,  # Ctrl-C is ours to answer
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise LimitError(f"it took more than {seconds} s") from None
    return _value_of(done, memory=memory, seconds=seconds)


def _value_of(
    done: subprocess.CompletedProcess[bytes], *, memory: int, seconds: int
) -> Any:
    if done.returncode == -getattr(signal, "SIGXCPU", 0) != 0:
        raise LimitError(f"it took more than {seconds} s")
    if done.returncode == -getattr(signal, "SIGKILL", 0) != 0:
        raise LimitError("the system ended it, as for want of memory", is_machine=True)
    try:
        out = json.loads(done.stdout)
    except ValueError:
        text = f"it ended the process that tried it (code {done.returncode})"
        text += ", as a crash or want of memory does"
        raise LimitError(text, is_machine=True) from None
    if "error" in out:
        raise LimitError(out["error"], is_machine="memory" in out)
    if "memory" in out:
        text = f"it needs more than {memory / 2**30:.1f} GiB of memory"
        raise LimitError(text, is_machine=True)
    return out["value"]
