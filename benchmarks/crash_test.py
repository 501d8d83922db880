"""Kill a training run again and again, resume it each time, and check what is left.

    python -m benchmarks.crash_test --kills 20 --out benchmarks/results/crash_test.json

A small variant of the quickstart, on three motions of less than a second, runs as a
process of its own and gets SIGKILL at a random moment of its start or its training,
while it writes a checkpoint, or right after it stored a rollout. Then it is resumed. At
the end SIGTERM has to stop it with exit code 0, and a last session has to finish.
"""

from __future__ import annotations

import argparse
import itertools
import json
import logging
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flashdex.hands.spec import load_hand
from flashdex.rollouts.findings import faults
from flashdex.rollouts.verify import verify_run
from flashdex.system.jsonl import read_lines
from flashdex.training.checkpoint import has_checkpoint, load_checkpoint
from tests.synthetic import write_library

KINDS = ("storing", "training", "saving", "startup")
TINY = ["env.num_envs=16", "algo.batch_size=32", "algo.min_buffer=500"]
TINY += ["algo.updates_per_step=0.25", "train.log_every_s=1"]
TINY += ["train.stop_when_all_converted=false", "train.checkpoint_replay=true"]
TINY += ["train.keep_checkpoints=2", "train.render_conversions=false"]


class Victim:
    """The run that is killed, and what must not get lost of it.

    Run and motion library go into an empty folder; checkpoints are ``interval`` seconds
    apart.
    """

    def __init__(
        self, folder: Path, *, interval: float, overrides: Sequence[str]
    ) -> None:
        self.folder, self.run_dir = folder, folder / "run"
        self.interval = interval
        library = folder / "library"
        if not library.exists():
            write_library(library, load_hand("xhand"))
        self.first = ["quickstart", f"motions.library={library}"]
        self.first.append(f"run_dir={self.run_dir}")
        self.first += [f"train.checkpoint_every_s={interval}", *TINY, *overrides]
        self.lines: list[str] = []
        self.startup_s = 10.0

    def start(self, *overrides: str) -> subprocess.Popen[bytes]:
        """Begin or resume the run."""
        words = self.first
        if (self.run_dir / "recipe.yaml").is_file():
            words = ["--resume", str(self.run_dir), *overrides]
        with (self.folder / "output.txt").open("ab") as output:
            return subprocess.Popen(
                [sys.executable, "-m", "flashdex.cli", "train", *words],
                cwd=self.folder,
                stdout=output,
                stderr=output,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
            )

    def events(self, kind: str) -> int:
        """Sessions that started or ended so far."""
        lines = read_lines(self.run_dir / "sessions.jsonl")
        return sum(line["event"] == kind for line in lines)

    def wait_for_training(self, process: subprocess.Popen[bytes], before: int) -> None:
        """Wait until the session trains; measures how long that takes."""
        began = time.monotonic()
        while self.events("start") == before:
            if process.poll() is not None:
                raise SystemExit(f"it ended by itself: see {self.folder}/output.txt")
            time.sleep(0.02)
        self.startup_s = time.monotonic() - began

    def kill(self, kind: str, draw: random.Random) -> dict[str, Any]:
        """One session that ends with SIGKILL; returns what happened."""
        before = self.events("start")
        rollouts = self._rollouts()
        process = self.start()
        if kind == "startup":
            time.sleep(draw.uniform(0.0, self.startup_s))
        else:
            self.wait_for_training(process, before)
            self._wait(process, kind, rollouts, draw)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        if self.events("start") == before:  # it did not come to train
            return {"kind": kind, "lost_s": 0.0}
        return {"kind": kind, **self._lost()}

    def _wait(
        self,
        process: subprocess.Popen[bytes],
        kind: str,
        rollouts: dict[str, int],
        draw: random.Random,
    ) -> None:
        patience = {"storing": 8.0, "saving": 3.0}.get(kind) or draw.uniform(0.2, 2.2)
        patience = time.monotonic() + patience * self.interval
        while time.monotonic() < patience and process.poll() is None:
            if kind == "saving" and any((self.run_dir / "checkpoints").rglob(".*.tmp")):
                time.sleep(draw.uniform(0.0, 0.01))
                return
            if kind == "storing" and self._rollouts() != rollouts:
                return
            time.sleep(0.001 if kind != "training" else 0.02)

    def _rollouts(self) -> dict[str, int]:
        found = (self.run_dir / "rollouts").glob("*.npz")
        return {path.name: path.stat().st_mtime_ns for path in found}

    def _lost(self) -> dict[str, Any]:
        """Work of this session after its newest checkpoint, s and env steps."""
        records = read_lines(self.run_dir / "metrics.jsonl")
        starts = read_lines(self.run_dir / "sessions.jsonl")
        since, env_steps = starts[-1]["wall_s"] if starts else 0.0, 0
        if has_checkpoint(self.run_dir):
            state = load_checkpoint(self.run_dir)
            env_steps, since = state["env_steps"], max(since, state["wall_s"])
        lost = {"lost_s": 0.0, "env_steps": env_steps, "lost_env_steps": 0}
        if records:
            lost["lost_env_steps"] = max(0, int(records[-1]["env_steps"] - env_steps))
            seconds = 3600 * records[-1]["hours"] - since
            lost["lost_s"] = round(max(0.0, seconds), 2)
        return lost

    def check_ledger(self) -> None:
        """Every line that was ever whole is still there, in its place."""
        path = self.run_dir / "conversions.jsonl"
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        lines = text.split("\n")[:-1]
        assert lines[: len(self.lines)] == self.lines, "a line of the ledger is lost"
        self.lines = lines


