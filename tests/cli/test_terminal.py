"""The command and its terminal: nothing steers it, Ctrl-C is heard."""

from __future__ import annotations

import io
import json
import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from flashdex.cli import interrupt
from flashdex.cli.interrupt import INTERRUPTED, loading
from flashdex.cli.main import main
from flashdex.cli.terminal import Formatter, say
from flashdex.cli.terminal import path as terminal_path
from flashdex.errors import RecipeError

ROOT = Path(__file__).parents[2]
STEERING = "a\x1b[31mb\x07\r\x9b2J\u202ec\u2028d\ne"


def exit_code(*words):
    try:
        return main(words)
    except SystemExit as stop:  # argparse's way out
        return stop.code


def run_python(code, *words, **kept):
    env = {**os.environ, "PYTHONPATH": str(ROOT), **kept}
    command = [sys.executable, "-c", code, *words]
    done = subprocess.run(command, capture_output=True, env=env, timeout=120)
    return done.returncode, done.stdout.decode("latin-1"), done.stderr.decode("latin-1")


COMMAND = "import sys; from flashdex.cli.__main__ import start; sys.exit(start())"


def test_control_characters_never_reach_the_terminal(capsys):
    say(STEERING)
    say(STEERING, error=True)
    record = logging.LogRecord("x", logging.INFO, "", 0, "%s", (STEERING,), None)
    captured = capsys.readouterr()
    for text in (captured.out, captured.err, Formatter().format(record)):
        assert not set(text) & set("\x1b\x07\r\x9b\u202e\u2028")
        assert "\\x1b[31m" in text
    error = str(RecipeError([STEERING]))
    assert error.splitlines()[1:] == [r"  1. a\x1b[31mb\x07\r\x9b2J\u202ec\u2028d e"]


LOGS = """
import logging
from flashdex.cli.main import main
main(["ls"])
logging.getLogger("OpenGL.acceleratesupport").info("theirs")
logging.getLogger("other").warning("wrong")
logging.getLogger("flashdex.x").info("ours")
"""


def test_of_other_packages_only_warnings_are_shown():
    _, _, err = run_python(LOGS)
    assert [line.split()[1:] for line in err.splitlines()] == [
        ["other:", "wrong"],
        ["flashdex.x:", "ours"],
    ]


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_any_name_can_be_shown_on_any_terminal(encoding, tmp_path):
    (tmp_path / "瓶é\udcff.yaml").write_text("seed: 1")
    words = ("validate", str(tmp_path))
    code, _, err = run_python(COMMAND, *words, PYTHONIOENCODING=encoding)
    assert code == 2
    assert "Traceback" not in err
    assert "total_env_steps: missing" in err


SWALLOWS = """
import os, signal, sys
from flashdex.cli.interrupt import loading
with loading():
    try:
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000): pass
    except BaseException:
        pass
print("went on")
"""


def test_an_import_cannot_swallow_an_interrupt():
    assert run_python(SWALLOWS)[:2] == (INTERRUPTED, "")


def test_what_ignores_interrupts_still_does():
    """A background job of a shell that has no job control, `nohup`."""
    code = f"import signal; signal.signal(2, signal.SIG_IGN)\n{SWALLOWS}"
    assert run_python(code)[:2] == (0, "went on\n")


def test_somebody_at_a_terminal_is_told_what_takes_long(monkeypatch):
    terminal = io.StringIO()
    monkeypatch.setattr(interrupt, "PATIENCE_S", 0.01)
    monkeypatch.setattr(sys, "stderr", terminal)
    for is_terminal, told in ((False, ""), (True, "loading libraries ...\n")):
        monkeypatch.setattr(terminal, "isatty", lambda a=is_terminal: a)
        with loading():
            time.sleep(0.1)
        assert terminal.getvalue() == told


def test_the_home_folder_may_be_written_as_in_a_shell(monkeypatch):
    monkeypatch.setenv("HOME", "/home/of/mine")
    assert terminal_path("~/a") == Path("/home/of/mine/a")
    assert terminal_path("a/~/b") == Path("a/~/b")


def test_loading_leaves_the_handler_as_it_was():
    before = signal.getsignal(signal.SIGINT)
    with loading():
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("delay", [0.6, 1.2])
def test_an_interrupt_at_the_start_ends_a_verb(delay, tmp_path):
    command = [sys.executable, "-c", COMMAND, "train", "quickstart", "--cfg", "job"]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        command, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=tmp_path
    ) as process:
        time.sleep(delay)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert process.returncode in (INTERRUPTED, 0)  # 0: it was faster
    assert b"Traceback" not in err


