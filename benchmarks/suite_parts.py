"""What the parts of `device_suite.py` run, most important first."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

PARTS = ("env", "train", "learner", "replay", "curve")
CURVE_LIBRARY = "procedural50"
RECIPE = "bench50_xhand"  # the paper's settings
FEW_WORLDS = "env.attempt_share=0.5"  # of a handful there must be one


@dataclass(frozen=True)
class Job:
    """One command: a module and its words.

    Attributes:
        name: in the lines of results.
        words: after `python -m`.
        limit_s: it is stopped after that many seconds.
        watch: file of JSON lines that grows while it runs, or None.
    """

    name: str
    words: list[str]
    limit_s: float
    watch: Path | None = field(default=None)


@dataclass(frozen=True)
class Choice:
    """What a call of the suite asks for.

    Attributes:
        engine: of the physics.
        libraries: folder of the prepared libraries.
        tiny: sizes that show on any computer that the commands work.
        minutes: of the whole call.
        overrides: ``key=value`` changes of the recipe, last.
        scratch: folder for runs.
    """

    engine: str
    libraries: Path
    tiny: bool
    minutes: float
    overrides: list[str]
    scratch: Path


def jobs_of(part: str, choice: Choice) -> list[Job]:
    """The jobs of a part.

    Args:
        part: one of `PARTS`.
        choice: sizes and folders.
    """
    makers = {
        "env": _env,
        "train": _train,
        "learner": _learner,
        "replay": _replay,
        "curve": _curve,
    }
    return makers[part](choice)


def _scene(choice: Choice, objects: int, hulls: int, worlds: int | None) -> list[str]:
    words = ["--recipe", RECIPE, "--libraries", str(choice.libraries)]
    words += ["--objects", str(objects), "--hulls", str(hulls)]
    return words if worlds is None else [*words, "--num-envs", str(worlds)]


def _env(choice: Choice) -> list[Job]:
    worlds = (8, 16) if choice.tiny else (4096, 8192, 2048, 16384, 1024)
    sizes = [(2, 16, n) for n in worlds]
    if not choice.tiny:
        sizes += [(2, 1, 4096), (2, 4, 4096), (2, 8, 4096), (1, 16, 4096), (1, 1, 4096)]
    times = ["--seconds", "0.5" if choice.tiny else "8"]
    # compiling would be most of a job's time; the full loop has it
    changes = [f"physics={choice.engine}", "env.compile=false"]
    changes += [FEW_WORLDS] * choice.tiny + choice.overrides
    return [
        Job(
            f"env o{objects} h{hulls} n{n}",
            ["benchmarks.env", *_scene(choice, objects, hulls, n), *times, *changes],
            limit_s=180,
        )
        for objects, hulls, n in sizes
    ]


def _train(choice: Choice) -> list[Job]:
    small = ["algo.batch_size=64", "algo.critic_width=16", "algo.actor_width=16"]
    small += ["algo.buffer_size=2000", "algo.compile=false", "env.compile=false"]
    small += [FEW_WORLDS]
    large = ["algo.bfloat16=true"]
    changes = [f"physics={choice.engine}", *(small if choice.tiny else large)]
    changes += choice.overrides
    times = ["--seconds", "2" if choice.tiny else "40"]
    times += ["--ceiling-seconds", "0.5" if choice.tiny else "6"]
    return [
        Job(
            f"train n{n}",
            ["benchmarks.train", *_scene(choice, 2, 16, n), *times, *changes],
            limit_s=300,
        )
        for n in ((8,) if choice.tiny else (4096, 8192, 2048))
    ]


def _learner(choice: Choice) -> list[Job]:
    words = ["benchmarks.learner", "--sizes", "tiny" if choice.tiny else "paper"]
    words += ["--device", "auto"]
    rounds = ["--rounds", "2" if choice.tiny else "10"]
    fast = [*words, *rounds, "--precision", "high", "--autocast"]
    jobs = [Job("learner tf32 bfloat16", fast, limit_s=240)]
    if not choice.tiny:
        jobs.append(Job("learner compiled", [*fast, "--compile"], limit_s=420))
        jobs.append(Job("learner float32", [*words, *rounds], limit_s=240))
    return jobs


def _replay(choice: Choice) -> list[Job]:
    sizes = [("auto", "20k"), ("cpu", "20k")]
    if not choice.tiny:
        sizes = [("device", "50M"), ("pinned", "50M"), ("device", "1M")]
        sizes += [("device", "10M"), ("pinned", "10M"), ("cpu", "1M")]
    words = ["benchmarks.replay", *_scene(choice, 2, 1, None)]
    if choice.tiny:
        words += ["--batch", "64", "--seconds", "0.2", "algo.compile=false"]
    words += ["env.compile=false"]  # its rows are what is wanted of the environment
    words += choice.overrides
    return [
        Job(
            f"replay {place} {rows}",
            [*words, "--replay", place, "--rows", rows],
            limit_s=240,
        )
        for place, rows in sizes
    ]


def _curve(choice: Choice) -> list[Job]:
    run = choice.scratch / "curve"
    # the rest of the call is for building the scenes and the last checkpoint
    limit = max(0.5, choice.minutes - (0.2 if choice.tiny else 1.5)) * 60
    words = [
        "flashdex.cli.main",
        "train",
        RECIPE,
        f"motions.library={choice.libraries / CURVE_LIBRARY}",
        f"run_dir={run}",
        f"physics={choice.engine}",
        f"train.wall_limit_s={limit:g}",
        "train.render_conversions=false",
        "train.checkpoint_every_s=100000",
    ]
    if choice.tiny:
        words += ["env.num_envs=8", "algo.batch_size=32", "algo.critic_width=16"]
        words += ["motions.count=1", "algo.buffer_size=2000", "algo.min_buffer=64"]
        words += ["algo.compile=false", "env.compile=false", "total_env_steps=160"]
        words += [FEW_WORLDS]
    else:
        words += ["env.num_envs=4096", "total_env_steps=30_000_000"]
        words += ["algo.bfloat16=true"]
    words += choice.overrides
    return [Job("curve", words, limit_s=60 * choice.minutes, watch=run / WATCHED)]


WATCHED = "metrics.jsonl"
