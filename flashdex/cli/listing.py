"""`flashdex ls`: recipes, what goes into them, hands, recordings."""

from __future__ import annotations

import json
from typing import Any

from flashdex.datasets import describe_sources
from flashdex.hands import known_hands
from flashdex.recipe.store import (
    RecipeEntry,
    format_listing,
    list_options,
    list_recipes,
)

_TITLES = {
    "hand": "hand=NAME",
    "motions": "motions=NAME",
    "physics": "physics=NAME, the engine",
    "world": "world=NAME, its friction and what else flatters or not",
    "algo": "algo=NAME, the algorithm and its sizes",
    "logger": "logger=NAME",
    "ablation": "ablation=NAME, or several: 'ablation=[a,b]'",
}


def listing() -> str:
    """Everything that can be named, one line each, laid out for a terminal."""
    options = list_options()
    parts = ["recipes (flashdex train NAME):", _indent(format_listing(list_recipes()))]
    for group in sorted(options, key=lambda g: [*_TITLES, g].index(g)):
        text = _indent(format_listing(options[group]))
        parts += ["", f"{_TITLES.get(group, f'{group}=NAME')}:", text]
    rows = [f"{name:<11} {about}" for name, about in describe_sources().items()]
    title = "recordings (flashdex prepare --source NAME):"
    parts += ["", title, _indent("\n".join(rows))]
    return "\n".join([*parts, "", f"hands: {', '.join(known_hands())}"])


def listing_json() -> str:
    """The same as JSON, for programs."""
    found = {
        "recipes": [_plain(entry) for entry in list_recipes()],
        "options": {
            g: [_plain(e) for e in found] for g, found in list_options().items()
        },
        "hands": known_hands(),
        "sources": describe_sources(),
    }
    return json.dumps(found, indent=1)


def _plain(entry: RecipeEntry) -> dict[str, Any]:
    return {
        "name": entry.name,
        "path": str(entry.path),
        "about": entry.headline,
        "expect": entry.expect,
        "problem": entry.problem,
    }


def _indent(text: str) -> str:
    return "\n".join(f"  {line}" for line in text.splitlines())
