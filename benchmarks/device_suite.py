"""Runs one part of the measurements on a GPU machine, unattended and within minutes.

    python -m benchmarks.device_suite --part env --minutes 9 --out env.jsonl \
        --libraries suite.tar.xz

Each configuration is a process of its own with a time limit, most important first. Its
lines are appended to the file as soon as it ends; one that fails or is stopped leaves a
line with the end of its messages. flashdex need not be installed, and nothing is
downloaded: see docs/benchmarks.md.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from flashdex.system.jsonl import append_line

ROOT = Path(__file__).resolve().parent.parent
RECIPE = "bench50_xhand"  # the paper's settings
CURVE_LIBRARY = "procedural50"
FEW_WORLDS = "env.attempt_share=0.5"  # of a handful there must be one
MESSAGE_LINES = 20
LEAST_S = 20.0  # less time than this is not worth a start
POLL_S = 0.5


@dataclass(frozen=True)
class Job:
    """One command: a module and its words."""

    name: str  # in the lines of results
    words: list[str]  # after `python -m`
    limit_s: float  # it is stopped after that many seconds
    watch: Path | None = None  # file of JSON lines that grows while it runs


@dataclass(frozen=True)
class Choice:
    """What a call of the suite asks for."""

    engine: str  # of the physics
    libraries: Path  # folder of the prepared libraries
    tiny: bool  # sizes that show on any computer that the commands work
    minutes: float  # of the whole call
    overrides: list[str]  # ``key=value`` changes of the recipe, last
    scratch: Path  # folder for runs

    def scene(self, objects: int, hulls: int, worlds: int | None = None) -> list[str]:
        """Words that choose recipe and scene."""
        words = ["--recipe", RECIPE, "--libraries", str(self.libraries)]
        words += ["--objects", str(objects), "--hulls", str(hulls)]
        return words if worlds is None else [*words, "--num-envs", str(worlds)]


def _env(choice: Choice) -> Iterator[Job]:
    worlds = (8, 16) if choice.tiny else (4096, 8192, 2048, 16384, 1024)
    sizes = [(2, 16, n) for n in worlds]
    if not choice.tiny:
        sizes += [(2, 1, 4096), (2, 4, 4096), (2, 8, 4096), (1, 16, 4096), (1, 1, 4096)]
    # compiling would be most of a job's time; the full loop has it
    words = ["--seconds", "0.5" if choice.tiny else "8", f"physics={choice.engine}"]
    words += ["env.compile=false", *[FEW_WORLDS] * choice.tiny, *choice.overrides]
    for size in sizes:
        name = "env o{} h{} n{}".format(*size)
        yield Job(name, ["benchmarks.env", *choice.scene(*size), *words], 180)


def _train(choice: Choice) -> Iterator[Job]:
    words = ["--seconds", "2" if choice.tiny else "40", "--ceiling-seconds"]
    words += ["0.5" if choice.tiny else "6", f"physics={choice.engine}"]
    if choice.tiny:
        words += ["algo.batch_size=64", "algo.critic_width=16", "algo.actor_width=16"]
        words += ["algo.buffer_size=2000", "algo.compile=false", "env.compile=false"]
        words.append(FEW_WORLDS)
    else:
        words.append("algo.bfloat16=true")
    for n in (8,) if choice.tiny else (4096, 8192, 2048):
        scene = choice.scene(2, 16, n)
        command = ["benchmarks.train", *scene, *words, *choice.overrides]
        yield Job(f"train n{n}", command, 300)


def _learner(choice: Choice) -> Iterator[Job]:
    words = ["benchmarks.learner", "--sizes", "tiny" if choice.tiny else "paper"]
    words += ["--device", "auto", "--rounds", "2" if choice.tiny else "10"]
    fast = [*words, "--precision", "high", "--autocast"]
    yield Job("learner tf32 bfloat16", fast, 240)
    if not choice.tiny:
        yield Job("learner compiled", [*fast, "--compile"], 420)
        yield Job("learner float32", words, 240)


def _replay(choice: Choice) -> Iterator[Job]:
    sizes = [("auto", "20k"), ("cpu", "20k")]
    if not choice.tiny:
        sizes = [("device", "50M"), ("pinned", "50M"), ("device", "1M")]
        sizes += [("device", "10M"), ("pinned", "10M"), ("cpu", "1M")]
    words = ["benchmarks.replay", *choice.scene(2, 1)]
    if choice.tiny:
        words += ["--batch", "64", "--seconds", "0.2", "algo.compile=false"]
    # its rows are what is wanted of the environment
    words += ["env.compile=false", *choice.overrides]
    for place, rows in sizes:
        command = [*words, "--replay", place, "--rows", rows]
        yield Job(f"replay {place} {rows}", command, 240)


def _curve(choice: Choice) -> Iterator[Job]:
    run = choice.scratch / "curve"
    # the rest of the call is for building the scenes and the last checkpoint
    limit = max(0.5, choice.minutes - (0.2 if choice.tiny else 1.5)) * 60
    words = ["flashdex.cli", "train", RECIPE, f"run_dir={run}"]
    words.append(f"motions.library={choice.libraries / CURVE_LIBRARY}")
    words += [f"physics={choice.engine}", f"train.wall_limit_s={limit:g}"]
    words += ["train.render_conversions=false", "train.checkpoint_every_s=100000"]
    if choice.tiny:
        words += ["env.num_envs=8", "algo.batch_size=32", "algo.critic_width=16"]
        words += ["motions.count=1", "algo.buffer_size=2000", "algo.min_buffer=64"]
        words += ["algo.compile=false", "env.compile=false", "total_env_steps=160"]
        words.append(FEW_WORLDS)
    else:
        words += ["env.num_envs=4096", "total_env_steps=30_000_000"]
        words.append("algo.bfloat16=true")
    words += choice.overrides
    yield Job("curve", words, 60 * choice.minutes, run / "metrics.jsonl")


def _search(choice: Choice) -> Iterator[Job]:
    sizes = [(8, 1), (8, 2)] if choice.tiny else [(4096, 1), (1024, 4), (1024, 1)]
    if not choice.tiny:
        sizes += [(16384, 1), (4096, 4)]
    words = ["--seconds", "0.5" if choice.tiny else "8"]
    words += ["--horizon", "4" if choice.tiny else "36", f"physics={choice.engine}"]
    for samples, worlds in sizes:
        size = ["--samples", str(samples), "--worlds", str(worlds)]
        command = ["benchmarks.search", *choice.scene(2, 16), *size, *words]
        yield Job(f"search n{samples} w{worlds}", [*command, *choice.overrides], 180)


_MAKERS = (_env, _train, _learner, _replay, _search, _curve)
PARTS = {make.__name__.removeprefix("_"): make for make in _MAKERS}


def jobs_of(part: str, choice: Choice) -> list[Job]:
    """The jobs of one of the `PARTS`, most important first."""
    return list(PARTS[part](choice))


class Lines:
    """Appends results to a file of JSON lines, each with the job it comes from."""

    def __init__(self, out: Path, part: str) -> None:
        out.parent.mkdir(parents=True, exist_ok=True)
        self.out, self.part = out, part
        self.results = 0  # lines that are no failures

    def write(self, job: Job, found: dict[str, Any], **more: Any) -> None:
        """Append one line, on disk when this returns."""
        suite = {"part": self.part, "job": job.name, **more}
        append_line(self.out, {**found, "suite": suite})
        self.results += "failed" not in found
        print(f"{self.part}: {job.name}: {_brief(found)}", flush=True)

    def fail(self, job: Job, why: str, stderr: str = "", **more: Any) -> None:
        """Append the line of a job without a result."""
        text = stderr.splitlines()[-MESSAGE_LINES:]
        self.write(job, {"benchmark": self.part, "failed": why, "stderr": text}, **more)


def _brief(found: dict[str, Any]) -> str:
    names = ("failed", "env_steps_per_s", "updates_per_s", "sampled_rows_per_s")
    names += (
        "samples_per_s",
        "ratio",
        "ratio_to_baseline",
        "convert/cumulative",
        "env_steps",
    )
    return ", ".join(f"{k} {found[k]}" for k in names if k in found)


def parse_lines(text: str) -> list[dict[str, Any]]:
    """The JSON objects among the lines of a text."""
    found = []
    for line in text.splitlines():
        try:
            value = json.loads(line)
        except ValueError:
            continue
        if isinstance(value, dict):
            found.append(value)
    return found


def _write_new(job: Job, lines: Lines, read: int) -> int:
    """Write what a running job has recorded since ``read`` bytes; half a line waits."""
    if job.watch is None or not job.watch.is_file():
        return read
    text = job.watch.read_bytes()
    end = max(read, text.rfind(b"\n") + 1)
    kept = ("env_steps", "hours", "updates", "perf/env_steps_per_s")
    for record in parse_lines(text[read:end].decode("utf-8", errors="replace")):
        names = [k for k in record if k in kept or k.startswith("convert/")]
        lines.write(job, {"benchmark": "curve", **{k: record[k] for k in names}})
    return end


def run_job(job: Job, lines: Lines, *, limit_s: float, scratch: Path) -> None:
    """Run one job to its end or its limit, and write what it has found."""
    begin, why, read = time.monotonic(), "", 0
    with (
        (scratch / "stdout").open("w+b") as stdout,
        (scratch / "stderr").open("w+b") as stderr,
    ):
        process = start(job.words, scratch, stdout=stdout, stderr=stderr)
        try:
            while process.poll() is None:
                if time.monotonic() - begin > limit_s:
                    why = f"stopped after {limit_s:.0f} s"
                    break
                read = _write_new(job, lines, read)
                time.sleep(POLL_S)
        finally:
            stop(process)
            spent = round(time.monotonic() - begin, 1)
            results = parse_lines(_text(stdout))
            for found in results:
                lines.write(job, found, seconds=spent)
            _write_new(job, lines, read)
            if process.returncode and not why:
                why = f"exit code {process.returncode}"
            if why or (not results and job.watch is None):
                lines.fail(job, why or "no result", _text(stderr), seconds=spent)


def start(words: list[str], scratch: Path, **streams: Any) -> subprocess.Popen[bytes]:
    """Begin a command in a process group of its own."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    env = {**os.environ, "PYTHONPATH": path.rstrip(os.pathsep)}
    env |= {"WANDB_MODE": "offline", "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, "-m", *words]
    return subprocess.Popen(
        command, cwd=scratch, env=env, start_new_session=True, **streams
    )


def stop(process: subprocess.Popen[bytes], *, patience_s: float = 5.0) -> None:
    """End a process and all it started: asked first, then killed."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(process.pid, number)
            process.wait(patience_s)
        except subprocess.TimeoutExpired:
            continue
        except ProcessLookupError:
            pass
        break
    process.wait()


def _text(stream: Any) -> str:
    stream.seek(0)
    return stream.read().decode("utf-8", errors="replace")


def run_part(part: str, choice: Choice, lines: Lines) -> None:
    """Run the jobs of a part one after the other until the time is up."""
    end = time.monotonic() + 60 * choice.minutes
    for job in jobs_of(part, choice):
        left = end - time.monotonic()
        if left < LEAST_S:
            lines.fail(job, f"not begun: {max(left, 0):.0f} s were left")
            continue
        limit = min(job.limit_s, left - 10)
        run_job(job, lines, limit_s=limit, scratch=choice.scratch)


def unpack(source: Path, folder: Path) -> Path:
    """The folder of the libraries: as given, or an archive unpacked into another."""
    if source.is_dir():
        return source.resolve()
    shutil.unpack_archive(source, folder, filter="data")
    return folder.resolve()


def _interrupted(number: int, frame: FrameType | None) -> None:
    raise SystemExit(128 + number)


def main() -> None:
    """Parse, unpack the libraries, run."""
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--part", choices=PARTS, required=True)
    add("--minutes", type=float, default=9.0, help="of the whole call")
    add("--out", type=Path, required=True, help="file of JSON lines")
    add("--libraries", type=Path, required=True, help="folder or archive")
    add("--engine", default="warp", choices=["warp", "cpu", "brax"])
    add("--tiny", action="store_true", help="only try the commands")
    add("overrides", nargs="*", metavar="key=value")
    args = parser.parse_intermixed_args()
    if not args.libraries.exists():
        parser.error(
            f"--libraries: {args.libraries} does not exist. Make it: python -m "
            "benchmarks.suite_libraries libraries/suite --pack suite.tar.xz"
        )
    signal.signal(signal.SIGTERM, _interrupted)
    with tempfile.TemporaryDirectory(prefix="flashdex-suite-") as folder:
        scratch = Path(folder)
        libraries = unpack(args.libraries, scratch / "libraries")
        rest = (args.tiny, args.minutes, args.overrides, scratch)
        choice = Choice(args.engine, libraries, *rest)
        lines = Lines(args.out.resolve(), args.part)
        run_part(args.part, choice, lines)
        if not lines.results:
            parser.exit(1, f"{args.part}: no result; {args.out} says why\n")


if __name__ == "__main__":
    main()
