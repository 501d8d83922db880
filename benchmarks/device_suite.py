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
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import FrameType
from typing import Any

from benchmarks.suite_parts import PARTS, Choice, Job, jobs_of

ROOT = Path(__file__).resolve().parent.parent
MESSAGE_LINES = 20
LEAST_S = 20.0  # less time than this is not worth a start
POLL_S = 0.5


class Lines:
    """Appends results to a file, each with the job it comes from.

    Args:
        out: file of JSON lines.
        part: of the suite.
    """

    def __init__(self, out: Path, part: str) -> None:
        out.parent.mkdir(parents=True, exist_ok=True)
        self.out, self.part = out, part
        self.results = 0  # lines that are no failures

    def write(self, job: Job, found: dict[str, Any], **more: Any) -> None:
        """Append one line, on disk when this returns."""
        suite = {"part": self.part, "job": job.name, **more}
        with self.out.open("a", encoding="utf-8") as file:
            file.write(json.dumps({**found, "suite": suite}) + "\n")
            file.flush()
            os.fsync(file.fileno())
        self.results += "failed" not in found
        print(f"{self.part}: {job.name}: {_brief(found)}", flush=True)

    def fail(self, job: Job, why: str, stderr: str = "", **more: Any) -> None:
        """Append the line of a job without a result."""
        text = stderr.splitlines()[-MESSAGE_LINES:]
        self.write(job, {"benchmark": self.part, "failed": why, "stderr": text}, **more)


def _brief(found: dict[str, Any]) -> str:
    names = ("failed", "env_steps_per_s", "updates_per_s", "sampled_rows_per_s")
    names += ("ratio", "ratio_to_baseline", "convert/cumulative", "env_steps")
    return ", ".join(f"{k} {found[k]}" for k in names if k in found)


class Watched:
    """New lines of a file that a running job appends to.

    Args:
        path: the file, existing or not; None is no file.
    """

    def __init__(self, path: Path | None) -> None:
        self.path, self.read = path, 0

    def new(self) -> list[dict[str, Any]]:
        """Whole lines that were not there before."""
        if self.path is None or not self.path.is_file():
            return []
        text = self.path.read_bytes()
        end = text.rfind(b"\n") + 1
        fresh, self.read = text[self.read : end], max(self.read, end)
        return parse_lines(fresh.decode("utf-8", errors="replace"))


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


def run_job(job: Job, lines: Lines, *, limit_s: float, scratch: Path) -> None:
    """Run one job to its end or its limit, and write what it has found.

    Args:
        job: the command.
        lines: where results go.
        limit_s: seconds after which it is stopped.
        scratch: working folder.
    """
    begin, why = time.monotonic(), ""
    watched = Watched(job.watch)
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
                _write_curve(job, lines, watched)
                time.sleep(POLL_S)
        finally:
            stop(process)
            spent = round(time.monotonic() - begin, 1)
            results = parse_lines(_text(stdout))
            for found in results:
                lines.write(job, found, seconds=spent)
            _write_curve(job, lines, watched)
            if process.returncode and not why:
                why = f"exit code {process.returncode}"
            if why or (not results and job.watch is None):
                lines.fail(job, why or "no result", _text(stderr), seconds=spent)


def _write_curve(job: Job, lines: Lines, watched: Watched) -> None:
    for record in watched.new():
        kept = ("env_steps", "hours", "updates", "perf/env_steps_per_s")
        curve = {
            k: v for k, v in record.items() if k in kept or k.startswith("convert/")
        }
        lines.write(job, {"benchmark": "curve", **curve})


def start(words: list[str], scratch: Path, **streams: Any) -> subprocess.Popen[bytes]:
    """Begin a command in a process group of its own.

    Args:
        words: after `python -m`.
        scratch: working folder.
        streams: of the process.
    """
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
        except ProcessLookupError:
            break
        try:
            process.wait(patience_s)
        except subprocess.TimeoutExpired:
            continue
        break
    process.wait()


def _text(stream: Any) -> str:
    stream.seek(0)
    return stream.read().decode("utf-8", errors="replace")


def run_part(part: str, choice: Choice, lines: Lines) -> None:
    """Run the jobs of a part one after the other until the time is up.

    Args:
        part: one of `PARTS`.
        choice: what the call asks for.
        lines: where results go.
    """
    end = time.monotonic() + 60 * choice.minutes
    for job in jobs_of(part, choice):
        left = end - time.monotonic()
        if left < LEAST_S:
            lines.fail(job, f"not begun: {max(left, 0):.0f} s were left")
            continue
        limit = min(job.limit_s, left - 10)
        run_job(job, lines, limit_s=limit, scratch=choice.scratch)


def _interrupted(number: int, frame: FrameType | None) -> None:
    raise SystemExit(128 + number)


def main() -> None:
    """Parse, unpack the libraries, run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", choices=PARTS, required=True)
    parser.add_argument("--minutes", type=float, default=9.0, help="of the whole call")
    parser.add_argument("--out", type=Path, required=True, help="file of JSON lines")
    parser.add_argument(
        "--libraries", type=Path, required=True, help="folder or archive"
    )
    parser.add_argument("--engine", default="warp", choices=["warp", "cpu", "brax"])
    parser.add_argument("--tiny", action="store_true", help="only try the commands")
    parser.add_argument("overrides", nargs="*", metavar="key=value")
    args = parser.parse_intermixed_args()
    if not args.libraries.exists():
        parser.error(
            f"--libraries: {args.libraries} does not exist. Make it: python "
            "benchmarks/suite_libraries.py libraries/suite --pack suite.tar.xz"
        )
    signal.signal(signal.SIGTERM, _interrupted)
    with tempfile.TemporaryDirectory(prefix="flashdex-suite-") as folder:
        from benchmarks.suite_libraries import unpack

        scratch = Path(folder)
        choice = Choice(
            engine=args.engine,
            libraries=unpack(args.libraries, scratch / "libraries"),
            tiny=args.tiny,
            minutes=args.minutes,
            overrides=args.overrides,
            scratch=scratch,
        )
        lines = Lines(args.out.resolve(), args.part)
        run_part(args.part, choice, lines)
        if not lines.results:
            parser.exit(1, f"{args.part}: no result; {args.out} says why\n")


if __name__ == "__main__":
    main()
