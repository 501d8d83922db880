"""A new hand is one folder: it is found, named in messages, and built into a scene."""

from __future__ import annotations

import dataclasses
import shutil
import sys
from pathlib import Path

import pytest

import flashdex.hands
from flashdex.errors import RecipeError, UnknownHandError
from flashdex.hands import known_hands
from flashdex.hands.spec import load_hand
from flashdex.recipe import compose, validate
from flashdex.system.mjcf import ModelError


@pytest.fixture
def toy_hand(tmp_path, monkeypatch):
    """A folder of its own with the XHand's models."""
    folder = tmp_path / "toyhand"
    shutil.copytree(Path(flashdex.hands.__path__[0]) / "xhand", folder)
    right = folder / "right.xml"
    before = right.read_text()
    right.write_text(before.replace("<mujoco", "<!-- a toy --><mujoco", 1))
    monkeypatch.setattr(
        flashdex.hands, "__path__", [*flashdex.hands.__path__, str(tmp_path)]
    )
    yield "toyhand"
    sys.modules.pop("flashdex.hands.toyhand", None)


def test_a_hand_is_one_folder(toy_hand):
    assert toy_hand in known_hands()
    hand = load_hand(toy_hand)["right"]
    assert hand.name == toy_hand
    assert "a toy" in hand.mjcf
    recipe = dataclasses.replace(compose("quickstart"), hand=toy_hand)
    assert validate(recipe).hand == toy_hand
    with pytest.raises(UnknownHandError, match="Did you mean 'toyhand'"):
        load_hand("toyhnd")


def test_without_its_folder_it_is_no_hand():
    recipe = dataclasses.replace(compose("quickstart"), hand="toyhand")
    with pytest.raises(RecipeError, match=r"'toyhand' is not a hand.*Known: xhand"):
        validate(recipe)


def test_a_hand_that_reads_other_files_is_refused(toy_hand):
    right = Path(flashdex.hands.__path__[-1]) / toy_hand / "right.xml"
    text = right.read_text()
    right.write_text(
        text.replace("<worldbody", '<include file="/etc/passwd"/><worldbody')
    )
    with pytest.raises(ModelError, match=r"right\.xml: <include> is not allowed"):
        load_hand(toy_hand)
