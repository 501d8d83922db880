"""Recipe files from anybody: one message each, nothing runs, waits or grows."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import pytest

from flashdex.cli.main import main
from flashdex.errors import FlashdexError, RecipeError
from flashdex.recipe import compose, load_recipe
from flashdex.recipe.merge import validate_paths
from flashdex.recipe.overrides import MAX_RUNS, expand_sweeps, merge, parse_overrides
from flashdex.recipe.reader import MAX_BYTES, parse_yaml
from flashdex.recipe.store import list_recipes

GOOD = "defaults: [{motions: procedural}, _self_]\ntotal_env_steps: 1_000_000\n"
ROOT = Path(__file__).parents[2]
LETTERS = "bcdefghijk"


def laughs(value: str) -> str:
    """Nine levels of nine aliases each: 9^9 values."""
    lines = ["a: &a [x, x]", *(f"{b}: &{b} {value}" for b in LETTERS[:9])]
    pairs = zip("a" + LETTERS, lines, strict=False)
    last = ""
    out = []
    for name, line in pairs:
        out.append(line.replace("*", f"*{last}") if last else line)
        last = name
    return "\n".join(out)


BAD_TEXTS = {
    "scalar": "hello",
    "list": "[1, 2]",
    "not_yaml": "total_env_steps: [1, 2",
    "two_documents": "a: 1\n---\nb: 1",
    "number_of_sixties": GOOD + "seed: 1" + ":00" * 300_000,
    "number_of_bits": GOOD + "seed: 0b" + "1" * 4000,
    "number_of_hex_digits": GOOD + "seed: 0x" + "f" * 900_000,
    "unknown_keys": GOOD + "".join(f"key_of_nobody_{i}: 1\n" for i in range(9000)),
    "deep_lists": "a: " + "[" * 100_000,
    "deep_maps": "{a: " * 100_000,
    "deep_blocks": "\n".join(f"{' ' * i}a:" for i in range(900)),
    "alias_of_itself": "a: &a [*a]",
    "billion_laughs": laughs("[*,*,*,*,*,*,*,*,*]"),
    "billion_merges": laughs("{<<: [*,*,*,*,*,*,*,*,*]}").replace("[x, x]", "{x: 1}"),
    "python_call": "a: !!python/object/apply:os.system ['touch ran']",
    "python_new": "a: !!python/object/new:os.system ['touch ran']",
    "python_module": "a: !!python/module:antigravity",
    "python_path": "a: !!python/object/apply:pathlib.PosixPath [x]",
    "own_tag": "a: !mine 1",
    "bytes": "a: !!binary aGVsbG8=",
    "set": "a: !!set {x}",
    "date": "a: !!timestamp 2020-01-01",
    "long_integer": "seed: " + "9" * 5000,
    "key_twice": "seed: 1\nseed: 2",
    "key_of_number": "1: 2",
    "key_of_list": "? [a]\n: 1",
    "nul": "a: \0",
    "many_values": "a: [" + "1," * 400_000 + "]",
    "values_of_defaults": GOOD + "defaults: 3",
    "resolver": GOOD + "run_dir: ${oc.env:SECRET}",
    "resolver_nested": GOOD + "run_dir: ${${run_dir}:SECRET}",
    "resolver_in_text": GOOD + "name: a-${oc.env:SECRET,x}-b",
    "resolver_in_list": GOOD + "logger: {wandb_tags: ['${oc.decode:x}']}",
    "interpolation_bomb": GOOD + "a: ${b}${b}\nb: ${c}${c}\nc: ${a}${a}\nrun_dir: ${a}",
    "hydra_searchpath": GOOD + "hydra: {searchpath: ['pkg://imported_by_recipe']}",
    "hydra_launcher": "defaults: [{override hydra/launcher: joblib}, _self_]",
    "target_at_the_top": GOOD + "_target_: imported_by_recipe.run",
    "target_in_algo": GOOD + "algo: {_target_: imported_by_recipe.run}",
    "target_in_physics": GOOD + "physics: {_target_: imported_by_recipe.run}",
    "target_of_a_term": GOOD
    + "env: {rewards: {a: {_target_: imported_by_recipe.run}}}",
    "source_as_a_module": GOOD + "motions: {source: imported_by_recipe}",
    "hand_as_a_module": GOOD + "hand: imported_by_recipe",
    "algorithm_as_a_module": GOOD + "algo: {kind: imported_by_recipe.run}",
    "includes_itself": "defaults: [mine, _self_]\ntotal_env_steps: 5",
    "includes_a_path": "defaults: [../mine, _self_]\ntotal_env_steps: 5",
    "group_by_a_path": "defaults: [{../..: mine}, _self_]\ntotal_env_steps: 5",
    "option_by_a_path": "defaults: [{hand: ../mine}, _self_]\ntotal_env_steps: 5",
    "unknown_package": "# @package foo.bar\n" + GOOD,
    "name_is_a_path": GOOD + "name: ../evil",
    "ablation_is_a_path": GOOD + "ablation: ../evil",
    "name_too_long": GOOD + f"name: {'n' * 300}",
    "run_dir_too_long": GOOD + f"run_dir: {'n' * 300}",
    "run_dir_with_line": GOOD + 'run_dir: "a\\nb"',
    "task_is_a_list": GOOD + "task: [gym]",
}
BAD_BYTES = {
    "binary": bytes(range(256)),
    "latin_1": "# é\n".encode("latin-1") + GOOD.encode(),
    "utf_16": GOOD.encode("utf-16"),
    "utf_32": GOOD.encode("utf-32"),
    "huge": b"#" * (MAX_BYTES + 1),
    "zeros": bytes(1000),
}


@pytest.fixture
def refused(tmp_path, monkeypatch, capsys):
    """Validate a file called mine.yaml; return the one message it is refused with."""
    (tmp_path / "imported_by_recipe.py").write_text("open('ran', 'w').close()")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("SECRET", "hunter2")

    def call():
        start = time.process_time()
        tracemalloc.start()
        assert main(["validate", "mine.yaml"]) == 2
        grown = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        captured = capsys.readouterr()
        assert time.process_time() - start < 20
        assert grown < 300e6
        assert captured.out == ""
        assert "Traceback" not in captured.err
        assert "hunter2" not in captured.err
        assert len(captured.err) < 4000
        assert not (tmp_path / "ran").exists()
        assert "imported_by_recipe" not in sys.modules
        return captured.err

    return call


@pytest.mark.parametrize("text", BAD_TEXTS.values(), ids=BAD_TEXTS)
def test_a_bad_text_is_refused_and_nothing_runs(text, refused, tmp_path):
    (tmp_path / "mine.yaml").write_text(text)
    assert "mine" in refused()


@pytest.mark.parametrize("content", BAD_BYTES.values(), ids=BAD_BYTES)
def test_other_bytes_are_refused(content, refused, tmp_path):
    (tmp_path / "mine.yaml").write_bytes(content)
    assert "mine.yaml" in refused()


def test_the_good_text_is_good(tmp_path):
    """Or the refusals above would mean nothing."""
    (tmp_path / "mine.yaml").write_text(GOOD)
    assert main(["validate", str(tmp_path / "mine.yaml")]) == 0


MAKERS = {
    "pipe": os.mkfifo,
    "folder": os.mkdir,
    "device": lambda path: os.symlink("/dev/zero", path),
    "dangling_link": lambda path: os.symlink("nowhere", path),
    "link_to_itself": lambda path: os.symlink("mine.yaml", path),
}


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_what_is_no_file_is_refused_without_waiting(make, refused, tmp_path):
    make(tmp_path / "mine.yaml")
    assert "mine.yaml" in refused()


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_a_stored_recipe_is_read_in_the_same_way(make, tmp_path):
    make(tmp_path / "recipe.yaml")
    with pytest.raises(FlashdexError):
        load_recipe(tmp_path / "recipe.yaml")


@pytest.mark.parametrize("name", ["billion_laughs", "resolver", "python_call"])
def test_a_stored_recipe_is_held_to_the_same(name, tmp_path):
    (tmp_path / "recipe.yaml").write_text(BAD_TEXTS[name])
    with pytest.raises(RecipeError):
        load_recipe(tmp_path / "recipe.yaml")


def test_a_mark_of_byte_order_is_let_pass(tmp_path):
    (tmp_path / "mine.yaml").write_bytes(b"\xef\xbb\xbf" + GOOD.encode())
    assert compose(tmp_path / "mine.yaml").total_env_steps == 1_000_000


def test_groups_that_name_each_other_end(tmp_path, monkeypatch):
    folder = tmp_path / "recipes" / "ablation"
    folder.mkdir(parents=True)
    for one, other in ("ab", "ba"):
        (folder / f"{one}.yaml").write_text(f"defaults: [{other}, {other}]\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RecipeError, match="includes itself"):
        compose("quickstart", ["ablation=a"])


def test_a_chain_of_many_files_ends(tmp_path, monkeypatch):
    """Each names the next one twice: 2^20 files."""
    (tmp_path / "recipes").mkdir()
    for i in range(20):
        text = f"defaults: [r{i + 1}, r{i + 1}]\n"
        (tmp_path / "recipes" / f"r{i}.yaml").write_text(text)
    (tmp_path / "recipes" / "r20.yaml").write_text(GOOD)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RecipeError, match="too many files"):
        compose("r0")


def test_a_broken_neighbour_does_not_break_the_list(tmp_path, monkeypatch, capsys):
    (tmp_path / "recipes").mkdir()
    monkeypatch.chdir(tmp_path)
    for name, text in BAD_TEXTS.items():
        (tmp_path / "recipes" / f"{name}.yaml").write_text(text)
    for name, content in BAD_BYTES.items():
        (tmp_path / "recipes" / f"{name}.yaml").write_bytes(content)
    os.mkfifo(tmp_path / "recipes" / "pipe.yaml")
    os.mkdir(tmp_path / "recipes" / "folder.yaml")
    assert main(["ls"]) == 0
    out = capsys.readouterr().out
    assert "BROKEN: " in out
    assert "quickstart" in out
    entries = {entry.name: entry for entry in list_recipes()}
    for name in ("billion_laughs", "latin_1", "pipe", "folder", "scalar"):
        assert entries[name].problem
    assert compose("quickstart").name == "quickstart"
    assert validate_paths(["quickstart"])


@pytest.mark.parametrize(
    "expect",
    ["3", "{a: 1}", "[1]", "[{metric: [], min: x, at_env_steps: {}}]"],
)
def test_a_strange_promise_does_not_break_the_list(expect, tmp_path, monkeypatch):
    (tmp_path / "recipes").mkdir()
    (tmp_path / "recipes" / "odd.yaml").write_text(f"{GOOD}expect: {expect}")
    monkeypatch.chdir(tmp_path)
    assert main(["ls"]) == 0


PATHS = (
    "/data/josé/libs",
    "/data/数据",
    "/data/run=3",
    "/data/(stir, spoon, bowl)",
    "/data/lib (copy)",
    "/data/a#2",
    "/data/o'brien",
    '/data/"x"',
    "/data/a,b",
    "/data/[x]",
    "/data/{x}",
    "/data/~x",
    "/data/a:b",
    "/data/a%20b",
    "/data/a&b;c",
    "/data/a@b!",
    "2024",
    "007",
    "1e3",
    "true",
    "[a]",
    "C:/data",
)


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("key", ["motions.library", "run_dir"])
def test_a_path_is_a_path(key, path):
    recipe = compose("quickstart", [f"{key}={path}"])
    found = recipe.run_dir if key == "run_dir" else recipe.motions.library
    assert found == path


def test_a_leading_tilde_is_the_home_folder(monkeypatch):
    monkeypatch.setenv("HOME", "/data/me")
    assert compose("quickstart", ["run_dir=~/a b"]).run_dir == "/data/me/a b"


@pytest.mark.parametrize(
    "folder", ["o'brien", "josé", "a b", "a=b", "a(1)", "a#b", "~"]
)
def test_recipes_are_found_below_any_folder(folder, tmp_path, monkeypatch):
    (tmp_path / folder / "recipes").mkdir(parents=True)
    (tmp_path / folder / "recipes" / "mine.yaml").write_text(GOOD)
    monkeypatch.chdir(tmp_path / folder)
    assert compose("mine").name == "mine"
    assert compose("quickstart", ["ablation=no_future"]).ablation == "no_future"


@pytest.mark.parametrize(
    "text",
    ["a=" + "[" * 5000, "a=" + "9" * 5000, "", "=", "=3", "~", "--m", "a b", "a[0]=1"],
    ids=lambda text: text[:8],
)
def test_an_override_that_is_not_understood_is_one_problem(text):
    parsed, problems = parse_overrides([text])
    assert len(problems) + len(parsed) == 1
    with pytest.raises(RecipeError):
        compose("quickstart", [text])


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (["algo.lr=interval(0,1)"], "one by one"),
        (["seed=glob(*)"], "one by one"),
        (["motions.library=/josé,/b"], "quote each value"),
        ([f"seed=range(0,{10**12})"], str(MAX_RUNS)),
        (["seed=range(0,900)", "algo.lr=1e-3,2e-3"], str(MAX_RUNS)),
    ],
    ids=["interval", "glob", "text", "range", "product"],
)
def test_a_sweep_that_cannot_be_is_refused(texts, expected):
    with pytest.raises(RecipeError, match=expected):
        expand_sweeps(texts)


def test_a_value_of_the_same_recipe_is_filled_in():
    recipe = compose("quickstart", ["run_dir=runs/${motions.count}-${total_env_steps}"])
    assert recipe.run_dir == "runs/4-400000"
    assert compose("quickstart", ["seed=${motions.count}"]).seed == 4


def test_merging_copies_what_it_is_given():
    """A value that an alias shares is changed in one place only."""
    data = parse_yaml("a: &a {x: 1}\nb: *a", where="here")
    merged = merge({}, data)
    merged["a"]["x"] = 2
    assert merged == {"a": {"x": 2}, "b": {"x": 1}}
    assert merge({"a": 1, "b": {"c": 1, "d": 2}}, {"b": {"c": None}, "e": [1]}) == {
        "a": 1,
        "b": {"c": None, "d": 2},
        "e": [1],
    }


def test_plugins_in_the_working_folder_are_not_loaded(tmp_path):
    """Hydra imports every module of the namespace `hydra_plugins` when it composes."""
    (tmp_path / "hydra_plugins").mkdir()
    (tmp_path / "hydra_plugins" / "evil.py").write_text("open('ran', 'w').close()")
    (tmp_path / "mine.yaml").write_text(GOOD)
    code = "from flashdex.recipe import compose, compose_runs; "
    code += "compose('mine.yaml', ['seed=1']); compose_runs('mine.yaml', ['seed=1,2'])"
    paths = os.pathsep.join([str(ROOT), str(tmp_path)])
    env = {**os.environ, "PYTHONPATH": paths}
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=env, check=True)
    assert not (tmp_path / "ran").exists()