HEAVY = "{'torch', 'mujoco', 'numpy', 'scipy', 'trimesh', 'torchrl', 'pydantic'}"
QUICK = {
    "ls": (["ls"], 0),
    "ls_json": (["ls", "--json"], 0),
    "version": (["--version"], 0),
    "unknown_verb": (["trian"], 2),
    "prepare_without_out": (["prepare", "--source", "myodm"], 2),
    "prepare_unknown_source": (["prepare", "--source", "mydm", "--out", "a"], 2),
    "prepare_unknown_hand": (
        ["prepare", "--source", "myodm", "--hand", "x", "--out", "a"],
        2,
    ),
    "prepare_no_input": (
        ["prepare", "--source", "arctic", "--input", "/nowhere", "--out", "a"],
        2,
    ),
    "prepare_rate": (["prepare", "--source", "myodm", "--out", "a", "--hz", "nan"], 2),
    "prepare_limit": (
        ["prepare", "--source", "myodm", "--out", "a", "--limit", "0"],
        2,
    ),
    "prepare_workers": (
        ["prepare", "--source", "myodm", "--out", "a", "--workers", "-1"],
        2,
    ),
    "train_nothing": (["train"], 2),
    "score_nothing_there": (["score", "/nowhere/a.npz"], 2),
    "baselines_out": (["baselines", "quickstart", "--out", "/nowhere/a.json"], 2),
    "cp": (["cp", "quickstrat", "mine.yaml"], 2),
    "prepare_no_mano": (
        ["prepare", "--source", "grab", "--input", "/", "--out", "a"],
        2,
    ),
    "prepare_out_is_a_file": (
        ["prepare", "--source", "procedural", "--out", "/dev/null"],
        2,
    ),
    "train_unknown": (["train", "quickstrat"], 2),
    "train_option": (["train", "quickstart", "ablation=no_futur"], 2),
    "train_grid": (["train", "quickstart", "-m", "seed=interval(0,1)"], 2),
    "train_word": (["train", "quickstart", "seed"], 2),
    "resume_no_run": (["train", "--resume", "/nowhere"], 2),
    "replay_no_run": (["replay", "/nowhere"], 2),
    "report_no_run": (["report", "/nowhere"], 2),
    "validate_unknown": (["validate", "quickstrat"], 2),
    "doctor_unknown": (["doctor", "quickstrat"], 2),
    "baselines_option": (["baselines", "quickstart", "physics=wrap"], 2),
    "score_no_archive": (["score", "/dev/null", __file__], 2),
}


@pytest.mark.parametrize(("words", "expected"), QUICK.values(), ids=QUICK)
def test_what_needs_no_library_loads_none(words, expected, tmp_path):
    code = f"""
import sys
from flashdex.cli.main import main
try:
    code = main({words!r})
except SystemExit as stop:
    code = stop.code
assert not {HEAVY} & set(sys.modules), {HEAVY} & set(sys.modules)
assert not [m for m in sys.modules if m.startswith("flashdex.datasets.") and
            m != "flashdex.datasets.source"]
sys.exit(code)
"""
    found, _, err = run_python(code)
    assert (found, "Traceback" in err) == (expected, False), err


def test_ls_tells_all_that_can_be_named(capsys):
    assert main(["ls"]) == 0
    out = capsys.readouterr().out
    for name in ("no_future", "flashsac_gym", "warp", "wandb", "keypoints", "xhand"):
        assert f" {name} " in f" {out} ".replace("\n", " ")


def test_ls_as_json(capsys):
    assert main(["ls", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {r["name"] for r in found["recipes"]} >= {"quickstart", "bench50_xhand"}
    assert {o["name"] for o in found["options"]["physics"]} == {"cpu", "warp", "brax"}
    assert "xhand" in found["hands"]
    assert found["sources"]["taco"].startswith("TACO: ")


def test_an_option_is_copied_and_validated(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["cp", "ablation/no_future", "recipes/ablation/mine.yaml"]) == 0
    assert main(["validate", "recipes/ablation/mine.yaml", "ablation/ppo"]) == 0
    assert main(["train", "quickstart", "ablation=mine", "--cfg", "job"]) == 0
    copy = tmp_path / "recipes" / "ablation" / "mine.yaml"
    copy.write_text(copy.read_text().replace("future_window", "future_windw"))
    capsys.readouterr()
    assert main(["validate", "recipes/ablation"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 2  # that mistake alone
    assert "Did you mean 'future_window'?" in err
    assert main(["cp", "ablation/no_futur", "x.yaml"]) == 2
    assert "Did you mean 'no_future'?" in capsys.readouterr().err


@pytest.mark.parametrize("group", sorted(p.name for p in (ROOT / "recipes").glob("*/")))
def test_no_option_that_ships_has_a_false_problem(group, capsys):
    folder = ROOT / "recipes" / group
    if folder.is_dir():
        assert main(["validate", str(folder)]) == 0


@pytest.mark.parametrize(
    ("target", "make"),
    [
        ("a.yaml", lambda path: path.write_text("mine")),
        ("a.yaml", lambda path: path.symlink_to("elsewhere")),
        ("a.yaml/b.yaml", lambda path: path.parent.write_text("mine")),
        ("x" * 300, lambda path: None),
    ],
    ids=["file", "link", "below_a_file", "long_name"],
)
def test_cp_never_writes_over_anything(target, make, tmp_path):
    make(tmp_path / target)
    before = sorted(tmp_path.rglob("*"))
    assert exit_code("cp", "quickstart", str(tmp_path / target)) == 2
    assert sorted(tmp_path.rglob("*")) == before


def test_cp_into_a_folder_that_a_slash_says_to_make(tmp_path):
    assert exit_code("cp", "quickstart", f"{tmp_path}/new/") == 0
    assert exit_code("cp", "real_cpu", f"{tmp_path}/new/") == 0
    names = sorted(path.name for path in (tmp_path / "new").iterdir())
    assert names == ["quickstart.yaml", "real_cpu.yaml"]


@pytest.mark.parametrize("word", ["seed=nan", "motions.library=/nowhere"])
def test_a_refused_baselines_leaves_the_file_it_would_replace(word, tmp_path, capsys):
    out = tmp_path / "scores.json"
    out.write_text("of another time")
    words = ["baselines", "quickstart", word, "--out"]
    assert main([*words, str(out)]) == 2
    assert out.read_text() == "of another time"
    assert main([*words, str(tmp_path)]) == 2
    assert "a folder" in capsys.readouterr().err
