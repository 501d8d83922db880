"""Following motions as a task: attempts are recorded, judged and stored in a ledger."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex import keys
from flashdex.algorithms.base import Learner
from flashdex.envs.mdp.assist import AssistEpoch
from flashdex.envs.tracking import TrackingEnv
from flashdex.errors import RunError
from flashdex.modules.layers import restore_generator
from flashdex.recipe import Recipe, RunRecipe, dump_recipe, expect_kind
from flashdex.replay.buffer import check_pinning
from flashdex.rollouts.ledger import Ledger, Source
from flashdex.rollouts.recorder import Episode, EpisodeRecorder
from flashdex.rollouts.scorer import InlineScorer, ProcessScorer, Scorer, ScorerSpec
from flashdex.system.files import own_file
from flashdex.system.jsonl import read_object, write_object
from flashdex.system.machine import versions
from flashdex.system.run_files import BASELINES, MOTIONS, run_id
from flashdex.training.baselines import score_baselines
from flashdex.training.build import RunBuilder, learner_device
from flashdex.training.checkpoint import EVALUATED, RESUMED
from flashdex.training.evaluator import evaluate_motions
from flashdex.training.memory.plan import check_memory
from flashdex.training.memory.stand_in import find_library
from flashdex.training.session import SessionStart
from flashdex.training.tasks.base import Task

if TYPE_CHECKING:
    from flashdex.training.trainer import Trainer

_LOG = logging.getLogger(__name__)
_ROOM = {"contacts": "physics.nconmax", "constraints": "physics.njmax"}


class TrackingTask(Task):
    """Attempts at motions, judged and certified."""

    worlds_key = "env.num_envs"
    evaluated_keys, resumed_keys = EVALUATED, RESUMED
    state_keys = (*keys.STATE, keys.ATTEMPT)
    updates_during_step = True

    def __init__(self, builder: RunBuilder) -> None:
        self.builder, self.recipe = builder, builder.recipe

    @classmethod
    def open(cls, recipe: RunRecipe, run_dir: Path | None = None) -> TrackingTask:
        """Prepare the motions; to train, refuse what cannot fit into memory."""
        recipe = expect_kind(recipe, Recipe, where=str(run_dir))
        if run_dir is None:
            return cls(RunBuilder.from_recipe(recipe))
        device = learner_device(recipe)
        if recipe.algo.replay == "pinned":
            check_pinning(device)
        if find_library(recipe) is None:
            check_memory(recipe, run_dir=run_dir)  # before what may be hours
        builder = RunBuilder.from_recipe(recipe)
        _LOG.info("%s", check_memory(recipe, library=builder.library, run_dir=run_dir))
        return cls(builder)

    def make_env(self, *, num_envs: int | None = None) -> TrackingEnv:
        """See ``Task``."""
        return self.builder.make_env(num_envs=num_envs)

    def make_learner(self, env: TrackingEnv) -> Learner:
        """See ``Task``."""
        return self.builder.make_learner(env)

    @cached_property
    def provenance(self) -> dict[str, str]:
        """What a rollout of any run of it comes from."""
        recipe = dump_recipe(self.recipe).encode()
        return {
            "recipe_sha256": hashlib.sha256(recipe).hexdigest(),
            "library_sha256": self.builder.library.content_hash,
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
        }

    @property
    def rows_meaning(self) -> str:
        """What replay rows depend on, hashed."""
        recipe = self.recipe
        rows = {
            "library": self.provenance["library_sha256"],
            "motions": self.builder.bank.names,
            "env": dataclasses.asdict(recipe.env),
            "physics": dataclasses.asdict(recipe.physics),
            "return": [recipe.algo.n_step, recipe.algo.gamma],
        }
        text = json.dumps(rows, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def check_inputs(self, run_dir: Path) -> None:
        """Refuse motions that have the names of the run's, and are others.

        Raises:
            RunError: the library was changed or exchanged.
        """
        known = read_object(run_dir, MOTIONS).get("motions", {})
        now = self.contents
        others = [name for name in now if known.get(name, now[name]) != now[name]]
        if others:
            raise RunError(
                f"{self.builder.library.path}: {len(others)} of {len(now)} motions are "
                f"not those that {run_dir} was trained on, {', '.join(others[:3])!a}: "
                "the library was changed. Restore it, or start a new run."
            )

    @cached_property
    def contents(self) -> dict[str, str]:
        """Hash of the content of each motion, by name."""
        library = self.builder.library
        return {n: library.motion_hash(row) for row, n in enumerate(library.names)}

    def _remember_motions(self, run_dir: Path) -> None:
        known = read_object(run_dir, MOTIONS).get("motions", {})
        if not self.contents.keys() <= known.keys():
            everything = {"motions": {**known, **self.contents}}
            write_object(everything, run_dir, MOTIONS)

    def prepare(self, run_dir: Path, env: TrackingEnv) -> None:
        """Score the baselines, what is new of them, and open the ledger."""
        self.env, self.run_dir = env, run_dir
        self.assist_epoch = AssistEpoch(env.terms.gates)
        self.ledger = self.open_ledger(run_dir, on_gpu=env.device.type == "cuda")

    def open_ledger(
        self, run_dir: Path, *, on_gpu: bool = False, source: Source = "policy"
    ) -> Ledger:
        """Note the motions, score what is new of the baselines, open the ledger."""
        self._remember_motions(run_dir)
        baselines = score_baselines(self.builder, own_file(run_dir, BASELINES))
        trivial = baselines.trivial(self.recipe.train.criterion)
        return open_ledger(self.builder, run_dir, trivial, on_gpu=on_gpu, source=source)

    def begin(self, start: SessionStart, state: dict[str, Any] | None) -> None:
        """Take in what a crash left in the ledger, and open recorder and scorer."""
        ledger = self.ledger
        if state is not None and ledger.num_bytes < state["ledger_bytes"]:
            _LOG.warning(
                "%s is shorter than at the checkpoint: attempts are missing",
                ledger.path,
            )
        for name in ledger.adopt(wall_s=start.wall_s):
            _LOG.info("%s: its stored rollout had no line yet, and has one now", name)
        for name in ledger.done:
            self._mark_converted(name)
        self.scorer: Scorer = self._open_scorer()
        self.recorder = EpisodeRecorder(self.env)

    def _open_scorer(self) -> Scorer:
        """In the loop, or in a process where the physics would wait for it."""
        recipe, env = self.recipe, self.env
        made_by = versions(recipe.physics.engine, env.device)
        provenance = {**self.provenance, "run": run_id(self.run_dir)}
        where = recipe.train.judge
        if where == "inline" or (where == "auto" and env.is_host_device):
            builder = self.builder.rollout_builder(
                env.physics.scenes, made_by=made_by, provenance=provenance
            )
            return InlineScorer(self.ledger, builder)
        # The process must not prepare the motions again: name the library in use.
        library = str(self.builder.library.path)
        motions = dataclasses.replace(recipe.motions, library=library)
        spec = ScorerSpec(
            dataclasses.replace(recipe, motions=motions),
            self.run_dir,
            made_by,
            provenance,
            self.ledger.trivial,
            self.ledger.on_gpu,
        )
        return ProcessScorer(self.ledger, spec, make_inline_scorer)

    def after_reset(self) -> None:
        """Keep the state that the coming step starts from."""
        self.recorder.record_start()

    def after_physics(self, trainer: Trainer, action: Tensor, done: Tensor) -> None:
        """Record the step and score what has ended; the learner may be at work."""
        with trainer.stats.time("judge"):
            episodes = self.recorder.record_step(action, done, trainer.env_steps)
            self._score(episodes, trainer.wall_s)

    def after_step(self, trainer: Trainer, after: TensorDictBase) -> None:
        """Count rewards, errors and ends; let the assist fade."""
        scored = self.env.last_step, after[keys.DONE], after[keys.TERMINATED]
        trainer.stats.add_step(*scored)
        self.assist_epoch.step(self.env, *scored, trainer.vector_steps)

    def rewards(self, after: TensorDictBase) -> Tensor:
        """Rewards of both hands, (N, 2)."""
        return torch.cat([after[keys.reward(side)] for side in keys.SIDES], -1)

    def _score(
        self, episodes: list[Episode], wall_s: float, *, wait: bool = False
    ) -> None:
        for episode in episodes:
            self.scorer.submit(episode, wall_s)
        for motion in self.scorer.collect(wait=wait):
            self._mark_converted(motion)

    def _mark_converted(self, name: str) -> None:
        row = self.env.bank.names.index(name)
        self.env.sampler.mark_converted(row)
        self.env.attempt_sampler.mark_converted(row)

    def settle(self, trainer: Trainer) -> RunError | None:
        """Score all attempts so far; what was learnt is not lost with the scorer."""
        try:
            self._score(self.recorder.finished(), trainer.wall_s, wait=True)
        except RunError as error:
            return error
        return None

    def end_reason(self) -> str:
        """``all converted``, when that ends the run."""
        everything = len(self.ledger.done) == len(self.ledger.names)
        stops = self.recipe.train.stop_when_all_converted
        return "all converted" if stops and everything else ""

    @property
    def note(self) -> str:
        """What was achieved, in a few words."""
        return self.ledger.note

    @property
    def num_results(self) -> int:
        """Attempts scored so far."""
        return self.ledger.num_attempts

    def metrics(self, trainer: Trainer) -> dict[str, float]:
        """Conversions and assist; the engine's overflow is read and cleared."""
        assist, physics = self.env.assist, self.env.physics
        record = {
            **self.ledger.metrics(trainer.wall_s / 3600),
            "convert/pending": float(self.scorer.pending),
            "assist/level": assist.upper[0] if assist is not None else 0.0,
        }
        for kind, worlds in physics.take_overflow().items():
            record[f"physics/overflow_{kind}"] = worlds
            _LOG.warning(
                "%d of %d worlds ran out of room for %s: the engine dropped some, so "
                "these worlds were wrong for a while%s",
                worlds,
                self.env.num_envs,
                kind,
                f". Raise {_ROOM[kind]}" if kind in _ROOM else "",
            )
        return record

    def state_dict(self) -> dict[str, Any]:
        """Assist, resets and the length of the ledger, its attempts all scored.

        The samplers hold nothing but what the conversions say, and those are in files.
        """
        assist = self.env.assist
        return {
            "assist": None if assist is None else assist.state_dict(),
            "assist_epoch": self.assist_epoch.state_dict(),
            "env_generator": self.env.generator.get_state(),
            "ledger_bytes": self.ledger.num_bytes,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore ``state_dict``."""
        self.assist_epoch.load_state_dict(state["assist_epoch"])
        if self.env.assist is not None and state["assist"] is not None:
            self.env.assist.load_state_dict(state["assist"])
            self.env.redraw_assist()
        restore_generator(self.env.generator, state["env_generator"])

    def evaluate(self, learner: Learner, env_steps: int) -> dict[str, Any]:
        """See ``Task``."""
        return evaluate_motions(self.builder, learner, env_steps=env_steps)

    def close(self, *, wait: bool) -> None:
        """End the scorer; ``wait`` scores what is in line first."""
        self.scorer.close(wait=wait)


def open_ledger(
    builder: RunBuilder,
    run_dir: Path,
    trivial: dict[str, list[str]],
    *,
    on_gpu: bool,
    source: Source = "policy",
) -> Ledger:
    """The ledger of a run; ``trivial``: which baselines already pass a motion."""
    recipe = builder.recipe
    return Ledger(
        run_dir,
        builder.bank.names,
        criterion=recipe.train.criterion,
        seed=recipe.seed,
        engine=recipe.physics.engine,
        on_gpu=on_gpu,
        certify=recipe.train.certify,
        trivial=trivial,
        source=source,
    )


def make_inline_scorer(spec: ScorerSpec) -> InlineScorer:
    """Build the scorer of the scoring process."""
    builder = RunBuilder.from_recipe(spec.recipe, device=torch.device("cpu"))
    rollouts = builder.rollout_builder(
        builder.scenes, made_by=spec.made_by, provenance=spec.provenance
    )
    ledger = open_ledger(builder, spec.run_dir, spec.trivial, on_gpu=spec.on_gpu)
    return InlineScorer(ledger, rollouts)
