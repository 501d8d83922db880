"""From a recipe to library, hands, environment and learner."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torchrl.envs.transforms import Transform

from flashdex import keys
from flashdex.algorithms import find_algorithm
from flashdex.algorithms.base import Learner, TaskSpec
from flashdex.datasets.source import SourceOptions, is_named
from flashdex.envs.feedforward import reference_targets
from flashdex.envs.physics.make import check_engine, engine_device, make_physics
from flashdex.envs.reference import ReferenceBank, stack_hands
from flashdex.envs.scene.scene import Scene, build_scenes
from flashdex.envs.tracking import TrackingEnv
from flashdex.envs.transforms.assembly import make_transforms
from flashdex.errors import DemoError, FlashdexError, LibraryError
from flashdex.hands.spec import HandSpec, load_hand
from flashdex.motions.library import MotionLibrary
from flashdex.motions.library_format import MANIFEST, OldLibraryError
from flashdex.motions.pipeline.motion import MotionSettings
from flashdex.motions.pipeline.prepare import Order, hash_inputs, run_order
from flashdex.recipe import Recipe
from flashdex.rollouts.build import RolloutBuilder
from flashdex.rollouts.truth import settings_of
from flashdex.system.machine import versions

JOINT_SLACK = 0.5  # m or rad beyond a hand's range that a reference may ask for
_LOG = logging.getLogger(__name__)


def load_library(recipe: Recipe) -> MotionLibrary:
    """Load the library of a recipe; prepare it where there is none or it is old.

    Raises:
        FlashdexError: it names no motions, or they cannot be read.
    """
    motions = recipe.motions
    if motions.library is not None:
        return MotionLibrary.load(motions.library)
    if motions.source is None:
        raise FlashdexError(
            "motions: neither 'library' nor 'source' is set. Give motions.library=DIR "
            "of a prepared library, or motions.source=procedural."
        )
    folder = Path("libraries") / library_name(recipe)
    order = make_order(recipe)
    if (library := load_current(folder)) is not None:
        try:
            if library.manifest.get("inputs") == hash_inputs(order):
                return library
        except DemoError as error:
            _LOG.info("%s is used as it is; its recordings: %s", folder, error)
            return library
        _LOG.info("the recordings have changed since %s was prepared", folder)
    _LOG.info("preparing motions from '%s' in %s", motions.source, folder)
    return run_order(order, folder)


def load_current(folder: Path) -> MotionLibrary | None:
    """An automatic library; None where there is none of this version."""
    if not (folder / MANIFEST).is_file():
        return None
    try:
        return MotionLibrary.load(folder)
    except OldLibraryError as error:
        _LOG.info("%s", error)
        return None


def make_order(recipe: Recipe) -> Order:
    """What a recipe that names a source has prepared: the motions it asks for."""
    motions = recipe.motions
    assert motions.source is not None
    # made-up motions are made by number, and selected from those
    made_up = motions.source == "procedural"
    select = None if made_up or motions.select is None else tuple(motions.select)
    options = SourceOptions(
        path=None if motions.input is None else Path(motions.input),
        mano=None if motions.mano is None else Path(motions.mano),
        models=None if motions.models is None else Path(motions.models),
        seed=motions.seed,
        select=select,
        limit=motions.count if made_up else None,
    )
    settings = MotionSettings(
        hand=recipe.hand, control_hz=motions.control_hz, speed=motions.speed
    )
    enough = None if made_up else motions.count
    return Order(motions.source, options, settings, enough=enough)


def library_name(recipe: Recipe) -> str:
    """Folder name of an automatic library: readable, and unique by the recipe."""
    motions = dataclasses.asdict(recipe.motions)
    motions.pop("library")
    text = json.dumps({**motions, "hand": recipe.hand}, sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    return f"{recipe.motions.source}-{recipe.hand}-{digest}"


def select_motions(library: MotionLibrary, recipe: Recipe) -> MotionLibrary:
    """Keep the motions named by ``motions.select`` and ``motions.count``.

    Their frames are copied into memory, one motion after the other.
    """
    chosen = list(range(library.num_motions))
    if recipe.motions.select is not None:
        chosen, missing = [], []
        for pattern in recipe.motions.select:
            if recipe.motions.count is not None and len(chosen) >= recipe.motions.count:
                break  # of the others none need be there
            rows = [i for i, n in enumerate(library.names) if is_named(n, pattern)]
            missing += [] if rows else [pattern]
            chosen += [r for r in rows if r not in chosen]
        count = recipe.motions.count
        if missing and (count is None or len(chosen) < count):
            raise LibraryError(
                f"{library.path}: motions.select '{missing[0]}' matches none of "
                f"{', '.join(library.names)}."
            )
    if recipe.motions.count is not None:
        chosen = chosen[: recipe.motions.count]
    if len(chosen) == library.num_motions:
        return library
    return _take(library, chosen)


def _take(library: MotionLibrary, rows: list[int]) -> MotionLibrary:
    index = [
        torch.arange(int(s), int(s) + int(n))
        for s, n in zip(
            library.motions["start"][rows].tolist(),
            library.motions["length"][rows].tolist(),
            strict=True,
        )
    ]
    motions = library.motions[torch.tensor(rows)].clone()
    length = motions["length"]
    motions["start"] = torch.cumsum(length, 0) - length
    manifest = dict(library.manifest)
    manifest["motions"] = [library.manifest["motions"][r] for r in rows]
    return MotionLibrary(
        path=library.path,
        frames=library.frames[torch.cat(index)],
        motions=motions,
        objects=library.objects,
        manifest=manifest,
        content_hash=library.content_hash,
    )


def _check_joints(library: MotionLibrary, hands: dict[keys.Side, HandSpec]) -> None:
    """A hand of the library's name may have changed since, or be another's."""
    found = library.frames["joint_pos"].shape[-1]
    ranges = stack_hands(hands, "joint_range")
    if found != ranges.shape[1]:
        raise LibraryError(
            f"{library.path}: has {found} joints of '{library.hand}', the hand has "
            f"{ranges.shape[1]}. Prepare it again for this hand."
        )
    low, high = ranges[..., 0] - JOINT_SLACK, ranges[..., 1] + JOINT_SLACK
    for row, name in enumerate(library.names):
        start, length = (int(library.motions[k][row]) for k in ("start", "length"))
        pos = library.frames["joint_pos"][start : start + length]
        outside = ((pos < low) | (pos > high)).any(0)
        outside &= library.motions["hand_active"][row].unsqueeze(-1)
        if outside.any():
            side, joint = outside.nonzero()[0].tolist()
            joint_name = hands[keys.SIDES[side]].joint_names[joint]
            raise LibraryError(
                f"{library.path}: motion {name!a} bends '{joint_name}' beyond its "
                "range: it is of another hand. Prepare it again for this one."
            )


def make_bank(
    recipe: Recipe, library: MotionLibrary, hands: dict[keys.Side, HandSpec]
) -> ReferenceBank:
    """Reference frames of the library, and the targets that the recipe starts from."""
    kind = recipe.env.feedforward
    targets = reference_targets(library, hands, recipe.physics, kind)
    return ReferenceBank(library, hands, targets)


@dataclass(frozen=True)
class RunBuilder:
    """Builds the parts of a run: environment, learner, rollouts."""

    recipe: Recipe
    library: MotionLibrary  # prepared, selected motions only
    hands: dict[keys.Side, HandSpec]
    bank: ReferenceBank  # the library as tensors, on the device of the physics

    @classmethod
    def from_recipe(
        cls, recipe: Recipe, *, device: torch.device | None = None
    ) -> RunBuilder:
        """Load or prepare the motions of a recipe and check that they fit it.

        Raises:
            LibraryError: the library is missing, of another hand or of another rate.
        """
        hands = load_hand(recipe.hand)
        library = select_motions(load_library(recipe), recipe)
        if library.hand != recipe.hand:
            raise LibraryError(
                f"{library.path}: prepared for hand '{library.hand}', the recipe asks "
                f"for '{recipe.hand}'. Prepare it again with --hand {recipe.hand}."
            )
        if (library.motions["object_index"] < 0).all():
            raise LibraryError(
                f"{library.path}: no motion has an object, so there is nothing to "
                "follow. Prepare recordings in which an object is held, or select "
                "others with motions.select."
            )
        _check_joints(library, hands)
        step_dt = recipe.physics.timestep * recipe.physics.decimation
        if not math.isclose(library.fps * step_dt, 1.0, rel_tol=1e-3):
            decimation = round(1 / (library.fps * recipe.physics.timestep))
            raise LibraryError(
                f"{library.path}: {library.fps:g} frames a second, but "
                f"physics.timestep x physics.decimation gives {1 / step_dt:g} control "
                f"steps a second. Set physics.decimation={decimation} or prepare with "
                f"--hz {1 / step_dt:g}."
            )
        if device is None:  # else somebody who steps no physics
            check_engine(library, recipe.physics)
            device = engine_device(recipe.physics)
        return cls(recipe, library, hands, make_bank(recipe, library, hands).to(device))

    @cached_property
    def scenes(self) -> list[Scene]:
        """Scenes of all motions; environments and scoring share them."""
        return build_scenes(self.library, self.hands, self.recipe.physics)

    @property
    def step_dt(self) -> float:
        """Control step, s."""
        return self.recipe.physics.timestep * self.recipe.physics.decimation

    def make_env(
        self,
        *,
        num_envs: int | None = None,
        seed: int | None = None,
        evaluation: bool = False,
    ) -> TrackingEnv:
        """Build physics and environment, as the recipe says where None."""
        recipe = self.recipe
        count = recipe.env.num_envs if num_envs is None else num_envs
        physics = make_physics(
            self.library, self.hands, recipe.physics, count, self.scenes
        )
        return TrackingEnv(
            physics,
            self.bank,
            self.hands,
            recipe.env,
            step_dt=self.step_dt,
            seed=recipe.seed if seed is None else seed,
            evaluation=evaluation,
        )

    def bank_on(self, device: torch.device) -> ReferenceBank:
        """The library as tensors on another device; ``bank`` itself on its own."""
        if device == self.bank.table.device:
            return self.bank
        return make_bank(self.recipe, self.library, self.hands).to(device)

    def rollout_builder(
        self,
        scenes: Sequence[Scene] | Mapping[int, Scene],
        *,
        made_by: dict[str, Any] | None = None,
        provenance: dict[str, Any] | None = None,
    ) -> RolloutBuilder:
        """Build what turns episodes into rollouts."""
        recipe, device = self.recipe, self.bank.table.device
        return RolloutBuilder(
            self.bank_on(torch.device("cpu")),
            self.hands,
            scenes,
            decimation=recipe.physics.decimation,
            criterion=recipe.train.criterion,
            seed=recipe.seed,
            made_by=made_by or versions(recipe.physics.engine, device),
            provenance={**(provenance or {}), "physics": settings_of(recipe)},
            motion_hash=self.library.motion_hash,
        )

    def make_transforms(self, bank: ReferenceBank) -> list[Transform]:
        """Build the observation transforms of the recipe on the bank's device."""
        return make_transforms(
            self.recipe.env.transforms,
            bank,
            self.hands,
            reference_offset=self.recipe.env.reference_offset,
        )

    def make_learner(self, env: TrackingEnv) -> Learner:
        """Build the recipe's algorithm for an environment's states.

        Raises:
            FlashdexError: the recipe asks for a device that is not there.
        """
        recipe, device = self.recipe, learner_device(self.recipe)
        bank = self.bank_on(device)
        spec = TaskSpec(
            example=env.reset().to(device),
            action_dim=bank.num_joints,
            vector_steps=recipe.total_env_steps / env.num_envs,
            seed=recipe.seed,
            device=device,
            bank=bank,
            transforms=self.make_transforms(bank),
        )
        return find_algorithm(recipe.algo.kind)(recipe.algo, spec)


def learner_device(recipe: Recipe) -> torch.device:
    """Where a recipe learns; ``algo.device=auto`` is a GPU where there is one.

    Raises:
        FlashdexError: it asks for a GPU, and torch sees none.
    """
    wanted, there = recipe.algo.device, torch.cuda.is_available()
    if wanted == "cuda" and not there:
        raise FlashdexError(
            "algo.device: 'cuda' is not there: torch sees no GPU ('flashdex doctor' "
            "says why). Use algo.device=cpu or auto."
        )
    if wanted == "cpu" or not there:
        return torch.device("cpu")
    return torch.device("cuda", torch.cuda.current_device())
