"""Jobs, one a recording, over worker processes or over a Ray cluster.

A job finds its recording in the cache or prepares it into it; no work is lost, and one
bad recording costs only itself.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from flashdex.datasets.source import Recording
from flashdex.errors import LibraryError, MissingExtraError
from flashdex.motions.findings import of_error, reject
from flashdex.motions.pipeline.cache import cache_file, read_prepared, write_prepared
from flashdex.motions.pipeline.motion import (
    MotionSettings,
    Prepared,
    prepare_recording,
    rejected,
)
from flashdex.motions.pipeline.stage import listening, tell
from flashdex.objects.mesh_files import MESH_SUFFIXES
from flashdex.system.children import spawning_pool

_LOG = logging.getLogger(__name__)

LINE_SECONDS = 15.0  # between progress lines where there is no terminal
# One worker is one core: threads of torch and CoACD would fight over the others.
THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Job:
    """What a worker is given: a recording and how to prepare it."""

    recording: Recording
    settings: MotionSettings


@dataclass(frozen=True)
class Outcome:
    """What a worker gives back; the motions stay on the disk where that is possible."""

    rows: list[dict[str, Any]]  # of the report, one a motion
    file: Path | None  # that keeps the motions, if they could be kept
    prepared: list[Prepared]  # the motions themselves, if not

    def load(self, root: Path) -> list[Prepared]:
        """The motions, whose objects are in the cache ``root``.

        Raises:
            LibraryError: they were kept on the disk and are gone.
        """
        stored = None if self.file is None else read_prepared(self.file, root)
        if stored is None and len(self.prepared) < len(self.rows):
            raise LibraryError(
                f"{self.file}: what a worker kept here cannot be read any more. All "
                f"workers need the same cache folder, and nobody may clean it "
                f"meanwhile. Start again: what is there is not prepared again."
            )
        return self.prepared if stored is None else stored


def run_job(job: Job, *, carry: bool = False) -> Outcome:
    """Prepare one recording, or find it prepared; never raises for its content.

    With ``carry`` the motions come along, for a caller that may not see this disk.
    """
    root = job.settings.cache_root
    try:
        file = cache_file(job.recording, job.settings)
    except OSError as error:
        item = rejected(job.recording.name, [of_error(error)])
        return Outcome([item.row], None, [item])
    prepared = read_prepared(file, root)
    is_kept = prepared is not None
    if prepared is None:
        prepared = prepare_recording(job.recording, job.settings)
        if not any(item.passing for item in prepared):
            write_prepared(file, prepared)
        # a disk that refuses the motions or their objects must not cost them
        is_kept = not carry and read_prepared(file, root) is not None
    rows = [item.row for item in prepared]
    return Outcome(rows, file, [] if is_kept and not carry else prepared)


def _crashed(job: Job) -> Outcome:
    """The outcome of a job whose worker died."""
    text = "the worker process died (out of memory, or a crash in a mesh library)"
    item = rejected(job.recording.name, [reject("E_CRASH", text)])
    return Outcome([item.row], None, [item])


def run_jobs(
    jobs: list[Job], *, workers: int, ray: bool = False, progress: bool | None = None
) -> list[Outcome]:
    """Run all jobs; outcomes in the order of the jobs.

    Jobs whose meshes nobody has prepared yet come first, so that workers do not wait
    for one another's convex parts. With one worker everything happens in this process.
    Progress is a bar where standard error is a terminal, else a line now and then.
    """
    order = _new_meshes_first(jobs)
    queue = [jobs[i] for i in order]
    if ray:
        stream = _run_on_ray(queue)
    elif workers > 1:
        stream = _run_in_processes(queue, workers)
    else:
        stream = ((i, run_job(job)) for i, job in enumerate(queue))
    outcomes: dict[int, Outcome] = {}
    try:
        for place, outcome in _show(stream, len(jobs), progress):
            outcomes[order[place]] = outcome
    except KeyboardInterrupt:
        told = f"stopped: {len(outcomes)} of {len(jobs)} recordings are in the cache"
        _LOG.info("%s; the same command goes on from there", told)
        raise
    return [outcomes[i] for i in range(len(jobs))]


def _new_meshes_first(jobs: list[Job]) -> list[int]:
    seen: set[Path] = set()
    first, later = [], []
    for i, job in enumerate(jobs):
        files = job.recording.files
        meshes = {f for f in files if f.suffix.lower() in MESH_SUFFIXES}
        (first if meshes - seen else later).append(i)
        seen |= meshes
    return first + later


def _run_in_processes(jobs: list[Job], workers: int) -> Iterator[tuple[int, Outcome]]:
    """Outcomes as they come; a worker that dies takes only its own job with it."""
    left = dict(enumerate(jobs))
    while left:
        suspects: list[int] = []
        for place, outcome in _run_pool(left, workers, suspects):
            del left[place]
            yield place, outcome
        for place in suspects:  # alone, the one that kills its worker is found
            job = left.pop(place)
            alone = list(_run_pool({place: job}, 1, []))
            yield alone[0] if alone else (place, _crashed(job))


def _run_pool(
    jobs: dict[int, Job], workers: int, suspects: list[int]
) -> Iterator[tuple[int, Outcome]]:
    """Run jobs, by place, until they are done or the pool breaks.

    Then ``suspects`` is filled with the places that were under way.
    """
    waiting = list(jobs.items())[::-1]
    running: dict[Future[Outcome], int] = {}
    with _pool(workers) as pool:
        try:
            while waiting or running:
                while waiting and len(running) < workers:
                    place, job = waiting.pop()
                    running[pool.submit(run_job, job)] = place
                    tell(job.recording.name, "begun")
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    outcome = future.result()
                    yield running.pop(future), outcome
        except BrokenProcessPool:
            suspects += running.values()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            # a worker inside a mesh library would keep the user waiting for a minute
            for worker in multiprocessing.active_children():
                worker.terminate()
            raise


def _pool(workers: int) -> ProcessPoolExecutor:
    for name in THREAD_LIMITS:
        os.environ.setdefault(name, "1")  # read by the libraries when they load
    return spawning_pool(workers, _start_worker)


def _start_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent to answer
    torch.set_num_threads(1)


def _show(
    stream: Iterator[tuple[int, Outcome]], total: int, progress: bool | None
) -> Iterator[tuple[int, Outcome]]:
    hidden = None if progress is None else not progress
    with tqdm(total=total, disable=hidden, unit="recording") as bar:
        shown = _Progress(bar, lines=bar.disable and progress is None)
        with listening(shown.hear):
            for item in stream:
                shown.count(item[1])
                yield item


class _Progress:
    """What a bar says, or a line now and then: counts, and what is being done."""

    def __init__(self, bar: tqdm, *, lines: bool) -> None:
        self._bar, self._lines, self._last = bar, lines, time.monotonic()
        self._done, self._counts = 0, Counter[str]()

    def count(self, outcome: Outcome) -> None:
        """One more recording is done."""
        self._done += 1
        self._counts.update(row["status"] for row in outcome.rows)
        self._bar.update()
        self.hear("")

    def hear(self, stage: str) -> None:
        """A stage of a recording begins."""
        told = ", ".join(f"{n} {status}" for status, n in sorted(self._counts.items()))
        note = "; ".join(filter(None, (told, stage)))
        self._bar.set_postfix_str(note, refresh=bool(stage))
        if self._lines and time.monotonic() - self._last > LINE_SECONDS:
            self._last = time.monotonic()
            text = "prepared %d of %d recordings; %s"
            _LOG.info(text, self._done, self._bar.total, note)


def _run_on_ray(jobs: list[Job]) -> Iterator[tuple[int, Outcome]]:
    """Outcomes as they come, with the places of their jobs.

    Joins the cluster that ``RAY_ADDRESS`` names, else starts one on this machine.
    """
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise MissingExtraError("ray", extra="ray") from error
    started = not ray.is_initialized()
    if started:
        ray.init(log_to_driver=False)
    try:
        remote = ray.remote(max_retries=1)(run_job)
        # the other nodes have caches of their own: motions travel with the answer
        running = {remote.remote(job, carry=True): i for i, job in enumerate(jobs)}
        while running:
            (done,), _ = ray.wait(list(running), num_returns=1)
            place = running.pop(done)
            try:
                yield place, ray.get(done)
            except ray.exceptions.RayError:
                yield place, _crashed(jobs[place])
    finally:
        if started:
            ray.shutdown()
