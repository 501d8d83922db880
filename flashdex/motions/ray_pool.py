"""Jobs over a Ray cluster; the recordings must lie where every node sees them."""

from __future__ import annotations

from collections.abc import Iterator

from flashdex.errors import MissingExtraError
from flashdex.motions.jobs import Job, Outcome, crashed, run_job


def run_on_ray(jobs: list[Job]) -> Iterator[tuple[int, Outcome]]:
    """Outcomes as they come, with the places of their jobs.

    Joins the cluster that ``RAY_ADDRESS`` names, else starts one on this machine.

    Args:
        jobs: one a recording.

    Raises:
        MissingExtraError: Ray is not installed.
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
                yield place, crashed(jobs[place])
    finally:
        if started:
            ray.shutdown()
