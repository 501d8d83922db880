"""The unattended runner keeps what is finished and records what is not."""

from __future__ import annotations

import importlib
import importlib.util
import sys

import pytest

from flashdex.system.jsonl import read_lines


@pytest.fixture(scope="module")
def suite():
    return load("device_suite")


def load(name):
    return importlib.import_module(f"benchmarks.{name}")


@pytest.fixture
def lines(suite, tmp_path):
    return suite.Lines(tmp_path / "out" / "lines.jsonl", "env")


def written(lines):
    return read_lines(lines.out)


def python(code):
    return lambda words, scratch, **streams: __import__("subprocess").Popen(
        [sys.executable, "-c", code], cwd=scratch, start_new_session=True, **streams
    )


def run(suite, lines, tmp_path, monkeypatch, code, limit=30.0, watch=None):
    monkeypatch.setattr(suite, "start", python(code))
    job = suite.Job("a job", [], limit_s=limit, watch=watch)
    suite.run_job(job, lines, limit_s=limit, scratch=tmp_path)
    return written(lines)


def test_results_are_kept_with_their_job(suite, lines, tmp_path, monkeypatch):
    code = "print('talk'); print('{\"ratio\": 0.5}')"
    (line,) = run(suite, lines, tmp_path, monkeypatch, code)
    assert line["ratio"] == 0.5
    assert line["suite"]["job"] == "a job"
    assert line["suite"]["part"] == "env"


def test_a_failure_is_a_line_with_the_end_of_its_messages(
    suite, lines, tmp_path, monkeypatch
):
    code = "import sys\nfor i in range(50): print(i, file=sys.stderr)\nsys.exit(3)"
    (line,) = run(suite, lines, tmp_path, monkeypatch, code)
    assert line["failed"] == "exit code 3"
    assert line["stderr"] == [str(i) for i in range(30, 50)]


def test_what_was_found_before_the_limit_is_not_lost(
    suite, lines, tmp_path, monkeypatch
):
    code = "import time\nprint('{\"rows\": 1}', flush=True)\ntime.sleep(60)"
    found = run(suite, lines, tmp_path, monkeypatch, code, limit=2.0)
    assert [line.get("rows") for line in found] == [1, None]
    assert found[1]["failed"] == "stopped after 2 s"


def test_a_growing_file_is_followed(suite, lines, tmp_path, monkeypatch):
    watch = tmp_path / "metrics.jsonl"
    record = '{"env_steps": 5, "convert/rate": 0.5, "loss/x": 1}'
    code = f"open({str(watch)!r}, 'w').write('{record}\\n' + '{record}'[:9])"
    (line,) = run(suite, lines, tmp_path, monkeypatch, code, watch=watch)
    line.pop("suite")
    assert line == {"benchmark": "curve", "env_steps": 5, "convert/rate": 0.5}


def test_no_time_left_is_written_for_every_job(suite, lines, tmp_path):
    choice = suite.Choice("cpu", tmp_path, True, 0.1, [], tmp_path)
    suite.run_part("env", choice, lines)
    assert [line["failed"][:9] for line in written(lines)] == ["not begun"] * 2


@pytest.mark.parametrize("tiny", [True, False])
def test_every_part_has_commands_that_exist(suite, tmp_path, tiny):
    from flashdex.cli.main import make_parser

    for part in suite.PARTS:
        choice = suite.Choice("warp", tmp_path, tiny, 9.0, ["seed=1"], tmp_path)
        jobs = suite.jobs_of(part, choice)
        assert len({job.name for job in jobs}) == len(jobs) > 0
        for job in jobs:
            module, *words = job.words
            assert importlib.util.find_spec(module)
            if module.startswith("flashdex"):
                make_parser().parse_args(words)


def test_tables_are_rendered_and_put_between_their_marks():
    table = load("render_table")
    lines = [
        {
            "benchmark": "env",
            "engine": "warp",
            "num_envs": 4096,
            "hulls": [16, 16],
            "ratio": 0.51234,
            "overflow": {"contacts": 3},
            "memory_gb": {"device_used": 12.5},
            "hardware": {"gpu": "G", "torch": "2", "warp": "1", "processor": "P"},
            "commit": "abc",
        },
        {"benchmark": "env", "failed": "stopped", "suite": {"job": "env n8"}},
    ]
    text = table.render(lines)
    assert "| warp | 4,096 | 16, 16 | 0.512 | 3 contacts | 12.5 |" in text
    assert "G, torch 2, warp 1, commit abc" in text
    assert "env n8: stopped." in text
    page = "a\n<!-- table x -->\nold\n<!-- end -->\nb"
    done = table.replace_between(page, "x", "new")
    assert done.startswith("a\n<!-- table x -->\n\nnew\n")
    assert "old" not in done
    assert table.replace_between(done, "x", "new") == done
    with pytest.raises(SystemExit, match="table y"):
        table.replace_between(page, "y", "new")


def test_growth_is_a_median_of_ratios_within_a_round():
    growth = load("env_growth")
    # the second round ran on a machine half as fast
    rounds = [[1.0, 3.0], [2.0, 6.0], [1.0, 30.0]]
    assert growth.relative(rounds, 0) == 1.0
    assert growth.relative(rounds, 1) == 3.0
