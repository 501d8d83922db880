"""A new dataset is one file: it is found, listed, checked in recipes and prepared."""

import subprocess
import sys

import numpy as np
import pytest

from flashdex import datasets
from flashdex.datasets import get_source, list_recordings, source_names
from flashdex.datasets.procedural.reader import procedural
from flashdex.datasets.source import Recording, Source, SourceOptions
from flashdex.errors import DemoError, UnknownSourceError
from flashdex.motions.pipeline.motion import MotionSettings
from flashdex.motions.pipeline.prepare import Order, run_order

TOY = '''
"""Reads one made-up motion."""

from flashdex.datasets.procedural.reader import procedural
from flashdex.datasets.source import Recording, Source


def read():
    (demo,) = procedural(0, kinds=["pick_sphere_right"])
    demo.source = SOURCE.name
    return [demo]


def list_toy(options):
    return [Recording(name="one", read=read, key=str(options.seed))]


SOURCE = Source(name="toy", list=list_toy, about="a toy", needs=())
'''


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """A folder beside the package's own, with one reader in it."""
    (tmp_path / "toy.py").write_text(TOY)
    monkeypatch.setattr(datasets, "__path__", [*datasets.__path__, str(tmp_path)])
    yield "toy"
    sys.modules.pop("flashdex.datasets.toy", None)


def test_every_reader_is_called_like_its_source():
    names = source_names()
    assert {"procedural", "keypoints", "arctic", "taco"} < set(names)
    assert [get_source(name).name for name in names] == names
    assert "body_models" not in names


def test_a_dataset_is_one_file(tmp_path, toy):
    assert toy in source_names()
    assert "toy" in datasets.describe_sources()
    with pytest.raises(UnknownSourceError, match=r"toy.*Did you mean 'toy'"):
        get_source("tooy")
    settings = MotionSettings(cache_dir=tmp_path / "cache", control_hz=30.0)
    order = Order(toy, SourceOptions(), settings)
    library = run_order(order, tmp_path / "library", progress=False)
    (motion,) = library.manifest["motions"]
    assert motion["source"] == "toy"


def test_a_reader_may_live_anywhere(monkeypatch):
    monkeypatch.setattr(datasets, "REGISTERED", {})
    made = {"list": lambda options: [Recording(name="a", read=list)], "about": "mine"}
    datasets.register(Source(name="mine", needs=("models",), **made))
    assert "mine" in source_names()
    with pytest.raises(DemoError, match=r"mine: give --models\. It reads mine"):
        list_recordings("mine", SourceOptions())


def test_names_are_listed_without_the_readers():
    ask = "import sys, flashdex.datasets as d, flashdex.recipe.motions as m; "
    ask += "assert 'arctic' in d.source_names(); "
    ask += "print([n for n in sys.modules if n.startswith('flashdex.datasets.')])"
    done = subprocess.run(
        [sys.executable, "-c", ask], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "['flashdex.datasets.source']"


def test_palms_are_those_of_the_keypoints_by_default():
    (demo,) = procedural(0, kinds=["pick_sphere_right"])
    palm = demo.palm["right"].copy()
    given = type(demo)("a", demo.fps, demo.keypoints, {"right": palm + 1}, demo.objects)
    made = type(demo)("a", demo.fps, demo.keypoints, objects=demo.objects)
    np.testing.assert_array_equal(made.palm["right"], palm)
    np.testing.assert_array_equal(given.palm["right"], palm + 1)


def test_codes_are_a_field_of_the_error():
    error = DemoError("file: lacks pose.", code="E_KEYS")
    assert (error.code, error.text) == ("E_KEYS", "file: lacks pose.")
    assert str(error) == "E_KEYS: file: lacks pose."
    plain = DemoError("too short")
    assert (plain.code, str(plain)) == (None, "too short")


@pytest.fixture
def shelf(monkeypatch):
    """A source of five recordings, one of them with brackets in its name."""
    monkeypatch.setattr(datasets, "REGISTERED", {})
    names = ("cup_1", "cup_2", "pour[1]", "pour1", "bowl")
    listed = [Recording(name=name, read=list) for name in names]
    datasets.register(Source(name="shelf", list=lambda _: listed, about="", needs=()))
    return "shelf"


@pytest.mark.parametrize(
    ("select", "limit", "expected"),
    [
        (None, None, ["cup_1", "cup_2", "pour[1]", "pour1", "bowl"]),
        (None, 2, ["cup_1", "cup_2"]),
        (("bowl", "cup_*"), None, ["bowl", "cup_1", "cup_2"]),
        (("bowl", "cup_*"), 1, ["bowl"]),
        (("cup_*", "cup_2"), 5, ["cup_1", "cup_2"]),
        (("pour[1]",), None, ["pour[1]", "pour1"]),  # literally, and as a glob
        (("cup_1_b",), None, ["cup_1"]),  # a piece
        (("*_b",), 1, ["cup_1", "cup_2", "pour[1]", "pour1", "bowl"]),
    ],
    ids=["all", "first", "chosen", "chosen_first", "once", "literal", "piece", "any"],
)
def test_only_what_is_asked_for_is_prepared(shelf, select, limit, expected):
    options = SourceOptions(select=select, limit=limit)
    assert [r.name for r in list_recordings(shelf, options)] == expected


BOWL_AND_CUPS = ["bowl", "cup_1", "cup_2"]


def test_a_recipe_asks_for_its_selection_only(shelf):
    """`train myodm_xhand motions.count=1` once prepared all 95 clips."""
    from flashdex.recipe import Recipe
    from flashdex.recipe.motions import MotionsConfig
    from flashdex.training.build import library_name, make_order

    def order(**motions):
        config = MotionsConfig(source="myodm", select=["bowl", "cup_*"], **motions)
        return Recipe(name="any", total_env_steps=1, motions=config)

    asked = make_order(order(count=1))
    assert [r.name for r in list_recordings(shelf, asked.options)] == BOWL_AND_CUPS
    assert asked.enough == 1
    assert library_name(order()) != library_name(order(count=1))
