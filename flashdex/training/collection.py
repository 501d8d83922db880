"""The motions a recipe asks for: loaded, or prepared first."""

from __future__ import annotations

import dataclasses
import fnmatch
import hashlib
import json
import logging
from pathlib import Path

import torch

from flashdex.datasets.source import SourceOptions
from flashdex.errors import DemoError, FlashdexError, LibraryError
from flashdex.motions.library import MotionLibrary
from flashdex.motions.pipeline.motion import MotionSettings
from flashdex.motions.pipeline.prepare import Order, hash_inputs, run_order
from flashdex.recipe import Recipe

_LOG = logging.getLogger(__name__)


def load_library(recipe: Recipe) -> MotionLibrary:
    """Load the library of a recipe; prepare it where there is none or it is old.

    Args:
        recipe: validated recipe.

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
    order = _order(recipe)
    if (folder / "manifest.json").is_file():
        library = MotionLibrary.load(folder)
        try:
            if library.manifest.get("inputs") == hash_inputs(order):
                return library
        except DemoError as error:
            _LOG.info("%s is used as it is; its recordings: %s", folder, error)
            return library
        _LOG.info("the recordings have changed since %s was prepared", folder)
    _LOG.info("preparing motions from '%s' in %s", motions.source, folder)
    return run_order(order, folder)


def _order(recipe: Recipe) -> Order:
    motions = recipe.motions
    assert motions.source is not None
    # made-up motions are made by number; of recorded ones, the selection is counted
    counted = motions.source == "procedural" or motions.select is None
    options = SourceOptions(
        path=None if motions.input is None else Path(motions.input),
        mano=None if motions.mano is None else Path(motions.mano),
        models=None if motions.models is None else Path(motions.models),
        seed=motions.seed,
        limit=motions.count if counted else None,
    )
    settings = MotionSettings(
        hand=recipe.hand, control_hz=motions.control_hz, speed=motions.speed
    )
    return Order(motions.source, options, settings)


def library_name(recipe: Recipe) -> str:
    """Folder name of an automatic library: readable, and unique by the recipe."""
    motions = dataclasses.asdict(recipe.motions)
    for key in ("library", "select"):
        motions.pop(key)
    text = json.dumps({**motions, "hand": recipe.hand}, sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    return f"{recipe.motions.source}-{recipe.hand}-{digest}"


def select_motions(library: MotionLibrary, recipe: Recipe) -> MotionLibrary:
    """Keep the motions named by ``motions.select`` and ``motions.count``.

    Their frames are copied into memory, one motion after the other.
    """
    chosen = list(range(library.num_motions))
    if recipe.motions.select is not None:
        chosen = []
        for pattern in recipe.motions.select:
            rows = [
                i
                for i, name in enumerate(library.names)
                if fnmatch.fnmatch(name, pattern)
            ]
            if not rows:
                raise LibraryError(
                    f"{library.path}: motions.select '{pattern}' matches none of "
                    f"{', '.join(library.names)}."
                )
            chosen += [r for r in rows if r not in chosen]
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
    )