def check_curves(run_dir: Path) -> dict[str, Any]:
    """Records go forward in env steps and time; counts never go back."""
    records = read_lines(run_dir / "metrics.jsonl")
    keys = ("env_steps", "env_steps_lost", "hours", "updates", "convert/cumulative")
    for a, b in itertools.pairwise(records):
        for key in ("env_steps", "hours"):
            assert b[key] > a[key], (key, a, b)
        for key in (*keys, "convert/attempts"):
            assert b[key] >= a[key], (key, a, b)
    return {"records": len(records), **{key: records[-1][key] for key in keys}}


def check_conversions(run_dir: Path) -> dict[str, Any]:
    """Every conversion has its rollout, and replays as its certificate says."""
    lines = read_lines(run_dir / "conversions.jsonl")
    converted = {line["motion"] for line in lines if line["converted"]}
    found = {one.motion: one for one in verify_run(run_dir).rollouts}
    assert converted == set(found), (converted, set(found))
    disagree = [name for name, one in found.items() if faults(one.findings)]
    assert not disagree, disagree
    return {
        "attempts": len(lines),
        "conversions": sorted(converted),
        "rollouts_that_replay_as_stored": len(found),
        "certified": sum(one.holds for one in found.values()),
    }


def run_test(
    folder: Path,
    *,
    kills: int,
    interval: float,
    seed: int,
    kinds: tuple[str, ...] = KINDS,
    overrides: tuple[str, ...] = (),
    last_env_steps: int = 4000,
) -> dict[str, Any]:
    """Kill, resume, stop and finish a run in an empty folder; return the summary.

    The kinds of moments are taken in turn; the session that finishes takes
    ``last_env_steps``.
    """
    draw = random.Random(seed)
    victim = Victim(folder, interval=interval, overrides=overrides)
    log = []
    for number in range(kills):
        log.append(victim.kill(kinds[number % len(kinds)], draw))
        victim.check_ledger()
        logging.info("kill %d: %s", number + 1, log[-1])
    before = victim.events("start")
    process = victim.start()
    victim.wait_for_training(process, before)
    time.sleep(interval / 2)
    process.terminate()
    assert process.wait(60) == 0, "SIGTERM did not end it cleanly"
    assert read_lines(victim.run_dir / "sessions.jsonl")[-1]["why"] == "signal"
    end = int(read_lines(victim.run_dir / "metrics.jsonl")[-1]["env_steps"])
    process = victim.start(f"total_env_steps={end + last_env_steps}")
    assert process.wait() == 0, "the last session failed"
    assert read_lines(victim.run_dir / "sessions.jsonl")[-1]["why"] == "budget"
    victim.check_ledger()
    output = (folder / "output.txt").read_text(encoding="utf-8")
    most = max(entry["lost_s"] for entry in log)
    # a checkpoint is due at the first vector step after the interval
    assert most < interval + 2.0, f"{most} s were lost"
    return {
        "kills": log,
        "checkpoint_every_s": interval,
        "most_lost_s": most,
        "clean_stop": "SIGTERM: exit code 0",
        # rollouts that were stored before a kill and got their line after it
        "lines_written_by_a_resume": output.count("its stored rollout had no line yet"),
        **check_curves(victim.run_dir),
        **check_conversions(victim.run_dir),
    }


def main() -> None:
    """Run the test and print its summary."""
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--kills", type=int, default=20)
    add("--interval", type=float, default=5.0)
    add("--seed", type=int, default=0)
    add("--folder", type=Path, required=True, help="empty folder")
    add("--out", type=Path, help="write the summary here, too")
    args = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    args.folder.mkdir(parents=True, exist_ok=True)
    times = {"kills": args.kills, "interval": args.interval, "seed": args.seed}
    summary = run_test(args.folder.resolve(), **times)
    text = json.dumps(summary, indent=1)
    if args.out is not None:
        args.out.write_text(text + "\n", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
